//! The rooms, adapters and image encoders that a server answers from, loaded, verified and
//! immutable. [`Loader`] makes a new snapshot when the store has changed; requests in flight keep
//! the one that they began with.

mod content;
mod loading;

use loading::Problem;
pub use loading::{Loader, Refused};

use std::collections::BTreeMap;
use std::sync::Arc;

use super::Error;
use super::auth::RoomScope;
use super::image_encoder::ImageEncoder;
use super::two_views::TwoViewReader;
use crate::store::StoredAdapter;
use seese3_core::eval::TrainedOn;
use seese3_core::features::FeatureSource;
use seese3_core::fitting::RoomReader;
use seese3_core::navigation::Navigator;
use seese3_core::room::Room;
use seese3_core::tracking::Map;

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
    /// One for each adapter that fits the room, in order of preference.
    pub navigators: Vec<Arc<ServedNavigator>>,
    /// Adapters that have the right features and still cannot serve the room, by name.
    refused_adapters: BTreeMap<String, Refusal>,
    /// The adapters that the room was loaded with, names and revisions, in order of preference.
    tried: Vec<(String, u64)>,
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
    /// The reader, of this or another adapter, that the map takes its anchors from.
    tracking_reader: Option<Arc<RoomReader>>,
}

impl ServedRoom {
    /// The reader of the adapter that was fitted to this room, if there is one for features of this
    /// source; that of the newest of several.
    pub fn reader(&self, source: &FeatureSource) -> Option<&RoomReader> {
        reader_of(&self.navigators, source).map(Arc::as_ref)
    }

    /// Whether this room was loaded with exactly these adapters.
    fn was_tried_with(&self, adapters: &[Arc<StoredAdapter>]) -> bool {
        let given = adapters
            .iter()
            .map(|adapter| (&adapter.name, adapter.revision));
        let tried = self.tried.iter().map(|(name, revision)| (name, *revision));
        given.eq(tried)
            && !self
                .refused_adapters
                .values()
                .any(|refusal| refusal.may_pass)
    }

    /// This room under an earlier revision of an adapter, if there is one.
    fn under_any(&self, adapter: &str) -> Option<&Arc<ServedNavigator>> {
        self.navigators
            .iter()
            .find(|served| served.adapter.name == adapter)
    }

    /// This room under an adapter, if trackers there take their anchors from `tracking_reader`.
    fn under(
        &self,
        adapter: &StoredAdapter,
        tracking_reader: Option<&Arc<RoomReader>>,
    ) -> Option<&Arc<ServedNavigator>> {
        let is_same_reader =
            |served: &ServedNavigator| match (&served.tracking_reader, tracking_reader) {
                (Some(before), Some(now)) => Arc::ptr_eq(before, now),
                (None, None) => true,
                _ => false,
            };

        self.navigators
            .iter()
            .find(|served| served.is_of(adapter) && is_same_reader(served))
    }
}

impl ServedNavigator {
    fn is_of(&self, adapter: &StoredAdapter) -> bool {
        self.adapter.name == adapter.name && self.adapter.revision == adapter.revision
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

/// A revision that is in the store and cannot be served.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// The revision.
    pub revision: u64,
    /// Why, in words; it may name files of the store.
    pub reason: String,
    /// Whether it may be different next time: a file that could not be read, not one that is
    /// damaged.
    pub may_pass: bool,
}

impl Refusal {
    fn new(revision: u64, problem: &Problem) -> Self {
        Self {
            revision,
            reason: problem.to_string(),
            may_pass: problem.may_pass(),
        }
    }
}

/// What is refused, by name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Refusals {
    pub rooms: BTreeMap<String, Refusal>,
    pub adapters: BTreeMap<String, Refusal>,
}

/// The current revision of every room and adapter of a store that can be served.
#[derive(Default)]
pub struct Snapshot {
    rooms: BTreeMap<String, Arc<ServedRoom>>,
    /// The adapters that an operator chose, by room.
    default_adapters: BTreeMap<String, String>,
    adapters: BTreeMap<String, Arc<StoredAdapter>>,
    image_encoders: BTreeMap<String, Arc<ImageEncoder>>,
    two_views: Option<Arc<TwoViewReader>>,
    refused: Refusals,
}

impl Snapshot {
    /// What is in the store and cannot be served. An older revision of it may be served instead.
    pub fn refused(&self) -> &Refusals {
        &self.refused
    }

    /// The same with the rooms of `scope` alone, and without adapters that were fitted to others.
    pub fn seen_by(&self, scope: &RoomScope) -> Self {
        let rooms = self.rooms.iter().filter(|(name, _)| scope.contains(name));
        let is_seen = |(_, adapter): &(&String, &Arc<StoredAdapter>)| {
            let fit = adapter.room_fit.as_ref();
            fit.is_none_or(|fit| scope.contains(fit.room.as_str()))
        };
        let refused_rooms = self.refused.rooms.iter();

        let chosen = self.default_adapters.iter();

        Self {
            rooms: owned(rooms),
            default_adapters: owned(chosen.filter(|(name, _)| scope.contains(name))),
            adapters: owned(self.adapters.iter().filter(is_seen)),
            image_encoders: self.image_encoders.clone(),
            two_views: self.two_views.clone(),
            refused: Refusals {
                rooms: owned(refused_rooms.filter(|(name, _)| scope.contains(name))),
                // An adapter may be named after its room.
                adapters: BTreeMap::new(),
            },
        }
    }

    /// How many adapters are refused in one of their rooms, over all rooms.
    pub fn refused_in_rooms(&self) -> usize {
        let rooms = self.rooms.values();
        rooms.map(|room| room.refused_adapters.len()).sum()
    }

    /// Whether both snapshots answer alike: every room and adapter was taken over unchanged.
    pub fn is_like(&self, other: &Self) -> bool {
        fn same<T>(ours: &BTreeMap<String, Arc<T>>, theirs: &BTreeMap<String, Arc<T>>) -> bool {
            let is_same = |((name, ours), (other, theirs)): ((&String, &Arc<T>), _)| {
                let (other, theirs): (&String, &Arc<T>) = (other, theirs);
                name == other && Arc::ptr_eq(ours, theirs)
            };
            ours.len() == theirs.len() && ours.iter().zip(theirs).all(is_same)
        }

        same(&self.rooms, &other.rooms)
            && same(&self.adapters, &other.adapters)
            && same(&self.image_encoders, &other.image_encoders)
            && self.default_adapters == other.default_adapters
            && self.refused == other.refused
    }

    /// The reader of motions between two images, if this server has one.
    pub fn two_views(&self) -> Option<&TwoViewReader> {
        self.two_views.as_deref()
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
    pub fn rooms(&self) -> &BTreeMap<String, Arc<ServedRoom>> {
        &self.rooms
    }

    /// Adapters by name.
    pub fn adapters(&self) -> &BTreeMap<String, Arc<StoredAdapter>> {
        &self.adapters
    }

    /// A room by name.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the name is empty, [`Error::NotFound`] if there is no such room,
    /// [`Error::Precondition`] if it is in the store and cannot be served.
    pub fn room(&self, name: &str) -> Result<&ServedRoom, Error> {
        if name.is_empty() {
            return Err(Error::invalid("room", "is required"));
        }

        let room = self.rooms.get(name).map(Arc::as_ref);
        room.ok_or_else(|| match self.refused.rooms.get(name) {
            Some(refusal) => refused_error("room", name, refusal),
            None => Error::not_found("room", name, self.rooms.keys()),
        })
    }

    /// An adapter by name.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the name is empty, [`Error::NotFound`] if there is no such adapter,
    /// [`Error::Precondition`] if it is in the store and cannot be served.
    pub fn adapter(&self, name: &str) -> Result<&Arc<StoredAdapter>, Error> {
        if name.is_empty() {
            return Err(Error::invalid("adapter", "is required"));
        }

        self.adapters
            .get(name)
            .ok_or_else(|| match self.refused.adapters.get(name) {
                Some(refusal) => refused_error("adapter", name, refusal),
                None => Error::not_found("adapter", name, self.adapters.keys()),
            })
    }

    /// A room under every adapter that fits it, the default first.
    pub fn navigators<'a>(
        &'a self,
        room: &'a ServedRoom,
    ) -> impl Iterator<Item = &'a Arc<ServedNavigator>> {
        let chosen = self.default_adapters.get(room.room.id().as_str());
        let is_chosen = move |served: &&Arc<ServedNavigator>| chosen == Some(&served.adapter.name);
        let first = room.navigators.iter().filter(is_chosen);
        let others = room
            .navigators
            .iter()
            .filter(move |served| !is_chosen(served));
        first.chain(others)
    }

    /// A room under its default adapter: the one that an operator chose, or the one that is preferred.
    fn default_navigator<'a>(
        &'a self,
        room: &'a ServedRoom,
    ) -> Result<&'a Arc<ServedNavigator>, Error> {
        let id = room.room.id();
        let first = self.navigators(room).next();

        // Another adapter in place of the one that was chosen would be a silent change of answers.
        match (self.default_adapters.get(id.as_str()), first) {
            (Some(chosen), first) if first.is_none_or(|first| first.adapter.name != *chosen) => {
                Err(Error::Precondition(format!(
                    "adapter '{chosen}' was chosen as the default of room '{id}' and does not serve \
                     it; name another, or choose another"
                )))
            }
            (_, Some(first)) => Ok(first),
            (_, None) => Err(Error::Precondition(format!(
                "no adapter fits room '{id}'; train one"
            ))),
        }
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
            return self.default_navigator(served);
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

                if let Some(refusal) = served.refused_adapters.get(adapter) {
                    return refused_error("adapter", adapter, refusal);
                }

                let source = &wanted.adapter.source().name;
                Error::Precondition(format!(
                    "room '{room}' has no features '{source}', which adapter '{adapter}' needs"
                ))
            })
    }
}

fn owned<'a, T: Clone + 'a>(
    entries: impl Iterator<Item = (&'a String, &'a T)>,
) -> BTreeMap<String, T> {
    entries
        .map(|(name, entry)| (name.clone(), entry.clone()))
        .collect()
}

/// The caller learns that it is the operator's turn. The reason stays in the log: it may name files.
fn refused_error(kind: &str, name: &str, refusal: &Refusal) -> Error {
    Error::Precondition(format!(
        "{kind} '{name}' cannot be served: its revision {} was refused, and the server's log says why",
        refusal.revision
    ))
}
