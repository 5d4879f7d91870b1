//! Candidate boxes for ray intersection: lists built once per bundle of rays, so that each ray
//! tests only a few boxes.

use nalgebra::{Point3, Vector3};

use super::Solid;

/// Bounding spheres of the boxes, as seen from one point.
pub(super) struct Spheres {
    seen: Vec<Sphere>,
}

struct Sphere {
    /// Unit vector toward the center.
    direction: Vector3<f64>,
    /// Sine and cosine of the sphere's angular radius; `None` if the point is inside the sphere.
    edge: Option<(f64, f64)>,
}

impl Spheres {
    /// The bounding spheres as seen from `apex`, each enlarged by `margin`, meters.
    pub fn around(apex: Point3<f64>, solids: &[Solid], margin: f64) -> Self {
        let seen = solids
            .iter()
            .map(|solid| {
                let to_center = solid.center - apex;
                let distance = to_center.norm();
                let sine = (solid.half.norm() + margin) / distance;

                Sphere {
                    direction: to_center / distance,
                    edge: (sine < 1.0).then(|| (sine, (1.0 - sine * sine).sqrt())),
                }
            })
            .collect();

        Self { seen }
    }

    /// Indices of the boxes that rays in a cone may hit, in ascending order. The cone is the
    /// narrowest about `axis` that contains all `directions`. All vectors have length 1; the cone's
    /// half-angle must be below 90°.
    pub fn met(&self, axis: Vector3<f64>, directions: &[Vector3<f64>]) -> Vec<u16> {
        let cosine = directions
            .iter()
            .map(|direction| axis.dot(direction))
            .fold(1.0, f64::min);
        let sine = (1.0 - cosine * cosine).sqrt();

        (0u16..)
            .zip(&self.seen)
            .filter(|(_, sphere)| {
                let Some((edge_sine, edge_cosine)) = sphere.edge else {
                    return true;
                };

                // Cosine of the sum of both angles; a sphere farther from the axis is outside. The
                // sum is below 180°, because each angle is below 90°.
                let limit = cosine * edge_cosine - sine * edge_sine;
                axis.dot(&sphere.direction) >= limit - 1e-9
            })
            .map(|(number, _)| number)
            .collect()
    }
}

/// Number of cells along each side of a face of the lamp's cube.
const CELLS: usize = 24;

/// Index of boxes by direction from the lamp: a cube around the lamp, with each face divided into
/// square cells.
#[derive(Debug, Clone, Default)]
pub(super) struct Shade {
    cells: Vec<Vec<u16>>,
}

impl Shade {
    /// Builds the index for a lamp at `lamp`. Shadow rays may miss the lamp by up to `margin`,
    /// meters.
    pub fn new(lamp: Point3<f64>, solids: &[Solid], margin: f64) -> Self {
        let spheres = Spheres::around(lamp, solids, margin);
        let cells = (0..6 * CELLS * CELLS)
            .map(|cell| {
                let face = cell / (CELLS * CELLS);
                let row = cell / CELLS % CELLS;
                let column = cell % CELLS;

                // The four corners of the cell, and its middle.
                let at = |right: f64, down: f64| {
                    let on_face = |part: f64| 2.0 * part / CELLS as f64 - 1.0;
                    direction(
                        face,
                        on_face(column as f64 + right),
                        on_face(row as f64 + down),
                    )
                };
                let corners = [at(0.0, 0.0), at(1.0, 0.0), at(0.0, 1.0), at(1.0, 1.0)];

                spheres.met(at(0.5, 0.5), &corners)
            })
            .collect();

        Self { cells }
    }

    /// The boxes that a ray from the lamp may hit; `direction` can have any length.
    pub fn towards(&self, direction: Vector3<f64>) -> &[u16] {
        let axis = direction.iamax();
        let face = 2 * axis + usize::from(direction[axis] < 0.0);
        let along = direction[axis].abs();

        let cell = |coordinate: f64| {
            let part = (coordinate / along + 1.0) / 2.0;
            ((part * CELLS as f64) as usize).min(CELLS - 1)
        };
        let column = cell(direction[(axis + 1) % 3]);
        let row = cell(direction[(axis + 2) % 3]);

        &self.cells[(face * CELLS + row) * CELLS + column]
    }
}

/// Unit vector to a point on a face of the cube; both coordinates are −1 to 1.
fn direction(face: usize, x: f64, y: f64) -> Vector3<f64> {
    let axis = face / 2;
    let mut direction = Vector3::zeros();
    direction[axis] = if face.is_multiple_of(2) { 1.0 } else { -1.0 };
    direction[(axis + 1) % 3] = x;
    direction[(axis + 2) % 3] = y;

    direction.normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Scene;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Oracle: testing every box. The lists contain every box that a ray hits, and exclude most of
    /// the others.
    #[test]
    fn no_box_that_is_met_is_left_out() {
        let scene = Scene::new(8);
        let apex = scene.lamp;
        let shade = Shade::new(apex, &scene.solids, 0.0);
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut listed = 0;
        let mut met = 0;

        for _ in 0..5_000 {
            let towards = Vector3::from_fn(|_, _| random.random_range(-1.0..1.0)).normalize();
            let ray = super::super::solid::Ray {
                origin: apex,
                direction: towards,
            };
            let candidates = shade.towards(towards);
            listed += candidates.len();

            for (number, solid) in (0u16..).zip(&scene.solids) {
                if solid.touch(&ray, f64::INFINITY).is_some() {
                    met += 1;
                    assert!(candidates.contains(&number), "box {number} in {towards}");
                }
            }
        }

        assert!(met > 1_000, "the test meets too few boxes: {met}");
        assert!(
            listed < 5_000 * scene.solids.len() / 4,
            "{listed} boxes are listed"
        );
    }
}
