//! Options with a closed set of values, parsed by the names of the values.

use std::str::FromStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use strum::{EnumMessage, VariantArray};

/// The parser of an option with a closed set of values.
pub fn one_of<T>() -> impl TypedValueParser<Value = T>
where
    T: VariantArray + EnumMessage + Into<&'static str> + FromStr<Err = strum::ParseError>,
    T: Copy + Send + Sync,
{
    PossibleValuesParser::new(possible_values::<T>()).try_map(|name| name.parse())
}

/// The values in the order of their declaration. As in clap's own derives, the help text of a value
/// is the first paragraph of its documentation.
pub fn possible_values<T>() -> impl Iterator<Item = PossibleValue>
where
    T: VariantArray + EnumMessage + Into<&'static str> + Copy,
{
    T::VARIANTS.iter().map(|&value| {
        let documentation = value.get_documentation().unwrap_or_default();
        let paragraph = documentation.lines().take_while(|line| !line.is_empty());
        let help = paragraph.collect::<Vec<_>>().join(" ");

        let name: &'static str = value.into();
        PossibleValue::new(name).help(help.trim_end_matches('.').to_owned())
    })
}
