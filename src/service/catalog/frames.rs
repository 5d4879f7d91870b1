//! The frames of a room with their poses, and the pose graph that they make.

use super::super::convert;
use super::super::snapshot::Snapshot;
use super::super::workers::Lane;
use super::super::{Error, Handlers};
use super::page_length;
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_core::planning::PoseGraph;
use seese3_core::room::{FrameId, Room};

/// The most neighbours that a frame is given.
const MOST_NEIGHBOURS: usize = 32;

impl Handlers {
    /// Answers a ListFrames request on a worker thread.
    pub(super) async fn listed_frames(
        &self,
        request: tonic::Request<pb::ListFramesRequest>,
    ) -> Result<pb::ListFramesResponse, Error> {
        let snapshot = self.snapshot(&request)?;
        let budget = self.workers.budget(request.metadata());
        let request = request.into_inner();

        self.workers
            .run(Lane::Short, budget, move |cancel| {
                answer(&snapshot, request, cancel)
            })
            .await
    }
}

fn answer(
    snapshot: &Snapshot,
    request: pb::ListFramesRequest,
    cancel: &Cancellation,
) -> Result<pb::ListFramesResponse, Error> {
    let pb::ListFramesRequest {
        room,
        page_size,
        page_token,
        neighbours_within,
    } = request;

    if neighbours_within.is_some_and(|hop| !(hop.is_finite() && hop > 0.0)) {
        return Err(Error::invalid(
            "neighbours_within",
            "must be finite and above 0",
        ));
    }

    let length = page_length(page_size)?;
    let served = snapshot.navigator(&room, "")?;
    let room = served.navigator.room();
    let first = first_frame(&page_token, served.room_revision)?;

    let frame_count = room.frame_count();
    let all: Vec<FrameId> = (0..frame_count as u32).map(FrameId).collect();
    let graph = PoseGraph::new(room.poses(), &all);
    let end = first.saturating_add(length).min(frame_count);

    let mut frames = Vec::new();
    for &frame in all.get(first..end).unwrap_or_default() {
        cancel.check()?;
        let mut wire = frame_to_wire(room, frame);
        if let Some(hop) = neighbours_within {
            wire.neighbours = graph
                .neighbours(frame, hop, MOST_NEIGHBOURS)
                .iter()
                .map(|(frame, motion)| pb::NeighbourFrame {
                    frame_id: frame.0,
                    motion: Some(convert::twist_to_wire(motion)),
                })
                .collect();
        }
        frames.push(wire);
    }

    Ok(pb::ListFramesResponse {
        room: Some(convert::room_revision(&served)),
        frames,
        next_page_token: if end < frame_count {
            format!("{}.{end}", served.room_revision)
        } else {
            String::new()
        },
    })
}

/// The first frame of the page that a token stands for: the token is the room's revision and the frame,
/// so that pages of two revisions are never put together.
fn first_frame(token: &str, revision: u64) -> Result<usize, Error> {
    if token.is_empty() {
        return Ok(0);
    }

    let parts = token.split_once('.');
    let numbers = parts.and_then(|(of, frame)| -> Option<(u64, usize)> {
        Some((of.parse().ok()?, frame.parse().ok()?))
    });
    match numbers {
        Some((of, frame)) if of == revision => Ok(frame),
        Some(_) => Err(Error::Precondition(
            "page_token: the room has changed since; start with the first page".to_owned(),
        )),
        None => Err(Error::invalid(
            "page_token",
            "is not a token of this service; start with the first page",
        )),
    }
}

fn frame_to_wire(room: &Room, frame: FrameId) -> pb::RoomFrame {
    let row = frame.row();
    pb::RoomFrame {
        frame_id: frame.0,
        pose: Some(convert::pose_to_wire(
            &room.poses()[row],
            room.id().as_str(),
        )),
        frame_name: room.frame_names().get(row).cloned().unwrap_or_default(),
        timestamp_ns: room.timestamps_ns().get(row).copied(),
        sequence: room.timeline().sequences.get(row).copied().unwrap_or(0),
        neighbours: Vec::new(),
    }
}
