//! Matches under a hypothesis of the motion, several at once by SIMD instructions.
//!
//! Loops are over indexes of lanes: closures would be compiled without the instructions of the target.
#![allow(
    clippy::needless_range_loop,
    reason = "several arrays share the index of a lane"
)]

use multiversion::multiversion;
use nalgebra::{Matrix3, Matrix6, Rotation3, Vector2, Vector3, Vector6};

use super::Match;

/// Prior mean of log ρ, ρ the inverse depth in 1/m, at a point (x, y) in normalized coordinates:
/// coefficients of 1, x, y, x², xy and y². The edges of an image are nearer than its center. Fitted
/// to drawn rooms and one photographed room.
const LOG_INVERSE_DEPTH: [f64; 6] = [-0.9446, -0.1065, -0.0705, 0.4672, 0.0214, 0.2502];

/// Number of matches that are computed together.
pub const LANES: usize = 8;

/// A number of each match of a block.
pub type Lanes = [f64; LANES];

/// Degrees of freedom of the Student-t distribution of a match.
const DEGREES_OF_FREEDOM: f64 = 4.0;

/// The largest weight of a match.
const LARGEST_WEIGHT: f64 = (DEGREES_OF_FREEDOM + 2.0) / DEGREES_OF_FREEDOM;

/// Blocks whose probabilities are multiplied before the logarithm is taken. The product of so few cannot overflow.
const FACTORS: usize = 4;

/// Matches in blocks.
#[derive(Debug)]
pub struct Matches {
    blocks: Vec<Block>,
    count: usize,
}

#[derive(Debug, Clone, Copy)]
struct Block {
    /// Directions (x, y, 1) in the first camera.
    x: Lanes,
    y: Lanes,
    /// Points in the second image, in normalized coordinates.
    u: Lanes,
    v: Lanes,
    /// Standard deviations of the points. Infinite where there is no match: such places have no influence.
    deviation: Lanes,
    /// The inverse depths of the prior, 1/m.
    usual_inverse_depth: Lanes,
}

/// A motion, and what is assumed of the matches.
#[derive(Debug, Clone, Copy)]
pub struct Hypothesis {
    /// `first_from_second`, the pose of the second camera in the first.
    pub rotation: Rotation3<f64>,
    /// Meters.
    pub translation: Vector3<f64>,
    /// Factor on the deviations of the matches.
    pub factor: f64,
    /// Standard deviation of the logarithm of an inverse depth.
    pub depth_spread: f64,
}

/// A block of matches under a hypothesis, each at its most probable depth.
#[derive(Debug, Clone, Copy)]
struct SeenBlock {
    /// log ρ minus its prior mean.
    excess: Lanes,
    inverse_depth: Lanes,
    /// Vectors to the points in the second camera's frame, in units of the depth in the first.
    direction: [Lanes; 3],
    /// Depths in the second camera, in units of those in the first; at least 0.05.
    depth: Lanes,
    /// Predicted points in the second image, and the residuals of the matches.
    expected: [Lanes; 2],
    residual: [Lanes; 2],
    /// Derivative of `expected` with respect to log ρ.
    by_depth: [Lanes; 2],
    /// Variance of the point due to the unknown depth, divided by the match's own variance.
    depth_share: Lanes,
    /// Student-t weights, at most [`LARGEST_WEIGHT`].
    weight: Lanes,
}

/// All matches under a hypothesis.
#[derive(Debug)]
pub struct Seen {
    blocks: Vec<SeenBlock>,
    /// Twice the negative logarithm of the matches' density, up to a constant.
    pub cost: f64,
}

/// Normal equations of a small step (v, ω) of the second camera, with every depth eliminated.
#[derive(Debug)]
pub struct NormalEquations {
    /// The information of the matches.
    pub information: Matrix6<f64>,
    /// The curvature along v of the log-determinants of the matches' variances.
    pub depth_curvature: Matrix3<f64>,
    /// The negative gradient of the matches alone, without their determinants.
    pub gradient: Vector6<f64>,
}

impl Matches {
    /// Puts matches into blocks.
    pub fn new(matches: &[Match]) -> Self {
        let block = |matches: &[Match]| {
            let number = |of: &dyn Fn(&Match) -> f64, absent: f64| {
                std::array::from_fn(|lane| matches.get(lane).map_or(absent, of))
            };
            let usual = |direction: Vector2<f64>| usual_log_inverse_depth(direction).exp();
            Block {
                x: number(&|match_| match_.direction.x, 0.0),
                y: number(&|match_| match_.direction.y, 0.0),
                u: number(&|match_| match_.point.x, 0.0),
                v: number(&|match_| match_.point.y, 0.0),
                deviation: number(&|match_| match_.deviation, f64::INFINITY),
                usual_inverse_depth: number(&|match_| usual(match_.direction.xy()), 1.0),
            }
        };
        Self {
            blocks: matches.chunks(LANES).map(block).collect(),
            count: matches.len(),
        }
    }

    /// The excess of each depth where all are those of the prior.
    pub fn usual_depths(&self) -> Vec<Lanes> {
        vec![[0.0; LANES]; self.blocks.len()]
    }

    /// The matches under a hypothesis. Each depth is optimized from an excess: log ρ minus its prior mean.
    pub fn seen(&self, hypothesis: &Hypothesis, excess: &[Lanes]) -> Seen {
        let (blocks, cost) = seen(&self.blocks, hypothesis, excess);
        Seen { blocks, cost }
    }

    /// The normal equations at a hypothesis.
    pub fn normal_equations(&self, hypothesis: &Hypothesis, seen: &Seen) -> NormalEquations {
        let Sums {
            information,
            gradient,
            shares,
        } = sums(&self.blocks, hypothesis, &seen.blocks);
        let sum = |lanes: &Lanes| lanes.iter().sum::<f64>();
        let upper = |row: usize, column: usize| sum(&information[row.min(column)][row.max(column)]);
        let [one, x, y, square] = shares.each_ref().map(sum);
        NormalEquations {
            information: Matrix6::from_fn(upper),
            gradient: Vector6::from_fn(|row, _| sum(&gradient[row])),
            depth_curvature: Matrix3::new(one, 0.0, -x, 0.0, one, -y, -x, -y, square),
        }
    }

    /// Effective number of inlier matches: the sum of their weights, 0 to 1 each.
    pub fn support(&self, seen: &Seen) -> f64 {
        let weights = seen.blocks.iter().flat_map(|block| block.weight);
        weights.take(self.count).sum::<f64>() / LARGEST_WEIGHT
    }
}

impl Seen {
    /// The excess of each depth.
    pub fn excess(&self) -> Vec<Lanes> {
        self.blocks.iter().map(|block| block.excess).collect()
    }
}

/// The blocks under a hypothesis, and their cost.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn seen(blocks: &[Block], hypothesis: &Hypothesis, excess: &[Lanes]) -> (Vec<SeenBlock>, f64) {
    let mut all = Vec::with_capacity(blocks.len());
    let mut cost = 0.0;
    let (mut distances, mut determinants) = ([1.0; LANES], [1.0; LANES]);

    for (number, (block, excess)) in blocks.iter().zip(excess).enumerate() {
        let seen = seen_block(block, hypothesis, *excess);
        for lane in 0..LANES {
            distances[lane] *= (DEGREES_OF_FREEDOM + 2.0) / seen.weight[lane] / DEGREES_OF_FREEDOM;
            determinants[lane] *= 1.0 + seen.depth_share[lane];
        }
        all.push(seen);

        if number % FACTORS == FACTORS - 1 || number + 1 == blocks.len() {
            for lane in 0..LANES {
                cost += (DEGREES_OF_FREEDOM + 2.0) * distances[lane].ln() + determinants[lane].ln();
            }
            (distances, determinants) = ([1.0; LANES], [1.0; LANES]);
        }
    }

    (all, cost)
}

#[inline(always)]
fn seen_block(block: &Block, hypothesis: &Hypothesis, mut excess: Lanes) -> SeenBlock {
    let Hypothesis {
        rotation,
        translation,
        factor,
        depth_spread,
    } = *hypothesis;
    let second_from_first = rotation.inverse();
    let shift = second_from_first * translation;
    let turn = second_from_first.matrix();
    let depth_information = 1.0 / (depth_spread * depth_spread);

    let mut turned = [[0.0; LANES]; 3];
    let mut variance = [0.0; LANES];
    for lane in 0..LANES {
        let [x, y] = [block.x[lane], block.y[lane]];
        for row in 0..3 {
            turned[row][lane] = turn[(row, 0)] * x + turn[(row, 1)] * y + turn[(row, 2)];
        }
        variance[lane] = (block.deviation[lane] * factor) * (block.deviation[lane] * factor);
    }

    let mut seen = at_depth(block, &turned, &shift, &excess);
    // Two Newton steps towards the most probable depth.
    for _ in 0..2 {
        for lane in 0..LANES {
            let [bx, by] = [seen.by_depth[0][lane], seen.by_depth[1][lane]];
            let along = bx * seen.residual[0][lane] + by * seen.residual[1][lane];
            let slope = along / variance[lane] - excess[lane] * depth_information;
            let curvature = (bx * bx + by * by) / variance[lane] + depth_information;
            let step = (slope / curvature).clamp(-0.7, 0.7);
            excess[lane] = (excess[lane] + step).clamp(-3.0 * depth_spread, 3.0 * depth_spread);
        }
        seen = at_depth(block, &turned, &shift, &excess);
    }

    for lane in 0..LANES {
        let [bx, by] = [seen.by_depth[0][lane], seen.by_depth[1][lane]];
        let [rx, ry] = [seen.residual[0][lane], seen.residual[1][lane]];
        let depth = excess[lane] * excess[lane] * depth_information;
        let distance = (rx * rx + ry * ry) / variance[lane] + depth;
        seen.depth_share[lane] =
            (bx * bx + by * by) / variance[lane] * (depth_spread * depth_spread);
        seen.weight[lane] = (DEGREES_OF_FREEDOM + 2.0) / (DEGREES_OF_FREEDOM + distance);
    }
    seen
}

/// The block at given depths, without weights. `turned` are its directions and `shift` the translation, in the axes
/// of the second camera.
#[inline(always)]
fn at_depth(block: &Block, turned: &[Lanes; 3], shift: &Vector3<f64>, excess: &Lanes) -> SeenBlock {
    let zeros = [0.0; LANES];
    let mut seen = SeenBlock {
        excess: *excess,
        inverse_depth: zeros,
        direction: [zeros; 3],
        depth: zeros,
        expected: [zeros; 2],
        residual: [zeros; 2],
        by_depth: [zeros; 2],
        depth_share: zeros,
        weight: zeros,
    };
    let [sx, sy, sz] = [shift.x, shift.y, shift.z];
    // The exponential is a call: apart from the rest, which is compiled for all lanes together.
    for lane in 0..LANES {
        seen.inverse_depth[lane] = block.usual_inverse_depth[lane] * excess[lane].exp();
    }
    for lane in 0..LANES {
        let inverse_depth = seen.inverse_depth[lane];
        let dx = turned[0][lane] - sx * inverse_depth;
        let dy = turned[1][lane] - sy * inverse_depth;
        let dz = turned[2][lane] - sz * inverse_depth;
        let depth = dz.max(0.05);
        let [x, y] = [dx / depth, dy / depth];
        let slope = -inverse_depth / depth;
        seen.direction[0][lane] = dx;
        seen.direction[1][lane] = dy;
        seen.direction[2][lane] = dz;
        seen.depth[lane] = depth;
        seen.expected[0][lane] = x;
        seen.expected[1][lane] = y;
        seen.residual[0][lane] = block.u[lane] - x;
        seen.residual[1][lane] = block.v[lane] - y;
        seen.by_depth[0][lane] = (sx - x * sz) * slope;
        seen.by_depth[1][lane] = (sy - y * sz) * slope;
    }
    seen
}

/// Sums over blocks, by lane.
struct Sums {
    /// The upper triangle.
    information: [[Lanes; 6]; 6],
    gradient: [Lanes; 6],
    /// Sums of the depth shares times 1, x, y and x² + y² of the predicted points.
    shares: [Lanes; 4],
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn sums(blocks: &[Block], hypothesis: &Hypothesis, seen: &[SeenBlock]) -> Sums {
    let zeros = [0.0; LANES];
    let mut sums = Sums {
        information: [[zeros; 6]; 6],
        gradient: [zeros; 6],
        shares: [zeros; 4],
    };
    for (block, seen) in blocks.iter().zip(seen) {
        add_block(&mut sums, block, hypothesis, seen);
    }
    sums
}

/// Adds the normal equations of a block.
#[inline(always)]
fn add_block(sums: &mut Sums, block: &Block, hypothesis: &Hypothesis, seen: &SeenBlock) {
    let Hypothesis {
        factor,
        depth_spread,
        ..
    } = *hypothesis;
    let depth_information = 1.0 / (depth_spread * depth_spread);
    let zeros = [0.0; LANES];
    // Derivatives of the predicted point by (v, ω), and these times the information of the point whose depth is
    // unknown (the Schur complement of the depth).
    let (mut rows, mut weighted) = ([[zeros; 6]; 2], [[zeros; 6]; 2]);
    let mut slopes = [zeros; 2];

    for lane in 0..LANES {
        let deviation = block.deviation[lane] * factor;
        let variance = deviation * deviation;
        let [x, y] = [seen.expected[0][lane], seen.expected[1][lane]];
        let [rx, ry] = [seen.residual[0][lane], seen.residual[1][lane]];
        let [bx, by] = [seen.by_depth[0][lane], seen.by_depth[1][lane]];
        let [by_x, by_y] = by_motion(seen, lane);

        let own = (bx * bx + by * by) / variance + depth_information;
        let weight = seen.weight[lane] / variance;
        let eliminated = weight / (variance * own);
        let [xx, xy, yy] = [
            weight - bx * bx * eliminated,
            -bx * by * eliminated,
            weight - by * by * eliminated,
        ];
        for column in 0..6 {
            rows[0][column][lane] = by_x[column];
            rows[1][column][lane] = by_y[column];
            weighted[0][column][lane] = xx * by_x[column] + xy * by_y[column];
            weighted[1][column][lane] = xy * by_x[column] + yy * by_y[column];
        }

        let slope = (bx * rx + by * ry) / variance - seen.excess[lane] * depth_information;
        slopes[0][lane] = weight * (rx - bx * slope / own);
        slopes[1][lane] = weight * (ry - by * slope / own);

        let share = depth_spread * seen.inverse_depth[lane] / seen.depth[lane];
        let share = share * share / variance / (1.0 + seen.depth_share[lane]);
        sums.shares[0][lane] += share;
        sums.shares[1][lane] += share * x;
        sums.shares[2][lane] += share * y;
        sums.shares[3][lane] += share * (x * x + y * y);
    }

    for row in 0..6 {
        for column in row..6 {
            for lane in 0..LANES {
                sums.information[row][column][lane] += rows[0][row][lane]
                    * weighted[0][column][lane]
                    + rows[1][row][lane] * weighted[1][column][lane];
            }
        }
        for lane in 0..LANES {
            sums.gradient[row][lane] +=
                rows[0][row][lane] * slopes[0][lane] + rows[1][row][lane] * slopes[1][lane];
        }
    }
}

/// Derivatives of a predicted point, x and y, by a small step (v, ω) of the second camera.
#[inline(always)]
fn by_motion(seen: &SeenBlock, lane: usize) -> [[f64; 6]; 2] {
    let [x, y] = [seen.expected[0][lane], seen.expected[1][lane]];
    let [dx, dy, dz] = [
        seen.direction[0][lane],
        seen.direction[1][lane],
        seen.direction[2][lane],
    ];
    let inverse = 1.0 / seen.depth[lane];
    let pull = -seen.inverse_depth[lane] * inverse;

    // The derivatives by the direction are (1, 0, −x) and (0, 1, −y) over the depth; those by ω their cross
    // products with the direction.
    [
        [
            pull,
            0.0,
            -x * pull,
            x * inverse * dy,
            -inverse * (dz + x * dx),
            inverse * dy,
        ],
        [
            0.0,
            pull,
            -y * pull,
            inverse * (dz + y * dy),
            -y * inverse * dx,
            -inverse * dx,
        ],
    ]
}

/// Prior mean of log ρ at a point on the plane at depth 1.
pub(crate) fn usual_log_inverse_depth(point: Vector2<f64>) -> f64 {
    let [x, y] = [point.x, point.y];
    let terms = [1.0, x, y, x * x, x * y, y * y];

    LOG_INVERSE_DEPTH
        .iter()
        .zip(terms)
        .map(|(factor, term)| factor * term)
        .sum()
}
