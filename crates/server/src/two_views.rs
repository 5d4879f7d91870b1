//! The motion between two images that callers send, read from where things are in both.

use ndarray::Array3;

use super::image_encoder::{ImageEncoder, ImageEncoders};
use super::{Error, RunError};
use seese3_core::cancel::Cancellation;
use seese3_core::geometry::Pinhole;
use seese3_encoder::{Encoder, Layer, ModelTask, Pooling, recipe};
use seese3_robot::two_view::{self, MotionEstimate};

/// The layer of XFeat whose maps are compared, and its channels, rows and columns.
const LAYER: &str = "fusion";
const MAP: [usize; 3] = [64, 30, 40];

/// How far the shape of an image may be from that of the camera's images, as a share.
const SHAPE_TOLERANCE: f64 = 0.02;

/// Compares two images.
pub struct TwoViewReader {
    encoder: ImageEncoder,
}

impl TwoViewReader {
    /// The reader of a server, if it was given the model.
    ///
    /// # Errors
    /// [`RunError::TwoView`] if the file is not XFeat's.
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
            "reads the motion between two images"
        );

        Ok(Some(Self {
            encoder: ImageEncoder::new(encoder, encoders.bounds),
        }))
    }

    /// The motion between two images of one camera.
    ///
    /// # Errors
    /// [`Error::Invalid`] on the field of an image that cannot be decoded, or is not of the shape of
    /// the camera's images.
    pub fn read(
        &self,
        first: &[u8],
        second: &[u8],
        camera: &Pinhole,
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

            // The encoder's width was checked when it was opened.
            let row = self.encoder.feature_of(field, image)?;
            Array3::from_shape_vec(MAP, row).map_err(|_| Error::Internal)
        };
        let first = map("first.image", first)?;
        let second = map("second.image", second)?;

        cancel.check()?;
        two_view::read(first.view(), second.view(), camera).map_err(|_| Error::Internal)
    }
}
