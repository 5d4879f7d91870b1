//! Printed summary of the frames of a recording.

use std::collections::{BTreeMap, BTreeSet};

use crate::output::say;
use seese3_core::room::Room;
use seese3_data::datasets::Dropped;

/// Maximum number of dropped frames that are listed one by one; further ones are only counted.
const MOST_LISTED: usize = 20;

/// Prints the facts about the frames that limit their use: sequences, the recording's own split,
/// gaps in the numbering, and images.
pub fn say_frames(room: &Room) {
    let timeline = room.timeline();
    let sequences: BTreeSet<u32> = timeline.sequences.iter().copied().collect();
    if !sequences.is_empty() {
        say(format_args!(
            "sequences: {}; a pair of frames never spans two of them",
            sequences.len()
        ));
    }

    let held_out = timeline
        .held_out
        .iter()
        .filter(|held_out| **held_out)
        .count();

    if !timeline.held_out.is_empty() {
        let train = room.frame_count() - held_out;
        say(format_args!(
            "the recording's own split (--split dataset): {train} training, {held_out} test frames"
        ));
    }

    // Where the recording skipped frames, a stride of k rows spans more time than elsewhere.
    let gaps = room
        .frame_numbers()
        .windows(2)
        .filter(|pair| pair[1].saturating_sub(pair[0]) > 1)
        .count();

    if gaps > 0 {
        say(format_args!(
            "frame numbers have {gaps} gaps: a stride counts frames of the room, not of the recording"
        ));
    }

    let root = &room.provenance().images_root;
    if !room.images().is_empty() {
        say(format_args!("images: {} below {root}", room.images().len()));
    }
}

/// Prints which frames were dropped, and why.
pub fn say_dropped(dropped: &[Dropped]) {
    for frame in dropped.iter().take(MOST_LISTED) {
        say(format_args!("dropped {frame}"));
    }

    // The list ends after MOST_LISTED frames; the counts by reason cover all of them.
    let mut counts = BTreeMap::new();
    for frame in dropped {
        *counts.entry(frame.reason).or_insert(0) += 1;
    }

    if !dropped.is_empty() {
        let counts: Vec<String> = counts
            .iter()
            .map(|(reason, count)| format!("{count} {reason}"))
            .collect();
        say(format_args!(
            "dropped {} frames in all: {}",
            dropped.len(),
            counts.join(", ")
        ));
    }
}
