//! `seese3 track --mcap` of a program without the feature `bags`.

use super::{Heard, Seen};
use crate::output::not_built;

/// Refused: this program cannot write MCAP.
pub fn recorded(_: &Heard, _: &[Seen]) -> anyhow::Result<Vec<u8>> {
    Err(not_built("track --mcap", "bags"))
}
