//! LocalizationService: Localize, which estimates the pose of a view and retrieves similar frames.
//! Relocalize is in `relocalization`.

use std::sync::Arc;

use tonic::{Request, Response, Status};

use super::convert;
use super::image_view::{ImageView, RoomTried, ViewFields, contradicted};
use super::snapshot::{ServedNavigator, ServedRoom};
use super::status::view_error;
use super::workers::Lane;
use super::{Error, Handlers, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::localization_service_server::LocalizationService;
use seese3_core::cancel::Cancellation;
use seese3_core::localization::{Place, localize};
use seese3_core::navigation::{Error as E, Source, Start, StepError};
use seese3_core::room;
use seese3_robot::fitting::RoomReader;
use seese3_robot::localization::{
    AdapterLocalizer, LocatedView, Method, NotInRoom, NotLocated, PoseEstimate, RoomLocalizer,
};
use seese3_robot::tracking::{MapQuery, PoseReader, PoseWithCovariance};

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
        camera,
    } = request;

    let thresholds = convert::thresholds(thresholds)?;
    let k = checked_count(top_k, most)?;

    // First match keypoints, which needs no adapter.
    let asked = asked_rooms(snapshot, &rooms)?;
    let fields = ViewFields {
        view: "view",
        camera: "camera",
    };
    let image = ImageView::of(snapshot, fields, view.as_ref(), camera.as_ref(), &asked)?;
    let tried = match &image {
        Some(image) => image.matched(&asked, cancel)?,
        None => Vec::new(),
    };

    // Then retrieve similar frames. All rooms share one adapter: the view is embedded once, and
    // distances are comparable between rooms.
    let served = match rooms_under(snapshot, &rooms, &adapter) {
        Err(_) if adapter.is_empty() && image.is_some() => Vec::new(),
        served => served?,
    };
    let retrieved = match served.as_slice() {
        [] => None,
        several => {
            let known = image.as_ref();
            let known = known.and_then(|image| image.feature_for(&several[0].adapter));
            let source = match known {
                Some(feature) => Source::Feature(feature),
                None => convert::source("view", view, &several[0].adapter, snapshot)?,
            };
            Some(Retrieved::of(several, source, k as usize, cancel)?)
        }
    };

    let mut response = match &retrieved {
        Some(retrieved) => pb::LocalizeResponse {
            adapter: Some(convert::adapter_revision(&served[0])),
            places: retrieved.places_to_wire(&served, &thresholds)?,
            ..Default::default()
        },
        None => pb::LocalizeResponse::default(),
    };
    response.room_count = served.len().max(asked.len().min(tried.len())) as u32;
    fill_pose(&mut response, tried, retrieved.as_ref(), &served)?;
    if response.method() != pb::LocalizationMethod::MatchedKeypoints
        && response.reason.is_empty()
        && image.is_none()
    {
        response.reason = not_tried(snapshot, &asked);
    }
    Ok(response)
}

/// The rooms of a request, or all rooms if it names none.
///
/// # Errors
/// [`Error::NotFound`] for an unknown room, [`Error::Invalid`] if a room is named twice.
pub(super) fn asked_rooms(
    snapshot: &Snapshot,
    rooms: &[String],
) -> Result<Vec<Arc<ServedRoom>>, Error> {
    if rooms.is_empty() {
        return Ok(snapshot.rooms().values().cloned().collect());
    }

    let mut asked = Vec::new();
    for (position, room) in rooms.iter().enumerate() {
        let served = snapshot.room(room);
        let served = served.map_err(|error| error.named(&format!("rooms[{position}]")))?;
        if rooms[..position].contains(room) {
            return Err(Error::invalid("rooms", format!("'{room}' is named twice")));
        }
        asked.push(served.clone());
    }

    Ok(asked)
}

/// A view with its most similar frames.
struct Retrieved {
    source: Source,
    start: Start,
    places: Vec<Place>,
}

impl Retrieved {
    fn of(
        served: &[Arc<ServedNavigator>],
        source: Source,
        k: usize,
        cancel: &Cancellation,
    ) -> Result<Self, Error> {
        if matches!(source, Source::Frame(_)) && served.len() != 1 {
            return Err(Error::invalid(
                "view.frame_id",
                "is a frame of one room; name that room alone in rooms",
            ));
        }

        // A stored frame has a recorded pose, used as ground truth of the places.
        let start = served[0].navigator.start(&source, None);
        let start = start.map_err(|error| match error {
            E::Adapter(problem) => view_error(&problem).within("view"),
            E::SourceFrame(room::Error::UnknownFrame { frame, .. }) => {
                Error::no_frame("view.frame_id", frame)
            }
            other => Error::from(other),
        })?;

        let navigators = served.iter().map(|served| served.navigator.as_ref());
        let places = localize(navigators, start.latent.view(), k, cancel)?;
        Ok(Self {
            source,
            start,
            places,
        })
    }

    /// The room of the most similar frame.
    fn nearest_room<'a>(
        &self,
        served: &'a [Arc<ServedNavigator>],
    ) -> Result<&'a ServedNavigator, Error> {
        // At least one frame is retrieved.
        let place = self.places.first().ok_or(Error::Internal)?;
        navigator_of(served, &place.room)
    }

    fn query(&self) -> MapQuery<'_> {
        MapQuery {
            latent: self.start.latent.view(),
            feature: match &self.source {
                Source::Feature(feature) => Some(feature),
                Source::Latent(_) | Source::Frame(_) => None,
            },
        }
    }

    fn places_to_wire(
        &self,
        served: &[Arc<ServedNavigator>],
        thresholds: &[f64],
    ) -> Result<Vec<pb::Place>, Error> {
        let place = |place: &Place| {
            let served = navigator_of(served, &place.room)?;
            let room = served.navigator.room();
            Ok(pb::Place {
                room: Some(convert::room_revision(served)),
                frame: Some(convert::retrieved_to_wire(&place.frame, room)),
                // The source of the error is the true pose itself, so its twist is
                // log(true⁻¹ · found).
                error: self.start.pose.map(|truth| {
                    let error = StepError::of(&truth, &place.frame.pose, &truth);
                    convert::error_to_wire(&error, thresholds)
                }),
            })
        };
        self.places.iter().map(place).collect()
    }
}

fn navigator_of<'a>(
    served: &'a [Arc<ServedNavigator>],
    room: &room::RoomId,
) -> Result<&'a ServedNavigator, Error> {
    let mut served = served.iter();
    let found = served.find(|served| served.navigator.room().id() == room);
    found.map(AsRef::as_ref).ok_or(Error::Internal)
}

/// Fills the pose of a response: from matched keypoints, else the recorded pose of a stored frame,
/// else from similar frames.
fn fill_pose(
    response: &mut pb::LocalizeResponse,
    tried: Vec<RoomTried>,
    retrieved: Option<&Retrieved>,
    served: &[Arc<ServedNavigator>],
) -> Result<(), Error> {
    let (located, unmatched) = best_match(tried);
    if let Some((room, located)) = located {
        response.room = Some(room_to_wire(&room));
        LocatedPose::of(Ok(PoseEstimate::matched(located)), room.id.as_str()).fill(response);
        return Ok(());
    }
    for (_, why) in &unmatched {
        if let Some(error) = contradicted("camera", Some(why)) {
            return Err(error);
        }
    }

    let Some(retrieved) = retrieved else {
        // The rooms were only searched by keypoints, and at least one of them has some.
        let (room, why) = unmatched.first().ok_or(Error::Internal)?;
        response.room = Some(room_to_wire(room));
        let nowhere = RoomLocalizer::default().locate_by_similarity(None, Some(*why));
        LocatedPose::of(nowhere, room.id.as_str()).fill(response);
        return Ok(());
    };

    let nearest = retrieved.nearest_room(served)?;
    let room = nearest.navigator.room().id();
    response.room = Some(convert::room_revision(nearest));
    if let (Source::Frame(_), Some(pose)) = (&retrieved.source, &retrieved.start.pose) {
        response.pose = Some(pb::PoseWithCovariance {
            pose: Some(convert::pose_to_wire(pose, room.as_str())),
            covariance: Vec::new(),
        });
        response.set_method(pb::LocalizationMethod::Recorded);
        return Ok(());
    }

    let why = unmatched.iter().find(|(tried, _)| tried.id == *room);
    let why = why.map(|(_, why)| *why);
    let localizer = localizer(nearest);
    let estimate = localizer.locate_by_similarity(Some(retrieved.query()), why);
    let mut located = LocatedPose::of(estimate, room.as_str());
    located.add_fitted(nearest, retrieved.query().feature)?;
    located.fill(response);
    Ok(())
}

/// The room in which the most keypoints agree, and the other rooms with the reason, the most
/// similar first.
type BestMatch = (
    Option<(Arc<ServedRoom>, LocatedView)>,
    Vec<(Arc<ServedRoom>, NotLocated)>,
);

pub(super) fn best_match(tried: Vec<RoomTried>) -> BestMatch {
    let mut best: Option<(Arc<ServedRoom>, LocatedView)> = None;
    let mut unmatched = Vec::new();
    for RoomTried { room, found } in tried {
        match found {
            Ok(located) => {
                let most = best.as_ref().map_or(0, |(_, best)| best.inliers);
                if located.inliers > most {
                    best = Some((room, located));
                }
            }
            Err(why) => unmatched.push((room, why)),
        }
    }
    unmatched.sort_by(|(_, a), (_, b)| a.novelty().total_cmp(&b.novelty()));
    (best, unmatched)
}

/// Why keypoints were not tried with the rooms; empty if none has keypoints.
fn not_tried(snapshot: &Snapshot, asked: &[Arc<ServedRoom>]) -> String {
    let sources = asked.iter();
    let mut sources = sources.filter_map(|room| room.summary.keypoints.as_ref());
    let Some(source) = sources.next() else {
        return String::new();
    };
    if snapshot.keypoint_encoder(source).is_none() {
        return "keypoints were not matched: this server has no encoder of the room's keypoints"
            .to_owned();
    }
    "keypoints were not matched: the view is not an image".to_owned()
}

/// The localizers of a room under an adapter.
pub(super) fn localizer(served: &ServedNavigator) -> RoomLocalizer<'_> {
    RoomLocalizer {
        keypoints: None,
        adapter: Some(AdapterLocalizer {
            navigator: &served.navigator,
            map: served.map.as_deref(),
            reader: served.room_reader().map(|reader| reader as &dyn PoseReader),
        }),
    }
}

pub(super) fn room_to_wire(room: &ServedRoom) -> pb::Revision {
    pb::Revision {
        name: room.id.to_string(),
        revision: room.summary.revision,
    }
}

/// An estimated pose as wire messages.
#[derive(Default)]
pub(super) struct LocatedPose {
    pub pose: Option<pb::PoseWithCovariance>,
    pub novelty: Option<f64>,
    pub method: pb::LocalizationMethod,
    pub reason: String,
    pub matches: Option<pb::KeypointMatches>,
    pub fitted: Option<pb::FittedEstimate>,
}

impl LocatedPose {
    pub fn of(estimate: Result<PoseEstimate, NotInRoom>, room: &str) -> Self {
        match estimate {
            Ok(estimate) => Self {
                pose: Some(pb::PoseWithCovariance {
                    pose: Some(convert::pose_to_wire(&estimate.pose, room)),
                    covariance: covariance_to_wire(&estimate),
                }),
                novelty: estimate.novelty,
                method: method_to_wire(estimate.method),
                reason: estimate
                    .unmatched
                    .map_or_else(String::new, |why| why.to_string()),
                matches: estimate.located.as_ref().map(matches_to_wire),
                fitted: None,
            },
            Err(NotInRoom {
                novelty, unmatched, ..
            }) => Self {
                novelty: Some(novelty).filter(|novelty| novelty.is_finite()),
                reason: match unmatched {
                    Some(why) => format!("the view is not in the map: {why}"),
                    None => {
                        "the view is not in the map: it resembles none of its frames".to_owned()
                    }
                },
                ..Self::default()
            },
        }
    }

    /// Adds the details of a pose by a fitted adapter. The feature must already fit the adapter.
    pub fn add_fitted(
        &mut self,
        served: &ServedNavigator,
        feature: Option<&[f32]>,
    ) -> Result<(), Error> {
        if let (pb::LocalizationMethod::FittedAdapter, Some(reader), Some(feature)) =
            (self.method, served.room_reader(), feature)
        {
            self.fitted = Some(fitted_to_wire(reader, feature)?);
        }
        Ok(())
    }

    fn fill(self, response: &mut pb::LocalizeResponse) {
        response.set_method(self.method);
        response.pose = self.pose;
        response.novelty = self.novelty;
        response.reason = self.reason;
        response.matches = self.matches;
        response.fitted = self.fitted;
    }
}

fn covariance_to_wire(estimate: &PoseEstimate) -> Vec<f64> {
    let covariance = estimate.covariance.map(|covariance| {
        let pose = PoseWithCovariance {
            pose: estimate.pose,
            covariance,
        };
        convert::matrix_to_wire(&pose.ros_covariance())
    });
    covariance.unwrap_or_default()
}

fn method_to_wire(method: Method) -> pb::LocalizationMethod {
    match method {
        Method::MatchedKeypoints => pb::LocalizationMethod::MatchedKeypoints,
        Method::FittedAdapter => pb::LocalizationMethod::FittedAdapter,
        Method::SimilarFrames => pb::LocalizationMethod::SimilarFrames,
        Method::NearestFrame => pb::LocalizationMethod::NearestFrame,
    }
}

pub(super) fn matches_to_wire(located: &LocatedView) -> pb::KeypointMatches {
    let frames = located.matched.frames.iter();
    pb::KeypointMatches {
        inliers: located.inliers as u32,
        keypoints: located.keypoints as u32,
        frame_ids: frames.map(|&row| row as u32).collect(),
    }
}

fn fitted_to_wire(reader: &RoomReader, feature: &[f32]) -> Result<pb::FittedEstimate, Error> {
    // The feature was checked against the adapter, so an error here is internal.
    let view = reader.locate(feature).map_err(|_| Error::Internal)?;
    Ok(pb::FittedEstimate {
        frame_id: view.nearest.frame.0,
        distance: view.nearest.distance,
        translation_reader: view.translation.reader.to_string(),
        translation_gain: view.translation.gain,
        rotation_reader: view.rotation.reader.to_string(),
        rotation_gain: view.rotation.gain,
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
    asked_rooms(snapshot, rooms)?;

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
