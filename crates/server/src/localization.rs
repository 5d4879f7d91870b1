//! LocalizationService: Localize, which estimates the pose of a view and retrieves similar frames.
//! Relocalize is in `relocalization`.

use std::collections::BTreeSet;
use std::sync::Arc;

use tonic::{Request, Response, Status};

use super::convert;
use super::cost::{check_batch, check_batch_pixels};
use super::image_view::{ImageView, RoomMatches, Searched, ViewFields};
use super::snapshot::{
    FittedReader, FoundRooms, Search, SearchedRooms, ServedNavigator, ServedRoom, ServedRooms,
};
use super::status::view_error;
use super::workers::Lane;
use super::{Error, Handlers, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_client::proto::v1::localization_service_server::LocalizationService;
use seese3_core::cancel::Cancellation;
use seese3_core::keypoints::KeypointSource;
use seese3_core::localization::{Place, joint_index, localize, localize_jointly};
use seese3_core::navigation::{Error as E, Source, Start, StepError};
use seese3_core::room::{self, FrameId, RoomId};
use seese3_robot::fitting::MotionReader;
use seese3_robot::localization::{
    AdapterLocalizer, LocatedView, Method, NotInRoom, NotLocated, PoseEstimate,
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

    async fn batch_localize(
        &self,
        request: Request<pb::BatchLocalizeRequest>,
    ) -> Result<Response<pb::BatchLocalizeResponse>, Status> {
        let limits = self.config.limits;
        let most = self.config.batch;
        self.unary(
            request,
            |_, _| Lane::Long,
            move |snapshot, request, cancel| {
                let frames = |request: &pb::LocalizeRequest| request.top_k.unwrap_or(1).into();
                check_batch(request.requests.iter().map(frames), most, limits)?;
                let views = request.requests.iter();
                check_batch_pixels(snapshot, views.filter_map(|request| request.view.as_ref()))?;
                answer_batch(snapshot, request, limits.top_k, cancel)
            },
        )
        .await
    }

    async fn localize(
        &self,
        request: Request<pb::LocalizeRequest>,
    ) -> Result<Response<pb::LocalizeResponse>, Status> {
        let most = self.config.limits.top_k;
        let response = self
            .unary(
                request,
                |costs, request| costs.locate(&request.rooms, request.view.as_slice()),
                move |snapshot, request, cancel| answer(snapshot, request, most, cancel),
            )
            .await?;

        let first = response.get_ref().frames.first();
        if let Some(frame) = first.and_then(|first| first.frame.as_ref()) {
            self.config.metrics.retrieved(frame.distance);
        }

        Ok(response)
    }
}

fn answer_batch(
    snapshot: &Snapshot,
    batch: pb::BatchLocalizeRequest,
    most: u32,
    cancel: &Cancellation,
) -> Result<pb::BatchLocalizeResponse, Error> {
    use pb::batch_localize_result::Result as Wire;

    let mut results = Vec::with_capacity(batch.requests.len());
    for request in batch.requests {
        cancel.check()?;
        let result = match answer(snapshot, request, most, cancel) {
            Ok(response) => Wire::Response(response),
            // Cancellation ends the batch; any other error fails only its own request.
            Err(Error::Cancelled) => return Err(Error::Cancelled),
            Err(error) => Wire::Error(error.into()),
        };
        results.push(pb::BatchLocalizeResult {
            result: Some(result),
        });
    }

    Ok(pb::BatchLocalizeResponse { results })
}

fn answer(
    snapshot: &Snapshot,
    request: pb::LocalizeRequest,
    most: u32,
    cancel: &Cancellation,
) -> Result<pb::LocalizeResponse, Error> {
    let pb::LocalizeRequest {
        rooms,
        room_revisions: _,
        adapter,
        adapter_revision: _,
        view,
        top_k,
        camera,
    } = request;

    let adapter = convert::stated_adapter(&adapter, &view)?.to_owned();
    let k = checked_count(top_k, most)?;

    // First match keypoints, which needs no adapter.
    let asked = asked_rooms(snapshot, &rooms)?;
    let fields = ViewFields {
        view: "view",
        camera: "camera",
    };
    let image = ImageView::of(snapshot, fields, view.as_ref(), camera.as_ref(), &asked)?;
    let matches = match &image {
        Some(image) => image.matched(&asked, Searched::of(&rooms), cancel)?,
        None => RoomMatches::default(),
    };

    if let Some(recorded) = recorded(snapshot, &asked, &adapter, view.as_ref())? {
        return Ok(recorded);
    }

    // Then retrieve similar frames. Without them, keypoints still answer.
    let retrieved = retrieved(snapshot, &rooms, &adapter, view, image.as_ref());
    let retrieved = match retrieved.and_then(|source| source.similar_frames(k as usize, cancel)) {
        Err(Error::Precondition(_) | Error::Invalid { .. })
            if adapter.is_empty() && matches.rooms().next().is_some() =>
        {
            None
        }
        retrieved => Some(retrieved?),
    };

    let mut response = match &retrieved {
        Some(retrieved) => pb::LocalizeResponse {
            adapter: Some(convert::adapter_revision(&retrieved.served[0])),
            frames: retrieved.frames_to_wire()?,
            index: retrieved.served[0].navigator.index_kind().name().to_owned(),
            ..Default::default()
        },
        None => pb::LocalizeResponse::default(),
    };

    let served = retrieved.as_ref().map(|retrieved| &retrieved.served);
    response.room_count = room_count(served, &matches) as u32;
    response.exact = served.is_none_or(|served| served.is_exact());

    fill_pose(&mut response, matches, retrieved.as_ref())?;
    if response.method() != pb::LocalizationMethod::MatchedKeypoints
        && response.reason.is_empty()
        && image.is_none()
    {
        response.reason = not_tried(snapshot, &asked);
    }
    Ok(response)
}

/// Number of rooms that were compared, by latents or by keypoints.
pub(super) fn room_count(by_latent: Option<&ServedRooms>, matches: &RoomMatches) -> usize {
    let matched: BTreeSet<&RoomId> = matches.rooms().collect();
    let by_latent = by_latent.map_or(&[][..], |rooms| rooms);
    if matched.is_empty() {
        return by_latent.len();
    }
    let is_not_matched =
        |served: &&Arc<ServedNavigator>| !matched.contains(served.navigator.room().id());
    matched.len() + by_latent.iter().filter(is_not_matched).count()
}

/// The answer for a stored frame of a room without an adapter; `None` for any other request.
///
/// # Errors
/// [`Error::NotFound`] if the room has no such frame, [`Error::Precondition`] if it cannot be
/// loaded.
fn recorded(
    snapshot: &Snapshot,
    asked: &[&Arc<ServedRoom>],
    adapter: &str,
    view: Option<&pb::View>,
) -> Result<Option<pb::LocalizeResponse>, Error> {
    let view = view.and_then(|view| view.view.as_ref());
    let (Some(pb::view::View::FrameId(frame)), [served], "") = (view, asked, adapter) else {
        return Ok(None);
    };
    if !snapshot.adapters_of(served).is_empty() {
        return Ok(None);
    }

    let room = &served.load()?.room;
    let unknown = |_| Error::no_frame("view.frame_id", FrameId(*frame), room.frame_count());
    let pose = room.pose(FrameId(*frame)).map_err(unknown)?;
    let mut response = pb::LocalizeResponse {
        pose: Some(pb::PoseWithCovariance {
            pose: Some(convert::pose_to_wire(pose, room.id().as_str())),
            covariance: Vec::new(),
        }),
        room: Some(convert::served_revision(served)),
        room_count: 1,
        exact: true,
        ..Default::default()
    };
    response.set_method(pb::LocalizationMethod::Recorded);
    Ok(Some(response))
}

/// The rooms of a request, or all rooms if it names none.
///
/// # Errors
/// [`Error::NotFound`] for an unknown room, [`Error::Invalid`] if a room is named twice.
pub(super) fn asked_rooms<'a>(
    snapshot: &'a Snapshot,
    rooms: &[String],
) -> Result<Vec<&'a Arc<ServedRoom>>, Error> {
    if rooms.is_empty() {
        return Ok(snapshot.rooms().values().collect());
    }

    let mut asked = Vec::new();
    for (position, room) in rooms.iter().enumerate() {
        let served = snapshot.room(room);
        let served = served.map_err(|error| error.named(&format!("rooms[{position}]")))?;
        if rooms[..position].contains(room) {
            return Err(Error::invalid("rooms", format!("'{room}' is named twice")));
        }
        asked.push(served);
    }

    Ok(asked)
}

/// A view to compare with rooms under one adapter, so that it is embedded once and distances are
/// comparable between rooms.
struct ComparedView {
    served: ServedRooms,
    source: Source,
}

/// The view of a request, for the adapter that serves the rooms.
fn retrieved(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
    view: Option<pb::View>,
    image: Option<&ImageView<'_>>,
) -> Result<ComparedView, Error> {
    let served = rooms_under(snapshot, rooms, adapter)?;
    let stored = &served[0].adapter;

    let source = match image.and_then(|image| image.feature_for(stored)) {
        Some(feature) => Source::Feature(feature),
        None => convert::source("view", view, stored, snapshot)?,
    };
    Ok(ComparedView { served, source })
}

/// A view with its most similar frames.
struct Retrieved {
    served: ServedRooms,
    source: Source,
    start: Start,
    places: Vec<Place>,
}

impl ComparedView {
    fn similar_frames(self, k: usize, cancel: &Cancellation) -> Result<Retrieved, Error> {
        let Self { served, source } = self;
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
            E::SourceFrame(room::Error::UnknownFrame {
                frame, frame_count, ..
            }) => Error::no_frame("view.frame_id", frame, frame_count),
            other => Error::from(other),
        })?;

        let navigators = || served.iter().map(|served| served.navigator.as_ref());
        let joint = served.joint(1, |rooms| {
            joint_index(rooms.iter().map(|served| served.navigator.as_ref()))
        });
        let latent = start.latent.view();
        let places = match joint {
            Some(joint) => localize_jointly(joint, |room| &served[room].navigator, latent, k),
            None => localize(navigators(), latent, k, cancel)?,
        };
        Ok(Retrieved {
            served,
            source,
            start,
            places,
        })
    }
}

impl Retrieved {
    /// The room of the most similar frame.
    fn nearest_room(&self) -> Result<&ServedNavigator, Error> {
        // At least one frame is retrieved.
        let place = self.places.first().ok_or(Error::Internal)?;
        Ok(&self.served[place.room])
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

    fn frames_to_wire(&self) -> Result<Vec<pb::SimilarFrame>, Error> {
        let place = |place: &Place| {
            let served = &self.served[place.room];
            let room = served.navigator.room();
            Ok(pb::SimilarFrame {
                room: Some(convert::room_revision(served)),
                frame: Some(convert::retrieved_to_wire(&place.frame, room)),
                // The source of the error is the true pose itself, so its twist is
                // log(true⁻¹ · found).
                error: self.start.pose.map(|truth| {
                    let error = StepError::of(&truth, &place.frame.pose, &truth);
                    convert::error_to_wire(&error)
                }),
            })
        };
        self.places.iter().map(place).collect()
    }
}

/// Fills the pose of a response: from matched keypoints, else the recorded pose of a stored frame,
/// else from similar frames.
fn fill_pose(
    response: &mut pb::LocalizeResponse,
    mut matches: RoomMatches,
    retrieved: Option<&Retrieved>,
) -> Result<(), Error> {
    if !matches.located.is_empty() {
        let (room, view) = matches.located.swap_remove(0);
        response.room = Some(convert::served_revision(&room));
        let estimate = PoseEstimate::choose(Some(Ok(view)), || None);
        LocatedPose::of(estimate, room.id.as_str()).fill(response);
        return Ok(());
    }

    let Some(retrieved) = retrieved else {
        // Only keypoints were compared, with at least one room.
        let (room, why) = matches.unmatched.first().ok_or(Error::Internal)?;
        response.room = Some(convert::served_revision(room));
        let estimate = PoseEstimate::choose(Some(Err(*why)), || None);
        LocatedPose::of(estimate, room.id.as_str()).fill(response);
        return Ok(());
    };

    let nearest = retrieved.nearest_room()?;
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

    let query = retrieved.query();
    let matched = matches.why_not_in(room).map(Err);
    let estimate = PoseEstimate::choose(matched, || Some(localizer(nearest).estimate(query)));
    let mut located = LocatedPose::of(estimate, room.as_str());
    located.add_fitted(nearest, query.feature)?;
    located.fill(response);
    Ok(())
}

/// Why keypoints were not tried with the rooms; empty if none has keypoints.
fn not_tried(snapshot: &Snapshot, asked: &[&Arc<ServedRoom>]) -> String {
    let sources = asked
        .iter()
        .filter_map(|room| room.summary.keypoints.as_ref());
    let sources: Vec<&KeypointSource> = sources.collect();
    if sources.is_empty() {
        return String::new();
    }

    let has_encoder = |source: &&KeypointSource| snapshot.keypoint_encoder(source).is_some();
    if !sources.iter().any(has_encoder) {
        return "keypoints were not matched: this server has no encoder of the room's keypoints"
            .to_owned();
    }
    "keypoints were not matched: the view is not an image".to_owned()
}

/// The localizer of a room under an adapter.
pub(super) fn localizer(served: &ServedNavigator) -> AdapterLocalizer<'_> {
    AdapterLocalizer {
        navigator: &served.navigator,
        map: served.map.as_deref(),
        reader: served
            .room_reader()
            .map(|fitted| fitted.reader.as_ref() as &dyn PoseReader),
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
                novelty,
                reason: reason_of(unmatched),
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

/// Why a view is not located in a room. `unmatched` is why its keypoints do not, if they were
/// tried.
fn reason_of(unmatched: Option<NotLocated>) -> String {
    match unmatched {
        None => "the view is not in the map: it resembles none of its frames".to_owned(),
        Some(why @ (NotLocated::NoKeypoints | NotLocated::NotInMap { .. })) => {
            format!("the view is not in the map: {why}")
        }
        Some(why) => format!("the view is not located: {why}"),
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

fn fitted_to_wire(fitted: &FittedReader, feature: &[f32]) -> Result<pb::FittedEstimate, Error> {
    // The feature was checked against the adapter, so an error here is internal.
    let view = fitted.reader.locate(feature).map_err(|_| Error::Internal)?;
    Ok(pb::FittedEstimate {
        frame_id: view.nearest.frame.0,
        distance: view.nearest.distance,
        translation_estimator: estimator_to_wire(view.translation.reader).into(),
        translation_gain: view.translation.gain,
        rotation_estimator: estimator_to_wire(view.rotation.reader).into(),
        rotation_gain: view.rotation.gain,
        adapter: Some(pb::Revision {
            name: fitted.adapter.name.clone(),
            revision: fitted.adapter.revision,
        }),
    })
}

fn estimator_to_wire(reader: MotionReader) -> pb::RelativeEstimator {
    match reader {
        MotionReader::Fitted => pb::RelativeEstimator::Fitted,
        MotionReader::ZeroShot => pb::RelativeEstimator::ZeroShot,
        MotionReader::NearestFrame => pb::RelativeEstimator::NearestFrame,
    }
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

/// The names of a request's rooms; if it names none and the server has one room, that room.
pub(super) fn rooms_or_only(snapshot: &Snapshot, rooms: &[String]) -> Vec<String> {
    let mut served = snapshot.rooms().keys();
    match (rooms, served.next(), served.next()) {
        ([], Some(only), None) => vec![only.clone()],
        _ => rooms.to_vec(),
    }
}

/// The rooms to search, all under one adapter; at least one. An empty `rooms` selects every room
/// that the adapter serves. An empty `adapter` selects the default of a single room, or that of
/// several ([`Snapshot::default_across`]).
///
/// # Errors
/// [`Error::NotFound`] for an unknown room or adapter, [`Error::Invalid`] if a room is named twice
/// or several adapters fit, [`Error::Precondition`] if the adapter does not fit a room.
pub(super) fn rooms_under(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<ServedRooms, Error> {
    if rooms.is_empty() {
        let find = || found_rooms(snapshot, rooms, adapter);
        return snapshot.searches().rooms(Search::Retrieve, adapter, find);
    }
    let found = found_rooms(snapshot, rooms, adapter)?;
    Ok(Arc::new(SearchedRooms::new(found.rooms)))
}

/// Uncached [`rooms_under`].
///
/// # Errors
/// As [`rooms_under`].
pub(super) fn found_rooms(
    snapshot: &Snapshot,
    rooms: &[String],
    adapter: &str,
) -> Result<FoundRooms, Error> {
    asked_rooms(snapshot, rooms)?;

    let rooms = &rooms_or_only(snapshot, rooms)[..];
    let adapter = match (adapter, rooms) {
        ("", [room]) => snapshot.navigator(room, "")?.adapter.name.clone(),
        ("", _) => snapshot.default_across(rooms, |_| true)?.name.clone(),
        (name, _) => snapshot.adapter(name)?.name.clone(),
    };

    if !rooms.is_empty() {
        let served = rooms.iter().map(|room| snapshot.navigator(room, &adapter));
        return Ok(FoundRooms {
            rooms: served.collect::<Result<_, _>>()?,
            is_final: true,
        });
    }

    // In a search of all rooms, skip damaged rooms, like those refused at loading. The log and the
    // rooms' health report them.
    let mut served = Vec::new();
    let mut is_final = true;
    for room in snapshot.rooms().values() {
        if !room.is_served_by(&adapter) {
            continue;
        }
        // Before a room is loaded, the choice of the adapter goes by its candidates.
        is_final &= room.is_in_memory() || room.refusal().is_some_and(|refusal| !refusal.may_pass);
        match room.load() {
            Ok(loaded) => served.extend(loaded.under_any(&adapter).cloned()),
            Err(Error::Precondition(_)) => {}
            Err(error) => return Err(error),
        }
    }

    if served.is_empty() {
        return Err(Error::Precondition(format!(
            "no room has the features of adapter '{adapter}'"
        )));
    }
    Ok(FoundRooms {
        rooms: served,
        is_final,
    })
}
