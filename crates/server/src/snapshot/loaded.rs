//! A room loaded into memory.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::Refusal;
use super::content::Content;
use seese3_core::eval::TrainedOn;
use seese3_core::features::FeatureSource;
use seese3_core::keypoints::KeypointSource;
use seese3_core::navigation::Navigator;
use seese3_core::room::Room;
use seese3_robot::fitting::RoomReader;
use seese3_robot::localization::KeypointRoom;
use seese3_robot::pose_filter::FilterParameters;
use seese3_robot::tracking::Map;
use seese3_store::StoredAdapter;

/// An adapter whose features a room has.
#[derive(Clone)]
pub struct Candidate {
    /// The revision to serve.
    pub adapter: Arc<StoredAdapter>,
    /// The previously served revision, as a fallback if the new one cannot serve the room.
    pub earlier: Option<Arc<StoredAdapter>>,
}

/// A room with its navigators, loaded into memory.
pub struct LoadedRoom {
    /// The room.
    pub room: Arc<Room>,
    /// One for each adapter that serves the room, in order of preference.
    pub navigators: Vec<Arc<ServedNavigator>>,
    /// The keypoints of the room, if it has any.
    pub keypoints: Option<ServedKeypoints>,
    /// Parameters of filters that were fitted to the room.
    pub tracking: Option<FilterParameters>,
    /// Adapters with matching features that cannot serve the room, by name.
    pub refused: BTreeMap<String, Refusal>,
}

/// The keypoints of a room.
#[derive(Clone)]
pub struct ServedKeypoints {
    /// What detects them.
    pub source: KeypointSource,
    /// The room's map of keypoints.
    pub room: Arc<KeypointRoom>,
}

/// A room with one adapter that serves it.
pub struct ServedNavigator {
    /// Retrieves frames and plans motions in this adapter's latent space.
    pub navigator: Arc<Navigator>,
    /// The map for tracking and relocalization; `None` if the adapter is not calibrated or the room
    /// is too small.
    pub map: Option<Arc<Map>>,
    /// The stored adapter with its training record.
    pub adapter: Arc<StoredAdapter>,
    /// Content hashes of the adapter and the room's frames.
    pub content: Content,
    /// The room's revision.
    pub room_revision: u64,
    /// Whether the adapter was trained on this room.
    pub trained_on: TrainedOn,
    /// Locates single views; only if the adapter was fitted to exactly these frames.
    pub reader: Option<Arc<FittedReader>>,
    /// The keypoints of the room and their source, if it has any.
    pub keypoints: Option<ServedKeypoints>,
    /// Parameters of filters that were fitted to the room.
    pub tracking: Option<FilterParameters>,
    /// The reader of the most preferred fitted adapter, with which the map locates views.
    pub(super) tracking_reader: Option<Arc<FittedReader>>,
}

/// Locates single views by an adapter that was fitted to the room.
pub struct FittedReader {
    /// The fitted adapter.
    pub adapter: Arc<StoredAdapter>,
    pub reader: Arc<RoomReader>,
}

impl LoadedRoom {
    /// The navigator of the adapter of this name.
    pub fn under_any(&self, adapter: &str) -> Option<&Arc<ServedNavigator>> {
        self.navigators
            .iter()
            .find(|served| served.adapter.name == adapter)
    }

    /// The navigator of this adapter revision, if its streams locate views by
    /// `tracking_reader`.
    pub(super) fn under(
        &self,
        adapter: &StoredAdapter,
        tracking_reader: Option<&Arc<FittedReader>>,
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

    /// Approximate memory use, bytes.
    pub(super) fn memory_bytes(&self) -> usize {
        let room = self.room.memory_bytes();
        let keypoints = self.keypoints.as_ref();
        let keypoints = keypoints.map_or(0, |keypoints| keypoints.room.memory_bytes());
        let navigators = self.navigators.iter();

        room + keypoints
            + navigators
                .map(|served| served.memory_bytes())
                .sum::<usize>()
    }
}

impl ServedNavigator {
    /// The reader of this adapter if it was fitted to this room; else that of the most preferred
    /// adapter that was, for features of this adapter's source.
    pub fn room_reader(&self) -> Option<&FittedReader> {
        let reader = self.reader.as_ref().or(self.tracking_reader.as_ref());
        reader.map(Arc::as_ref)
    }

    fn is_of(&self, adapter: &StoredAdapter) -> bool {
        self.adapter.name == adapter.name && self.adapter.revision == adapter.revision
    }

    fn memory_bytes(&self) -> usize {
        let map = self.map.as_ref().map_or(0, |map| map.memory_bytes());
        let reader = self.reader.as_ref();
        let reader = reader.map_or(0, |fitted| fitted.reader.localizer.memory_bytes());

        self.navigator.memory_bytes() + map + reader
    }
}

/// The reader of the most preferred adapter for features of this source, if any.
pub(super) fn reader_of<'a>(
    navigators: &'a [Arc<ServedNavigator>],
    source: &FeatureSource,
) -> Option<&'a Arc<FittedReader>> {
    navigators
        .iter()
        .filter(|served| served.adapter.adapter.source().is_like(source))
        .find_map(|served| served.reader.as_ref())
}
