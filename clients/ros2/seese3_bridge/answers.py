"""The server's answers as ROS messages."""

from .v1 import geometry_pb2, odometry_pb2

# What ROS takes for unknown, on the diagonal of a covariance.
UNKNOWN = 9999.0
# The only status under which a pose in the map may be used.
LOCALIZED = "TRACKING"


def set_pose(target, pose):
    """A wire pose into a geometry_msgs/Pose or, by its other names, a geometry_msgs/Transform."""
    position = target.position if hasattr(target, "position") else target.translation
    orientation = target.orientation if hasattr(target, "orientation") else target.rotation
    position.x, position.y, position.z = pose.position.x, pose.position.y, pose.position.z
    for axis in "wxyz":
        setattr(orientation, axis, getattr(pose.orientation, axis))


def set_stamp(header, timestamp_ns, frame_id):
    header.stamp.sec, header.stamp.nanosec = divmod(timestamp_ns, 1_000_000_000)
    header.frame_id = frame_id


def status_name(update):
    return odometry_pb2.TrackStatus.Name(update.status).removeprefix("TRACK_STATUS_")


def is_localized(update):
    """Whether the pose in the map may be used."""
    return status_name(update) == LOCALIZED


def sensor_names(update):
    """The sensors that contradict the others or the pose."""
    return [odometry_pb2.TrackSensor.Name(sensor).removeprefix("TRACK_SENSOR_") for sensor in update.contradicted]


def body_of(update):
    """The base, where it is known, else the camera."""
    return update.base if update.HasField("base") else update.camera


def odometry_message(update, Odometry):
    """nav_msgs/Odometry: the pose in odom, the twist in the body's own frame, both with their covariances."""
    message, body = Odometry(), body_of(update)
    pose = body.odom_pose.pose
    set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
    message.child_frame_id = pose.child_frame
    set_pose(message.pose.pose, pose)
    message.pose.covariance = list(body.odom_pose.covariance)
    message.twist.covariance = [UNKNOWN if place % 7 == 0 else 0.0 for place in range(36)]
    if body.HasField("velocity"):
        for part in ("linear", "angular"):
            for axis in "xyz":
                value = getattr(getattr(body.velocity.twist, part), axis)
                setattr(getattr(message.twist.twist, part), axis, value)
        message.twist.covariance = list(body.velocity.covariance)
    return message


def pose_message(update, PoseWithCovarianceStamped):
    """geometry_msgs/PoseWithCovarianceStamped in map, or None while the camera is not localized."""
    body = body_of(update)
    if not body.HasField("map_pose") or not is_localized(update):
        return None
    message, pose = PoseWithCovarianceStamped(), body.map_pose.pose
    set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
    set_pose(message.pose.pose, pose)
    message.pose.covariance = list(body.map_pose.covariance)
    return message


def transform_message(pose, timestamp_ns, TransformStamped):
    """A wire pose as a TF."""
    message = TransformStamped()
    set_stamp(message.header, timestamp_ns, pose.parent_frame)
    message.child_frame_id = pose.child_frame
    set_pose(message.transform, pose)
    return message


def transforms(update, TransformStamped):
    """TF of odom and, while the camera is localized, of map."""
    poses = [body_of(update).odom_pose.pose]
    if is_localized(update) and update.HasField("map_from_odom"):
        poses.append(update.map_from_odom)
    return [transform_message(pose, update.timestamp_ns, TransformStamped) for pose in poses]


def map_transform(update, odom_from_base, odom_frame, TransformStamped):
    """TF from map to the robot's own odometry frame, as AMCL publishes it; None while the camera is not localized.

    `odom_from_base` is the robot's own odometry at the time of the frame, as a wire pose.
    """
    if odom_from_base is None or not is_localized(update) or not update.base.HasField("map_pose"):
        return None
    map_from_base = update.base.map_pose.pose
    map_from_odom = composed(map_from_base, inverse(odom_from_base))
    map_from_odom.parent_frame, map_from_odom.child_frame = map_from_base.parent_frame, odom_frame
    return transform_message(map_from_odom, update.timestamp_ns, TransformStamped)


def _rotated(q, v):
    """A vector by a quaternion: v + 2 u × (u × v + w v)."""
    ax, ay, az = q.y * v[2] - q.z * v[1], q.z * v[0] - q.x * v[2], q.x * v[1] - q.y * v[0]
    ax, ay, az = ax + q.w * v[0], ay + q.w * v[1], az + q.w * v[2]
    return (v[0] + 2 * (q.y * az - q.z * ay), v[1] + 2 * (q.z * ax - q.x * az), v[2] + 2 * (q.x * ay - q.y * ax))


def _vector(pose):
    return pose.position.x, pose.position.y, pose.position.z


def _pose(position, quaternion):
    return geometry_pb2.Pose(position=geometry_pb2.Vector3(x=position[0], y=position[1], z=position[2]), orientation=quaternion)


def inverse(pose):
    """The inverse of a wire pose."""
    q = pose.orientation
    back = geometry_pb2.Quaternion(w=q.w, x=-q.x, y=-q.y, z=-q.z)
    return _pose([-value for value in _rotated(back, _vector(pose))], back)


def composed(first, second):
    """The product of two wire poses."""
    p, q = first.orientation, second.orientation
    quaternion = geometry_pb2.Quaternion(
        w=p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z, x=p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
        y=p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x, z=p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w)
    moved = _rotated(p, _vector(second))
    return _pose([a + b for a, b in zip(_vector(first), moved)], quaternion)
