//! Loading one room under every adapter that fits it.

use std::collections::BTreeMap;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;

use futures_util::FutureExt;

use super::Refusal;
use super::content::Content;
use super::loaded::{Candidate, LoadedRoom, ServedNavigator, reader_of};
use seese3_core::eval::TrainedOn;
use seese3_core::features::Features;
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{FrameId, Room, RoomId};
use seese3_core::training::RoomData;
use seese3_robot::fitting::{Localizer, RoomReader};
use seese3_robot::tracking::Map;
use seese3_store::{RoomFit, Store, StoredAdapter, StoredRoom};

/// Why a room, or a room under an adapter, cannot be served.
#[derive(Debug, thiserror::Error)]
pub(super) enum Problem {
    #[error(transparent)]
    Store(#[from] seese3_store::Error),
    #[error("adapter '{adapter}' does not serve it: {problem}")]
    Navigator {
        adapter: String,
        problem: seese3_core::navigation::Error,
    },
    #[error(
        "adapter '{adapter}' was fitted from revision {revision} of adapter '{base}', which cannot be read: {problem}; \
         publish that again, or fit anew"
    )]
    Base {
        adapter: String,
        base: String,
        revision: u64,
        problem: Box<seese3_store::Error>,
    },
    #[error("adapter '{adapter}' does not locate views in it: {problem}")]
    Localizer {
        adapter: String,
        problem: Box<seese3_robot::fitting::Error>,
    },
    #[error("loading it panicked, which is a defect of this program; the server's log says where")]
    Panicked,
}

impl Problem {
    /// Whether it may be gone at the next look.
    pub(super) fn may_pass(&self) -> bool {
        match self {
            Self::Store(error) => may_pass(error),
            Self::Base { problem, .. } => may_pass(problem),
            Self::Navigator { .. } | Self::Localizer { .. } | Self::Panicked => false,
        }
    }
}

fn may_pass(error: &seese3_store::Error) -> bool {
    use seese3_store::Error as E;

    matches!(
        error,
        E::Io { .. } | E::Absent { .. } | E::Unknown { .. } | E::UnknownRevision { .. }
    )
}

/// Loads one thing such that a panic refuses it alone.
pub(super) async fn contained<T>(
    loading: impl Future<Output = Result<T, Problem>>,
) -> Result<T, Problem> {
    // What the loading had begun is dropped with it.
    let loaded = AssertUnwindSafe(loading).catch_unwind().await;
    loaded.unwrap_or(Err(Problem::Panicked))
}

/// Loads the rooms of a store.
#[derive(Clone)]
pub struct RoomLoader {
    pub store: Store,
    pub index: IndexKind,
}

/// A room that is to be loaded, and what is known of it from before.
pub struct RoomToLoad<'a> {
    pub id: &'a RoomId,
    pub revision: u64,
    pub candidates: &'a [Candidate],
    /// Adapters that were refused when the room was loaded before.
    pub refused_before: BTreeMap<String, Refusal>,
    /// The same revision of the room, if it is in memory.
    pub loaded_before: Option<&'a LoadedRoom>,
}

impl RoomLoader {
    /// A room under its adapters. What did not change since it was served before is taken over.
    ///
    /// # Errors
    /// [`Problem`] if the room itself cannot be loaded. An adapter that cannot serve it is refused
    /// by itself, and its revision before serves on.
    pub async fn load(&self, room: RoomToLoad<'_>) -> Result<LoadedRoom, Problem> {
        let stored = self.store.load_room(room.id.as_str(), Some(room.revision));
        let stored = stored.await?;
        let frames = Arc::new(stored.room.clone());

        let before = room.loaded_before;
        let mut navigators: Vec<Arc<ServedNavigator>> = Vec::new();
        let mut refused = BTreeMap::new();

        for candidate in room.candidates {
            let adapter = &candidate.adapter;
            let served = self
                .under(&stored, &frames, adapter, &navigators, before)
                .await;
            let problem = match served {
                Ok(served) => {
                    navigators.push(served);
                    continue;
                }
                Err(problem) => problem,
            };

            let refusal = Refusal::new(adapter.revision, &problem);
            // What was refused before has been logged.
            if room.refused_before.get(&adapter.name) != Some(&refusal) {
                refusal.log("adapter", &adapter.name);
            }
            refused.insert(adapter.name.clone(), refusal);

            // A failure of the revision before is no news: it served until now.
            if let Some(earlier) = &candidate.earlier {
                let served = self
                    .under(&stored, &frames, earlier, &navigators, before)
                    .await;
                navigators.extend(served.ok());
            }
        }

        Ok(LoadedRoom {
            navigators,
            refused,
        })
    }

    /// The room under one adapter, after those that come `first`.
    async fn under(
        &self,
        stored: &StoredRoom,
        room: &Arc<Room>,
        adapter: &Arc<StoredAdapter>,
        first: &[Arc<ServedNavigator>],
        before: Option<&LoadedRoom>,
    ) -> Result<Arc<ServedNavigator>, Problem> {
        // Fitted adapters come first, so that the reader that trackers are to use is known.
        let tracking_reader = reader_of(first, adapter.adapter.source()).cloned();

        let known = before.and_then(|before| before.under(adapter, tracking_reader.as_ref()));
        match known {
            Some(known) => Ok(known.clone()),
            None => self
                .navigator(stored, room, adapter, tracking_reader)
                .await
                .map(Arc::new),
        }
    }

    /// A room under one adapter. `tracking_reader` gives the anchors of trackers, where an adapter
    /// was fitted to the room.
    async fn navigator(
        &self,
        stored: &StoredRoom,
        room: &Arc<Room>,
        adapter: &Arc<StoredAdapter>,
        tracking_reader: Option<Arc<RoomReader>>,
    ) -> Result<ServedNavigator, Problem> {
        let source = adapter.adapter.source();
        let features = stored
            .features
            .iter()
            .find(|set| set.source().is_like(source));
        let features = features.ok_or_else(|| seese3_store::Error::UnknownFeatures {
            room: room.id().to_string(),
            name: source.name.clone(),
            known: Vec::new(),
        })?;

        let navigator = Navigator::new(room.clone(), features, adapter.adapter.clone(), self.index)
            .map_err(|problem| Problem::Navigator {
                adapter: adapter.name.clone(),
                problem,
            })?;
        log_audit(&navigator, &adapter.name);

        let navigator = Arc::new(navigator);
        let trained_on = self
            .store
            .trained_on(&adapter.record, room.id(), stored.revision)
            .await?;

        // Rules that were measured on other frames say nothing of these.
        let room_data = RoomData {
            room,
            revision: stored.revision,
            features,
        };
        let reader = match &adapter.room_fit {
            Some(fit) if trained_on == TrainedOn::TheseFrames => {
                Some(Arc::new(self.room_reader(adapter, fit, &room_data).await?))
            }
            _ => None,
        };

        Ok(ServedNavigator {
            map: map(&navigator, features, tracking_reader.as_ref()),
            content: Content::of(&navigator),
            trained_on,
            reader,
            tracking_reader,
            room_revision: stored.revision,
            adapter: adapter.clone(),
            navigator,
        })
    }

    /// The reader of a fitted adapter, with the adapter that it began from as a second one.
    async fn room_reader(
        &self,
        adapter: &StoredAdapter,
        fit: &RoomFit,
        data: &RoomData<'_>,
    ) -> Result<RoomReader, Problem> {
        let base = match &fit.base {
            Some(base) => {
                let loaded = self
                    .store
                    .load_adapter(&base.name, Some(base.revision))
                    .await;
                let stored = loaded.map_err(|problem| Problem::Base {
                    adapter: adapter.name.clone(),
                    base: base.name.clone(),
                    revision: base.revision,
                    problem: Box::new(problem),
                })?;
                Some(stored.adapter)
            }
            None => None,
        };

        let mapped: Vec<FrameId> = (0..data.room.frame_count() as u32).map(FrameId).collect();
        let localizer = Localizer::new(data, &mapped, base, Some(adapter.adapter.clone()))
            .map_err(|problem| Problem::Localizer {
                adapter: adapter.name.clone(),
                problem: Box::new(problem),
            })?;

        Ok(RoomReader {
            localizer,
            rules: fit.rules.clone(),
        })
    }
}

fn log_audit(navigator: &Navigator, adapter: &str) {
    if let Some(audit) = navigator.audit() {
        tracing::info!(
            room = %navigator.room().id(), adapter, frames = audit.frame_count, unreachable = audit.unreachable,
            recall = audit.recall, k = audit.k, queries = audit.queries,
            "approximate index audited against the exact scan"
        );
    }
}

/// The map of all frames of a room; none if the adapter is not calibrated. A room that is too small
/// to track in also gives none, which is logged. Where an adapter was fitted to the room, its
/// reader gives the anchors.
fn map(
    navigator: &Arc<Navigator>,
    features: &Features,
    reader: Option<&Arc<RoomReader>>,
) -> Option<Arc<Map>> {
    navigator.adapter().error_model()?;
    let frames: Vec<FrameId> = (0..navigator.room().frame_count() as u32)
        .map(FrameId)
        .collect();

    match Map::new(navigator.clone(), &frames) {
        Ok(map) => {
            let map = map.with_features(features.rows(), &frames);
            Some(Arc::new(match reader {
                Some(reader) => map.with_pose_reader(reader.clone()),
                None => map,
            }))
        }
        Err(error) => {
            tracing::warn!(room = %navigator.room().id(), %error, "the room cannot be tracked in");
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the promise itself: what panics is refused, and tried again only when that is asked for.
    #[tokio::test]
    async fn a_panic_refuses_one_thing() {
        let panicked: Result<(), Problem> = contained(async { panic!("on purpose") }).await;
        let problem = panicked.unwrap_err();
        assert!(matches!(problem, Problem::Panicked) && !problem.may_pass());

        assert_eq!(contained(async { Ok(7) }).await.unwrap(), 7);
    }
}
