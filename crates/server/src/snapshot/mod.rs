//! An immutable, verified snapshot of the rooms, adapters and image encoders that a server uses.
//! [`Loader`] builds a new snapshot when the store changes; requests in flight keep theirs.

mod cache;
mod content;
mod loading;
mod room_loading;
mod loaded;
mod pinned;
mod searches;
mod served;

pub use content::frames_content;
pub use loaded::{FittedReader, ServedKeypoints, ServedNavigator};
pub use loading::{Loader, Refused, RoomMemory};
use pinned::PinnedRevisions;
use room_loading::Problem;
use searches::Searches;
pub use searches::{FoundRooms, Search, SearchedRooms, ServedRooms};
pub use served::ServedRoom;

use std::collections::BTreeMap;
use std::sync::Arc;

use super::Error;
use super::auth::RoomScope;
use super::decoding::DecodingMemory;
use super::image_encoder::ImageEncoder;
use super::metrics::ServedCounts;
use seese3_core::keypoints::KeypointSource;
use seese3_core::splits::Split;
use seese3_store::StoredAdapter;
use seese3_store::adapter_choice::{
    EvaluatedRoom, EvaluationCandidate, NoDefault, RoomAdapters, across_rooms, for_evaluation,
};

/// A stored revision that cannot be served.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// The revision number.
    pub revision: u64,
    /// The reason, as text; it may name files of the store.
    pub reason: String,
    /// Whether the problem may be temporary: an unreadable file, as opposed to a damaged one.
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

    fn log(&self, kind: &str, name: &str) {
        let Self {
            revision, reason, ..
        } = self;
        tracing::error!(kind, name, revision, reason, "a revision cannot be served");
    }
}

/// Everything in the store that cannot be served, by name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Refusals {
    /// Why the newest defaults file is not in effect; an older one is used instead.
    pub defaults: Option<String>,
    pub rooms: BTreeMap<String, Refusal>,
    pub adapters: BTreeMap<String, Refusal>,
}

/// Encoders of keypoints, by what they detect.
type KeypointEncoders = Vec<(KeypointSource, Arc<ImageEncoder>)>;

/// The served rooms and adapters of a store.
#[derive(Default)]
pub struct Snapshot {
    rooms: BTreeMap<String, Arc<ServedRoom>>,
    /// The operator's default adapters, by room.
    default_adapters: BTreeMap<String, String>,
    adapters: BTreeMap<String, Arc<StoredAdapter>>,
    /// By the name of the adapter.
    image_encoders: BTreeMap<String, Arc<ImageEncoder>>,
    /// Encoders of the rooms' keypoints.
    keypoint_encoders: KeypointEncoders,
    /// Memory for decoding images, shared with the encoders.
    decoding: Arc<DecodingMemory>,
    refused: Refusals,
    /// Loads the revisions that requests state; `None` without a store.
    pinned: Option<Arc<PinnedRevisions>>,
    searches: Searches,
}

impl Snapshot {
    /// Memory for decoding images.
    pub fn decoding(&self) -> &DecodingMemory {
        &self.decoding
    }

    /// Refusals found when this snapshot was made. An older revision may be served instead.
    pub fn refused(&self) -> &Refusals {
        &self.refused
    }

    /// This snapshot limited to the rooms of `scope`, without adapters fitted to other rooms.
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
            keypoint_encoders: self.keypoint_encoders.clone(),
            decoding: self.decoding.clone(),
            pinned: self.pinned.clone(),
            searches: Searches::default(),
            refused: Refusals {
                rooms: owned(refused_rooms.filter(|(name, _)| scope.contains(name))),
                // An adapter may be named after its room.
                adapters: BTreeMap::new(),
                defaults: None,
            },
        }
    }

    fn copied(&self) -> Self {
        Self {
            rooms: self.rooms.clone(),
            default_adapters: self.default_adapters.clone(),
            adapters: self.adapters.clone(),
            image_encoders: self.image_encoders.clone(),
            keypoint_encoders: self.keypoint_encoders.clone(),
            decoding: self.decoding.clone(),
            refused: self.refused.clone(),
            pinned: self.pinned.clone(),
            searches: Searches::default(),
        }
    }

    /// A snapshot with only the image encoders.
    pub fn without_rooms(&self) -> Self {
        Self {
            image_encoders: self.image_encoders.clone(),
            keypoint_encoders: self.keypoint_encoders.clone(),
            ..Self::default()
        }
    }

    /// Number of adapters refused in a room, summed over all rooms.
    pub fn refused_in_rooms(&self) -> usize {
        let rooms = self.rooms.values();
        rooms.map(|room| room.refused_adapters().len()).sum()
    }

    /// Number of refused rooms, including those that failed to load on their first request.
    pub fn refused_rooms(&self) -> usize {
        let later = |(name, room): &(&String, &Arc<ServedRoom>)| {
            room.refusal().is_some() && !self.refused.rooms.contains_key(*name)
        };
        self.refused.rooms.len() + self.rooms.iter().filter(later).count()
    }

    /// Counts of served and refused resources, for metrics.
    pub(super) fn counts(&self) -> ServedCounts {
        ServedCounts {
            rooms: self.rooms.len(),
            adapters: self.adapters().len(),
            refused: [
                ("room", self.refused_rooms()),
                ("adapter", self.refused.adapters.len()),
                ("adapter of a room", self.refused_in_rooms()),
                ("defaults", usize::from(self.refused.defaults.is_some())),
            ],
        }
    }

    /// Whether the room is served and no load of it has failed.
    pub fn answers_in(&self, room: &str) -> bool {
        let room = self.rooms.get(room);
        room.is_some_and(|room| room.refusal().is_none())
    }

    /// Whether both snapshots are equivalent: the same rooms, adapters, image encoders, default
    /// adapters and refusals.
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
            && self.keypoint_encoders.len() == other.keypoint_encoders.len()
            && self.default_adapters == other.default_adapters
            && self.refused == other.refused
    }

    /// The image encoder of an adapter.
    ///
    /// # Errors
    /// [`Error::Precondition`] if this server has no encoder for it.
    pub fn image_encoder(&self, adapter: &StoredAdapter) -> Result<&ImageEncoder, Error> {
        self.image_encoders.get(&adapter.name).map(AsRef::as_ref).ok_or_else(|| {
            let encoder = &adapter.adapter.source().encoder;
            Error::Precondition(format!(
                "adapter '{}' cannot be used with images: this server has no encoder '{encoder}'; \
                 start it with --encoder, use another adapter, or send the feature",
                adapter.name
            ))
        })
    }

    /// Any encoder of images, for the limits that all share; `None` if this server has none.
    pub fn any_image_encoder(&self) -> Option<&ImageEncoder> {
        self.image_encoders.values().next().map(AsRef::as_ref)
    }

    /// The adapters whose features this server makes from images.
    pub fn encoded_adapters(&self) -> impl Iterator<Item = &Arc<StoredAdapter>> {
        let names = self.image_encoders.keys();
        names.filter_map(|name| self.adapters.get(name))
    }

    /// The keypoints that this server detects.
    pub fn keypoint_sources(&self) -> impl Iterator<Item = &KeypointSource> {
        self.keypoint_encoders.iter().map(|(source, _)| source)
    }

    /// The encoder of keypoints; `None` if this server has no such encoder.
    pub fn keypoint_encoder(&self, source: &KeypointSource) -> Option<&ImageEncoder> {
        let mut encoders = self.keypoint_encoders.iter();
        let (_, encoder) = encoders.find(|(made, _)| made.is_like(source))?;
        Some(encoder)
    }

    /// An encoder of keypoints for images that are matched with each other: that of a room's
    /// keypoints, else any; `None` if this server has none.
    pub fn keypoint_encoder_for(&self, room: Option<&ServedRoom>) -> Option<&ImageEncoder> {
        let source = room.and_then(|room| room.summary.keypoints.as_ref());
        let of_room = source.and_then(|source| self.keypoint_encoder(source));
        let any = self.keypoint_encoders.first();
        of_room.or_else(|| any.map(|(_, encoder)| encoder.as_ref()))
    }

    /// The rooms of searches that name none.
    pub fn searches(&self) -> &Searches {
        &self.searches
    }

    /// Number of rooms.
    pub fn room_count(&self) -> usize {
        self.rooms.len()
    }

    /// Number of adapters.
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
    pub fn room(&self, name: &str) -> Result<&Arc<ServedRoom>, Error> {
        if name.is_empty() {
            return Err(Error::invalid("room", "is required"));
        }

        self.rooms
            .get(name)
            .ok_or_else(|| match self.refused.rooms.get(name) {
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

    /// The adapters that serve a room, default first.
    pub fn adapters_of(&self, room: &ServedRoom) -> Vec<Arc<StoredAdapter>> {
        let chosen = self.default_adapters.get(room.id.as_str());
        let mut adapters = room.adapters();

        // Stable sort: the others keep their order.
        adapters.sort_by_key(|adapter| chosen != Some(&adapter.name));
        adapters
    }

    /// The default adapter of a room: the operator's choice, or else the most preferred one.
    fn default_adapter(&self, room: &ServedRoom) -> Result<Arc<StoredAdapter>, Error> {
        let id = &room.id;
        let first = self.adapters_of(room).into_iter().next();

        // Falling back to another adapter would silently change the results.
        match (self.default_adapters.get(id.as_str()), first) {
            (Some(chosen), first) if first.as_ref().is_none_or(|first| first.name != *chosen) => {
                Err(Error::Precondition(format!(
                    "adapter '{chosen}' is the default of room '{id}' but does not serve it; name \
                     another adapter, or change the default"
                )))
            }
            (_, Some(first)) => Ok(first),
            (_, None) => Err(Error::Precondition(format!(
                "no adapter fits room '{id}'; fit one with FitAdapter or `seese3 fit`, or upload one for its \
                 features"
            ))),
        }
    }

    /// The navigator of a room and an adapter; the room's default adapter if the name is empty.
    /// Loads the room if it is not in memory: call only on threads that may block.
    ///
    /// # Errors
    /// As [`Snapshot::room`] and [`Snapshot::adapter`]; [`Error::Precondition`] if the room cannot
    /// be loaded, or no adapter, or not the requested one, serves it.
    pub fn navigator(&self, room: &str, adapter: &str) -> Result<Arc<ServedNavigator>, Error> {
        let served = self.room(room)?;

        // Check the name before loading the room.
        if !adapter.is_empty() {
            self.adapter(adapter)?;
        }
        let loaded = served.load()?;
        let wanted = match adapter {
            "" => self.default_adapter(served)?,
            name => self.adapter(name)?.clone(),
        };

        let navigator = loaded.under_any(&wanted.name);
        navigator
            .cloned()
            .ok_or_else(|| does_not_serve(served, &wanted))
    }

    /// The navigator of an evaluation in a room. If no adapter is named: the default adapter of
    /// evaluations, for which the test pairs are held out. Loads the room if it is not in memory.
    ///
    /// # Errors
    /// As [`Snapshot::navigator`]; [`Error::Invalid`] on `adapter` if the test pairs are held out
    /// from no adapter.
    pub fn evaluated(
        &self,
        room: &str,
        adapter: &str,
        pairs: WantedPairs,
    ) -> Result<Arc<ServedNavigator>, Error> {
        if !adapter.is_empty() {
            return self.navigator(room, adapter);
        }

        let loaded = self.room(room)?.load()?;
        let candidate = |served: &Arc<ServedNavigator>| EvaluationCandidate {
            adapter: served.adapter.clone(),
            trained_on: served.trained_on,
        };
        let candidates: Vec<_> = loaded.navigators.iter().map(candidate).collect();
        let wanted = EvaluatedRoom {
            room,
            chosen: self.default_adapters.get(room).map(String::as_str),
            split: pairs.split,
            stride: pairs.stride,
        };
        let best = for_evaluation(&candidates, wanted)?;
        loaded.under_any(&best.name).cloned().ok_or(Error::Internal)
    }

    /// The default adapter of a task in these rooms, among the adapters that `counts` accepts. With
    /// no room: in all rooms that such an adapter serves.
    ///
    /// # Errors
    /// As [`Snapshot::room`]; [`Error::Invalid`] on `adapter` if several adapters serve the rooms,
    /// [`Error::Precondition`] if none does.
    pub fn default_across(
        &self,
        rooms: &[String],
        counts: impl Fn(&StoredAdapter) -> bool,
    ) -> Result<Arc<StoredAdapter>, Error> {
        let of_room = |served: &Arc<ServedRoom>| {
            let mut adapters = served.adapters();
            adapters.retain(|adapter| counts(adapter));
            adapters
        };
        let mut served: Vec<_> = match rooms {
            [] => self
                .rooms
                .values()
                .map(|room| (room, of_room(room)))
                .collect(),
            named => {
                let named = named.iter().map(|name| {
                    let room = self.room(name)?;
                    Ok((room, of_room(room)))
                });
                named.collect::<Result<_, Error>>()?
            }
        };
        if rooms.is_empty() {
            let is_for_any_room = |adapter: &Arc<StoredAdapter>| adapter.room_fit.is_none();
            served.retain(|(_, adapters)| adapters.iter().any(is_for_any_room));
        }

        let served = served.into_iter().map(|(room, adapters)| RoomAdapters {
            room: room.id.as_str(),
            chosen: self
                .default_adapters
                .get(room.id.as_str())
                .map(String::as_str),
            adapters,
        });
        let served: Vec<RoomAdapters<'_>> = served.collect();
        Ok(across_rooms(&served)?)
    }

    /// The default adapter of a task without a room: the only one that is not fitted to a room,
    /// else the only one.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `adapter` if there are several.
    pub fn default_without_room(&self) -> Result<Arc<StoredAdapter>, Error> {
        let mut adapters = self.adapters.values();
        if let (Some(only), None) = (adapters.next(), adapters.next()) {
            return Ok(only.clone());
        }

        let anywhere = RoomAdapters {
            room: "",
            chosen: None,
            adapters: self.adapters.values().cloned().collect(),
        };
        across_rooms(&[anywhere]).map_err(|error| match error {
            NoDefault::NoneServes { .. } => Error::invalid(
                "adapter",
                "is required when no room is named: every adapter is fitted to a room",
            ),
            error => error.into(),
        })
    }
}

impl From<NoDefault> for Error {
    fn from(error: NoDefault) -> Self {
        match error {
            NoDefault::NoneServes { .. } => Self::Precondition(error.to_string()),
            NoDefault::Several { .. } | NoDefault::AllLeak { .. } => {
                Self::invalid("adapter", error)
            }
        }
    }
}

/// The test pairs of an evaluation, as far as a request states them.
#[derive(Debug, Clone, Copy)]
pub struct WantedPairs {
    pub split: Option<Split>,
    pub stride: Option<u32>,
}

/// The error for an adapter that does not serve a room.
fn does_not_serve(room: &ServedRoom, adapter: &StoredAdapter) -> Error {
    let name = &adapter.name;
    if let Some(fit) = &adapter.room_fit
        && fit.room != room.id
    {
        return Error::Precondition(format!(
            "adapter '{name}' was fitted to room '{}' and serves only that room",
            fit.room
        ));
    }

    if let Some(refusal) = room.refused_adapters().get(name) {
        return refused_error("adapter", name, refusal);
    }

    let source = &adapter.adapter.source().name;
    Error::Precondition(format!(
        "room '{}' has no features '{source}', which adapter '{name}' needs",
        room.id
    ))
}

fn owned<'a, T: Clone + 'a>(
    entries: impl Iterator<Item = (&'a String, &'a T)>,
) -> BTreeMap<String, T> {
    entries
        .map(|(name, entry)| (name.clone(), entry.clone()))
        .collect()
}

/// The error for the caller, who must ask the operator. The reason is only logged, since it may
/// name files.
fn refused_error(kind: &str, name: &str, refusal: &Refusal) -> Error {
    Error::Precondition(format!(
        "{kind} '{name}' cannot be served: its revision {} was refused; see the server's log",
        refusal.revision
    ))
}
