//! All that a server answers from, loaded and verified. Immutable.

use std::collections::BTreeMap;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::eye::{self, Eye, ImageEncoders};
use super::{Error, RunError};
use crate::adapter::Network;
use crate::features::FeatureSource;
use crate::navigation::{IndexKind, Navigator};
use crate::odometry::Map;
use crate::room::{FrameId, Room};
use crate::store::{Store, StoredAdapter};

/// A room that is served.
pub struct ServedRoom {
    /// The room.
    pub room: Arc<Room>,
    /// Its revision.
    pub revision: u64,
    /// When that was published, RFC 3339.
    pub created: String,
    /// What its features were made by.
    pub sources: Vec<FeatureSource>,
    /// One for each adapter that fits, the default first.
    pub navigators: Vec<Arc<ServedNavigator>>,
}

/// A room under an adapter.
pub struct ServedNavigator {
    /// Answers.
    pub navigator: Arc<Navigator>,
    /// What cameras are followed against, if the adapter is calibrated and the room not too small.
    pub map: Option<Arc<Map>>,
    /// With whose numbers.
    pub adapter: Arc<StoredAdapter>,
    /// SHA-256 of what answers are computed from: poses, latents, and how the adapter reads them.
    pub content: [u8; 32],
    /// The room's revision.
    pub room_revision: u64,
    /// Whether the adapter learned from this room, and from which frames of it.
    pub trained_on: Option<TrainedOn>,
}

/// What an adapter learned from, of the room that it serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainedOn {
    /// The frames that are served.
    TheseFrames,
    /// Other frames under the room's name: a test frame of today may have been a training frame.
    OtherFrames,
}

/// Rooms and adapters, newest revisions.
pub struct Snapshot {
    rooms: BTreeMap<String, ServedRoom>,
    adapters: BTreeMap<String, Arc<StoredAdapter>>,
    eyes: BTreeMap<String, Arc<Eye>>,
}

impl Snapshot {
    /// What encodes images for an adapter.
    pub fn eye(&self, adapter: &StoredAdapter) -> Result<&Eye, Error> {
        self.eyes.get(&adapter.name).map(AsRef::as_ref).ok_or_else(|| {
            let encoder = &adapter.adapter.source().encoder;
            Error::Precondition(format!(
                "images cannot be sent for adapter '{}': this server has no encoder '{encoder}'; start it with \
                 --encoder, or send the feature",
                adapter.name
            ))
        })
    }

    /// How many rooms it has.
    pub fn room_count(&self) -> usize {
        self.rooms.len()
    }

    /// How many adapters it has.
    pub fn adapter_count(&self) -> usize {
        self.adapters.len()
    }

    /// Rooms by name.
    pub fn rooms(&self) -> &BTreeMap<String, ServedRoom> {
        &self.rooms
    }

    /// Adapters by name.
    pub fn adapters(&self) -> &BTreeMap<String, Arc<StoredAdapter>> {
        &self.adapters
    }

    /// A room by name.
    pub fn room(&self, name: &str) -> Result<&ServedRoom, Error> {
        if name.is_empty() {
            return Err(Error::invalid("room", "is required"));
        }

        self.rooms.get(name).ok_or_else(|| Error::NotFound {
            field: "room".to_owned(),
            name: name.to_owned(),
        })
    }

    /// An adapter by name.
    pub fn adapter(&self, name: &str) -> Result<&Arc<StoredAdapter>, Error> {
        if name.is_empty() {
            return Err(Error::invalid("adapter", "is required"));
        }

        self.adapters.get(name).ok_or_else(|| Error::NotFound {
            field: "adapter".to_owned(),
            name: name.to_owned(),
        })
    }

    /// A room under the adapter of that name, or under its default if the name is empty.
    pub fn navigator(&self, room: &str, adapter: &str) -> Result<&Arc<ServedNavigator>, Error> {
        let served = self.room(room)?;
        if adapter.is_empty() {
            return served.navigators.first().ok_or_else(|| {
                Error::Precondition(format!("no adapter fits room '{room}'; train one"))
            });
        }

        let wanted = self.adapter(adapter)?;
        served
            .navigators
            .iter()
            .find(|navigator| navigator.adapter.name == wanted.name)
            .ok_or_else(|| {
                let source = &wanted.adapter.source().name;
                Error::Precondition(format!(
                    "room '{room}' has no features '{source}', which adapter '{adapter}' needs"
                ))
            })
    }
}

/// Loads every room and adapter of a store and makes their navigators, off the serving threads.
pub async fn load(
    store: Store,
    index: IndexKind,
    encoders: Option<ImageEncoders>,
) -> Result<Snapshot, RunError> {
    let runtime = tokio::runtime::Handle::current();
    let loading = tokio::task::spawn_blocking(move || {
        runtime.block_on(load_all(&store, index, encoders.as_ref()))
    });

    loading
        .await
        .map_err(|error| RunError::Loading(error.to_string()))?
}

async fn load_all(
    store: &Store,
    index: IndexKind,
    encoders: Option<&ImageEncoders>,
) -> Result<Snapshot, RunError> {
    let mut adapters = BTreeMap::new();
    let mut shared = BTreeMap::new();
    for name in store.adapter_names().await? {
        let stored = store.load_adapter(&name, None).await?;
        // One for all rooms: maps of one adapter are told by it.
        shared.insert(name.clone(), Arc::new(stored.adapter.clone()));
        adapters.insert(name, Arc::new(stored));
    }

    let eyes = eye::open(encoders, &adapters)?;
    let mut rooms = BTreeMap::new();
    for summary in store.rooms().await? {
        let stored = store.load_room(&summary.room, None).await?;
        let room = Arc::new(stored.room);
        let mut fitting: Vec<&Arc<StoredAdapter>> = adapters.values().collect();

        let rank = |a: &StoredAdapter| {
            let learned_here = a.record.rooms.iter().any(|(name, _)| name == room.id());
            (learned_here, a.created.clone(), a.name.clone())
        };
        fitting.sort_by_key(|adapter| std::cmp::Reverse(rank(adapter)));

        let mut navigators = Vec::new();
        for adapter in fitting {
            let source = adapter.adapter.source();
            let Some(features) = stored
                .features
                .iter()
                .find(|features| features.source().is_like(source))
            else {
                continue;
            };

            let Some(computing) = shared.get(&adapter.name) else {
                continue;
            };
            let navigator = Navigator::new(room.clone(), features, computing.clone(), index);
            let navigator = navigator.map_err(|problem| RunError::Navigator {
                adapter: adapter.name.clone(),
                room: room.id().to_string(),
                problem,
            })?;

            log_audit(&navigator, &adapter.name);

            let trained = adapter
                .record
                .rooms
                .iter()
                .find(|(name, _)| name == room.id());

            let trained_on = match trained {
                None => None,
                Some((name, revision))
                    if store
                        .same_frames(name.as_str(), *revision, stored.revision)
                        .await? =>
                {
                    Some(TrainedOn::TheseFrames)
                }
                Some(_) => Some(TrainedOn::OtherFrames),
            };

            let adapter = adapter.clone();
            let room_revision = stored.revision;
            let navigator = Arc::new(navigator);
            let map = map(&navigator);

            let content = content(&navigator);
            let served = ServedNavigator {
                navigator,
                map,
                content,
                adapter,
                room_revision,
                trained_on,
            };

            navigators.push(Arc::new(served));
        }

        let sources = stored
            .features
            .iter()
            .map(|features| features.source().clone())
            .collect();

        let served = ServedRoom {
            room,
            revision: stored.revision,
            created: stored.created,
            sources,
            navigators,
        };

        rooms.insert(summary.room, served);
    }

    if rooms.is_empty() {
        return Err(RunError::NoRoom {
            location: store.location().to_owned(),
        });
    }

    Ok(Snapshot {
        rooms,
        adapters,
        eyes,
    })
}

/// What answers are computed from, hashed: names and revisions of two stores may be the same by
/// chance.
fn content(navigator: &Navigator) -> [u8; 32] {
    let mut digest = Sha256::new();

    let poses = navigator.room().poses().iter().flat_map(|pose| {
        let t = pose.translation.vector;
        let q = pose.rotation.coords;
        [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
    });
    poses
        .chain(navigator.latents().iter().copied())
        .for_each(|x| digest.update(x.to_le_bytes()));

    let adapter = navigator.adapter();
    for parameter in adapter.network().parameters() {
        parameter
            .iter()
            .for_each(|x| digest.update(x.to_le_bytes()));
    }

    digest.update(format!("{:?} {:?}", adapter.scale(), adapter.calibration()));
    digest.finalize().into()
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

/// All frames of a room as a map; none where cameras cannot be followed, which the log says if it
/// is the room's fault.
fn map(navigator: &Arc<Navigator>) -> Option<Arc<Map>> {
    navigator.adapter().calibration()?;
    let frames: Vec<FrameId> = (0..navigator.room().frame_count() as u32)
        .map(FrameId)
        .collect();

    match Map::new(navigator.clone(), &frames) {
        Ok(map) => Some(Arc::new(map)),
        Err(error) => {
            tracing::warn!(room = %navigator.room().id(), %error, "the room cannot be tracked in");
            None
        }
    }
}
