//! Where the camera was at the times of its images, from the poses and transforms of a bag.

use std::collections::{BTreeMap, VecDeque};

use super::messages::StampedPose;
use seese3_core::geometry::Pose;

/// The longest time between the poses before and after an image, nanoseconds. Between poses further
/// apart the camera may have been anywhere.
const LONGEST_GAP_NS: i64 = 500_000_000;

/// Poses over time, ascending.
type Track = Vec<(i64, Pose)>;

/// Everything that a bag says of poses.
#[derive(Default)]
pub struct Poses {
    /// By topic of poses: the frame whose poses it has, and the poses.
    topics: BTreeMap<String, PoseTopic>,
    /// `parent_from_child`, by the names of both, of topics of transforms alone: other topics may state
    /// the same two frames and mean another estimate.
    transforms: BTreeMap<(String, String), Transform>,
}

#[derive(Default)]
struct PoseTopic {
    child: String,
    track: Track,
}

#[derive(Default)]
struct Transform {
    track: Track,
    /// Whether it was said on /tf_static, and holds for ever.
    is_static: bool,
}

impl Poses {
    /// Adds what a message of a topic of poses said.
    pub fn add_poses(&mut self, topic: &str, poses: Vec<StampedPose>) {
        let of_topic = self.topics.entry(topic.to_owned()).or_default();
        for stated in poses {
            of_topic.child = without_slash(&stated.child);
            of_topic.track.push((stated.time_ns, stated.pose));
        }
    }

    /// Adds what a message of a topic of transforms said.
    pub fn add_transforms(&mut self, topic: &str, transforms: Vec<StampedPose>) {
        for stated in transforms {
            let edge = (without_slash(&stated.parent), without_slash(&stated.child));
            let transform = self.transforms.entry(edge).or_default();
            transform.track.push((stated.time_ns, stated.pose));
            transform.is_static |= topic.ends_with("tf_static");
        }
    }

    /// Brings everything into the order of time. Called once, after the last message.
    pub fn sort(&mut self) {
        let of_topics = self.topics.values_mut().map(|topic| &mut topic.track);
        let of_transforms = self.transforms.values_mut().map(|one| &mut one.track);
        for track in of_topics.chain(of_transforms) {
            track.sort_by_key(|(time, _)| *time);
        }
    }

    /// The path of the camera, by a topic of poses or, without one, by transforms in `world`. The
    /// error says what is missing.
    pub fn path(
        &self,
        pose_topic: Option<&str>,
        world: Option<&str>,
        camera_frame: &str,
        base_from_camera: Option<Pose>,
    ) -> Result<Path<'_>, String> {
        let camera = without_slash(camera_frame);
        let Some(topic) = pose_topic else {
            let world = without_slash(world.unwrap_or_default());
            let chain = self.chain(&world, &camera)?;
            return Ok(Path {
                chain,
                then: base_from_camera.unwrap_or_else(Pose::identity),
            });
        };

        let found = self
            .topics
            .get(topic)
            .ok_or_else(|| format!("topic {topic} has no message that states a pose"))?;
        let mut chain = vec![Edge {
            track: &found.track,
            is_reversed: false,
            is_static: false,
        }];

        // A topic that does not say what its poses are of is taken to be of the camera.
        if base_from_camera.is_none() && !found.child.is_empty() && found.child != camera {
            let rest = self.chain(&found.child, &camera).map_err(|problem| {
                format!(
                    "{problem}; topic {topic} has poses of '{}' and the images are of '{camera}': give --base-from-camera",
                    found.child
                )
            })?;
            chain.extend(rest);
        }
        Ok(Path {
            chain,
            then: base_from_camera.unwrap_or_else(Pose::identity),
        })
    }

    /// The transforms that lead from one frame to another, the fewest; none if they are the same.
    fn chain(&self, from: &str, to: &str) -> Result<Vec<Edge<'_>>, String> {
        let mut reached: BTreeMap<&str, Vec<Edge<'_>>> = BTreeMap::from([(from, Vec::new())]);
        let mut open = VecDeque::from([from]);

        while let Some(frame) = open.pop_front() {
            if frame == to {
                return Ok(reached.remove(to).unwrap_or_default());
            }
            for ((parent, child), transform) in &self.transforms {
                let (next, is_reversed) = match frame {
                    _ if frame == parent => (child.as_str(), false),
                    _ if frame == child => (parent.as_str(), true),
                    _ => continue,
                };
                if !reached.contains_key(next) {
                    let mut way = reached[frame].clone();
                    way.push(Edge {
                        track: &transform.track,
                        is_reversed,
                        is_static: transform.is_static,
                    });
                    reached.insert(next, way);
                    open.push_back(next);
                }
            }
        }

        let mut known: Vec<&str> = self
            .transforms
            .keys()
            .flat_map(|(parent, child)| [parent.as_str(), child.as_str()])
            .collect();
        known.sort_unstable();
        known.dedup();
        let known = match known.as_slice() {
            [] => "it has none".to_owned(),
            names => format!("it has {}", names.join(", ")),
        };
        Err(format!(
            "no transforms lead from '{from}' to '{to}'; {known}"
        ))
    }
}

/// A frame's name as TF compares it.
fn without_slash(frame: &str) -> String {
    frame.trim_start_matches('/').to_owned()
}

#[derive(Debug, Clone, Copy)]
struct Edge<'a> {
    track: &'a Track,
    is_reversed: bool,
    is_static: bool,
}

/// Where a camera was, over time.
pub struct Path<'a> {
    chain: Vec<Edge<'a>>,
    then: Pose,
}

impl Path<'_> {
    /// The camera's pose, `world_from_camera`; none if there is no pose near that time.
    pub fn at(&self, time_ns: i64) -> Option<Pose> {
        let mut pose = Pose::identity();
        for edge in &self.chain {
            let step = if edge.is_static {
                last_before(edge.track, time_ns)?
            } else {
                between(edge.track, time_ns)?
            };
            pose *= if edge.is_reversed {
                step.inverse()
            } else {
                step
            };
        }
        Some(pose * self.then)
    }
}

/// The pose that was said last, as of a static transform: the first one also holds before it was said.
fn last_before(track: &Track, time_ns: i64) -> Option<Pose> {
    let after = track.partition_point(|(time, _)| *time <= time_ns);
    let (_, pose) = track.get(after.saturating_sub(1))?;
    Some(*pose)
}

/// The pose at a time, between those before and after.
fn between(track: &Track, time_ns: i64) -> Option<Pose> {
    let after = track.partition_point(|(time, _)| *time < time_ns);
    let (next_time, next) = track.get(after)?;
    if *next_time == time_ns {
        return Some(*next);
    }
    let (last_time, last) = after.checked_sub(1).map(|before| &track[before])?;

    let gap = next_time - last_time;
    if gap > LONGEST_GAP_NS {
        return None;
    }
    let share = (time_ns - last_time) as f64 / gap as f64;
    let rotation = last
        .rotation
        .try_slerp(&next.rotation, share, 1e-12)
        .unwrap_or(last.rotation);
    let translation = last
        .translation
        .vector
        .lerp(&next.translation.vector, share);
    Some(Pose::from_parts(translation.into(), rotation))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(time_ns: i64, parent: &str, child: &str, x: f64) -> StampedPose {
        StampedPose {
            time_ns,
            parent: parent.to_owned(),
            child: child.to_owned(),
            pose: Pose::translation(x, 0.0, 0.0),
        }
    }

    fn x_at(path: &Path<'_>, time_ns: i64) -> Option<f64> {
        path.at(time_ns).map(|pose| pose.translation.x)
    }

    /// By hand: the base moves 1 m in .4 s, and the camera stands .5 m before it. The map is a child
    /// of odom, so that this transform is inverted.
    #[test]
    fn transforms_are_chained_and_interpolated() {
        let mut poses = Poses::default();
        poses.add_transforms(
            "/tf",
            vec![
                said(0, "odom", "base", 0.0),
                said(400_000_000, "odom", "base", 1.0),
            ],
        );
        // Broadcasters of static transforms say theirs again whenever they have a new one.
        poses.add_transforms(
            "/tf_static",
            vec![
                said(0, "base", "camera", 0.5),
                said(200_000_000, "base", "camera", 0.5),
                said(0, "odom", "/map", -10.0),
            ],
        );
        poses.sort();

        let path = poses.path(None, Some("map"), "camera", None).unwrap();
        assert_eq!(x_at(&path, 100_000_000), Some(10.0 + 0.25 + 0.5));
        assert_eq!(x_at(&path, 400_000_000), Some(11.5));
        assert_eq!(x_at(&path, 400_000_001), None);

        let problem = poses
            .path(None, Some("world"), "camera", None)
            .err()
            .unwrap();
        assert!(problem.contains("base, camera, map, odom"), "{problem}");
    }

    #[test]
    fn an_odometry_of_the_base_needs_to_know_where_the_camera_is() {
        let mut poses = Poses::default();
        let track = vec![said(0, "odom", "base", 2.0), said(100, "odom", "base", 3.0)];
        poses.add_poses("/odom", track);
        poses.sort();

        let problem = poses
            .path(Some("/odom"), None, "camera", None)
            .err()
            .unwrap();
        assert!(problem.contains("--base-from-camera"), "{problem}");

        let camera = Pose::translation(0.25, 0.0, 0.0);
        let path = poses
            .path(Some("/odom"), None, "camera", Some(camera))
            .unwrap();
        assert_eq!(x_at(&path, 50), Some(2.75));
    }

    /// Two estimates of the same frames, of which /tf has one: transforms are those of /tf alone.
    #[test]
    fn an_odometry_is_no_transform() {
        let mut poses = Poses::default();
        poses.add_poses("/wheel/odom", vec![said(50, "odom", "base", 9.0)]);
        let of_tf = vec![said(0, "odom", "base", 1.0), said(100, "odom", "base", 2.0)];
        poses.add_transforms("/tf", of_tf);
        poses.sort();

        let path = poses.path(None, Some("odom"), "base", None).unwrap();
        assert_eq!(x_at(&path, 50), Some(1.5));
        // One pose of a topic is that of its own time.
        let path = poses.path(Some("/wheel/odom"), None, "base", None).unwrap();
        assert_eq!(x_at(&path, 50), Some(9.0));
        assert_eq!(x_at(&path, 51), None);
    }

    /// Half a second without poses: the camera may have been anywhere.
    #[test]
    fn no_pose_is_made_up_over_a_gap() {
        let mut poses = Poses::default();
        let later = LONGEST_GAP_NS + 1;
        poses.add_poses(
            "/pose",
            vec![said(0, "map", "", 0.0), said(later, "map", "", 1.0)],
        );
        poses.sort();
        let path = poses.path(Some("/pose"), None, "camera", None).unwrap();
        assert_eq!(x_at(&path, 0), Some(0.0));
        assert_eq!(x_at(&path, 1), None);
    }
}
