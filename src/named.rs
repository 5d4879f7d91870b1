//! Options with a closed set of values, parsed by the names of the values.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use seese3_core::adapter::Reading;
use seese3_core::navigation::Mode;

/// A closed set of values with names.
pub trait ClosedSet: Copy + Send + Sync + 'static {
    /// Every value, in the order of the help text.
    fn all() -> Vec<Self>;

    /// Name of the value, the same on the command line and elsewhere.
    fn name(self) -> &'static str;

    /// Help text of the value.
    fn help(self) -> &'static str;
}

/// The parser of an option with a closed set of values.
pub fn one_of<T: ClosedSet>() -> impl TypedValueParser<Value = T> {
    let possible = T::all()
        .into_iter()
        .map(|value| PossibleValue::new(value.name()).help(value.help()));

    PossibleValuesParser::new(possible).try_map(|name| {
        T::all()
            .into_iter()
            .find(|value| value.name() == name)
            .ok_or("is not one of the possible values")
    })
}

impl ClosedSet for Mode {
    fn all() -> Vec<Self> {
        vec![Self::OpenLoop, Self::Snap, Self::ClosedLoop]
    }

    fn name(self) -> &'static str {
        self.name()
    }

    fn help(self) -> &'static str {
        match self {
            Self::OpenLoop => "Steps add up in latent space, without feedback",
            Self::Snap => "Each step starts from the frame that the previous step retrieved",
            Self::ClosedLoop => {
                "As snap, and the remaining motion to the goal is replanned from the retrieved frame's pose"
            }
        }
    }
}

impl ClosedSet for Reading {
    fn all() -> Vec<Self> {
        Self::ALL.to_vec()
    }

    fn name(self) -> &'static str {
        self.name()
    }

    fn help(self) -> &'static str {
        match self {
            Self::Affine => "Inverts the trained predictor exactly; zero motion changes the latent",
            Self::Homogeneous => "Zero motion keeps the latent; equal parts add up to the whole",
            Self::Literal => "As printed in the paper",
        }
    }
}
