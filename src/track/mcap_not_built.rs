//! `seese3 track --mcap` in a build without the feature `bags`.

use super::{ReceivedAnswers, RecordedView};
use crate::output::not_built;

/// Fails: this build cannot write MCAP.
pub fn recorded(_: &ReceivedAnswers, _: &[RecordedView]) -> anyhow::Result<Vec<u8>> {
    Err(not_built("track --mcap", "bags"))
}
