//! Loads one room with every compatible adapter.

use std::collections::BTreeMap;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;

use futures_util::FutureExt;

use super::Refusal;
use super::content::Content;
use super::loaded::{
    Candidate, FittedReader, LoadedRoom, ServedKeypoints, ServedNavigator, reader_of,
};
use seese3_core::eval::TrainedOn;
use seese3_core::features::Features;
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{FrameId, Room, RoomId};
use seese3_core::training::RoomData;
use seese3_robot::fitting::{Localizer, RoomReader};
use seese3_robot::localization::KeypointRoom;
use seese3_robot::tracking::Map;
use seese3_store::{Derived, RoomFit, Store, StoredAdapter, StoredRoom};

/// Errors of loading a room, or one of its adapters.
#[derive(Debug, thiserror::Error)]
pub(super) enum Problem {
    #[error(transparent)]
    Store(#[from] seese3_store::Error),
    #[error("adapter '{adapter}' cannot serve it: {problem}")]
    Navigator {
        adapter: String,
        problem: seese3_core::navigation::Error,
    },
    #[error(
        "adapter '{adapter}' was fitted from revision {revision} of adapter '{base}', which cannot be read: {problem}; \
         publish the base again, or repeat the fit"
    )]
    Base {
        adapter: String,
        base: String,
        revision: u64,
        problem: Box<seese3_store::Error>,
    },
    #[error("adapter '{adapter}' cannot locate views in it: {problem}")]
    Localizer {
        adapter: String,
        problem: Box<seese3_robot::fitting::Error>,
    },
    #[error("loading it panicked, which is a bug in this program; see the server's log")]
    Panicked,
}

impl Problem {
    /// Whether the problem may be temporary.
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

/// Runs a load and converts a panic to [`Problem::Panicked`].
pub(super) async fn contained<T>(
    loading: impl Future<Output = Result<T, Problem>>,
) -> Result<T, Problem> {
    // Unwind safe: partial state of the load is dropped with it.
    let loaded = AssertUnwindSafe(loading).catch_unwind().await;
    loaded.unwrap_or(Err(Problem::Panicked))
}

/// Loads the rooms of a store.
#[derive(Clone)]
pub struct RoomLoader {
    pub store: Store,
    pub index: IndexKind,
}

/// A room to load, with its state in the previous snapshot.
pub struct RoomToLoad<'a> {
    pub id: &'a RoomId,
    pub revision: u64,
    pub candidates: &'a [Candidate],
    /// Adapters that were refused in the previous load.
    pub refused_before: BTreeMap<String, Refusal>,
    /// The previously loaded room, if it is in memory.
    pub loaded_before: Option<&'a LoadedRoom>,
}

/// A room while its adapters are loaded.
struct LoadingRoom<'a> {
    stored: &'a StoredRoom,
    frames: &'a Arc<Room>,
    keypoints: Option<&'a ServedKeypoints>,
}

impl RoomLoader {
    /// Loads a room with its adapters, reusing unchanged parts of the previous load.
    ///
    /// # Errors
    /// [`Problem`] if the room itself cannot be loaded. An adapter that cannot serve it is only
    /// listed as refused, and its previous revision remains in use.
    pub async fn load(&self, room: RoomToLoad<'_>) -> Result<LoadedRoom, Problem> {
        let stored = self.store.load_room(room.id.as_str(), Some(room.revision));
        let stored = stored.await?;
        let frames = Arc::new(stored.room.clone());

        let before = room.loaded_before;
        let keypoints_before = before.and_then(|before| before.keypoints.clone());
        let keypoints = stored.keypoints.as_ref().map(|keypoints| {
            keypoints_before.unwrap_or_else(|| {
                let poses = stored.room.poses().to_vec();
                ServedKeypoints {
                    source: keypoints.source.clone(),
                    room: Arc::new(KeypointRoom::new(poses, keypoints.map.clone())),
                }
            })
        });
        let loaded = LoadingRoom {
            stored: &stored,
            frames: &frames,
            keypoints: keypoints.as_ref(),
        };
        let mut navigators: Vec<Arc<ServedNavigator>> = Vec::new();
        let mut refused = BTreeMap::new();

        for candidate in room.candidates {
            let adapter = &candidate.adapter;
            let served = self.under(&loaded, adapter, &navigators, before).await;
            let problem = match served {
                Ok(served) => {
                    navigators.push(served);
                    continue;
                }
                Err(problem) => problem,
            };

            let refusal = Refusal::new(adapter.revision, &problem);
            // Known refusals were logged before.
            if room.refused_before.get(&adapter.name) != Some(&refusal) {
                refusal.log("adapter", &adapter.name);
            }
            refused.insert(adapter.name.clone(), refusal);

            // A failure of the previous revision is not logged: it served until now.
            if let Some(earlier) = &candidate.earlier {
                let served = self.under(&loaded, earlier, &navigators, before).await;
                navigators.extend(served.ok());
            }
        }

        Ok(LoadedRoom {
            room: frames,
            navigators,
            keypoints,
            tracking: stored.tracking,
            refused,
        })
    }

    /// Loads the room with one adapter, or reuses it from `before`. `first` has the navigators of
    /// preferred adapters.
    async fn under(
        &self,
        room: &LoadingRoom<'_>,
        adapter: &Arc<StoredAdapter>,
        first: &[Arc<ServedNavigator>],
        before: Option<&LoadedRoom>,
    ) -> Result<Arc<ServedNavigator>, Problem> {
        // Fitted adapters come first, so the trackers' reader is already loaded.
        let tracking_reader = reader_of(first, adapter.adapter.source()).cloned();

        let known = before.and_then(|before| before.under(adapter, tracking_reader.as_ref()));
        match known {
            Some(known) => Ok(known.clone()),
            None => self
                .navigator(room, adapter, tracking_reader)
                .await
                .map(Arc::new),
        }
    }

    /// Loads the room with one adapter. `tracking_reader` locates the views of streams, if an
    /// adapter was fitted to the room.
    async fn navigator(
        &self,
        loading: &LoadingRoom<'_>,
        adapter: &Arc<StoredAdapter>,
        tracking_reader: Option<Arc<FittedReader>>,
    ) -> Result<ServedNavigator, Problem> {
        let LoadingRoom {
            stored,
            frames: room,
            keypoints,
        } = loading;
        let source = adapter.adapter.source();
        let refused = |problem| Problem::Navigator {
            adapter: adapter.name.clone(),
            problem,
        };
        let features = Features::of_source(&stored.features, source);
        let features = features.map_err(|problem| refused(problem.into()))?;
        let features = features.ok_or_else(|| seese3_store::Error::UnknownFeatures {
            room: room.id().to_string(),
            name: source.name.clone(),
            known: Vec::new(),
        })?;
        let features: &Features = &features;

        let (navigator, map) = self.navigator_and_map(loading, adapter, features).await?;
        log_audit(&navigator, &adapter.name);
        let trained_on = self
            .store
            .trained_on(&adapter.record, room.id(), stored.revision)
            .await?;

        // Rules measured on other frames are not valid for these.
        let room_data = RoomData {
            room,
            revision: stored.revision,
            features,
        };
        let reader = match &adapter.room_fit {
            Some(fit) if trained_on == TrainedOn::TheseFrames => {
                let reader = self.room_reader(adapter, fit, &room_data).await?;
                Some(Arc::new(FittedReader {
                    adapter: adapter.clone(),
                    reader: Arc::new(reader),
                }))
            }
            _ => None,
        };

        // If an adapter was fitted to the room, its reader locates the views of streams.
        let map = map.map(|map| match &tracking_reader {
            Some(fitted) => map.with_pose_reader(fitted.reader.clone()),
            None => map,
        });
        Ok(ServedNavigator {
            map: map.map(Arc::new),
            content: Content::of(&navigator),
            trained_on,
            reader,
            keypoints: keypoints.cloned(),
            tracking: stored.tracking,
            tracking_reader,
            room_revision: stored.revision,
            adapter: adapter.clone(),
            navigator,
        })
    }

    /// The navigator and the map of all frames, of what the store keeps, else computed and then kept.
    /// There is no map if the adapter is not calibrated, or, with a warning, if the room is too small for
    /// tracking.
    async fn navigator_and_map(
        &self,
        loading: &LoadingRoom<'_>,
        adapter: &StoredAdapter,
        features: &Features,
    ) -> Result<(Arc<Navigator>, Option<Map>), Problem> {
        let room = loading.frames;
        let revision = loading.stored.revision;

        // Without a key, everything is computed.
        let key = self
            .store
            .derived_key(room.id().as_str(), revision, adapter);
        let key = key.await.ok().flatten();
        if let Some(key) = &key
            && let Some(derived) = self.store.load_derived(key).await
            && let Some(made) = self.of_derived(room, adapter, features, derived)
        {
            return Ok(made);
        }

        let navigator = Navigator::new(room.clone(), features, adapter.adapter.clone(), self.index);
        let navigator = Arc::new(navigator.map_err(|problem| Problem::Navigator {
            adapter: adapter.name.clone(),
            problem,
        })?);
        let map = map(&navigator, features);

        if let Some(key) = &key {
            let derived = Derived {
                latents: navigator.latents().to_owned(),
                map: map.as_ref().map(Map::tables),
            };
            if let Err(error) = self.store.keep_derived(key, &derived).await {
                tracing::debug!(%error, "what was derived from a room is not kept");
            }
        }
        Ok((navigator, map))
    }

    /// The navigator and the map of what was derived before; `None` if that does not fit, or if the reason
    /// for having no map has to be found and logged again.
    fn of_derived(
        &self,
        room: &Arc<Room>,
        adapter: &StoredAdapter,
        features: &Features,
        derived: Derived,
    ) -> Option<(Arc<Navigator>, Option<Map>)> {
        let Derived { latents, map } = derived;
        let adapter = adapter.adapter.clone();
        let is_calibrated = adapter.error_model().is_some();
        let navigator = Navigator::of_latents(room.clone(), features, adapter, self.index, latents);
        let navigator = Arc::new(navigator.ok()?);

        let map = match map {
            Some(tables) => Some(Map::of_tables(
                navigator.clone(),
                &all_frames(room),
                tables,
            )?),
            None if is_calibrated => return None,
            None => None,
        };
        Some((navigator, map))
    }

    /// The reader of a fitted adapter, with its base as the second predictor.
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

        let mapped = all_frames(data.room);
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

fn all_frames(room: &Room) -> Vec<FrameId> {
    (0..room.frame_count() as u32).map(FrameId).collect()
}

/// Computes the map of all frames of a room.
fn map(navigator: &Arc<Navigator>, features: &Features) -> Option<Map> {
    navigator.adapter().error_model()?;
    let mapped = all_frames(navigator.room());
    match Map::new(navigator.clone(), &mapped) {
        Ok(map) => Some(map.with_features(features.rows(), &mapped)),
        Err(error) => {
            tracing::warn!(room = %navigator.room().id(), %error, "tracking is unavailable");
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the contract: a panic is a permanent refusal of one resource.
    #[tokio::test]
    async fn a_panic_refuses_one_thing() {
        let panicked: Result<(), Problem> = contained(async { panic!("on purpose") }).await;
        let problem = panicked.unwrap_err();
        assert!(matches!(problem, Problem::Panicked) && !problem.may_pass());

        assert_eq!(contained(async { Ok(7) }).await.unwrap(), 7);
    }
}
