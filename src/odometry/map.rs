//! A room as a tracker matches against it.

use std::sync::Arc;

use ndarray::{ArrayView1, Axis, s};

use super::{Belief, Error, own_errors};
use crate::adapter::{BESIDE, Calibration, MotionErrors};
use crate::geometry::exp;
use crate::index::{ExactIndex, Exclusion, Index, Neighbour};
use crate::navigation::Navigator;
use crate::room::FrameId;

/// Frames whose nearest others say how near a room's frames are to one another.
const SAMPLED: usize = 1_000;

/// Some frames of a room under an adapter whose errors are known.
pub struct Map {
    navigator: Arc<Navigator>,
    calibration: Arc<Calibration>,
    index: ExactIndex,
    typical: f64,
    extent_m: f64,
    motion: MotionErrors,
    anchor_factor: f64,
}

/// What a latent looks like in a map.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// The nearest frames, by distance in deviations of flicker; at least one.
    pub nearest: Vec<Neighbour>,
    /// The distance of the nearest over the room's limit: above 1 it looks like another place.
    pub out_of_distribution: f64,
    /// Whether hardly a frame of another room is as near.
    pub is_sure: bool,
    /// Where the nearest frame says that the camera is, `world_from_camera`.
    pub anchor: Belief,
}

impl Map {
    /// The frames `mapped` of a room, in order.
    ///
    /// # Errors
    /// [`Error::NotCalibrated`], [`Error::SmallMap`] when no frame has another one that is not
    /// beside it in time.
    pub fn new(navigator: Arc<Navigator>, mapped: &[FrameId]) -> Result<Self, Error> {
        let calibration = navigator
            .adapter()
            .calibration()
            .ok_or(Error::NotCalibrated)?
            .clone();

        let columns = s![.., ..navigator.adapter().coordinate_count()];
        let white = calibration
            .flicker()
            .whitened(navigator.latents().slice(columns));
        let index = ExactIndex::new(white.view(), mapped);

        let every = mapped.len().div_ceil(SAMPLED).max(1);
        let apart = mapped.iter().step_by(every).filter_map(|&centre| {
            let row = white.row(centre.row()).to_vec();
            Some(
                index
                    .nearest(
                        &row,
                        1,
                        Some(Exclusion {
                            centre,
                            radius: BESIDE,
                        }),
                    )
                    .first()?
                    .distance,
            )
        });

        let typical = crate::scores::median(&apart.collect::<Vec<_>>());
        if !(typical.is_finite() && typical > 0.0) {
            return Err(Error::SmallMap {
                room: navigator.room().id().clone(),
                frames: mapped.len(),
            });
        }

        let extent_m = extent(&navigator, mapped);

        // Sums of sound covariances by positive factors are sound.
        let motion = own_errors::motion_errors(&navigator, &calibration, mapped)
            .map_err(|_| Error::NotCalibrated)?;
        let anchor_factor = own_errors::anchor_factor(&navigator, &calibration, mapped, &white);

        Ok(Self {
            navigator,
            calibration,
            index,
            typical,
            extent_m,
            motion,
            anchor_factor,
        })
    }

    /// The room and its adapter.
    pub fn navigator(&self) -> &Arc<Navigator> {
        &self.navigator
    }

    /// The errors of motions here: told by the mapped frames, whose motions are known.
    pub fn motion(&self) -> &MotionErrors {
        &self.motion
    }

    /// The diagonal of the box around the mapped cameras, metres.
    pub fn extent_m(&self) -> f64 {
        self.extent_m
    }

    /// What a latent looks like here, the `k` nearest frames.
    pub fn sighting(&self, latent: ArrayView1<'_, f64>, k: usize) -> Sighting {
        let adapter = self.navigator.adapter();
        let coordinates = latent.slice(s![..adapter.coordinate_count()]);
        let white = self
            .calibration
            .flicker()
            .whitened(coordinates.insert_axis(Axis(0)));
        let nearest = self.index.nearest(&white.row(0).to_vec(), k.max(1), None);

        // A map has frames, or it would not have a typical distance.
        let best = nearest.first().copied().unwrap_or(Neighbour {
            frame: FrameId(0),
            distance: f64::INFINITY,
        });
        let errors = self.calibration.anchor_errors(best.distance);

        let latents = self.navigator.latents();
        let stored = latents.row(best.frame.row());
        let step = adapter.displacement(stored, latent).scaled(errors.gain);
        let pose = self.navigator.room().poses()[best.frame.row()] * exp(&step);

        let apart = best.distance / self.typical;
        Sighting {
            nearest,
            out_of_distribution: apart / self.calibration.measured().foreign,
            is_sure: apart <= self.calibration.measured().sure,
            anchor: Belief {
                pose,
                covariance: errors.covariance * self.anchor_factor,
            },
        }
    }
}

fn extent(navigator: &Navigator, mapped: &[FrameId]) -> f64 {
    let positions = mapped
        .iter()
        .map(|frame| navigator.room().poses()[frame.row()].translation.vector);

    let mut low = nalgebra::Vector3::repeat(f64::INFINITY);
    let mut high = nalgebra::Vector3::repeat(f64::NEG_INFINITY);
    for position in positions {
        low = low.inf(&position);
        high = high.sup(&position);
    }

    (high - low).norm()
}
