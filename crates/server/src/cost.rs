//! Estimated costs of requests: the lane of the work, before it starts, and the size of the answer.
//!
//! Time is counted in comparisons: one comparison of a view with one stored frame, about 10 ns.

use std::sync::Arc;

use super::Error;
use super::snapshot::{ServedRoom, Snapshot};
use super::workers::{Lane, image_count, images_of};
use seese3_client::proto::v1 as pb;
use seese3_core::navigation::{IndexKind, Limits, NavigatorKind, RetrievalMetric, StepKind};
use seese3_core::room::Room;

/// Cost limit of the lane for short requests, comparisons: about 10 ms.
const SHORT: f64 = 1e6;
/// Cost limit of work that is done in place, products of coordinates: about 0.1 ms.
const BRIEF: f64 = 4e6;
/// Cost limit of a BatchNavigate in the lane for short requests, products of coordinates: about 4 ms, and
/// 8 ms more to embed and answer 256 requests (by the rates in docs/performance.md).
const SHORT_BATCH: f64 = 25.0 * BRIEF;
/// Products that take as long as choosing a frame among the nearest.
const CHOICE: usize = 20;
/// Maximum number of images of a request in the lane for images: a stereo pair.
const IMAGES: usize = 2;
/// Maximum number of rooms in whose keypoints an image is searched in the lane for images.
const MATCHED_ROOMS: usize = 8;

/// Estimates the costs of requests to the rooms of a snapshot.
pub struct Costs<'a> {
    pub snapshot: &'a Snapshot,
    pub index: IndexKind,
}

impl Costs<'_> {
    /// Lane of a Navigate request.
    pub fn navigate(&self, request: &pb::NavigateRequest) -> Lane {
        let images = image_count(&request.source);
        let steps = step_count(request) as f64;
        match lane(images, steps * self.comparisons(&request.room)) {
            Lane::Short if is_prepared(request) => self.brief(&request.room, steps),
            lane => lane,
        }
    }

    /// Lane of a BatchNavigate request.
    pub fn batch_navigate(&self, requests: &[pb::NavigateRequest]) -> Lane {
        let products_of = |request: &pb::NavigateRequest| {
            let is_known = is_prepared(request) && image_count(&request.source) == 0;
            let room = self.exact_room(&request.room).filter(|_| is_known)?;
            let views = step_count(request) as f64;
            Some(views * products(room.widest_latent(), room.summary.frame_count))
        };
        batch_lane(requests.iter().map(products_of))
    }

    /// Lane of `views` views that are compared with the frames of a room, as latents. A room that is not in
    /// memory is read from the store, which may take any time.
    pub fn brief(&self, room: &str, views: f64) -> Lane {
        let Some(room) = self.exact_room(room) else {
            return Lane::Short;
        };
        brief_or_short(views * products(room.widest_latent(), room.summary.frame_count))
    }

    /// A room in memory that is searched exactly.
    fn exact_room(&self, room: &str) -> Option<&Arc<ServedRoom>> {
        let room = self.snapshot.rooms().get(room);
        room.filter(|room| self.index == IndexKind::Exact && room.is_in_memory())
    }

    /// Lane of a Localize or Relocalize request.
    pub fn locate(&self, rooms: &[String], views: &[pb::View]) -> Lane {
        let images = image_count(views);
        let (room_count, comparisons) = match rooms {
            [] => {
                let all = self.snapshot.rooms();
                let count = || all.keys().map(|room| self.comparisons(room)).sum();
                (all.len(), self.snapshot.searches().comparisons(count))
            }
            named => {
                // A list with more names than there are rooms is refused later.
                let most = self.snapshot.rooms().len();
                let named = named.iter().take(most);
                (named.len(), named.map(|room| self.comparisons(room)).sum())
            }
        };

        match lane(images, views.len() as f64 * comparisons) {
            Lane::Images if room_count > MATCHED_ROOMS => Lane::Long,
            lane => lane,
        }
    }

    /// Lane of a ListPairs request.
    pub fn list_pairs(&self, room: &str) -> Lane {
        lane(0, self.frame_count(room) as f64)
    }

    /// Lane of a ListFrames request for `frames` frames. The neighbors of a frame are searched
    /// among all frames of the room.
    pub fn list_frames(&self, request: &pb::ListFramesRequest, frames: usize) -> Lane {
        let thumbnails = match request.thumbnail_width {
            Some(_) => frames,
            None => 0,
        };
        let neighbors = match request.neighbors_within {
            Some(_) => frames as f64 * self.frame_count(&request.room) as f64,
            None => frames as f64,
        };
        lane(thumbnails, neighbors)
    }

    /// Comparisons of one view with a room; 0 for an unknown room.
    fn comparisons(&self, room: &str) -> f64 {
        self.index.comparisons(self.frame_count(room)) as f64
    }

    fn frame_count(&self, room: &str) -> usize {
        let room = self.snapshot.rooms().get(room);
        room.map_or(0, |room| room.summary.frame_count)
    }
}

/// Products of coordinates when a view is compared with this many frames, to find the nearest.
pub fn products(coordinates: usize, frame_count: usize) -> f64 {
    (coordinates + CHOICE) as f64 * frame_count as f64
}

/// Lane of a batch by the products of its requests; `None` for a request of another cost.
fn batch_lane(products: impl Iterator<Item = Option<f64>>) -> Lane {
    match products.sum::<Option<f64>>() {
        Some(products) if products <= SHORT_BATCH => Lane::Short,
        _ => Lane::Long,
    }
}

/// Lane of work without images, of this many products of coordinates.
pub fn brief_or_short(products: f64) -> Lane {
    if products <= BRIEF {
        Lane::Brief
    } else {
        Lane::Short
    }
}

/// Whether a request needs only what is prepared when the served revision of a room is loaded. A stated revision
/// may be another one, a refit is fitted at its first request, some metrics are prepared then, and the relational
/// reader takes milliseconds.
fn is_prepared(request: &pb::NavigateRequest) -> bool {
    let is_prepared = |navigator| {
        matches!(
            navigator,
            NavigatorKind::Step(
                StepKind::InversePoincare(_) | StepKind::Corrector(_),
                RetrievalMetric::Full
            )
        )
    };
    let has_revision = request.room_revision.is_some() || request.adapter_revision.is_some();
    let is_known = request.navigator.is_empty()
        || NavigatorKind::from_name(&request.navigator).is_some_and(is_prepared);
    is_known && !has_revision
}

/// Lane of a request with images to decode and comparisons.
pub fn lane(images: usize, comparisons: f64) -> Lane {
    if images > IMAGES || comparisons > SHORT {
        Lane::Long
    } else if images > 0 {
        Lane::Images
    } else {
        Lane::Short
    }
}

/// Checks the size of a batch. `frames` are the numbers of frames that its requests ask for.
///
/// # Errors
/// [`Error::Invalid`] if the batch is empty, or is over the limit on requests or on frames.
pub fn check_batch(
    frames: impl ExactSizeIterator<Item = u64>,
    most: usize,
    limits: Limits,
) -> Result<(), Error> {
    let count = frames.len();
    if count == 0 || count > most {
        let problem = format!("needs 1 to {most}, got {count}");
        return Err(Error::invalid("requests", problem));
    }

    // The limit on retrieved frames bounds the size of the answer, so it applies to the whole
    // batch.
    let in_all = frames.fold(0, u64::saturating_add);
    if in_all > limits.frames_in_answer {
        let problem = format!(
            "ask for {in_all} frames together, over the limit of {}",
            limits.frames_in_answer
        );
        return Err(Error::invalid("requests", problem));
    }
    Ok(())
}

/// Checks the number of pixels of a batch's images. The limit is the same for all adapters.
///
/// # Errors
/// [`Error::Invalid`] if it is over the limit.
pub fn check_batch_pixels<'a>(
    snapshot: &Snapshot,
    views: impl Iterator<Item = &'a pb::View> + Clone,
) -> Result<(), Error> {
    match snapshot.any_image_encoder() {
        Some(encoder) if image_count(views.clone()) > 0 => {
            encoder.check_pixels("requests", images_of(views))
        }
        _ => Ok(()),
    }
}

/// Number of steps that a Navigate request asks for, of all motions.
pub fn step_count(request: &pb::NavigateRequest) -> u64 {
    let motion = request.motion.as_ref();
    let motions = match motion.and_then(|given| given.motion.as_ref()) {
        Some(pb::requested_motion::Motion::Twists(list)) => list.twists.len() as u64,
        _ => 1,
    };

    u64::from(request.steps.unwrap_or(1)).saturating_mul(motions)
}

/// Upper bound of the encoded size of a retrieved frame with its pose and name, bytes.
pub fn frame_bytes(room: &Room) -> usize {
    /// Numbers of the frame and its pose, with their tags.
    const NUMBERS: usize = 140;
    NUMBERS + room.id().as_str().len() + room.longest_frame_name()
}

/// Upper bound of the encoded size of a step without its frames, bytes.
pub fn step_bytes(latent_dim: usize, adapter: &str) -> usize {
    /// The requested pose and its room's name, the errors, and the adapter's revision.
    const POSE: usize = 280;
    POSE + 8 * latent_dim + adapter.len()
}

#[cfg(test)]
mod tests {
    use super::super::convert;
    use super::*;
    use prost::Message;
    use seese3_core::geometry::Pose;

    /// Oracle: the encoder, for the largest values of all fields.
    #[test]
    fn a_frame_is_no_larger_than_its_bound() {
        let (name, room) = ("n".repeat(900), "r".repeat(100));
        let pose = pb::Pose {
            position: Some(pb::Vector3 {
                x: -1.0,
                y: -1.0,
                z: -1.0,
            }),
            orientation: Some(pb::Quaternion {
                w: -1.0,
                x: -1.0,
                y: -1.0,
                z: -1.0,
            }),
            ..convert::pose_to_wire(&Pose::identity(), &room)
        };
        let frame = pb::RetrievedFrame {
            frame_id: u32::MAX,
            distance: -1.0,
            pose: Some(pose),
            frame_name: name.clone(),
            timestamp_ns: Some(-1),
        };
        let frames = seese3_core::room::Frames {
            poses: vec![Pose::identity()],
            names: vec![name],
            ..Default::default()
        };
        let id = seese3_core::room::RoomId::new(&room).unwrap();
        let stored = Room::new(id, frames, Default::default()).unwrap();

        let step = pb::NavigationStep {
            frames: vec![frame],
            ..Default::default()
        };
        assert!(
            step.encoded_len() <= frame_bytes(&stored),
            "{}",
            step.encoded_len()
        );
    }

    /// Oracle: the definition of the lanes.
    #[test]
    fn lanes_follow_the_cost() {
        assert_eq!(lane(0, 20_000.0), Lane::Short);
        assert_eq!(lane(0, 20_000.0 * 1_000.0), Lane::Long);
        assert_eq!(lane(2, 20_000.0), Lane::Images);
        assert_eq!(lane(3, 20_000.0), Lane::Long);

        // Four latents of 20 numbers among 5,000 frames, and among 30,000.
        assert_eq!(brief_or_short(4.0 * products(20, 5_000)), Lane::Brief);
        assert_eq!(brief_or_short(4.0 * products(20, 30_000)), Lane::Short);

        // 64 such requests, 256 in a larger room, and one whose cost is not known.
        let each = |frames| Some(4.0 * products(20, frames));
        let of = |count, frames| std::iter::repeat_n(each(frames), count);
        assert_eq!(batch_lane(of(64, 5_000)), Lane::Short);
        assert_eq!(batch_lane(of(256, 30_000)), Lane::Long);
        assert_eq!(batch_lane(of(64, 5_000).chain([None])), Lane::Long);
    }
}
