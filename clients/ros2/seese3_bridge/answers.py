"""The server's answers as ROS messages."""

from seese3.v1 import odometry_pb2

# What ROS takes for unknown: the errors of velocities are not reported.
UNKNOWN = 9999.0
LOCALIZED = ("TRACKING", "DEGRADED")


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


def sensor_names(update):
    """The sensors that contradict the others or the pose."""
    return [odometry_pb2.TrackSensor.Name(sensor).removeprefix("TRACK_SENSOR_") for sensor in update.contradicted]


def body_of(update):
    """The names of the fields of the base, where it is known, else of the camera: in odom, in map, its covariance, its velocity."""
    if update.HasField("odom_from_base"):
        return "odom_from_base", "map_from_base", "map_from_base_covariance", "base_velocity"
    return "odom_from_camera", "map_from_camera", "map_from_camera_covariance", "body_velocity"


def odometry_message(update, Odometry):
    """nav_msgs/Odometry: the pose in odom, the twist in the body's own frame."""
    message = Odometry()
    in_odom, _, _, velocity = body_of(update)
    pose = getattr(update, in_odom)
    set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
    message.child_frame_id = pose.child_frame
    set_pose(message.pose.pose, pose)
    # The camera's, which differs from the base's by the lever of the mounting alone.
    message.pose.covariance = list(update.odom_from_camera_covariance)
    message.twist.covariance = [UNKNOWN if place % 7 == 0 else 0.0 for place in range(36)]
    if update.HasField(velocity):
        for part in ("linear", "angular"):
            for axis in "xyz":
                setattr(getattr(message.twist.twist, part), axis, getattr(getattr(getattr(update, velocity), part), axis))
    return message


def pose_message(update, PoseWithCovarianceStamped):
    """geometry_msgs/PoseWithCovarianceStamped in map, or None while the camera is not localized."""
    _, in_map, covariance, _ = body_of(update)
    if not update.HasField(in_map) or status_name(update) not in LOCALIZED:
        return None
    message, pose = PoseWithCovarianceStamped(), getattr(update, in_map)
    set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
    set_pose(message.pose.pose, pose)
    message.pose.covariance = list(getattr(update, covariance))
    return message


def transforms(update, TransformStamped):
    """TF of odom and, while the camera is localized, of map."""
    fields = [body_of(update)[0]] + (["map_from_odom"] if status_name(update) in LOCALIZED else [])
    found = []
    for field in fields:
        if update.HasField(field):
            pose, message = getattr(update, field), TransformStamped()
            set_stamp(message.header, update.timestamp_ns, pose.parent_frame)
            message.child_frame_id = pose.child_frame
            set_pose(message.transform, pose)
            found.append(message)
    return found
