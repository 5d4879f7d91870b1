//! `seese3 track --mcap` of a program without the feature `bags`.

use super::{ReceivedAnswers, RecordedView};
use crate::output::not_built;

/// Refused: this program cannot write MCAP.
pub fn recorded(_: &ReceivedAnswers, _: &[RecordedView]) -> anyhow::Result<Vec<u8>> {
    Err(not_built("track --mcap", "bags"))
}
