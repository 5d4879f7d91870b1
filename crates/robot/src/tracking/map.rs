//! A room as a tracker matches views against it.

use std::sync::Arc;

use ndarray::{Array2, ArrayView1, ArrayView2, Axis, s};

use super::anchor_model::{
    AnchorModel, AnchorModels, Blend, LOOKED_AT, Likeness, MapAnchor, calibrated_anchor,
};
use super::appearance::{Appearance, RoomAppearance};
use super::clock::frame_period_s;
use super::motion_prior::MotionPrior;
use super::{Error, PoseWithCovariance, room_errors};
use seese3_core::adapter::{ErrorModel, MotionErrors, TEMPORAL_NEIGHBOURS};
use seese3_core::index::{ExactIndex, Exclusion, Index, Neighbour};
use seese3_core::navigation::Navigator;
use seese3_core::room::FrameId;
use seese3_core::statistics::median;

/// How many mapped frames are asked, at most, how far their nearest others are.
const SAMPLED_FRAMES: usize = 1_000;

/// Reads where a view is in one room better than the adapter that several rooms share.
pub trait PoseReader: Send + Sync {
    /// The pose of a view, `world_from_camera`, from its raw feature of shape (d,); none if the
    /// feature cannot be read.
    fn read_pose(&self, feature: &[f32]) -> Option<PoseWithCovariance>;

    /// How far a view is from the map, over the furthest that the reader was tried at: above 1 it
    /// reads nothing. None if it does not know such a distance.
    fn distance_over_range(&self, _feature: &[f32]) -> Option<f64> {
        None
    }
}

/// A view as a map looks for it.
#[derive(Debug, Clone, Copy)]
pub struct MapQuery<'a> {
    /// Its latent, shape (k,).
    pub latent: ArrayView1<'a, f64>,
    /// Its raw feature, shape (d,), if it is known. It finds the mapped frames that are nearest
    /// better than the latent does.
    pub feature: Option<&'a [f32]>,
}

impl<'a> MapQuery<'a> {
    /// A view of which the latent alone is known.
    pub fn of_latent(latent: ArrayView1<'a, f64>) -> Self {
        Self {
            latent,
            feature: None,
        }
    }
}

/// The mapped frames by what the views of the room differ in.
struct AppearanceMap {
    appearance: Appearance,
    index: ExactIndex,
    anchor_models: AnchorModels,
}

impl AppearanceMap {
    /// The mapped frames whose features are most like one of shape (d,).
    fn nearest(&self, feature: &[f32], count: usize) -> Vec<Neighbour> {
        let coordinates = self.appearance.coordinates(feature).to_vec();
        self.index.nearest(&coordinates, count, None)
    }
}

/// The mapped frames of a room under an adapter with an error model.
pub struct Map {
    navigator: Arc<Navigator>,
    error_model: Arc<ErrorModel>,
    index: ExactIndex,
    typical_distance: f64,
    extent_m: f64,
    motion_errors: MotionErrors,
    /// None where too few frames are mapped: the calibrated errors are taken.
    anchor_model: Option<AnchorModel>,
    motion_prior: MotionPrior,
    pose_reader: Option<Arc<dyn PoseReader>>,
    by_appearance: Option<AppearanceMap>,
}

/// How a view matches a map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapMatch {
    /// The mapped frames that look most alike, the most alike first, each with the distance of its
    /// latent in standard deviations of frame noise; at least one.
    pub nearest: Vec<Neighbour>,
    /// The distance of the nearest latent, in standard deviations of frame noise: it compares
    /// between rooms.
    pub distance: f64,
    /// That distance over the room's limit: above 1 the view looks like another place.
    pub out_of_distribution: f64,
    /// Whether the view is so near that hardly any frame of another room would be.
    pub is_certain: bool,
    /// The pose that the nearest frames tell.
    pub anchor: MapAnchor,
    /// Whether that was found by the view's raw feature; else by its latent.
    pub is_by_feature: bool,
}

impl Map {
    /// A map of the frames `mapped` of a room, given in order.
    ///
    /// # Errors
    /// [`Error::NotCalibrated`] when the adapter has no error model, [`Error::SmallMap`] when no
    /// mapped frame has another one that is not its neighbour in time.
    pub fn new(navigator: Arc<Navigator>, mapped: &[FrameId]) -> Result<Self, Error> {
        let error_model = navigator
            .adapter()
            .error_model()
            .ok_or(Error::NotCalibrated)?
            .clone();

        // Distances are taken in standard deviations of frame noise, so that they compare between
        // rooms and adapters.
        let coordinates = s![.., ..navigator.adapter().coordinate_count()];
        let whitened = error_model
            .frame_noise()
            .whitened(navigator.latents().slice(coordinates));
        let index = ExactIndex::new(whitened.view(), mapped);

        // As many rows as the neighbours in time took in the rooms where limits were measured.
        let rows_per_frame =
            error_model.statistics().frame_period_s / frame_period_s(navigator.room());
        let neighbours = (f64::from(TEMPORAL_NEIGHBOURS) * rows_per_frame)
            .round()
            .max(1.0);
        let typical_distance = typical_distance(&index, &whitened, mapped, neighbours as u32);
        if !(typical_distance.is_finite() && typical_distance > 0.0) {
            return Err(Error::SmallMap {
                room: navigator.room().id().clone(),
                frames: mapped.len(),
            });
        }

        // How large the adapter's errors are in this very room is told by its own frames, whose
        // poses are known.
        let motion_errors = room_errors::motion_errors(&navigator, &error_model, mapped)
            .map_err(Error::RoomErrors)?;
        let by_latent = Likeness {
            coordinates: &whitened,
            without_part: None,
            second_opinion: None,
        };
        let anchor_model = AnchorModel::measured(&navigator, by_latent, mapped);

        Ok(Self {
            extent_m: extent(&navigator, mapped),
            motion_prior: MotionPrior::of_path(navigator.room(), mapped),
            navigator,
            error_model,
            index,
            typical_distance,
            motion_errors,
            anchor_model,
            pose_reader: None,
            by_appearance: None,
        })
    }

    /// The same map with the raw features of its room, shape (n, d), of which the frames `mapped`
    /// are mapped: a view whose feature is known is looked for by it. A room with few frames, or of
    /// which they tell too little, stays as it is.
    #[must_use]
    pub fn with_features(self, features: ArrayView2<'_, f32>, mapped: &[FrameId]) -> Self {
        let measured = || {
            let RoomAppearance {
                appearance,
                coordinates,
                without_part,
            } = RoomAppearance::of(features, mapped)?;

            let of_motion = s![.., ..self.navigator.adapter().coordinate_count()];
            let whitened = self
                .error_model
                .frame_noise()
                .whitened(self.navigator.latents().slice(of_motion));
            let likeness = Likeness {
                coordinates: &coordinates,
                without_part: Some(&without_part),
                second_opinion: Some(&whitened),
            };

            let anchor_models =
                AnchorModel::measured_with_and_without(&self.navigator, likeness, mapped)?;
            Some(AppearanceMap {
                anchor_models,
                index: ExactIndex::new(coordinates.view(), mapped),
                appearance,
            })
        };

        let by_appearance = measured();
        Self {
            by_appearance,
            ..self
        }
    }

    /// The same map with a reader of its own room, which gives anchors wherever a frame brings its
    /// raw feature.
    #[must_use]
    pub fn with_pose_reader(self, pose_reader: Arc<dyn PoseReader>) -> Self {
        Self {
            pose_reader: Some(pose_reader),
            ..self
        }
    }

    /// The pose of a view by the reader of this room; none without one, or without a feature.
    pub(super) fn pose_by_reader(&self, feature: Option<&[f32]>) -> Option<PoseWithCovariance> {
        self.pose_reader.as_ref()?.read_pose(feature?)
    }

    /// The room and its adapter.
    pub fn navigator(&self) -> &Arc<Navigator> {
        &self.navigator
    }

    /// About how much memory it holds, bytes, besides the navigator.
    pub fn memory_bytes(&self) -> usize {
        let by_appearance = self.by_appearance.as_ref().map_or(0, |map| {
            map.appearance.memory_bytes() + map.index.memory_bytes()
        });
        self.index.memory_bytes() + by_appearance
    }

    /// The errors of motions read in this room, scaled by what its mapped frames show.
    pub fn motion_errors(&self) -> &MotionErrors {
        &self.motion_errors
    }

    /// How the camera that mapped the room moved.
    pub fn motion_prior(&self) -> &MotionPrior {
        &self.motion_prior
    }

    /// The diagonal of the box around the mapped camera positions, metres.
    pub fn extent_m(&self) -> f64 {
        self.extent_m
    }

    /// Matches a view with the `count` mapped frames that look most alike.
    pub fn match_view(&self, query: MapQuery<'_>, count: usize) -> MapMatch {
        let whitened = self.whitened(query.latent);
        let mut by_latent = self.index.nearest(&whitened, count.max(LOOKED_AT), None);
        // A map has frames, or it would not have a typical distance.
        if by_latent.is_empty() {
            by_latent.push(Neighbour {
                frame: FrameId(0),
                distance: f64::INFINITY,
            });
        }

        let limits = self.error_model.statistics();
        let distance = by_latent[0].distance;
        let relative_distance = distance / self.typical_distance;
        let out_of_distribution = relative_distance / limits.out_of_distribution_ratio;

        let blend = Blend::of(&self.navigator, &by_latent, query.latent, None);
        let by_feature = self.by_appearance.as_ref().zip(query.feature);
        let (mut nearest, anchor) = match by_feature {
            Some((map, feature)) => {
                let alike = map.nearest(feature, count.max(LOOKED_AT));

                // A latent that looks like another place says nothing of this one: images that are
                // blurred, noisy or partly hidden spoil latents before they spoil features.
                let second = Some(blend.pose());
                let blend = Blend::of(&self.navigator, &alike, query.latent, second);
                let models = &map.anchor_models;
                let anchor = match out_of_distribution <= 1.0 {
                    true => models.with_latent.anchor(&blend),
                    false => models.without_latent.anchor(&blend.without_latent()),
                };

                let nearest = self.with_latent_distances(&alike, &whitened);
                (nearest, anchor)
            }
            None => {
                let anchor = match &self.anchor_model {
                    Some(model) => model.anchor(&blend),
                    None => calibrated_anchor(&self.error_model, &blend),
                };
                (by_latent, anchor)
            }
        };
        nearest.truncate(count.max(1));

        MapMatch {
            nearest,
            distance,
            out_of_distribution,
            is_certain: relative_distance <= limits.certain_match_ratio,
            anchor,
            is_by_feature: by_feature.is_some(),
        }
    }

    /// The same frames, with the distances of their latents from a whitened one.
    fn with_latent_distances(&self, frames: &[Neighbour], whitened: &[f64]) -> Vec<Neighbour> {
        let latents = self.navigator.latents();
        let of_latent = |found: &Neighbour| {
            let other = self.whitened(latents.row(found.frame.row()));
            let squares = whitened.iter().zip(other).map(|(a, b)| (a - b).powi(2));
            Neighbour {
                frame: found.frame,
                distance: squares.sum::<f64>().sqrt(),
            }
        };
        frames.iter().map(of_latent).collect()
    }

    /// A latent of shape (k,) in standard deviations of frame noise.
    fn whitened(&self, latent: ArrayView1<'_, f64>) -> Vec<f64> {
        let coordinates = latent.slice(s![..self.navigator.adapter().coordinate_count()]);
        self.error_model
            .frame_noise()
            .whitened(coordinates.insert_axis(Axis(0)))
            .row(0)
            .to_vec()
    }
}

/// The median distance from a mapped frame to the nearest other one that is not among its
/// `neighbours` before and after it in time: how far apart views of this room lie when a camera
/// comes back.
fn typical_distance(
    index: &ExactIndex,
    whitened: &Array2<f64>,
    mapped: &[FrameId],
    neighbours: u32,
) -> f64 {
    let every = mapped.len().div_ceil(SAMPLED_FRAMES).max(1);
    let distances: Vec<f64> = mapped
        .iter()
        .step_by(every)
        .filter_map(|&centre| {
            let exclusion = Exclusion {
                centre,
                radius: neighbours,
            };
            let row = whitened.row(centre.row()).to_vec();
            Some(index.nearest(&row, 1, Some(exclusion)).first()?.distance)
        })
        .collect();

    median(&distances)
}

/// The diagonal of the box around the mapped camera positions, metres.
fn extent(navigator: &Navigator, mapped: &[FrameId]) -> f64 {
    let mut low = nalgebra::Vector3::repeat(f64::INFINITY);
    let mut high = nalgebra::Vector3::repeat(f64::NEG_INFINITY);
    for frame in mapped {
        let position = navigator.room().poses()[frame.row()].translation.vector;
        low = low.inf(&position);
        high = high.sup(&position);
    }

    (high - low).norm()
}
