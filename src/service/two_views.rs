//! The motion between two images that callers send, read from where things are in both.

use ndarray::ArrayView3;

use super::image_encoder::{ImageEncoder, ImageEncoders};
use super::{Error, RunError};
use crate::encoder::{Encoder, Layer, ModelTask, Pooling, recipe};
use seese3_core::geometry::Pinhole;
use seese3_core::two_view::{self, Reading};

/// The layer of XFeat whose maps are compared, and its channels, rows and columns.
const LAYER: &str = "fusion";
const MAP: [usize; 3] = [64, 30, 40];

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
            problem: "the recipe 'xfeat' is missing".to_owned(),
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
        };

        let failed = |problem: String| RunError::TwoView {
            file: file.clone(),
            problem,
        };
        let encoder =
            Encoder::model(task, &encoders.runtime).map_err(|error| failed(error.to_string()))?;
        if encoder.dims() != [channels * rows * columns] {
            return Err(failed(format!(
                "its layer '{LAYER}' gives {:?} numbers instead of {channels} channels on {columns} \
                 by {rows} cells",
                encoder.dims()
            )));
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
    /// [`Error::Invalid`] for an image that cannot be decoded, on its field.
    pub fn read(&self, first: &[u8], second: &[u8], camera: &Pinhole) -> Result<Reading, Error> {
        let first = self.encoder.feature("first.image", first)?;
        let second = self.encoder.feature("second.image", second)?;
        let [first, second] = [&first, &second].map(|row| ArrayView3::from_shape(MAP, row));

        // The encoder's width was checked when it was opened.
        let (Ok(first), Ok(second)) = (first, second) else {
            return Err(Error::Internal);
        };

        two_view::read(first, second, camera).map_err(|_| Error::Internal)
    }
}
