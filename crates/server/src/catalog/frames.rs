//! Lists a room's frames with poses, pose-graph neighbors and thumbnails.

use std::ops::RangeInclusive;
use std::path::Path;

use tonic::{Request, Response, Status};

use super::super::convert;
use super::super::cost::frame_bytes;
use super::super::decoding::DecodingMemory;
use super::super::memory::hold_for_answer;
use super::super::snapshot::Snapshot;
use super::super::status::Full;
use super::super::workers::off_the_lane;
use super::super::{Error, Handlers};
use super::page_length;
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_core::room::{FrameId, Room};
use seese3_encoder::{decoding_cost, read_image_bytes, thumbnail};
use seese3_robot::planning::PoseGraph;

/// Maximum number of neighbors per frame.
const MOST_NEIGHBORS: usize = 32;

/// Encoded size of a neighbor, at most, bytes.
const NEIGHBOR_BYTES: usize = 80;

/// Allowed thumbnail widths, pixels.
const THUMBNAIL_WIDTHS: RangeInclusive<u32> = 16..=512;
/// Thumbnail bytes after which a page ends, so that it fits gRPC's default message limit of 4 MiB.
const THUMBNAILS_OF_A_PAGE: usize = 2 << 20;

impl Handlers {
    /// Answers a ListFrames request on a worker thread.
    pub(super) async fn listed_frames(
        &self,
        request: Request<pb::ListFramesRequest>,
    ) -> Result<Response<pb::ListFramesResponse>, Status> {
        let with_thumbnails = request.get_ref().thumbnail_width.is_some();
        if with_thumbnails && !self.config.thumbnails {
            return Err(no_thumbnails("this server provides no thumbnails (--thumbnails)").into());
        }

        let frames = page_length(request.get_ref().page_size)?;
        self.unary(
            request,
            |costs, request| costs.list_frames(request, frames),
            answer,
        )
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
        room_revision: _,
        page_size,
        page_token,
        neighbors_within,
        thumbnail_width,
    } = request;

    if neighbors_within.is_some_and(|hop| !(hop.is_finite() && hop > 0.0)) {
        return Err(Error::invalid(
            "neighbors_within",
            "must be finite and above 0",
        ));
    }
    if thumbnail_width.is_some_and(|width| !THUMBNAIL_WIDTHS.contains(&width)) {
        return Err(Error::invalid("thumbnail_width", "must be 16 to 512"));
    }

    let length = page_length(page_size)?;
    let served = snapshot.room(&room)?;
    let revision = convert::served_revision(served);
    let room = &served.load()?.room;
    let first = first_frame(&page_token, revision.revision)?;
    if thumbnail_width.is_some() && room.images().is_empty() {
        return Err(no_thumbnails("the server has no images of this room"));
    }

    let frame_count = room.frame_count();
    let all: Vec<FrameId> = (0..frame_count as u32).map(FrameId).collect();
    let graph = PoseGraph::new(room.poses(), &all);
    let last = first.saturating_add(length).min(frame_count);

    let neighbors = match neighbors_within {
        Some(_) => MOST_NEIGHBORS * NEIGHBOR_BYTES,
        None => 0,
    };
    hold_for_answer(last.saturating_sub(first) * (frame_bytes(room) + neighbors))?;

    let mut frames = Vec::new();
    let mut picture_bytes = 0;
    for &frame in all.get(first..last).unwrap_or_default() {
        cancel.check()?;
        if picture_bytes >= THUMBNAILS_OF_A_PAGE {
            break;
        }

        let mut wire = frame_to_wire(room, frame);
        if let Some(hop) = neighbors_within {
            wire.neighbors = graph
                .neighbors(frame, hop, MOST_NEIGHBORS)
                .iter()
                .map(|(frame, motion)| pb::NeighborFrame {
                    frame_id: frame.0,
                    motion: Some(convert::twist_to_wire(motion)),
                })
                .collect();
        }
        if let Some(width) = thumbnail_width {
            wire.thumbnail = picture(room, frame, width, snapshot.decoding())?;
            picture_bytes += wire.thumbnail.len();
        }
        frames.push(wire);
    }

    let end = first.saturating_add(frames.len());
    Ok(pb::ListFramesResponse {
        room: Some(revision.clone()),
        frames,
        next_page_token: if end < frame_count {
            format!("{}.{end}", revision.revision)
        } else {
            String::new()
        },
    })
}

/// First frame of a page. The token has the room's revision and the frame, so that pages of
/// different revisions are never mixed.
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
        segment: room.timeline().sequences.get(row).copied().unwrap_or(0),
        neighbors: Vec::new(),
        thumbnail: Vec::new(),
    }
}

/// The thumbnail of a frame; empty if its image cannot be read.
fn picture(
    room: &Room,
    frame: FrameId,
    width: u32,
    decoding: &DecodingMemory,
) -> Result<Vec<u8>, Error> {
    let root = Path::new(&room.provenance().images_root);
    let image = &room.images()[frame.row()];

    // The folder of the images may not answer.
    let read = off_the_lane(|| read_image_bytes(root, image));
    let what = Full::DiskReads;
    let read = read.map_err(|_| Error::Full { what })?;
    let picture = read.and_then(|bytes| {
        let cost = decoding_cost(&bytes).map_or(0, |cost| cost.bytes);
        let _memory = decoding.wait(cost);
        thumbnail(image, &bytes, width as usize)
    });
    Ok(picture.unwrap_or_else(|error| {
        // Paths go only to the operator's log.
        tracing::warn!(room = %room.id(), frame = frame.0, %error, "no thumbnail");
        Vec::new()
    }))
}

fn no_thumbnails(problem: &str) -> Error {
    Error::Precondition(format!("thumbnail_width: {problem}; leave it out"))
}
