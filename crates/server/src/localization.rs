//! LocalizationService: Localize, which retrieves the nearest frames and estimates the pose.
//! Relocalize is in `relocalization`.

use std::sync::Arc;

use ndarray::ArrayView1;
use tonic::{Request, Response, Status};

use super::convert;
use super::snapshot::ServedNavigator;
use super::status::view_error;
use super::workers::Lane;
use super::{Error, Handlers, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::localization_service_server::LocalizationService;
use seese3_core::cancel::Cancellation;
use seese3_core::localization::localize;
use seese3_core::navigation::{Error as E, Source, StepError};
use seese3_core::room;
use seese3_robot::fitting::RoomReader;
use seese3_robot::planning::{BelievedStart, KnownRoom};
use seese3_robot::tracking::{PoseReader, PoseWithCovariance};

#[tonic::async_trait]
impl LocalizationService for Handlers {
    async fn relocalize(
        &self,
        request: Request<pb::RelocalizeRequest>,
    ) -> Result<Response<pb::RelocalizeResponse>, Status> {
        self.relocalized(request).await
    }

    async fn localize(
        &self,
        request: Request<pb::LocalizeRequest>,
    ) -> Result<Response<pb::LocalizeResponse>, Status> {
        let most = self.config.limits.top_k;
        let response = self
            .unary(
                request,
                |request| Lane::of(&request.view),
                move |snapshot, request, cancel| answer(snapshot, request, most, cancel),
            )
            .await?;

        let place = response.get_ref().places.first();
        if let Some(frame) = place.and_then(|place| place.frame.as_ref()) {
            self.config.metrics.retrieved(frame.distance);
        }

        Ok(response)
    }
}

fn answer(
    snapshot: &Snapshot,
    request: pb::LocalizeRequest,
    most: u32,
    cancel: &Cancellation,
) -> Result<pb::LocalizeResponse, Error> {
    let pb::LocalizeRequest {
        rooms,
        adapter,
        view,
        top_k,
        thresholds,
    } = request;

    let thresholds = convert::thresholds(thresholds)?;
    let k = checked_count(top_k, most)?;

    // All rooms share one adapter: the view is embedded once, and distances are comparable between
    // rooms.
    let served = rooms_under(snapshot, &rooms, &adapter)?;
    let first = &served[0];
    let source = convert::source("view", view, &first.adapter, snapshot)?;
    if matches!(source, Source::Frame(_)) && served.len() != 1 {
        return Err(Error::invalid(
            "view.frame_id",
            "is a frame of one room; name that room alone in rooms",
        ));
    }

    // A stored frame has a recorded pose, used as ground truth below.
    let start = first
        .navigator
        .start(&source, None)
        .map_err(|error| match error {
            E::Adapter(problem) => view_error(&problem).within("view"),
            E::SourceFrame(room::Error::UnknownFrame { frame, .. }) => {
                Error::no_frame("view.frame_id", frame)
            }
            other => Error::from(other),
        })?;

    let navigators = served.iter().map(|served| served.navigator.as_ref());
    let places = localize(navigators, start.latent.view(), k as usize, cancel)?;

    let revision = |room: &str| {
        served
            .iter()
            .find(|served| served.navigator.room().id().as_str() == room)
    };

    let place = |place: &seese3_core::localization::Place| {
        let served = revision(place.room.as_str()).ok_or(Error::Internal)?;
        Ok(pb::Place {
            room: Some(convert::room_revision(served)),
            frame: Some(convert::retrieved_to_wire(
                &place.frame,
                served.navigator.room(),
            )),
            // The source of the error is the true pose itself, so its twist is log(true⁻¹ · found).
            error: start.pose.map(|truth| {
                convert::error_to_wire(
                    &StepError::of(&truth, &place.frame.pose, &truth),
                    &thresholds,
                )
            }),
        })
    };

    // If one room is searched, also estimate the pose of a view that is not a stored frame.
    let (located, believed) = match (served.as_slice(), &source) {
        (_, Source::Frame(_)) => (None, None),
        ([only], Source::Feature(feature)) => (
            located(only, feature)?,
            Some(believed(only, start.latent.view(), Some(feature))),
        ),
        ([only], Source::Latent(_)) => (None, Some(believed(only, start.latent.view(), None))),
        _ => (None, None),
    };

    Ok(pb::LocalizeResponse {
        adapter: Some(convert::adapter_revision(first)),
        places: places.iter().map(place).collect::<Result<_, Error>>()?,
        room_count: served.len() as u32,
        located,
        believed,
    })
}

/// The number of frames to return.
fn checked_count(top_k: Option<u32>, most: u32) -> Result<u32, Error> {
    match top_k.unwrap_or(1) {
        count if count == 0 || count > most => Err(Error::invalid(
            "top_k",
            format!("must be 1 to {most}, got {count}"),
        )),
        count => Ok(count),
    }
}

/// Estimated camera pose of a view, and its out-of-distribution score for the room.
fn believed(
    served: &ServedNavigator,
    latent: ArrayView1<'_, f64>,
    feature: Option<&[f32]>,
) -> pb::BelievedPose {
    let room = KnownRoom {
        navigator: &served.navigator,
        map: served.map.as_deref(),
        reader: served.room_reader().map(|reader| reader as &dyn PoseReader),
    };
    let seen = BelievedStart::seen(room, latent, feature);

    let covariance = seen.covariance.map(|covariance| {
        let belief = PoseWithCovariance {
            pose: seen.pose,
            covariance,
        };
        convert::matrix_to_wire(&belief.ros_covariance())
    });
    pb::BelievedPose {
        pose: Some(convert::pose_to_wire(
            &seen.pose,
            served.navigator.room().id().as_str(),
        )),
        covariance: covariance.unwrap_or_default(),
        out_of_distribution: seen.out_of_distribution,
    }
}

/// Camera pose of a feature from the fitted adapter; `None` if the adapter is not fitted to the
/// room.
fn located(served: &ServedNavigator, feature: &[f32]) -> Result<Option<pb::LocatedPose>, Error> {
    let room = served.navigator.room().id();
    let located = served.reader.as_ref();
    located
        .map(|reader| located_by(reader, feature, room))
        .transpose()
}

/// Camera pose in a room from the fitted adapter. The feature must already fit the adapter.
pub(super) fn located_by(
    reader: &RoomReader,
    feature: &[f32],
    room: &room::RoomId,
) -> Result<pb::LocatedPose, Error> {
    // The feature was checked against the adapter, so an error here is internal.
    let view = reader.locate(feature).map_err(|_| Error::Internal)?;
    let room = room.as_str();

    Ok(pb::LocatedPose {
        pose: Some(convert::pose_to_wire(&view.pose.pose, room)),
        covariance: convert::matrix_to_wire(&view.pose.ros_covariance()),
        frame_id: view.nearest.frame.0,
        distance: view.nearest.distance,
        translation_reader: view.translation.reader.to_string(),
        translation_gain: view.translation.gain,
        rotation_reader: view.rotation.reader.to_string(),
        rotation_gain: view.rotation.gain,
    })
}

/// The rooms to search, all under one adapter; at least one. An empty `rooms` selects every room
/// that the adapter fits. An empty `adapter` selects the default of a single room, or the only
/// adapter that fits all rooms.
///
/// # Errors
/// [`Error::NotFound`] for an unknown room or adapter, [`Error::Invalid`] if a room is named twice
/// or several adapters fit, [`Error::Precondition`] if the adapter does not fit a room.
pub(super) fn rooms_under(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<Vec<Arc<ServedNavigator>>, Error> {
    for (position, room) in rooms.iter().enumerate() {
        snapshot
            .room(room)
            .map_err(|error| error.named(&format!("rooms[{position}]")))?;

        if rooms[..position].contains(room) {
            return Err(Error::invalid("rooms", format!("'{room}' is named twice")));
        }
    }

    // If no adapter is named, use the default of a single named room, or the only adapter that fits
    // all rooms.
    let adapter = match (adapter, rooms) {
        ("", [room]) => snapshot.navigator(room, "")?.adapter.name.clone(),
        ("", _) => only_adapter_of(snapshot, rooms)?,
        (name, _) => snapshot.adapter(name)?.name.clone(),
    };

    if !rooms.is_empty() {
        return rooms
            .iter()
            .map(|room| snapshot.navigator(room, &adapter))
            .collect();
    }

    // In a search of all rooms, skip damaged rooms, like those refused at loading. The log and the
    // rooms' health report them.
    let fitting = snapshot
        .rooms()
        .iter()
        .filter(|(_, room)| room.is_served_by(&adapter));
    let answers = |answer: &Result<_, Error>| !matches!(answer, Err(Error::Precondition(_)));
    let served: Vec<_> = fitting
        .map(|(name, _)| snapshot.navigator(name, &adapter))
        .filter(answers)
        .collect::<Result<_, _>>()?;

    if served.is_empty() {
        return Err(Error::Precondition(format!(
            "no room has the features of adapter '{adapter}'"
        )));
    }
    Ok(served)
}

/// The only adapter that fits all the rooms; distances under different adapters are not comparable.
/// It is an error if none or several fit.
fn only_adapter_of(snapshot: &Snapshot, rooms: &[String]) -> Result<String, Error> {
    // In a search of all rooms, skip those without a fitting adapter: one of them would rule out
    // every adapter.
    let answered = snapshot
        .rooms()
        .iter()
        .filter(|(_, room)| !room.adapters().is_empty())
        .map(|(name, _)| name);
    let asked: Vec<&String> = if rooms.is_empty() {
        answered.collect()
    } else {
        rooms.iter().collect()
    };

    // Keep the adapters that fit every room.
    let mut fitting: Vec<&String> = snapshot.adapters().keys().collect();
    for room in asked {
        let served = snapshot.room(room)?;
        fitting.retain(|name| served.is_served_by(name));
    }

    match fitting.as_slice() {
        [only] => Ok((*only).clone()),
        several => {
            let names: Vec<&str> = several.iter().map(|name| name.as_str()).collect();
            let problem = format!(
                "is required: {} adapters fit all these rooms ({})",
                names.len(),
                names.join(", ")
            );

            Err(Error::invalid("adapter", problem))
        }
    }
}
