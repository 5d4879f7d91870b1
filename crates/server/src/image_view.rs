//! Images of requests whose keypoints are matched with those of rooms.

use std::cell::RefCell;
use std::sync::Arc;

use super::image_encoder::ImageEncoder;
use super::snapshot::{ServedRoom, Snapshot};
use super::{Error, convert};
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::image::RgbImage;
use seese3_core::keypoints::{KeypointSource, Keypoints};
use seese3_robot::localization::{LocatedView, NotLocated};
use seese3_robot::matched_views::ViewKeypoints;
use seese3_store::StoredAdapter;

/// Largest relative difference between the aspect ratios of an image and its camera.
const MAX_ASPECT_DIFFERENCE: f64 = 0.01;

/// Where the images of a request and their camera are, for errors.
#[derive(Clone, Copy)]
pub struct ViewFields<'a> {
    /// Field of the view.
    pub view: &'a str,
    /// Field of the camera.
    pub camera: &'a str,
}

/// A decoded image and its camera.
pub struct ImageView<'a> {
    fields: ViewFields<'a>,
    snapshot: &'a Snapshot,
    image: RgbImage,
    camera: GivenCamera,
    /// One pass of each encoder of keypoints.
    passes: RefCell<Vec<Arc<Pass>>>,
}

enum GivenCamera {
    Stated(CameraIntrinsics),
    /// The camera that mapped the room.
    Mapping,
}

/// One encoder pass over the image.
struct Pass {
    source: KeypointSource,
    keypoints: Keypoints,
    feature: Vec<f32>,
}

/// The match of an image with one room.
pub struct RoomTried {
    pub room: Arc<ServedRoom>,
    pub found: Result<LocatedView, NotLocated>,
}

impl<'a> ImageView<'a> {
    /// The image of a view, if it is one and if this server can match its keypoints with one of
    /// these rooms.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the camera is missing or wrong, or the image cannot be decoded.
    pub fn of(
        snapshot: &'a Snapshot,
        fields: ViewFields<'a>,
        view: Option<&pb::View>,
        camera: Option<&pb::ViewCamera>,
        rooms: &[Arc<ServedRoom>],
    ) -> Result<Option<Self>, Error> {
        let camera = camera
            .map(|camera| given_camera(fields.camera, camera))
            .transpose()?;
        let view = view.and_then(|view| view.view.as_ref());
        let Some(pb::view::View::Image(bytes)) = view else {
            return Ok(None);
        };
        let Some((room, encoder)) = first_with_keypoints(snapshot, rooms) else {
            return Ok(None);
        };

        let camera = camera.ok_or_else(|| {
            let problem = format!(
                "is required to match the image with room '{}': state the intrinsics, or mapping_camera \
                 for the camera that mapped the room",
                room.id
            );
            Error::invalid(fields.camera, problem)
        })?;

        let image = encoder.decoded(&format!("{}.image", fields.view), bytes)?;
        Ok(Some(Self {
            fields,
            snapshot,
            image,
            camera,
            passes: RefCell::default(),
        }))
    }

    /// Matches the image with each room that has keypoints. Blocks while rooms are loaded.
    ///
    /// # Errors
    /// As [`ImageView::matched_with`]; [`Error::Cancelled`] once `cancel` is set.
    pub fn matched(
        &self,
        rooms: &[Arc<ServedRoom>],
        cancel: &Cancellation,
    ) -> Result<Vec<RoomTried>, Error> {
        let mut tried = Vec::new();
        for room in rooms {
            cancel.check()?;
            if let Some(found) = self.matched_with(room)? {
                let room = room.clone();
                tried.push(RoomTried { room, found });
            }
        }

        Ok(tried)
    }

    /// Matches the image with a room; `None` if the room has no keypoints, or this server no
    /// encoder of them.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the image has not the aspect ratio of its camera;
    /// [`Error::Precondition`] if the room cannot be loaded.
    fn matched_with(
        &self,
        room: &ServedRoom,
    ) -> Result<Option<Result<LocatedView, NotLocated>>, Error> {
        let Some(pass) = self.pass(room)? else {
            return Ok(None);
        };
        let loaded = room.load()?;
        let Some(mapped) = &loaded.keypoints else {
            return Ok(None);
        };

        let camera = match &self.camera {
            GivenCamera::Stated(camera) => *camera,
            GivenCamera::Mapping => mapped.room.map().camera,
        };
        let RgbImage { width, height, .. } = self.image;
        check_aspect(width, height, &camera)
            .map_err(|problem| Error::invalid(format!("{}.image", self.fields.view), problem))?;
        Ok(Some(mapped.room.locate(ViewKeypoints {
            keypoints: &pass.keypoints,
            camera: &camera,
        })))
    }

    /// The feature of the image for an adapter, if a pass for keypoints has computed it.
    pub fn feature_for(&self, adapter: &StoredAdapter) -> Option<Vec<f32>> {
        let source = adapter.adapter.source();
        let passes = self.passes.borrow();
        let pass = passes
            .iter()
            .find(|pass| pass.source.feature.is_like(source))?;
        Some(pass.feature.clone())
    }

    /// The pass of the encoder of a room's keypoints.
    fn pass(&self, room: &ServedRoom) -> Result<Option<Arc<Pass>>, Error> {
        let Some(source) = &room.summary.keypoints else {
            return Ok(None);
        };
        let Some(encoder) = self.snapshot.keypoint_encoder(source) else {
            return Ok(None);
        };

        let known = self.passes.borrow();
        if let Some(pass) = known.iter().find(|pass| pass.source.is_like(source)) {
            return Ok(Some(pass.clone()));
        }
        drop(known);

        let frame = encoder.frame_of(&format!("{}.image", self.fields.view), self.image.clone())?;
        let pass = Arc::new(Pass {
            source: source.clone(),
            keypoints: frame.keypoints.unwrap_or_default(),
            feature: frame.feature,
        });
        self.passes.borrow_mut().push(pass.clone());
        Ok(Some(pass))
    }
}

/// Checks that an image of this size can be of the camera.
///
/// # Errors
/// What is wrong with the image.
pub fn check_aspect(width: usize, height: usize, camera: &CameraIntrinsics) -> Result<(), String> {
    let aspect = height as f64 / width as f64;
    if (aspect / camera.height() - 1.0).abs() <= MAX_ASPECT_DIFFERENCE {
        return Ok(());
    }

    Err(format!(
        "has {width} × {height} pixels, height / width {aspect:.3}; its camera has {:.3}",
        camera.height()
    ))
}

/// The first room whose keypoints this server can match, with their encoder.
fn first_with_keypoints<'a>(
    snapshot: &'a Snapshot,
    rooms: &'a [Arc<ServedRoom>],
) -> Option<(&'a ServedRoom, &'a ImageEncoder)> {
    rooms.iter().find_map(|room| {
        let source = room.summary.keypoints.as_ref()?;
        Some((room.as_ref(), snapshot.keypoint_encoder(source)?))
    })
}

fn given_camera(field: &str, camera: &pb::ViewCamera) -> Result<GivenCamera, Error> {
    use pb::view_camera::Camera;

    match &camera.camera {
        Some(Camera::Intrinsics(intrinsics)) => {
            let camera = convert::camera(intrinsics);
            let intrinsics_field = format!("{field}.intrinsics");
            Ok(GivenCamera::Stated(
                camera.map_err(|error| error.named(&intrinsics_field))?,
            ))
        }
        Some(Camera::MappingCamera(true)) => Ok(GivenCamera::Mapping),
        Some(Camera::MappingCamera(false)) => Err(Error::invalid(
            format!("{field}.mapping_camera"),
            "must be true; state the intrinsics of another camera",
        )),
        None => Err(Error::invalid(
            field,
            "has no value: state the intrinsics, or mapping_camera",
        )),
    }
}

/// The error for a camera that the matches contradict, if they do.
pub fn contradicted(field: &str, why: Option<&NotLocated>) -> Option<Error> {
    match why {
        Some(why @ NotLocated::CameraContradicted { .. }) => Some(Error::invalid(
            field,
            format!("{why}; state the intrinsics of the camera of this image"),
        )),
        _ => None,
    }
}
