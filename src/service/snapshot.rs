//! The rooms, adapters and image encoders that a server answers from, loaded, verified and
//! immutable.

use std::collections::BTreeMap;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::image_encoder::{self, ImageEncoder, ImageEncoders};
use super::two_views::TwoViewReader;
use super::{Error, RunError};
use crate::store::{RoomFit, Store, StoredAdapter, StoredRoom};
use seese3_core::adapter::{Adapter, ErrorStatistics, Network};
use seese3_core::eval::TrainedOn;
use seese3_core::features::FeatureSource;
use seese3_core::fitting::{Localizer, PartRule, ReadingRule, RoomReader};
use seese3_core::navigation::{IndexKind, Navigator};
use seese3_core::room::{FrameId, Room, RoomId};
use seese3_core::tracking::Map;
use seese3_core::training::RoomData;

/// A room that is served.
pub struct ServedRoom {
    /// The room.
    pub room: Arc<Room>,
    /// The revision that is served.
    pub revision: u64,
    /// When this revision was published, RFC 3339.
    pub created: String,
    /// The sources of the room's features: encoder, layer, pooling and preprocessing.
    pub sources: Vec<FeatureSource>,
    /// One for each adapter that fits the room, the default first.
    pub navigators: Vec<Arc<ServedNavigator>>,
}

/// A room under one adapter that fits it.
pub struct ServedNavigator {
    /// Retrieves frames and plans motions in the latents of this adapter.
    pub navigator: Arc<Navigator>,
    /// The map for tracking and relocalisation; none if the adapter is not calibrated or the room
    /// is too small.
    pub map: Option<Arc<Map>>,
    /// The adapter as it is stored, with its training record.
    pub adapter: Arc<StoredAdapter>,
    /// SHA-256 of the numbers that answers depend on: poses, latents, and the adapter's parameters,
    /// scale and calibration.
    pub content: [u8; 32],
    /// The room's revision.
    pub room_revision: u64,
    /// What the adapter has seen of this room.
    pub trained_on: TrainedOn,
    /// Locates single views, where the adapter was fitted to these very frames.
    pub reader: Option<Arc<RoomReader>>,
}

impl ServedRoom {
    /// The reader of the adapter that was fitted to this room, if there is one for features of this
    /// source; that of the newest of several.
    pub fn reader(&self, source: &FeatureSource) -> Option<&RoomReader> {
        reader_of(&self.navigators, source).map(Arc::as_ref)
    }
}

fn reader_of<'a>(
    navigators: &'a [Arc<ServedNavigator>],
    source: &FeatureSource,
) -> Option<&'a Arc<RoomReader>> {
    navigators
        .iter()
        .filter(|served| served.adapter.adapter.source().is_like(source))
        .find_map(|served| served.reader.as_ref())
}

/// The newest revision of every room and adapter of a store.
pub struct Snapshot {
    rooms: BTreeMap<String, ServedRoom>,
    adapters: BTreeMap<String, Arc<StoredAdapter>>,
    image_encoders: BTreeMap<String, Arc<ImageEncoder>>,
    two_views: Option<TwoViewReader>,
}

impl Snapshot {
    /// The reader of motions between two images, if this server has one.
    pub fn two_views(&self) -> Option<&TwoViewReader> {
        self.two_views.as_ref()
    }

    /// The image encoder of an adapter.
    ///
    /// # Errors
    /// [`Error::Precondition`] if this server has no encoder for it.
    pub fn image_encoder(&self, adapter: &StoredAdapter) -> Result<&ImageEncoder, Error> {
        self.image_encoders.get(&adapter.name).map(AsRef::as_ref).ok_or_else(|| {
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
    ///
    /// # Errors
    /// [`Error::Invalid`] if the name is empty, [`Error::NotFound`] if no such room is served.
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
    ///
    /// # Errors
    /// [`Error::Invalid`] if the name is empty, [`Error::NotFound`] if no such adapter is served.
    pub fn adapter(&self, name: &str) -> Result<&Arc<StoredAdapter>, Error> {
        if name.is_empty() {
            return Err(Error::invalid("adapter", "is required"));
        }

        self.adapters.get(name).ok_or_else(|| Error::NotFound {
            field: "adapter".to_owned(),
            name: name.to_owned(),
        })
    }

    /// A room under the adapter of that name, or under the room's default adapter if the name is
    /// empty.
    ///
    /// # Errors
    /// As [`Snapshot::room`] and [`Snapshot::adapter`]; [`Error::Precondition`] if the adapter does
    /// not fit the room, or none does.
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
                if let Some(fit) = &wanted.room_fit
                    && fit.room != *served.room.id()
                {
                    return Error::Precondition(format!(
                        "adapter '{adapter}' was fitted to room '{}' and serves no other",
                        fit.room
                    ));
                }

                let source = &wanted.adapter.source().name;
                Error::Precondition(format!(
                    "room '{room}' has no features '{source}', which adapter '{adapter}' needs"
                ))
            })
    }
}

/// Loads every room and adapter of a store and builds their navigators, on a blocking thread.
///
/// # Errors
/// [`RunError`] if the store is empty or damaged, or if an adapter, a room or an encoder cannot be
/// used.
pub async fn load(
    store: Store,
    index: IndexKind,
    encoders: Option<ImageEncoders>,
) -> Result<Snapshot, RunError> {
    // Loading mixes reads with long computation (embedding, indexing). On an async thread it
    // would hold up the health checks that are answered meanwhile.
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
    for name in store.adapter_names().await? {
        let stored = store.load_adapter(&name, None).await?;
        adapters.insert(name, Arc::new(stored));
    }

    let image_encoders = image_encoder::open(encoders, &adapters)?;
    let two_views = TwoViewReader::open(encoders)?;
    let mut rooms = BTreeMap::new();
    for summary in store.rooms().await? {
        let served = load_room(store, index, &adapters, &summary.room).await?;
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
        image_encoders,
        two_views,
    })
}

/// A room under every adapter that fits it.
async fn load_room(
    store: &Store,
    index: IndexKind,
    adapters: &BTreeMap<String, Arc<StoredAdapter>>,
    name: &str,
) -> Result<ServedRoom, RunError> {
    let StoredRoom {
        room,
        revision,
        created,
        features,
        ..
    } = store.load_room(name, None).await?;
    let room = Arc::new(room);

    let mut navigators = Vec::new();
    for adapter in by_preference(adapters, room.id()) {
        // An adapter that was fitted to a room serves that room alone.
        let is_of_another = |fit: &RoomFit| fit.room != *room.id();
        if adapter.room_fit.as_ref().is_some_and(is_of_another) {
            continue;
        }

        // An adapter fits a room that has features made as its training features were.
        let source = adapter.adapter.source();
        let Some(features) = features.iter().find(|set| set.source().is_like(source)) else {
            continue;
        };

        let navigator = Navigator::new(room.clone(), features, adapter.adapter.clone(), index)
            .map_err(|problem| RunError::Navigator {
                adapter: adapter.name.clone(),
                room: room.id().to_string(),
                problem,
            })?;
        log_audit(&navigator, &adapter.name);

        let navigator = Arc::new(navigator);
        let trained_on = store
            .trained_on(&adapter.record, room.id(), revision)
            .await?;

        // Rules that were measured on other frames say nothing of these.
        let room_data = RoomData {
            room: &room,
            revision,
            features,
        };
        let reader = match &adapter.room_fit {
            Some(fit) if trained_on == TrainedOn::TheseFrames => Some(Arc::new(
                room_reader(store, &adapter, fit, &room_data).await?,
            )),
            _ => None,
        };

        // Fitted adapters come first, so that the reader that trackers are to use is known.
        let tracking_reader = reader_of(&navigators, source);

        navigators.push(Arc::new(ServedNavigator {
            map: map(&navigator, tracking_reader),
            content: content(&navigator, tracking_reader.map(Arc::as_ref)),
            trained_on,
            reader,
            room_revision: revision,
            adapter,
            navigator,
        }));
    }

    Ok(ServedRoom {
        sources: features.iter().map(|set| set.source().clone()).collect(),
        room,
        revision,
        created,
        navigators,
    })
}

/// The reader of a fitted adapter, with the adapter that it began from as a second one.
async fn room_reader(
    store: &Store,
    adapter: &StoredAdapter,
    fit: &RoomFit,
    data: &RoomData<'_>,
) -> Result<RoomReader, RunError> {
    let base = match &fit.base {
        Some(base) => {
            let loaded = store.load_adapter(&base.name, Some(base.revision)).await;
            let stored = loaded.map_err(|problem| RunError::Base {
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
    let localizer =
        Localizer::new(data, &mapped, base, Some(adapter.adapter.clone())).map_err(|problem| {
            RunError::Localizer {
                adapter: adapter.name.clone(),
                room: data.room.id().to_string(),
                problem: Box::new(problem),
            }
        })?;

    Ok(RoomReader {
        localizer,
        rules: fit.rules.clone(),
    })
}

/// Adapters in order of preference, of which the first that fits is a room's default: those fitted
/// to this room first, then those trained in it, then the newest.
fn by_preference(
    adapters: &BTreeMap<String, Arc<StoredAdapter>>,
    room: &RoomId,
) -> Vec<Arc<StoredAdapter>> {
    let rank = |adapter: &StoredAdapter| {
        let is_trained_here = adapter.record.rooms.iter().any(|(name, _)| name == room);
        let is_fitted_here = adapter
            .room_fit
            .as_ref()
            .is_some_and(|fit| fit.room == *room);
        (
            is_fitted_here,
            is_trained_here,
            adapter.created.clone(),
            adapter.name.clone(),
        )
    };

    let mut ranked: Vec<Arc<StoredAdapter>> = adapters.values().cloned().collect();
    ranked.sort_by_key(|adapter| std::cmp::Reverse(rank(adapter)));
    ranked
}

/// SHA-256 of the numbers that answers are computed from. Name and revision do not identify a room
/// or adapter across stores: two stores may use the same ones for different content.
fn content(navigator: &Navigator, reader: Option<&RoomReader>) -> [u8; 32] {
    let mut digest = ContentDigest(Sha256::new());

    // Every number enters with all its bits, so that states resume only where the tracker would
    // compute exactly the same.
    for pose in navigator.room().poses() {
        digest.numbers(&pose.translation.vector);
        digest.numbers(&pose.rotation.coords);
    }
    digest.numbers(navigator.latents());

    let adapter = navigator.adapter();
    digest.adapter(adapter);

    if let Some(reader) = reader {
        for adapter in reader.localizer.adapters() {
            digest.adapter(adapter);
        }
        for rule in reader.rules.rules() {
            digest.reading_rule(rule);
        }
    }

    if let Some(error_model) = adapter.error_model() {
        digest.error_statistics(error_model.statistics());
    }

    digest.0.finalize().into()
}

/// A hash of numbers, in a fixed order.
struct ContentDigest(Sha256);

impl ContentDigest {
    fn numbers<'a>(&mut self, numbers: impl IntoIterator<Item = &'a f64>) {
        for number in numbers {
            self.0.update(number.to_le_bytes());
        }
    }

    fn adapter(&mut self, adapter: &Adapter) {
        for parameter in adapter.network().parameters() {
            self.numbers(&parameter.mapv(f64::from));
        }
        self.numbers(&adapter.scale().mean);
        self.numbers(&adapter.scale().deviation);
    }

    fn reading_rule(&mut self, rule: &ReadingRule) {
        // Destructured with no `..`, so that a new field breaks the build here.
        let ReadingRule {
            up_to,
            translation,
            rotation,
            covariance,
            least_disagreement,
        } = rule;

        self.numbers([up_to, least_disagreement]);
        self.numbers(covariance);
        for PartRule { reader, gain } in [translation, rotation] {
            self.0.update(reader.name());
            self.numbers([gain]);
        }
    }

    fn error_statistics(&mut self, statistics: &ErrorStatistics) {
        // Destructured with no `..`, so that a new statistic breaks the build here.
        let ErrorStatistics {
            frame_noise,
            motion_spread,
            motion_errors,
            anchor_errors,
            out_of_distribution_ratio,
            certain_match_ratio,
            jump_distance,
            map_pose_factor,
        } = statistics;

        self.numbers(frame_noise);
        self.numbers(motion_spread);
        for table in [&motion_errors.shapes, anchor_errors] {
            for stratum in table.strata() {
                self.numbers([&stratum.at, &stratum.gain]);
                self.numbers(&stratum.covariance);
            }
        }
        self.numbers([
            &motion_errors.floor,
            out_of_distribution_ratio,
            certain_match_ratio,
            jump_distance,
            map_pose_factor,
        ]);
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
/// to track in also gives none, which is logged. Where an adapter was fitted to the room, its reader
/// gives the anchors.
fn map(navigator: &Arc<Navigator>, reader: Option<&Arc<RoomReader>>) -> Option<Arc<Map>> {
    navigator.adapter().error_model()?;
    let frames: Vec<FrameId> = (0..navigator.room().frame_count() as u32)
        .map(FrameId)
        .collect();

    match Map::new(navigator.clone(), &frames) {
        Ok(map) => Some(Arc::new(match reader {
            Some(reader) => map.with_pose_reader(reader.clone()),
            None => map,
        })),
        Err(error) => {
            tracing::warn!(room = %navigator.room().id(), %error, "the room cannot be tracked in");
            None
        }
    }
}
