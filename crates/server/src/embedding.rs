//! Embedding of the views in requests: features, latents, images and stored frames to latents of
//! one adapter.

use std::sync::Arc;

use ndarray::Array1;

use super::image_encoder::ImageEncoder;
use super::snapshot::{ServedNavigator, Snapshot};
use super::status::view_error;
use super::{Error, convert};
use seese3_client::proto::v1 as pb;
use seese3_core::keypoints::Keypoints;
use seese3_core::navigation::Source;
use seese3_robot::tracking::View;
use seese3_store::StoredAdapter;

/// Embeds views with one adapter.
pub struct ViewEmbedder<'a> {
    pub adapter: &'a StoredAdapter,
    /// The encoders of images.
    pub snapshot: &'a Snapshot,
    pub frames: StoredFrames<'a>,
    /// The encoder of the keypoints of images, if they are to be detected.
    pub detector: Option<&'a ImageEncoder>,
}

/// What a view that is a stored frame means.
#[derive(Clone, Copy)]
pub enum StoredFrames<'a> {
    /// A frame of this room.
    Of(&'a ServedNavigator),
    /// An error: the request names no room.
    RoomMissing,
    /// An error: the view must be one of the camera.
    Refused,
}

/// A view embedded by an adapter.
pub struct EmbeddedView {
    /// Shape (k,).
    pub latent: Array1<f64>,
    /// The raw feature, shape (d,); `None` for a latent or a stored frame.
    pub feature: Option<Vec<f32>>,
    /// Whether the view is an image without contrast.
    pub is_blank: bool,
    /// The keypoints of an image, if they were detected.
    pub keypoints: Option<ImageKeypoints>,
}

/// The keypoints of an image.
pub struct ImageKeypoints {
    pub keypoints: Keypoints,
    /// Width and height of the image, pixels.
    pub size: [usize; 2],
}

impl ImageKeypoints {
    /// A hash that identical images share; `None` without keypoints.
    pub fn fingerprint(&self) -> Option<u64> {
        use std::hash::{DefaultHasher, Hash, Hasher};

        let mut hasher = DefaultHasher::new();
        for (point, score) in self.keypoints.points().iter().zip(self.keypoints.scores()) {
            [point.x, point.y, *score]
                .map(f32::to_bits)
                .hash(&mut hasher);
        }
        (!self.keypoints.is_empty()).then(|| hasher.finish())
    }
}

impl ViewEmbedder<'_> {
    /// Embeds one view. `field` is its field in the request, for errors.
    ///
    /// # Errors
    /// [`Error::Invalid`] if the view is missing or does not fit the adapter, if an image cannot be
    /// decoded, or if it is a stored frame that [`StoredFrames`] does not allow;
    /// [`Error::Precondition`] if the server has no encoder for images.
    pub fn embed(&self, field: &str, view: Option<pb::View>) -> Result<EmbeddedView, Error> {
        if let Some(pb::view::View::Image(image)) =
            view.as_ref().and_then(|view| view.view.as_ref())
        {
            let image_field = format!("{field}.image");
            let encoder = self.snapshot.image_encoder(self.adapter)?;
            let pixels = encoder.decoded(&image_field, image)?;
            let is_blank = pixels.is_blank();

            let Some(detector) = self.detector else {
                let feature = encoder.feature_of(&image_field, pixels)?;
                return self.embed_feature(field, feature, is_blank);
            };

            // One pass gives keypoints and feature if both come from the same encoder.
            let size = [pixels.width, pixels.height];
            let frame = detector.frame_of(&image_field, pixels.clone())?;
            let feature = if detector.makes(self.adapter.adapter.source()) {
                frame.feature
            } else {
                encoder.feature_of(&image_field, pixels)?
            };
            let keypoints = frame.keypoints.unwrap_or_default();
            return Ok(EmbeddedView {
                keypoints: Some(ImageKeypoints { keypoints, size }),
                ..self.embed_feature(field, feature, is_blank)?
            });
        }

        match convert::source(field, view, self.adapter, self.snapshot)? {
            Source::Feature(feature) => self.embed_feature(field, feature, false),
            Source::Latent(values) => Ok(EmbeddedView {
                latent: self.latent(field, &View::Latent(values))?,
                feature: None,
                is_blank: false,
                keypoints: None,
            }),
            Source::Frame(frame) => {
                let frame_field = format!("{field}.frame_id");
                let served = match self.frames {
                    StoredFrames::Of(served) => served,
                    StoredFrames::RoomMissing => {
                        let problem = format!("is required: {field} is a frame");
                        return Err(Error::invalid("room", problem));
                    }
                    StoredFrames::Refused => {
                        let problem = "is a stored frame; give a feature, a latent or an image of the \
                                       camera";
                        return Err(Error::invalid(frame_field, problem));
                    }
                };

                let room = served.navigator.room();
                let unknown = |_| Error::no_frame(&frame_field, frame, room.frame_count());
                room.pose(frame).map_err(unknown)?;
                Ok(EmbeddedView {
                    latent: served.navigator.latents().row(frame.row()).to_owned(),
                    feature: None,
                    is_blank: false,
                    keypoints: None,
                })
            }
        }
    }

    fn embed_feature(
        &self,
        field: &str,
        feature: Vec<f32>,
        is_blank: bool,
    ) -> Result<EmbeddedView, Error> {
        let view = View::Feature(feature);
        let latent = self.latent(field, &view)?;
        let View::Feature(feature) = view else {
            return Err(Error::Internal);
        };
        Ok(EmbeddedView {
            latent,
            feature: Some(feature),
            is_blank,
            keypoints: None,
        })
    }

    fn latent(&self, field: &str, view: &View) -> Result<Array1<f64>, Error> {
        view.latent(&self.adapter.adapter)
            .map_err(|error| view_error(&error).within(field))
    }
}

/// The adapter of a request, and its room if the request names one.
pub struct RequestAdapter {
    pub stored: Arc<StoredAdapter>,
    pub served: Option<Arc<ServedNavigator>>,
}

impl RequestAdapter {
    /// The adapter named `adapter`, or the default of `room`; both names may be empty.
    ///
    /// # Errors
    /// [`Error::Invalid`] on `adapter` if it is needed; otherwise as [`Snapshot::navigator`].
    pub fn of(snapshot: &Snapshot, room: &str, adapter: &str) -> Result<Self, Error> {
        if room.is_empty() {
            let stored = match adapter {
                "" => snapshot.default_without_room()?,
                name => snapshot.adapter(name)?.clone(),
            };
            return Ok(Self {
                stored,
                served: None,
            });
        }

        let served = snapshot.navigator(room, adapter)?;
        Ok(Self {
            stored: served.adapter.clone(),
            served: Some(served),
        })
    }

    /// An embedder of the request's views.
    pub fn embedder<'a>(&'a self, snapshot: &'a Snapshot) -> ViewEmbedder<'a> {
        ViewEmbedder {
            adapter: &self.stored,
            snapshot,
            frames: match &self.served {
                Some(served) => StoredFrames::Of(served),
                None => StoredFrames::RoomMissing,
            },
            detector: None,
        }
    }
}
