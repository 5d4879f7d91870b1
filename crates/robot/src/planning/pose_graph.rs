//! Shortest routes over the frames of a room, from a pose to a goal, in hops of bounded length.
//!
//! The frames are the nodes of a graph. An edge joins two frames if the motion between them is at
//! most the longest hop. If no route exists, the result holds the hop length that would suffice.

use ndarray::{ArrayView1, s};

use seese3_core::cancel::{Cancellation, Cancelled};
use seese3_core::geometry::{Pose, PoseError, Twist, body_twist};
use seese3_core::index::Neighbor;
use seese3_core::navigation::{Feedback, Navigator, RetrievedFrame};
use seese3_core::room::FrameId;

/// Relative rounding tolerance of the straight-line lower bound of a hop.
const ROUNDING: f64 = 1e-9;

/// Graph of the frames that a route may use; at least one frame.
#[derive(Debug, Clone, Copy)]
pub struct PoseGraph<'a> {
    poses: &'a [Pose],
    frames: &'a [FrameId],
}

/// Constraints of a route.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RouteBounds {
    /// Limit of the hop length.
    pub hops: Hops,
    /// Position tolerance at the goal, meters.
    pub tolerance_m: f64,
    /// Rotation tolerance at the goal, radians.
    pub tolerance_rad: f64,
    /// Minimum arrival probability, 0 to 1; used by [`super::plan`] only.
    pub least_arrival_probability: f64,
}

impl RouteBounds {
    /// Whether a pose error relative to the goal is within both tolerances.
    fn are_met(&self, left: &PoseError) -> bool {
        left.translation_m <= self.tolerance_m && left.rotation_rad <= self.tolerance_rad
    }
}

/// Limit of the hop length ‖(v, ω)‖, meters and radians mixed; above 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Hops {
    /// Hops are at most this long.
    AtMost(f64),
    /// Hops are at most this long if such a route exists. Otherwise the limit is the longest hop of
    /// the bottleneck-shortest path.
    Preferably(f64),
}

/// A route to the goal.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Route {
    /// Frames in order, without the start. If the start is within the tolerance of the goal, there
    /// is at most one hop, to a frame nearer to the goal.
    pub frames: Vec<FrameId>,
    /// Sum of the hop lengths ‖(v, ω)‖, meters and radians mixed.
    pub length: f64,
}

/// Why no route leads to the goal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum NoRoute {
    /// No frame lies within the tolerance of the goal.
    GoalNotMapped {
        /// Frame nearest to the goal.
        nearest: FrameId,
        /// Distance from that frame to the goal.
        off: PoseError,
    },
    /// Every route to the goal has a hop longer than the limit.
    HopTooLong {
        /// Smallest limit for which a route exists.
        needed: f64,
    },
}

/// Path cost that a search minimizes.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Measure {
    /// Sum of the hop lengths.
    Sum,
    /// Longest hop (bottleneck).
    Longest,
}

/// Result of Dijkstra's algorithm, indexed by position in [`PoseGraph::frames`].
struct Search {
    /// Path cost from the start; infinite if unreachable.
    cost: Vec<f64>,
    /// Index of the preceding frame; `None` if that is the start.
    before: Vec<Option<usize>>,
}

impl<'a> PoseGraph<'a> {
    /// A graph over some frames of a room. `poses` are `world_from_camera` of all its frames.
    pub fn new(poses: &'a [Pose], frames: &'a [FrameId]) -> Self {
        Self { poses, frames }
    }

    /// Finds the shortest route from `start` to the reachable frame nearest to `goal`, among the
    /// frames within the tolerance. Time is quadratic in the number of frames.
    ///
    /// # Errors
    /// [`Cancelled`] once `cancel` is set.
    pub fn route(
        &self,
        start: &Pose,
        goal: &Pose,
        bounds: RouteBounds,
        cancel: &Cancellation,
    ) -> Result<Result<Route, NoRoute>, Cancelled> {
        let targets = self.targets(goal, bounds);
        if bounds.are_met(&PoseError::between(start, goal)) {
            return Ok(Ok(self.last_hop(start, goal, bounds, &targets)));
        }

        if targets.is_empty() {
            return Ok(Err(self.goal_not_mapped(goal)));
        }

        let (Hops::AtMost(longest_hop) | Hops::Preferably(longest_hop)) = bounds.hops;
        let found = self.search(start, longest_hop, Measure::Sum, cancel)?;
        if let Some(route) = self.route_of(&found, &targets) {
            return Ok(Ok(route));
        }

        let by_longest = self.search(start, f64::INFINITY, Measure::Longest, cancel)?;
        let needed = targets
            .iter()
            .map(|(place, _)| by_longest.cost[*place])
            .fold(f64::INFINITY, f64::min);
        if matches!(bounds.hops, Hops::AtMost(_)) {
            return Ok(Err(NoRoute::HopTooLong { needed }));
        }

        let found = self.search(start, needed, Measure::Sum, cancel)?;
        let route = self.route_of(&found, &targets);
        Ok(route.ok_or(NoRoute::HopTooLong { needed }))
    }

    /// Route of a camera already within the tolerance: one hop to the frame nearest to the goal, if
    /// that is nearer than the start and within the hop limit; otherwise empty.
    fn last_hop(
        &self,
        start: &Pose,
        goal: &Pose,
        bounds: RouteBounds,
        targets: &[(usize, f64)],
    ) -> Route {
        let left = body_twist(start, goal).norm();
        let best = targets.first().filter(|(_, theirs)| *theirs < left);
        let hop = best.map(|&(place, _)| (place, body_twist(start, self.pose(place)).norm()));

        let (Hops::AtMost(longest_hop) | Hops::Preferably(longest_hop)) = bounds.hops;
        match hop {
            Some((place, length)) if length <= longest_hop => Route {
                frames: vec![self.frames[place]],
                length,
            },
            _ => Route::default(),
        }
    }

    /// Route to the first reachable target.
    fn route_of(&self, found: &Search, targets: &[(usize, f64)]) -> Option<Route> {
        let is_reached = |target: &&(usize, f64)| found.cost[target.0].is_finite();
        let &(place, _) = targets.iter().find(is_reached)?;

        Some(Route {
            frames: self.way_to(found, place),
            length: found.cost[place],
        })
    }

    /// Neighbors of a frame within `longest_hop`, with the motions to them; at most `most`, nearest
    /// first. The length is ‖(v, ω)‖, meters and radians mixed.
    pub fn neighbors(&self, from: FrameId, longest_hop: f64, most: usize) -> Vec<(FrameId, Twist)> {
        let pose = &self.poses[from.row()];
        let position = pose.translation.vector;
        let near = |to: &&FrameId| {
            let line = self.poses[to.row()].translation.vector - position;
            **to != from && line.norm() <= longest_hop
        };

        let mut found: Vec<(FrameId, Twist)> = self
            .frames
            .iter()
            .filter(near)
            .map(|&to| (to, body_twist(pose, &self.poses[to.row()])))
            .filter(|(_, motion)| motion.norm() <= longest_hop)
            .collect();
        found.sort_by(|a, b| a.1.norm().total_cmp(&b.1.norm()));
        found.truncate(most);
        found
    }

    /// Indices of the frames within the tolerance of the goal with their distances ‖(v, ω)‖ to it,
    /// nearest first.
    fn targets(&self, goal: &Pose, bounds: RouteBounds) -> Vec<(usize, f64)> {
        let mut targets: Vec<(usize, f64)> = (0..self.frames.len())
            .filter(|&place| bounds.are_met(&PoseError::between(self.pose(place), goal)))
            .map(|place| (place, body_twist(self.pose(place), goal).norm()))
            .collect();

        targets.sort_by(|a, b| a.1.total_cmp(&b.1));
        targets
    }

    fn goal_not_mapped(&self, goal: &Pose) -> NoRoute {
        let left = |place: &usize| body_twist(self.pose(*place), goal).norm();
        let nearest = (0..self.frames.len()).min_by(|a, b| left(a).total_cmp(&left(b)));
        let nearest = self.frames[nearest.unwrap_or_default()];

        NoRoute::GoalNotMapped {
            nearest,
            off: PoseError::between(&self.poses[nearest.row()], goal),
        }
    }

    /// Dijkstra's algorithm without a heap, since the graph can be nearly complete.
    fn search(
        &self,
        start: &Pose,
        longest_hop: f64,
        measure: Measure,
        cancel: &Cancellation,
    ) -> Result<Search, Cancelled> {
        let count = self.frames.len();
        let mut found = Search {
            cost: vec![f64::INFINITY; count],
            before: vec![None; count],
        };
        let mut open: Vec<usize> = (0..count).collect();
        let mut from = (start, None, 0.0);

        loop {
            cancel.check()?;
            let (pose, before, cost) = from;
            for &place in &open {
                let to = self.pose(place);

                // The straight line is a lower bound of the hop, up to rounding. It excludes most
                // frames cheaply.
                let line = (to.translation.vector - pose.translation.vector).norm();
                let line = line * (1.0 - ROUNDING);
                if line > longest_hop || measure.with(cost, line) >= found.cost[place] {
                    continue;
                }

                let hop = body_twist(pose, to).norm();
                let there = measure.with(cost, hop);
                if hop <= longest_hop && there < found.cost[place] {
                    found.cost[place] = there;
                    found.before[place] = before;
                }
            }

            let next = (0..open.len())
                .filter(|&at| found.cost[open[at]].is_finite())
                .min_by(|&a, &b| found.cost[open[a]].total_cmp(&found.cost[open[b]]));
            let Some(next) = next else { return Ok(found) };
            let place = open.swap_remove(next);
            from = (self.pose(place), Some(place), found.cost[place]);
        }
    }

    fn way_to(&self, found: &Search, target: usize) -> Vec<FrameId> {
        let mut places = vec![target];
        while let Some(before) = found.before[places[places.len() - 1]] {
            places.push(before);
        }

        places
            .iter()
            .rev()
            .map(|&place| self.frames[place])
            .collect()
    }

    fn pose(&self, place: usize) -> &'a Pose {
        &self.poses[self.frames[place].row()]
    }
}

impl Measure {
    /// Cost of a path extended by a hop.
    fn with(self, way: f64, hop: f64) -> f64 {
        match self {
            Self::Sum => way + hop,
            Self::Longest => way.max(hop),
        }
    }
}

impl Route {
    /// Longest hop, including the first one from `start`; `poses` holds all frames of the room.
    pub fn longest_hop(&self, start: &Pose, poses: &[Pose]) -> f64 {
        let stops: Vec<&Pose> = std::iter::once(start)
            .chain(self.frames.iter().map(|frame| &poses[frame.row()]))
            .collect();
        let hops = stops
            .windows(2)
            .map(|pair| body_twist(pair[0], pair[1]).norm());
        hops.fold(0.0, f64::max)
    }

    /// Feedback before the first hop and after each hop, for a camera that starts with this latent,
    /// shape (k,), and pose. A frame's distance is the latent distance from the previous frame.
    pub fn feedback(
        &self,
        navigator: &Navigator,
        latent: ArrayView1<'_, f64>,
        start: &Pose,
        goal: &Pose,
    ) -> Vec<Feedback> {
        let coordinates = s![..navigator.adapter().coordinate_count()];
        let mut reported = vec![Feedback {
            step: 0,
            frame: None,
            motion: Twist::default(),
            remaining: PoseError::between(start, goal),
            recoveries: 0,
        }];

        let mut at = (*start, latent.to_owned());
        for (step, &frame) in (1..).zip(&self.frames) {
            let pose = navigator.room().poses()[frame.row()];
            let latent = navigator.latents().row(frame.row()).to_owned();
            let apart = &latent.slice(coordinates) - &at.1.slice(coordinates);
            let neighbor = Neighbor {
                frame,
                distance: apart.dot(&apart).sqrt(),
            };

            reported.push(Feedback {
                step,
                frame: Some(RetrievedFrame { neighbor, pose }),
                motion: body_twist(&at.0, &pose),
                remaining: PoseError::between(&pose, goal),
                recoveries: 0,
            });
            at = (pose, latent);
        }

        reported
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;
    use proptest::prelude::*;

    use super::*;
    use seese3_core::geometry::exp;

    fn bounds(longest_hop: f64) -> RouteBounds {
        RouteBounds {
            hops: Hops::AtMost(longest_hop),
            tolerance_m: 0.05,
            tolerance_rad: 0.05,
            least_arrival_probability: 0.0,
        }
    }

    fn at(x: f64, y: f64) -> Pose {
        Pose::new(Vector3::new(x, y, 0.0), Vector3::zeros())
    }

    fn all(poses: &[Pose]) -> Vec<FrameId> {
        (0..poses.len() as u32).map(FrameId).collect()
    }

    fn routed(poses: &[Pose], start: &Pose, goal: &Pose, hop: f64) -> Result<Route, NoRoute> {
        PoseGraph::new(poses, &all(poses))
            .route(start, goal, bounds(hop), &Cancellation::default())
            .unwrap()
    }

    /// Oracle: by hand. Frames lie 1 m apart on three sides of a square of 2 m. The goal is 2 m
    /// away, across the open side.
    #[test]
    fn a_route_goes_round_what_no_hop_crosses() {
        let poses = [
            at(0.0, 1.0),
            at(0.0, 2.0),
            at(1.0, 2.0),
            at(2.0, 2.0),
            at(2.0, 1.0),
            at(2.0, 0.0),
        ];
        let start = at(0.0, 0.0);
        let goal = at(2.0, 0.0);

        let around = routed(&poses, &start, &goal, 1.1).unwrap();
        assert_eq!(around.frames, all(&poses));
        assert!((around.length - 6.0).abs() < 1e-12);

        let across = routed(&poses, &start, &goal, 2.1).unwrap();
        assert_eq!(across.frames, [FrameId(5)]);

        let diagonal = routed(&poses, &start, &goal, 1.5).unwrap();
        assert!((diagonal.length - (2.0 + 2.0 * 2_f64.sqrt())).abs() < 1e-12);
    }

    /// Oracle: by hand. The widest gap of the only route is 3 m; an unmapped goal gives
    /// [`NoRoute::GoalNotMapped`]; a camera at the goal gets an empty route.
    #[test]
    fn what_keeps_a_route_from_the_goal_is_said() {
        let poses = [at(1.0, 0.0), at(4.0, 0.0), at(5.0, 0.0)];
        let start = at(0.0, 0.0);

        let Err(NoRoute::HopTooLong { needed }) = routed(&poses, &start, &at(5.0, 0.0), 2.0) else {
            panic!("a hop of 3 m must exceed a limit of 2 m");
        };
        assert!((needed - 3.0).abs() < 1e-12);
        assert!(routed(&poses, &start, &at(5.0, 0.0), needed).is_ok());

        let preferring = RouteBounds {
            hops: Hops::Preferably(2.0),
            ..bounds(2.0)
        };
        let lengthened = PoseGraph::new(&poses, &all(&poses))
            .route(&start, &at(5.0, 0.0), preferring, &Cancellation::default())
            .unwrap();
        assert_eq!(lengthened.unwrap().frames, all(&poses));

        let unmapped = routed(&poses, &start, &at(2.0, 0.0), 9.0);
        let Err(NoRoute::GoalNotMapped { nearest, off }) = unmapped else {
            panic!("the nearest frame is 1 m from the goal, outside the tolerance");
        };
        assert_eq!(nearest, FrameId(0));
        assert!((off.translation_m - 1.0).abs() < 1e-12);

        let there = routed(&poses, &at(5.0, 0.0), &at(5.0, 0.0), 2.0).unwrap();
        assert!(there.frames.is_empty());

        // Being nearer to an unmapped goal than any frame is not enough; the tolerance decides.
        assert!(routed(&poses, &at(2.1, 0.0), &at(2.0, 0.0), 9.0).is_err());
        let within = routed(&poses, &at(2.04, 0.0), &at(2.0, 0.0), 9.0).unwrap();
        assert!(within.frames.is_empty());
        let one_hop = routed(&poses, &at(4.96, 0.0), &at(5.0, 0.0), 1.0).unwrap();
        assert_eq!(one_hop.frames, [FrameId(2)]);
        let no_hop = routed(&poses, &at(4.96, 0.0), &at(5.0, 0.0), 1e-3).unwrap();
        assert!(no_hop.frames.is_empty());
    }

    /// Oracle: the tolerances, by hand. The frame is within 0.25 m and 0.25 rad of the goal. The
    /// start is 0.27 m away: nearer by ‖(v, ω)‖, but outside the tolerance.
    #[test]
    fn a_start_outside_the_tolerance_is_not_there() {
        let frame = Pose::new(Vector3::new(0.2, 0.0, 0.0), Vector3::new(0.0, 0.2, 0.0));
        let bounds = RouteBounds {
            tolerance_m: 0.25,
            tolerance_rad: 0.25,
            ..bounds(1.0)
        };
        let route = PoseGraph::new(&[frame], &[FrameId(0)])
            .route(
                &at(0.27, 0.0),
                &at(0.0, 0.0),
                bounds,
                &Cancellation::default(),
            )
            .unwrap();
        assert_eq!(route.unwrap().frames, [FrameId(0)]);
    }

    proptest! {
        /// Oracle: the Floyd–Warshall algorithm over all pairs. With the longest hop in place of
        /// the sum it gives the bottleneck, the smallest sufficient hop limit.
        #[test]
        fn a_route_is_the_shortest(
            twists in prop::collection::vec(prop::array::uniform6(-1.0..1.0), 4..12),
            hop in 0.5..2.5,
        ) {
            let poses: Vec<Pose> = twists
                .iter()
                .map(|values| exp(&Twist::from_vector(&(*values).into())))
                .collect();
            let [start, frames @ ..] = poses.as_slice() else { unreachable!() };
            let goal = frames[frames.len() - 1];

            let count = poses.len();
            let apart = |a: usize, b: usize| body_twist(&poses[a], &poses[b]).norm();
            let mut sums = vec![vec![f64::INFINITY; count]; count];
            let mut longest = vec![vec![f64::INFINITY; count]; count];
            for a in 0..count {
                for b in 0..count {
                    longest[a][b] = apart(a, b);
                    if apart(a, b) <= hop {
                        sums[a][b] = apart(a, b);
                    }
                }
            }
            for via in 0..count {
                for a in 0..count {
                    for b in 0..count {
                        sums[a][b] = sums[a][b].min(sums[a][via] + sums[via][b]);
                        longest[a][b] = longest[a][b].min(longest[a][via].max(longest[via][b]));
                    }
                }
            }

            match routed(frames, start, &goal, hop) {
                Ok(route) => prop_assert!((route.length - sums[0][count - 1]).abs() < 1e-9),
                Err(NoRoute::HopTooLong { needed }) => {
                    prop_assert!(sums[0][count - 1].is_infinite());
                    prop_assert!((needed - longest[0][count - 1]).abs() < 1e-9);
                }
                Err(other) => prop_assert!(false, "{other:?}"),
            }
        }
    }
}
