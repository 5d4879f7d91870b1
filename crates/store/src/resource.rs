//! Resource names in a store: `rooms/kitchen`, `adapters/base`, `rooms/kitchen/revisions/3`.

use std::fmt;
use std::str::FromStr;

use seese3_core::room::is_plain_name;
use strum::{Display, IntoStaticStr, VariantArray};

/// The two kinds of content in a store.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Display, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "kebab-case")]
pub enum Kind {
    /// A recording of one place, with features.
    Room,
    /// A trained adapter.
    Adapter,
}

impl Kind {
    /// Collection name, which is also the folder name.
    pub fn collection(self) -> &'static str {
        match self {
            Self::Room => "rooms",
            Self::Adapter => "adapters",
        }
    }
}

/// A room or an adapter, or one revision of it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct ResourceName {
    /// Room or adapter.
    pub kind: Kind,
    /// The name within its collection.
    pub name: String,
    /// One revision, or `None` for all.
    pub revision: Option<u64>,
}

impl ResourceName {
    /// The room of this name.
    pub fn room(name: impl Into<String>) -> Self {
        Self {
            kind: Kind::Room,
            name: name.into(),
            revision: None,
        }
    }

    /// The adapter of this name.
    pub fn adapter(name: impl Into<String>) -> Self {
        Self {
            kind: Kind::Adapter,
            name: name.into(),
            revision: None,
        }
    }

    /// This resource, limited to one revision.
    #[must_use]
    pub fn at(self, revision: u64) -> Self {
        Self {
            revision: Some(revision),
            ..self
        }
    }
}

impl fmt::Display for ResourceName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.kind.collection(), self.name)?;
        match self.revision {
            Some(revision) => write!(f, "/revisions/{revision}"),
            None => Ok(()),
        }
    }
}

/// Error: the text is not a valid resource name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{text:?} is not a resource name; write rooms/NAME or adapters/NAME; add /revisions/NUMBER to \
     name one revision"
)]
pub struct ResourceNameError {
    text: String,
}

impl FromStr for ResourceName {
    type Err = ResourceNameError;

    fn from_str(text: &str) -> Result<Self, ResourceNameError> {
        let unfit = || ResourceNameError {
            text: text.chars().take(200).collect(),
        };

        let parts: Vec<&str> = text.split('/').collect();
        let (collection, name, revision) = match parts.as_slice() {
            [collection, name] => (*collection, *name, None),
            [collection, name, "revisions", number] => {
                // Accept only the printed form of a number: no sign, no leading zero.
                let revision: u64 = number.parse().map_err(|_| unfit())?;
                if revision == 0 || revision.to_string() != *number {
                    return Err(unfit());
                }
                (*collection, *name, Some(revision))
            }
            _ => return Err(unfit()),
        };

        let kind = Kind::VARIANTS
            .iter()
            .copied()
            .find(|kind| kind.collection() == collection)
            .ok_or_else(unfit)?;
        if !is_plain_name(name) {
            return Err(unfit());
        }

        Ok(Self {
            kind,
            name: name.to_owned(),
            revision,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: by hand. Printed names parse back, and no other form parses.
    #[test]
    fn names_are_read_as_they_are_printed() {
        for name in [
            ResourceName::room("kitchen"),
            ResourceName::adapter("base").at(12),
        ] {
            assert_eq!(name.to_string().parse(), Ok(name));
        }

        for nonsense in [
            "",
            "kitchen",
            "rooms/",
            "rooms/../adapters",
            "room/kitchen",
            "rooms/kitchen/",
            "rooms/kitchen/revisions",
            "rooms/kitchen/revisions/0",
            "rooms/kitchen/revisions/+1",
            "rooms/kitchen/revisions/01",
            "rooms/kitchen/revisions/1/x",
        ] {
            assert!(nonsense.parse::<ResourceName>().is_err(), "{nonsense}");
        }
    }
}
