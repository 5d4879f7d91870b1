//! The camera's pose at the times of its images, interpolated from a bag's poses and transforms.

use std::collections::{BTreeMap, VecDeque};

use super::messages::StampedPose;
use seese3_core::geometry::Pose;

/// The longest gap between two poses that is interpolated, nanoseconds.
const LONGEST_GAP_NS: i64 = 500_000_000;

/// Times, nanoseconds, and poses, in ascending order of time.
type Track = Vec<(i64, Pose)>;

/// All poses and transforms of a bag.
#[derive(Default)]
pub struct Poses {
    /// The pose topics, by name.
    topics: BTreeMap<String, PoseTopic>,
    /// `parent_from_child` by (parent, child), from transform topics only. A pose topic with the
    /// same two frames may be another estimate.
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
    /// Whether it was published on /tf_static, so that it does not expire.
    is_static: bool,
}

impl Poses {
    /// Adds the poses of a message on a pose topic.
    pub fn add_poses(&mut self, topic: &str, poses: Vec<StampedPose>) {
        let of_topic = self.topics.entry(topic.to_owned()).or_default();
        for stated in poses {
            of_topic.child = without_slash(&stated.child);
            of_topic.track.push((stated.time_ns, stated.pose));
        }
    }

    /// Adds the transforms of a message on a transform topic.
    pub fn add_transforms(&mut self, topic: &str, transforms: Vec<StampedPose>) {
        for stated in transforms {
            let edge = (without_slash(&stated.parent), without_slash(&stated.child));
            let transform = self.transforms.entry(edge).or_default();
            transform.track.push((stated.time_ns, stated.pose));
            transform.is_static |= topic.ends_with("tf_static");
        }
    }

    /// Sorts everything by time. Called once, after the last message.
    pub fn sort(&mut self) {
        let of_topics = self.topics.values_mut().map(|topic| &mut topic.track);
        let of_transforms = self.transforms.values_mut().map(|one| &mut one.track);
        for track in of_topics.chain(of_transforms) {
            track.sort_by_key(|(time, _)| *time);
        }
    }

    /// The camera's path: from a pose topic or, without one, from the transforms between `world`
    /// and the camera. The error names what is missing.
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
            .ok_or_else(|| format!("topic {topic} has no message with a valid pose"))?;
        let mut chain = vec![Edge {
            track: &found.track,
            is_reversed: false,
            is_static: false,
        }];

        // Poses without a child frame are taken as the camera's own.
        if base_from_camera.is_none() && !found.child.is_empty() && found.child != camera {
            let rest = self.chain(&found.child, &camera).map_err(|problem| {
                format!(
                    "{problem}; topic {topic} has poses of frame '{}', but the images have frame '{camera}': give --base-from-camera",
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

    /// The shortest chain of transforms from one frame to another; empty if the frames are the
    /// same.
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
            [] => "the bag has no transforms".to_owned(),
            names => format!("the bag has transforms between {}", names.join(", ")),
        };
        Err(format!(
            "no chain of transforms connects '{from}' and '{to}'; {known}"
        ))
    }
}

/// A frame's name without leading slashes, as TF compares names.
fn without_slash(frame: &str) -> String {
    frame.trim_start_matches('/').to_owned()
}

#[derive(Debug, Clone, Copy)]
struct Edge<'a> {
    track: &'a Track,
    is_reversed: bool,
    is_static: bool,
}

/// The camera's pose as a function of time.
pub struct Path<'a> {
    chain: Vec<Edge<'a>>,
    then: Pose,
}

impl Path<'_> {
    /// The camera's pose, `world_from_camera`. `None` if a pose before or after is missing, or the
    /// two are further apart than `LONGEST_GAP_NS`.
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

/// The latest pose at or before a time, for static transforms; before the first one, the first.
fn last_before(track: &Track, time_ns: i64) -> Option<Pose> {
    let after = track.partition_point(|(time, _)| *time <= time_ns);
    let (_, pose) = track.get(after.saturating_sub(1))?;
    Some(*pose)
}

/// The pose at a time, interpolated between its neighbors.
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

    /// Oracle: by hand. The base moves 1 m in 0.4 s; the camera is 0.5 m ahead of it. The map is a
    /// child of odom, so that this transform is inverted.
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
        // Static broadcasters repeat all their transforms whenever one is added.
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

    /// Oracle: by hand. Two topics estimate the same frames; only the one on /tf is a transform.
    #[test]
    fn an_odometry_is_no_transform() {
        let mut poses = Poses::default();
        poses.add_poses("/wheel/odom", vec![said(50, "odom", "base", 9.0)]);
        let of_tf = vec![said(0, "odom", "base", 1.0), said(100, "odom", "base", 2.0)];
        poses.add_transforms("/tf", of_tf);
        poses.sort();

        let path = poses.path(None, Some("odom"), "base", None).unwrap();
        assert_eq!(x_at(&path, 50), Some(1.5));
        // A single pose is valid only at its own time.
        let path = poses.path(Some("/wheel/odom"), None, "base", None).unwrap();
        assert_eq!(x_at(&path, 50), Some(9.0));
        assert_eq!(x_at(&path, 51), None);
    }

    /// Oracle: the definition. A gap longer than half a second is not interpolated.
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
