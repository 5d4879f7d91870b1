//! The map of a room, in which views are retrieved.

use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis, s};

use super::appearance::{Appearance, COMPONENTS, RoomAppearance};
use super::blend::{Blend, BlendErrors, LOOKED_AT, Likeness, ViewErrors};
use super::clock::frame_period_s;
use super::{Error, PoseWithCovariance};
use seese3_core::adapter::{ErrorModel, TEMPORAL_NEIGHBORS};
use seese3_core::index::{ExactIndex, Exclusion, Index, Neighbor, distance};
use seese3_core::navigation::Navigator;
use seese3_core::room::{FrameId, Room};
use seese3_core::statistics::median;

/// Maximum number of mapped frames sampled for the typical distance.
const SAMPLED_FRAMES: usize = 1_000;

/// Localizer of one room, more accurate than the adapter shared between rooms.
pub trait PoseReader: Send + Sync {
    /// Estimates the pose of a view, `world_from_camera`, from its raw feature, shape (d,). `None`
    /// if that is not possible.
    fn read_pose(&self, feature: &[f32]) -> Option<PoseWithCovariance>;

    /// Distance of a view from the map divided by the largest validated distance: above 1 there is
    /// no pose. `None` if unknown.
    fn distance_over_range(&self, _feature: &[f32]) -> Option<f64> {
        None
    }
}

/// Query of a map for a view.
#[derive(Debug, Clone, Copy)]
pub struct MapQuery<'a> {
    /// Latent, shape (k,).
    pub latent: ArrayView1<'a, f64>,
    /// Raw feature, shape (d,), if known: it retrieves nearer frames than the latent does.
    pub feature: Option<&'a [f32]>,
}

impl<'a> MapQuery<'a> {
    /// A query by latent only.
    pub fn of_latent(latent: ArrayView1<'a, f64>) -> Self {
        Self {
            latent,
            feature: None,
        }
    }
}

/// Index of the mapped frames by PCA of the room's features, with the errors of the poses that it
/// gives.
struct AppearanceMap {
    appearance: Appearance,
    index: ExactIndex,
    errors: ViewErrors,
}

impl AppearanceMap {
    /// The map of these tables; `None` if they do not fit the mapped frames, in order.
    fn of_tables(tables: FeatureTables, mapped: &[FrameId]) -> Option<Self> {
        if tables.coordinates.dim() != (mapped.len(), tables.components.nrows()) {
            return None;
        }

        let [with_latent, without_latent] = &tables.errors;
        Some(Self {
            index: ExactIndex::of_frames(tables.coordinates.view(), mapped),
            errors: ViewErrors {
                with_latent: BlendErrors::of_numbers(with_latent)?,
                without_latent: BlendErrors::of_numbers(without_latent)?,
            },
            appearance: Appearance::of_parts(tables.mean, tables.components)?,
        })
    }

    /// The mapped frames most similar to a feature of shape (d,).
    fn nearest(&self, feature: &[f32], count: usize) -> Vec<Neighbor> {
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
    /// `None` if too few frames are mapped; the calibrated errors are then used.
    errors: Option<BlendErrors>,
    pose_reader: Option<Arc<dyn PoseReader>>,
    by_appearance: Option<AppearanceMap>,
}

/// What a map derives from the latents and features of its frames. It takes most of the time of
/// making a map, and can be kept.
#[derive(Debug, Clone, PartialEq)]
pub struct MapTables {
    /// The typical distance between views when a camera returns to a place, in standard deviations
    /// of frame noise.
    pub typical_distance: f64,
    /// Errors of poses by latent, as many numbers as [`MapTables::ERRORS`]; `None` if too few frames
    /// are mapped.
    pub errors: Option<Vec<f64>>,
    /// Retrieval by feature, if there is any.
    pub by_feature: Option<FeatureTables>,
}

/// The part of [`MapTables`] for retrieval by feature.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureTables {
    /// Mean of the features at length 1, shape (d,).
    pub mean: Array1<f64>,
    /// Scaled components, shape (c, d).
    pub components: Array2<f64>,
    /// Coordinates of the mapped frames, in order, shape (m, c).
    pub coordinates: Array2<f64>,
    /// Errors of poses with and without a latent in distribution, each as many numbers as
    /// [`MapTables::ERRORS`].
    pub errors: [Vec<f64>; 2],
}

impl MapTables {
    /// The version of the computation. It changes with any change of a result.
    pub const VERSION: u32 = 1;
    /// Numbers of the errors of poses.
    pub const ERRORS: usize = BlendErrors::NUMBERS;
}

/// Match of a view with a map.
#[derive(Debug, Clone, PartialEq)]
pub struct MapMatch {
    /// Most similar mapped frames, best first; at least one. The distances are those of latents, in
    /// standard deviations of frame noise.
    pub nearest: Vec<Neighbor>,
    /// Distance of the nearest latent, in standard deviations of frame noise, comparable between
    /// rooms.
    pub distance: f64,
    /// `distance` divided by the room's limit: above 1 the view is out of distribution.
    pub out_of_distribution: f64,
    /// Whether the match is certain: hardly any frame of another room is that near.
    pub is_certain: bool,
    /// Pose estimated from the nearest frames, `world_from_camera`.
    pub pose: PoseWithCovariance,
    /// Whether the frames were retrieved by raw feature, not by latent.
    pub is_by_feature: bool,
}

impl Map {
    /// The largest number of coordinates of a view's appearance.
    pub const COMPONENTS: usize = COMPONENTS;

    /// Builds a map of the frames `mapped` of a room, given in order.
    ///
    /// # Errors
    /// - [`Error::NotCalibrated`] if the adapter has no error model.
    /// - [`Error::SmallMap`] if no mapped frame has a distinct one outside its temporal
    ///   neighborhood.
    pub fn new(navigator: Arc<Navigator>, mapped: &[FrameId]) -> Result<Self, Error> {
        let (error_model, whitened) = whitened_latents(&navigator)?;
        let index = ExactIndex::new(whitened.view(), mapped);

        // The temporal neighborhood covers the same time as in the calibration rooms.
        let rows_per_frame =
            error_model.statistics().frame_period_s / frame_period_s(navigator.room());
        let neighbors = (f64::from(TEMPORAL_NEIGHBORS) * rows_per_frame)
            .round()
            .max(1.0);
        let typical_distance = typical_distance(&index, &whitened, mapped, neighbors as u32);
        if !(typical_distance.is_finite() && typical_distance > 0.0) {
            return Err(Error::SmallMap {
                room: navigator.room().id().clone(),
                frames: mapped.len(),
            });
        }

        let by_latent = Likeness {
            coordinates: &whitened,
            without_part: None,
            second_opinion: None,
        };
        let errors = BlendErrors::measured(&navigator, by_latent, mapped);

        Ok(Self {
            navigator,
            error_model,
            index,
            typical_distance,
            errors,
            pose_reader: None,
            by_appearance: None,
        })
    }

    /// The map that gave these tables, of the same navigator and mapped frames, in order. `None` if they
    /// do not fit, or the adapter has no error model.
    pub fn of_tables(
        navigator: Arc<Navigator>,
        mapped: &[FrameId],
        tables: MapTables,
    ) -> Option<Self> {
        let (error_model, whitened) = whitened_latents(&navigator).ok()?;
        let errors = match tables.errors {
            Some(numbers) => Some(BlendErrors::of_numbers(&numbers)?),
            None => None,
        };
        let by_appearance = match tables.by_feature {
            Some(tables) => Some(AppearanceMap::of_tables(tables, mapped)?),
            None => None,
        };

        Some(Self {
            index: ExactIndex::new(whitened.view(), mapped),
            typical_distance: tables.typical_distance,
            errors,
            by_appearance,
            navigator,
            error_model,
            pose_reader: None,
        })
    }

    /// What [`Map::of_tables`] makes this map of, without its localizer.
    pub fn tables(&self) -> MapTables {
        let by_feature = |map: &AppearanceMap| {
            let (mean, components) = map.appearance.parts();
            FeatureTables {
                mean: mean.clone(),
                components: components.clone(),
                coordinates: map.index.rows(),
                errors: [&map.errors.with_latent, &map.errors.without_latent]
                    .map(BlendErrors::to_numbers),
            }
        };
        MapTables {
            typical_distance: self.typical_distance,
            errors: self.errors.as_ref().map(BlendErrors::to_numbers),
            by_feature: self.by_appearance.as_ref().map(by_feature),
        }
    }

    /// Adds retrieval by raw feature. `features` has shape (n, d), `mapped` holds the mapped
    /// frames. Without enough frames for the PCA and the errors, retrieval by latent remains.
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

            Some(AppearanceMap {
                errors: ViewErrors::measured(&self.navigator, likeness, mapped)?,
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

    /// Adds a localizer of this room. Streams use it for certain matches with a raw feature.
    #[must_use]
    pub fn with_pose_reader(self, pose_reader: Arc<dyn PoseReader>) -> Self {
        Self {
            pose_reader: Some(pose_reader),
            ..self
        }
    }

    /// Estimates the pose of a view with the localizer of this room; `None` without a localizer or
    /// a feature, or if the localizer gives no pose.
    pub fn pose_by_reader(&self, feature: Option<&[f32]>) -> Option<PoseWithCovariance> {
        self.pose_reader.as_ref()?.read_pose(feature?)
    }

    /// The room and its adapter.
    pub fn navigator(&self) -> &Arc<Navigator> {
        &self.navigator
    }

    /// Approximate memory use without the navigator, bytes.
    pub fn memory_bytes(&self) -> usize {
        let by_appearance = self.by_appearance.as_ref().map_or(0, |map| {
            map.appearance.memory_bytes() + map.index.memory_bytes()
        });
        self.index.memory_bytes() + by_appearance
    }

    /// Distance of a whitened latent from the nearest mapped frame, in standard deviations of frame noise; infinite
    /// without mapped frames.
    pub(super) fn distance(&self, whitened: &[f64]) -> f64 {
        let nearest = self.index.nearest(whitened, 1, None);
        nearest
            .first()
            .map_or(f64::INFINITY, |nearest| nearest.distance)
    }

    /// A distance from the nearest mapped frame, divided by the room's limit: above 1, a view is out of
    /// distribution.
    pub fn out_of_distribution(&self, distance: f64) -> f64 {
        let limit = self.error_model.statistics().out_of_distribution_ratio;
        distance / self.typical_distance / limit
    }

    /// Matches a view with its `count` most similar mapped frames.
    pub fn match_view(&self, query: MapQuery<'_>, count: usize) -> MapMatch {
        let whitened = self.whitened(query.latent);
        let mut by_latent = self.index.nearest(&whitened, count.max(LOOKED_AT), None);
        // Not reachable: a map without frames has no typical distance and is rejected.
        if by_latent.is_empty() {
            by_latent.push(Neighbor {
                frame: FrameId(0),
                distance: f64::INFINITY,
            });
        }

        let limits = self.error_model.statistics();
        let distance = by_latent[0].distance;
        let relative_distance = distance / self.typical_distance;
        let out_of_distribution = self.out_of_distribution(distance);

        let blend = Blend::of(&self.navigator, &by_latent, None);
        let by_feature = self.by_appearance.as_ref().zip(query.feature);
        let (mut nearest, pose) = match by_feature {
            Some((map, feature)) => {
                let alike = map.nearest(feature, count.max(LOOKED_AT));

                // Ignore a latent that is out of distribution. Blurred, noisy or partly occluded
                // images degrade latents more than features.
                let blend = Blend::of(&self.navigator, &alike, Some(&blend.pose));
                let pose = if out_of_distribution <= 1.0 {
                    map.errors.with_latent.pose(&blend)
                } else {
                    map.errors.without_latent.pose(&blend.without_latent())
                };

                let nearest = self.with_latent_distances(&alike, &whitened);
                (nearest, pose)
            }
            None => {
                let pose = match &self.errors {
                    Some(errors) => errors.pose(&blend),
                    None => blend.calibrated(&self.error_model),
                };
                (by_latent, pose)
            }
        };
        nearest.truncate(count.max(1));

        MapMatch {
            nearest,
            distance,
            out_of_distribution,
            is_certain: relative_distance <= limits.certain_match_ratio,
            pose,
            is_by_feature: by_feature.is_some(),
        }
    }

    /// The same mapped frames with the distances of their latents from a whitened latent.
    fn with_latent_distances(&self, frames: &[Neighbor], whitened: &[f64]) -> Vec<Neighbor> {
        let of_latent = |found: &Neighbor| Neighbor {
            frame: found.frame,
            distance: distance(self.index.row(found.frame).unwrap_or_default(), whitened),
        };
        frames.iter().map(of_latent).collect()
    }

    /// The whitened latents of the mapped frames, in order, shape (m, k).
    pub(super) fn whitened_latents(&self) -> Array2<f64> {
        self.index.rows()
    }

    /// Whitens a latent of shape (k,): the result is in standard deviations of frame noise.
    pub(super) fn whitened(&self, latent: ArrayView1<'_, f64>) -> Vec<f64> {
        let coordinates = latent.slice(s![..self.navigator.adapter().coordinate_count()]);
        self.error_model
            .frame_noise()
            .whitened(coordinates.insert_axis(Axis(0)))
            .row(0)
            .to_vec()
    }
}

/// The error model of a navigator's adapter, and the latents in standard deviations of frame noise,
/// which are comparable between rooms and adapters.
fn whitened_latents(navigator: &Navigator) -> Result<(Arc<ErrorModel>, Array2<f64>), Error> {
    let adapter = navigator.adapter();
    let error_model = adapter.error_model().ok_or(Error::NotCalibrated)?.clone();
    let coordinates = s![.., ..adapter.coordinate_count()];
    let whitened = error_model
        .frame_noise()
        .whitened(navigator.latents().slice(coordinates));
    Ok((error_model, whitened))
}

/// Median distance from a mapped frame to its nearest mapped frame more than `neighbors` rows
/// away: the typical distance between views when a camera returns to a place.
fn typical_distance(
    index: &ExactIndex,
    whitened: &Array2<f64>,
    mapped: &[FrameId],
    neighbors: u32,
) -> f64 {
    let every = mapped.len().div_ceil(SAMPLED_FRAMES).max(1);
    let distances: Vec<f64> = mapped
        .iter()
        .step_by(every)
        .filter_map(|&center| {
            let exclusion = Exclusion {
                center,
                radius: neighbors,
            };
            let row = whitened.row(center.row()).to_vec();
            Some(index.nearest(&row, 1, Some(exclusion)).first()?.distance)
        })
        .collect();

    median(&distances)
}

/// Diagonal of the bounding box of the mapped camera positions, meters.
pub(crate) fn extent_m(room: &Room, mapped: &[FrameId]) -> f64 {
    let mut low = nalgebra::Vector3::repeat(f64::INFINITY);
    let mut high = nalgebra::Vector3::repeat(f64::NEG_INFINITY);
    for frame in mapped {
        let position = room.poses()[frame.row()].translation.vector;
        low = low.inf(&position);
        high = high.sup(&position);
    }

    (high - low).norm()
}
