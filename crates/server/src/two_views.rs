//! Estimates the motion between two images from matched image features (XFeat).

use ndarray::Array3;

use super::image_encoder::{ImageEncoder, ImageEncoders};
use super::{Error, RunError};
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::CameraIntrinsics;
use seese3_encoder::{Encoder, Layer, ModelTask, Pooling, recipe};
use seese3_robot::two_view::{self, MotionEstimate};

/// The XFeat layer with the feature maps, and its shape (channels, rows, columns).
const LAYER: &str = "fusion";
const MAP: [usize; 3] = [64, 30, 40];

/// Maximum relative deviation of an image's aspect ratio from the camera's.
const SHAPE_TOLERANCE: f64 = 0.02;

/// Estimates the relative pose of two images.
pub struct TwoViewReader {
    encoder: ImageEncoder,
}

impl TwoViewReader {
    /// Opens the model; `None` if none is configured.
    ///
    /// # Errors
    /// [`RunError::TwoView`] if the file is not an XFeat model.
    pub fn open(encoders: Option<&ImageEncoders>) -> Result<Option<Self>, RunError> {
        let Some((encoders, file)) =
            encoders.and_then(|encoders| Some((encoders, encoders.two_view.as_ref()?)))
        else {
            return Ok(None);
        };
        let recipe = recipe("xfeat").ok_or(RunError::TwoView {
            file: file.clone(),
            problem: "the recipe 'xfeat' is missing".into(),
        })?;
        let [channels, rows, columns] = MAP;
        let task = ModelTask {
            file: file.clone(),
            preparation: recipe.preparation.clone(),
            layers: vec![Layer {
                name: LAYER.to_owned(),
                base: recipe.base.clone(),
                norm: recipe.norm.clone(),
                pooling: Pooling::Grid {
                    columns,
                    rows,
                    skip: 0,
                },
            }],
            window: recipe.window,
            keypoints: None,
            is_prefix_stated: true,
        };

        let failed = |problem: seese3_core::Cause| RunError::TwoView {
            file: file.clone(),
            problem,
        };
        let encoder =
            Encoder::model(task, &encoders.runtime).map_err(|error| failed(error.into()))?;
        if encoder.dims() != [channels * rows * columns] {
            return Err(failed(format!(
                "its layer '{LAYER}' gives {:?} numbers instead of {channels} channels on {columns} \
                 by {rows} cells",
                encoder.dims()
            ).into()));
        }

        tracing::info!(
            encoder = encoder.id(),
            runtime = encoder.runtime(),
            "two-view model ready"
        );

        Ok(Some(Self {
            encoder: ImageEncoder::new(encoder, encoders.bounds),
        }))
    }

    /// Estimates the motion between two images of one camera.
    ///
    /// # Errors
    /// [`Error::Invalid`] on the field of an image that cannot be decoded, or has another aspect
    /// ratio than the camera's images.
    pub fn read(
        &self,
        first: &[u8],
        second: &[u8],
        camera: &CameraIntrinsics,
        cancel: &Cancellation,
    ) -> Result<MotionEstimate, Error> {
        let map = |field: &str, image: &[u8]| {
            cancel.check()?;
            let image = self.encoder.decoded(field, image)?;
            let [width, height] = [image.width, image.height];
            let shape = height as f64 / width as f64;
            if (shape / camera.height() - 1.0).abs() > SHAPE_TOLERANCE {
                return Err(Error::invalid(
                    field,
                    format!(
                        "is {width}×{height}, but the camera's images are {:.3} times as high as \
                         wide; send whole images of this camera",
                        camera.height()
                    ),
                ));
            }

            // The encoder's output width was checked in `open`.
            let row = self.encoder.feature_of(field, image)?;
            Array3::from_shape_vec(MAP, row).map_err(|_| Error::Internal)
        };
        let first = map("first.image", first)?;
        let second = map("second.image", second)?;

        cancel.check()?;
        two_view::read(first.view(), second.view(), camera).map_err(|_| Error::Internal)
    }
}
