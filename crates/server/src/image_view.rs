//! Images of requests whose keypoints are matched with those of rooms.

use std::cell::RefCell;
use std::cmp::Reverse;
use std::sync::Arc;

use super::Error;
use super::convert::{self, ImageCamera};
use super::image_encoder::ImageEncoder;
use super::snapshot::{ServedRoom, Snapshot};
use seese3_client::proto::v1 as pb;
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::CameraIntrinsics;
use seese3_core::image::RgbImage;
use seese3_core::keypoints::{KeypointSource, Keypoints};
use seese3_core::room::RoomId;
use seese3_robot::localization::{LocatedView, NotLocated};
use seese3_robot::matched_views::ViewKeypoints;
use seese3_store::StoredAdapter;

/// Largest relative difference between the aspect ratios of an image and its camera or its depths.
pub const MAX_ASPECT_DIFFERENCE: f64 = 0.01;

/// Request fields of the image and its camera, for error messages.
#[derive(Clone, Copy)]
pub struct ViewFields<'a> {
    /// Field of the view.
    pub view: &'a str,
    /// Field of the camera.
    pub camera: &'a str,
}

/// Which rooms are searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Searched {
    /// Rooms that the request names. One that cannot be loaded is an error.
    Named,
    /// All rooms. Those that cannot be loaded are skipped; the log and their health report them.
    All,
}

impl Searched {
    /// All rooms if the request names none.
    pub fn of(rooms: &[String]) -> Self {
        if rooms.is_empty() {
            Self::All
        } else {
            Self::Named
        }
    }
}

/// A decoded image and its camera.
pub struct ImageView<'a> {
    fields: ViewFields<'a>,
    snapshot: &'a Snapshot,
    image: RgbImage,
    camera: ImageCamera,
    /// One pass of each encoder of keypoints.
    passes: RefCell<Vec<Arc<Pass>>>,
}

/// One encoder pass over the image.
struct Pass {
    source: KeypointSource,
    keypoints: Keypoints,
    feature: Vec<f32>,
}

/// The matches of an image with several rooms.
#[derive(Default)]
pub struct RoomMatches {
    /// Rooms in which the view is located, the most inliers first.
    pub located: Vec<(Arc<ServedRoom>, LocatedView)>,
    /// The other rooms with the reason, the most similar first.
    pub unmatched: Vec<(Arc<ServedRoom>, NotLocated)>,
}

impl RoomMatches {
    fn of(tried: Vec<(Arc<ServedRoom>, Result<LocatedView, NotLocated>)>) -> Self {
        let mut matches = Self::default();
        for (room, found) in tried {
            match found {
                Ok(view) => matches.located.push((room, view)),
                Err(why) => matches.unmatched.push((room, why)),
            }
        }

        matches
            .located
            .sort_by_key(|(_, view)| Reverse(view.inliers));
        let novelty = |why: &NotLocated| why.novelty().unwrap_or(f64::INFINITY);
        matches
            .unmatched
            .sort_by(|(_, a), (_, b)| novelty(a).total_cmp(&novelty(b)));
        matches
    }

    /// The names of the rooms that were tried.
    pub fn rooms(&self) -> impl Iterator<Item = &RoomId> {
        let located = self.located.iter().map(|(room, _)| &room.id);
        located.chain(self.unmatched.iter().map(|(room, _)| &room.id))
    }

    /// Why the view is not located in a room, if it was tried there.
    pub fn why_not_in(&self, room: &RoomId) -> Option<NotLocated> {
        let mut unmatched = self.unmatched.iter();
        let (_, why) = unmatched.find(|(tried, _)| tried.id == *room)?;
        Some(*why)
    }

    /// The camera that the matches contradict, unless another room locates the view.
    fn contradicted(&self) -> Option<&NotLocated> {
        let mut reasons = self.unmatched.iter().map(|(_, why)| why);
        reasons
            .find(|why| matches!(why, NotLocated::CameraContradicted { .. }))
            .filter(|_| self.located.is_empty())
    }
}

impl<'a> ImageView<'a> {
    /// The image of a view. `None` if the view is not an image, or if no room can be matched.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the camera is missing or wrong, or the image cannot be decoded.
    pub fn of(
        snapshot: &'a Snapshot,
        fields: ViewFields<'a>,
        view: Option<&pb::View>,
        camera: Option<&pb::ViewCamera>,
        rooms: &[&Arc<ServedRoom>],
    ) -> Result<Option<Self>, Error> {
        let camera = camera
            .map(|camera| convert::image_camera(fields.camera, camera))
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
        if let ImageCamera::Stated(camera) = &camera {
            check_aspect(image.width, image.height, camera)
                .map_err(|problem| Error::invalid(format!("{}.image", fields.view), problem))?;
        }

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
    /// [`Error::Invalid`] on the camera if the matches contradict it, or on the image if it has not
    /// the aspect ratio of the only room's camera; [`Error::Precondition`] if a named room cannot
    /// be loaded; [`Error::Cancelled`] once `cancel` is set.
    pub fn matched(
        &self,
        rooms: &[&Arc<ServedRoom>],
        searched: Searched,
        cancel: &Cancellation,
    ) -> Result<RoomMatches, Error> {
        let mut tried = Vec::new();
        for &room in rooms {
            cancel.check()?;
            match self.matched_with(room, rooms.len() == 1) {
                Ok(Some(found)) => tried.push((room.clone(), found)),
                Ok(None) => {}
                Err(Error::Precondition(_)) if searched == Searched::All => {}
                Err(error) => return Err(error),
            }
        }

        let matches = RoomMatches::of(tried);
        match matches.contradicted() {
            Some(why) => {
                let problem = format!("{why}; state the intrinsics of the camera of this image");
                Err(Error::invalid(self.fields.camera, problem))
            }
            None => Ok(matches),
        }
    }

    /// Matches the image with a room. `None` if the room has no keypoints, this server no encoder
    /// for them, or, unless it `is_only` one, the mapping camera another aspect ratio than the
    /// image.
    fn matched_with(
        &self,
        room: &ServedRoom,
        is_only: bool,
    ) -> Result<Option<Result<LocatedView, NotLocated>>, Error> {
        let Some(source) = &room.summary.keypoints else {
            return Ok(None);
        };
        let Some(encoder) = self.snapshot.keypoint_encoder(source) else {
            return Ok(None);
        };
        let loaded = room.load()?;
        let Some(mapped) = &loaded.keypoints else {
            return Ok(None);
        };

        let camera = match &self.camera {
            ImageCamera::Stated(camera) => *camera,
            ImageCamera::Mapping => mapped.room.map().camera,
        };
        match check_aspect(self.image.width, self.image.height, &camera) {
            Ok(()) => {}
            Err(problem) if is_only => {
                let field = format!("{}.image", self.fields.view);
                let problem = format!("{problem} (room '{}')", room.id);
                return Err(Error::invalid(field, problem));
            }
            Err(_) => return Ok(None),
        }

        let pass = self.pass(source, encoder)?;
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

    /// The pass of an encoder of keypoints.
    fn pass(&self, source: &KeypointSource, encoder: &ImageEncoder) -> Result<Arc<Pass>, Error> {
        let known = self.passes.borrow();
        if let Some(pass) = known.iter().find(|pass| pass.source.is_like(source)) {
            return Ok(pass.clone());
        }
        drop(known);

        let field = format!("{}.image", self.fields.view);
        let frame = encoder.frame_of(&field, self.image.clone())?;
        let pass = Arc::new(Pass {
            source: source.clone(),
            keypoints: frame.keypoints.unwrap_or_default(),
            feature: frame.feature,
        });
        self.passes.borrow_mut().push(pass.clone());
        Ok(pass)
    }
}

/// Checks that the aspect ratio of an image is that of its camera.
///
/// # Errors
/// A description of the mismatch.
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
    rooms: &[&'a Arc<ServedRoom>],
) -> Option<(&'a ServedRoom, &'a ImageEncoder)> {
    rooms.iter().find_map(|&room| {
        let source = room.summary.keypoints.as_ref()?;
        Some((room.as_ref(), snapshot.keypoint_encoder(source)?))
    })
}
