//! Loads a store into a [`Snapshot`], at the start and whenever the store changes.
//!
//! - Unchanged parts are reused from the previous snapshot, so that a reload costs only what
//!   changed.
//! - A room or adapter that cannot be loaded is refused individually, and its previously served
//!   revision remains in use. Without preloading, only the manifest of a room is checked at this
//!   point, unless its previous revision is in memory.
//! - A damaged revision is retried only when the operator asks for it (`Reload::requested`); an
//!   unreadable one is retried at every reload.

use std::collections::BTreeMap;
use std::num::NonZero;
use std::sync::Arc;

use futures_util::StreamExt;
use tokio::runtime::Handle;

use super::super::DECODING;
use super::super::decoding::DecodingMemory;
use super::super::image_encoder::{self, ImageEncoder, ImageEncoders};
use super::super::metrics::Metrics;
use super::super::{Config, RunError};
use super::cache::RoomCache;
use super::loaded::Candidate;
use super::pinned::PinnedRevisions;
use super::room_loading::{Problem, RoomLoader, contained};
use super::searches::Searches;
use super::served::ServedRoom;
use super::{Refusal, Snapshot};
use seese3_core::features::FeatureSource;
use seese3_core::keypoints::KeypointSource;
use seese3_core::room::RoomId;
use seese3_encoder::Encoder;
use seese3_store::adapter_choice::serving_room;
use seese3_store::{Defaults, Kind, StandingDefaults, Store, StoredAdapter};

/// Whether previously refused revisions are retried.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refused {
    TryAgain,
    LeaveOut,
}

/// Memory policy for rooms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RoomMemory {
    /// Whether every room is loaded, and so verified, before it is served. Otherwise it is loaded
    /// on its first request.
    pub preload: bool,
    /// Approximate memory limit of all loaded rooms, bytes; `None` for no limit.
    pub bytes: Option<usize>,
}

impl Default for RoomMemory {
    fn default() -> Self {
        Self {
            preload: true,
            bytes: None,
        }
    }
}

/// Result of loading a room for a snapshot.
struct TriedRoom {
    served: Option<Arc<ServedRoom>>,
    /// Why the current revision is not served, if so.
    refusal: Option<Refusal>,
}

/// Builds the snapshots of one server.
#[derive(Clone)]
pub struct Loader {
    store: Store,
    rooms: Arc<RoomCache>,
    pinned: Arc<PinnedRevisions>,
    memory: RoomMemory,
    encoders: Option<ImageEncoders>,
    decoding: Arc<DecodingMemory>,
    metrics: Metrics,
}

impl Loader {
    /// Creates a loader of `store`. Reads the operator's models, on a blocking thread.
    ///
    /// # Errors
    /// [`RunError::Model`] if a model cannot be used.
    pub async fn open(store: Store, config: &Config) -> Result<Self, RunError> {
        let Config {
            index,
            rooms: memory,
            encoders,
            metrics,
            memory_bytes,
            ..
        } = config.clone();
        let decoding = Arc::new(DecodingMemory::new((memory_bytes / DECODING) as u64));

        blocking(move || {
            if let Some(encoders) = &encoders {
                image_encoder::check_models(&encoders.models)?;
            }

            let loader = RoomLoader {
                store: store.clone(),
                index,
            };
            let rooms = Arc::new(RoomCache::new(loader, memory.bytes));
            count_rooms(&rooms, &metrics);

            Ok(Self {
                pinned: Arc::new(PinnedRevisions::new(store.clone(), rooms.clone())),
                store,
                rooms,
                memory,
                encoders,
                decoding,
                metrics,
            })
        })
        .await
    }

    /// Builds the first snapshot. A store without rooms is an error unless this server can add
    /// rooms.
    ///
    /// # Errors
    /// [`RunError::Store`] if the store cannot be listed, [`RunError::NoRoom`] if it has no room,
    /// [`RunError::NoneServed`] if none of its rooms can be served.
    pub async fn first(&self, is_writable: bool) -> Result<Snapshot, RunError> {
        let location = self.store.location().to_owned();
        let snapshot = self
            .load(Arc::new(Snapshot::default()), Refused::TryAgain)
            .await?;

        if !snapshot.rooms.is_empty() {
            if let Some(encoders) = &self.encoders {
                let rooms = snapshot.rooms.values();
                let keypoints = rooms.filter_map(|room| room.summary.keypoints.as_ref());
                image_encoder::warn_of_unneeded(&encoders.models, &snapshot.adapters, keypoints);
            }
            return Ok(snapshot);
        }
        match snapshot.refused.rooms.iter().next() {
            None if is_writable => Ok(snapshot),
            None => Err(RunError::NoRoom { location }),
            Some((room, refusal)) => Err(RunError::NoneServed {
                room: room.clone(),
                reason: refusal.reason.clone(),
            }),
        }
    }

    /// Whether the store has, or ever had, rooms. False for a store that has disappeared, for
    /// instance with its disk.
    pub async fn remembers_rooms(&self) -> bool {
        self.store.remembers(Kind::Room).await.unwrap_or(false)
    }

    /// Builds a snapshot on a blocking thread, loading only what differs from `before`.
    ///
    /// # Errors
    /// [`RunError::Store`] if the store cannot be listed. Other problems are refusals in the
    /// snapshot.
    pub async fn load(
        &self,
        before: Arc<Snapshot>,
        refused: Refused,
    ) -> Result<Snapshot, RunError> {
        // Loading mixes file access with long computation (embedding, indexing), which would block
        // health checks and requests on an async thread.
        let loader = self.clone();
        let runtime = Handle::current();
        blocking(move || runtime.block_on(loader.load_now(&before, refused))).await
    }

    async fn load_now(
        &self,
        before: &Arc<Snapshot>,
        refused: Refused,
    ) -> Result<Snapshot, RunError> {
        let mut loaded = Snapshot {
            decoding: self.decoding.clone(),
            pinned: Some(self.pinned.clone()),
            searches: Searches::new(self.memory.bytes.is_none()),
            ..Snapshot::default()
        };

        let defaults = self.defaults(&mut loaded, before).await?;
        for (name, revision) in self.store.current_adapters(&defaults).await? {
            self.add_adapter(&mut loaded, before, refused, name, revision)
                .await;
        }
        self.add_image_encoders(&mut loaded, before, refused);

        let rooms = self.store.current_rooms(&defaults).await?;
        for (name, _) in &rooms {
            let chosen = defaults.adapter(name).map(str::to_owned);
            loaded
                .default_adapters
                .extend(chosen.map(|adapter| (name.clone(), adapter)));
        }
        self.add_rooms(&mut loaded, before, refused, rooms).await?;
        self.add_keypoint_encoders(&mut loaded, before);

        Ok(loaded)
    }

    /// Adds the current revisions of rooms. At the start, rooms are loaded in parallel on all
    /// processors; later one by one, to leave processors for requests.
    async fn add_rooms(
        &self,
        loaded: &mut Snapshot,
        before: &Arc<Snapshot>,
        refused: Refused,
        rooms: Vec<(String, u64)>,
    ) -> Result<(), RunError> {
        let at_once = match before.rooms.is_empty() {
            true => std::thread::available_parallelism().map_or(1, NonZero::get),
            false => 1,
        };
        let adapters = Arc::new(loaded.adapters.clone());
        let tried = rooms.into_iter().map(|(name, revision)| {
            let (loader, before, adapters) = (self.clone(), before.clone(), adapters.clone());
            let runtime = Handle::current();
            blocking(move || {
                let tried = loader.tried_room(&name, revision, &adapters, &before, refused);
                let tried = runtime.block_on(tried);
                Ok((name, tried))
            })
        });

        let mut tried = futures_util::stream::iter(tried).buffered(at_once);
        while let Some(tried) = tried.next().await {
            let (name, TriedRoom { served, refusal }) = tried?;
            loaded.rooms.extend(served.map(|room| (name.clone(), room)));
            let refusals = &mut loaded.refused.rooms;
            refusals.extend(refusal.map(|refusal| (name, refusal)));
        }

        Ok(())
    }

    /// The operator's defaults; if their newest file is damaged, the previous ones.
    async fn defaults(
        &self,
        loaded: &mut Snapshot,
        before: &Snapshot,
    ) -> Result<Defaults, RunError> {
        let StandingDefaults { defaults, refused } = self.store.standing_defaults().await?;

        let reason = refused.map(|problem| problem.to_string());
        if let Some(reason) = &reason
            && before.refused.defaults.as_ref() != Some(reason)
        {
            tracing::error!(
                reason,
                "the newest defaults file cannot be read: the previous defaults are in effect, if \
                 any; roll back the last change with `seese3 store default --back`"
            );
        }

        loaded.refused.defaults = reason;
        Ok(defaults)
    }

    /// Adds the current revision of an adapter or, if it is refused, the previously served one.
    async fn add_adapter(
        &self,
        loaded: &mut Snapshot,
        before: &Snapshot,
        refused: Refused,
        name: String,
        revision: u64,
    ) {
        let known = before.adapters.get(&name);
        if let Some(same) = known.filter(|known| known.revision == revision) {
            loaded.adapters.insert(name, same.clone());
            return;
        }

        let refusal = match kept(&before.refused.adapters, &name, revision, refused) {
            Some(refusal) => refusal,
            None => match self.adapter(&name, revision).await {
                Ok(stored) => {
                    loaded.adapters.insert(name, Arc::new(stored));
                    return;
                }
                Err(problem) => {
                    let refusal = Refusal::new(revision, &problem);
                    log_refusal(
                        "adapter",
                        &name,
                        before.refused.adapters.get(&name),
                        &refusal,
                    );
                    refusal
                }
            },
        };

        if let Some(known) = known {
            loaded.adapters.insert(name.clone(), known.clone());
        }
        loaded.refused.adapters.insert(name, refusal);
    }

    async fn adapter(&self, name: &str, revision: u64) -> Result<StoredAdapter, Problem> {
        let load = async { Ok(self.store.load_adapter(name, Some(revision)).await?) };
        contained(load).await
    }

    /// Adds the image encoders of all adapters. An adapter whose encoder cannot be used is served
    /// without it: callers may still send features. A failed encoder is retried on request.
    fn add_image_encoders(&self, loaded: &mut Snapshot, before: &Snapshot, refused: Refused) {
        let Some(encoders) = &self.encoders else {
            return;
        };

        // Adapters with the same feature source share one encoder, because loading a model is
        // expensive.
        let mut opened: Vec<(FeatureSource, Option<Arc<ImageEncoder>>)> = Vec::new();
        for (name, adapter) in &before.adapters {
            let encoder = before.image_encoders.get(name).cloned();
            if encoder.is_some() || refused == Refused::LeaveOut {
                opened.push((adapter.adapter.source().clone(), encoder));
            }
        }

        for (name, adapter) in &loaded.adapters {
            let source = adapter.adapter.source();
            let encoder = match opened.iter().find(|(other, _)| other.is_like(source)) {
                Some((_, encoder)) => encoder.clone(),
                None => {
                    let encoder = opened_for(name, source, encoders, self.decoding.clone())
                        .map(|encoder| Arc::new(encoder.counted_in(self.metrics.clone())));
                    opened.push((source.clone(), encoder.clone()));
                    encoder
                }
            };
            if let Some(encoder) = encoder {
                loaded.image_encoders.insert(name.clone(), encoder);
            }
        }
    }

    /// Adds the encoders of the rooms' keypoints. A room whose encoder cannot be used is served
    /// without matching keypoints.
    fn add_keypoint_encoders(&self, loaded: &mut Snapshot, before: &Snapshot) {
        let Some(encoders) = &self.encoders else {
            return;
        };

        let mut tried: Vec<KeypointSource> = Vec::new();
        for (name, room) in &loaded.rooms {
            let Some(source) = &room.summary.keypoints else {
                continue;
            };
            if tried.iter().any(|other| other.is_like(source)) {
                continue;
            }
            tried.push(source.clone());

            let mut known = before.keypoint_encoders.iter();
            if let Some(known) = known.find(|(other, _)| other.is_like(source)) {
                loaded.keypoint_encoders.push(known.clone());
                continue;
            }

            match Encoder::of_keypoints(source, &encoders.models, &encoders.runtime) {
                Ok(Some(encoder)) => {
                    let encoder = ImageEncoder::new(encoder, encoders, self.decoding.clone());
                    let encoder = Arc::new(encoder.counted_in(self.metrics.clone()));
                    loaded.keypoint_encoders.push((source.clone(), encoder));
                }
                Ok(None) => tracing::warn!(
                    room = name,
                    encoder = source.feature.encoder,
                    "no --encoder detects the room's keypoints; views are not matched with them"
                ),
                Err(problem) => tracing::error!(
                    room = name, %problem, "no encoder of keypoints; views are not matched with them"
                ),
            }
        }
    }

    /// Loads the current revision of a room; if it is refused, the previously served one remains.
    async fn tried_room(
        &self,
        name: &str,
        revision: u64,
        adapters: &BTreeMap<String, Arc<StoredAdapter>>,
        before: &Snapshot,
        refused: Refused,
    ) -> TriedRoom {
        let known = before.rooms.get(name);
        let same = known.filter(|known| known.summary.revision == revision);
        if let Some(same) = same
            && is_up_to_date(same, adapters, refused)
        {
            return TriedRoom {
                served: Some(same.clone()),
                refusal: None,
            };
        }

        let refusal = match kept(&before.refused.rooms, name, revision, refused) {
            Some(refusal) => refusal,
            None => match self.room(name, revision, adapters, known).await {
                Ok(room) => {
                    return TriedRoom {
                        served: Some(Arc::new(room)),
                        refusal: None,
                    };
                }
                Err(refusal) => {
                    log_refusal("room", name, before.refused.rooms.get(name), &refusal);
                    refusal
                }
            },
        };

        TriedRoom {
            served: known.cloned(),
            refusal: Some(refusal),
        }
    }

    /// Builds a room to serve. `known` is the previously served room: if it is in memory, the new
    /// one is loaded now, so that no request has to wait.
    async fn room(
        &self,
        name: &str,
        revision: u64,
        adapters: &BTreeMap<String, Arc<StoredAdapter>>,
        known: Option<&Arc<ServedRoom>>,
    ) -> Result<ServedRoom, Refusal> {
        let refusal =
            |problem: seese3_store::Error| Refusal::new(revision, &Problem::Store(problem));

        let summary = self.store.room_summary(name, Some(revision)).await;
        let summary = summary.map_err(refusal)?;
        let id = RoomId::new(name).map_err(|error| {
            refusal(seese3_store::Error::Damaged {
                file: format!("rooms/{name}"),
                problem: error.into(),
            })
        })?;

        let served = known.map_or_else(Vec::new, |known| known.adapters());
        let candidate = |adapter: Arc<StoredAdapter>| {
            let is_earlier = |served: &&Arc<StoredAdapter>| {
                served.name == adapter.name && served.revision != adapter.revision
            };
            Candidate {
                earlier: served.iter().find(is_earlier).cloned(),
                adapter,
            }
        };
        let serving = serving_room(adapters.values(), &id, &summary.features);
        let candidates = serving.into_iter().map(candidate).collect();

        let room = ServedRoom::new(id, summary, candidates, self.rooms.clone());
        if self.memory.preload || known.is_some_and(|known| known.in_memory().is_some()) {
            let same = known.filter(|known| known.summary.revision == revision);
            room.preload(same.map(AsRef::as_ref)).await?;
        }
        Ok(room)
    }
}

/// Registers gauges of the rooms in memory.
fn count_rooms(rooms: &Arc<RoomCache>, metrics: &Metrics) {
    let counted = rooms.clone();
    metrics.gauge_elsewhere(
        "rooms_in_memory",
        "Rooms whose frames, latents and indexes are in memory",
        move || counted.size().0,
    );

    let counted = rooms.clone();
    metrics.gauge_elsewhere(
        "rooms_in_memory_bytes",
        "Approximate size of the rooms in memory",
        move || counted.size().1,
    );
}

/// Whether the room need not be rebuilt.
fn is_up_to_date(
    room: &ServedRoom,
    adapters: &BTreeMap<String, Arc<StoredAdapter>>,
    refused: Refused,
) -> bool {
    let serving = serving_room(adapters.values(), &room.id, &room.summary.features);
    let tried = room.candidates.iter().map(|candidate| &candidate.adapter);
    let is_same = |(tried, now): (&Arc<StoredAdapter>, &Arc<StoredAdapter>)| {
        (&tried.name, tried.revision) == (&now.name, now.revision)
    };
    if tried.len() != serving.len() || !tried.zip(&serving).all(is_same) {
        return false;
    }

    let in_room = room.refused_adapters();
    let of_room = room.refusal();
    let mut refusals = in_room.values().chain(&of_room);
    match refused {
        Refused::TryAgain => refusals.next().is_none(),
        Refused::LeaveOut => !refusals.any(|refusal| refusal.may_pass),
    }
}

/// Runs work on a blocking thread.
async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, RunError> + Send + 'static,
) -> Result<T, RunError> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(RunError::Loading)?
}

/// Logs a refusal, unless it is already known.
fn log_refusal(kind: &str, name: &str, known: Option<&Refusal>, refusal: &Refusal) {
    if known != Some(refusal) {
        refusal.log(kind, name);
    }
}

/// The previous refusal of this revision, if it is not to be retried.
fn kept(
    before: &BTreeMap<String, Refusal>,
    name: &str,
    revision: u64,
    refused: Refused,
) -> Option<Refusal> {
    before
        .get(name)
        .filter(|refusal| refused == Refused::LeaveOut && refusal.revision == revision)
        .filter(|refusal| !refusal.may_pass)
        .cloned()
}

/// Opens the image encoder of an adapter; `None` if it is not available or cannot be used, which is
/// logged.
fn opened_for(
    adapter: &str,
    source: &FeatureSource,
    encoders: &ImageEncoders,
    decoding: Arc<DecodingMemory>,
) -> Option<ImageEncoder> {
    let opened: Result<_, seese3_encoder::Error> =
        image_encoder::open_for(adapter, source, encoders, decoding);
    opened.unwrap_or_else(|problem| {
        tracing::error!(adapter, %problem, "no image encoder; the adapter takes only features");
        None
    })
}
