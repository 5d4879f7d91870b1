//! The default adapter of a request or a command: one rule for each task. The service, the command
//! line and the Python client follow these rules; `docs/defaults.md` states them for users.
//!
//! | task | default adapter | function |
//! | --- | --- | --- |
//! | in one room | the room's default, else the first in the order of preference | [`serving_room`] |
//! | in several rooms, or with no room named | the only one that serves them all; adapters fitted to one room do not count | [`across_rooms`] |
//! | evaluation | the most preferred one for which the test pairs are held out | [`for_evaluation`] |

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;

use seese3_core::eval::{Leak, TrainedOn};
use seese3_core::features::FeatureSource;
use seese3_core::room::RoomId;
use seese3_core::splits::Split;

use super::stored_adapter::{RoomFit, StoredAdapter};

/// Why there is no default adapter.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NoDefault {
    /// No adapter serves the rooms.
    #[error("no adapter serves {rooms}; train one, or name one room")]
    NoneServes {
        /// The rooms, as text.
        rooms: String,
    },
    /// Several adapters serve all rooms, and distances under different adapters are not comparable.
    #[error("is required: {} adapters serve these rooms ({})", names.len(), names.join(", "))]
    Several {
        /// Their names.
        names: Vec<String>,
    },
    /// Every adapter was trained on test pairs, or may have been.
    #[error(
        "is required: every adapter of room '{room}' may have been trained on the test pairs{} ({}), so its \
         scores are not held-out scores; name one of them to see these scores, or train one with this split",
        split.map_or_else(String::new, |split| format!(" of the split '{split}'")),
        names.join(", ")
    )]
    AllLeak {
        /// The room.
        room: String,
        /// The split of the request.
        split: Option<Split>,
        /// The names of the adapters.
        names: Vec<String>,
    },
}

/// The adapters that serve one room.
#[derive(Debug, Clone)]
pub struct RoomAdapters<'a> {
    /// The room's name.
    pub room: &'a str,
    /// The default adapter that the operator chose, if any.
    pub chosen: Option<&'a str>,
    /// The adapters, in any order.
    pub adapters: Vec<Arc<StoredAdapter>>,
}

/// Whether an adapter serves a room that has features of these sources. An adapter that is fitted
/// to a room serves only that room.
pub fn serves(adapter: &StoredAdapter, room: &RoomId, sources: &[FeatureSource]) -> bool {
    let has_features = adapter.adapter.source().is_among(sources);
    let is_of_another = |fit: &RoomFit| fit.room != *room;

    has_features && !adapter.room_fit.as_ref().is_some_and(is_of_another)
}

/// The adapters that serve a room, in order of preference: fitted to this room, then trained in it,
/// then newest; adapters of experiments last.
pub fn serving_room<'a>(
    adapters: impl IntoIterator<Item = &'a Arc<StoredAdapter>>,
    room: &RoomId,
    sources: &[FeatureSource],
) -> Vec<Arc<StoredAdapter>> {
    let rank = |adapter: &Arc<StoredAdapter>| {
        let is_trained_here = adapter.record.rooms.iter().any(|(name, _)| name == room);
        (
            !adapter.is_experiment,
            adapter.room_fit.is_some(),
            is_trained_here,
            adapter.created.clone(),
            adapter.name.clone(),
        )
    };

    let adapters = adapters.into_iter();
    let serving = adapters.filter(|adapter| serves(adapter, room, sources));
    let mut ranked: Vec<Arc<StoredAdapter>> = serving.cloned().collect();
    ranked.sort_by_key(|adapter| Reverse(rank(adapter)));
    ranked
}

/// The default adapter of a task in several rooms: the only one that serves them all. Adapters that
/// are fitted to one room do not count, and those of experiments only if there is no other. Of
/// several, the one that is the operator's default in every room.
///
/// # Errors
/// [`NoDefault::NoneServes`] or [`NoDefault::Several`].
pub fn across_rooms(rooms: &[RoomAdapters<'_>]) -> Result<Arc<StoredAdapter>, NoDefault> {
    let mut serving: BTreeMap<&str, (usize, &Arc<StoredAdapter>)> = BTreeMap::new();
    for adapter in rooms.iter().flat_map(|room| &room.adapters) {
        if adapter.room_fit.is_none() {
            serving.entry(&adapter.name).or_insert((0, adapter)).0 += 1;
        }
    }
    let in_all = serving.values().filter(|(count, _)| *count == rooms.len());
    let mut in_all: Vec<&Arc<StoredAdapter>> = in_all.map(|(_, adapter)| *adapter).collect();
    if in_all.iter().any(|adapter| !adapter.is_experiment) {
        in_all.retain(|adapter| !adapter.is_experiment);
    }

    let is_chosen = |adapter: &&&Arc<StoredAdapter>| {
        let mut rooms = rooms.iter();
        rooms.all(|room| room.chosen == Some(adapter.name.as_str()))
    };
    match in_all.as_slice() {
        [] => {
            let names: Vec<String> = rooms
                .iter()
                .map(|room| format!("'{}'", room.room))
                .collect();
            Err(NoDefault::NoneServes {
                rooms: match names.len() {
                    0 => "any room".to_owned(),
                    1..=5 => format!("all these rooms ({})", names.join(", ")),
                    count => format!("all {count} rooms"),
                },
            })
        }
        [only] => Ok((*only).clone()),
        several => match several.iter().find(is_chosen) {
            Some(chosen) => Ok((*chosen).clone()),
            None => Err(NoDefault::Several {
                names: several.iter().map(|adapter| adapter.name.clone()).collect(),
            }),
        },
    }
}

/// An adapter that serves the room of an evaluation.
#[derive(Debug, Clone)]
pub struct EvaluationCandidate {
    /// The adapter.
    pub adapter: Arc<StoredAdapter>,
    /// The overlap of its training set with the room.
    pub trained_on: TrainedOn,
}

/// The room and the protocol of an evaluation, as far as they are stated.
#[derive(Debug, Clone, Copy)]
pub struct EvaluatedRoom<'a> {
    /// The room's name.
    pub room: &'a str,
    /// The default adapter that the operator chose for the room, if any.
    pub chosen: Option<&'a str>,
    /// The split; if absent, that of the adapter's training.
    pub split: Option<Split>,
    /// Frames from the source to the target of a test pair; if absent, that of the adapter's
    /// training.
    pub stride: Option<u32>,
}

/// The default adapter of an evaluation. It is never fitted to the room, and the test pairs are
/// held out from its training. Of several: the room's default, then one that was trained in this
/// room, then one with this stride, then the newest; adapters of experiments last.
///
/// # Errors
/// [`NoDefault::NoneServes`] or [`NoDefault::AllLeak`].
pub fn for_evaluation(
    candidates: &[EvaluationCandidate],
    wanted: EvaluatedRoom<'_>,
) -> Result<Arc<StoredAdapter>, NoDefault> {
    let is_held_out = |candidate: &&EvaluationCandidate| {
        let record = &candidate.adapter.record;
        let split = wanted.split.unwrap_or(record.split);
        candidate.adapter.room_fit.is_none()
            && Leak::of(record, candidate.trained_on, split).is_none()
    };
    let rank = |candidate: &&EvaluationCandidate| {
        let adapter = &candidate.adapter;
        let stride = adapter.record.stride;
        (
            !adapter.is_experiment,
            wanted.chosen == Some(adapter.name.as_str()),
            candidate.trained_on != TrainedOn::Nothing,
            wanted.stride.is_none_or(|wanted| wanted == stride),
            adapter.created.clone(),
            adapter.name.clone(),
        )
    };

    let held_out = candidates.iter().filter(is_held_out);
    if let Some(best) = held_out.max_by_key(rank) {
        return Ok(best.adapter.clone());
    }

    if candidates.is_empty() {
        let rooms = format!("room '{}'", wanted.room);
        return Err(NoDefault::NoneServes { rooms });
    }
    let names = candidates
        .iter()
        .map(|candidate| candidate.adapter.name.clone());
    Err(NoDefault::AllLeak {
        room: wanted.room.to_owned(),
        split: wanted.split,
        names: names.collect(),
    })
}
