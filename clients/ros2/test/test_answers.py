"""Answers of the server as ROS messages. Expectations are by hand, from the definitions of REP-105 and of the messages."""

import math

import pytest
import stand_in

stand_in.install()

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from seese3_bridge import answers, connection  # noqa: E402
from seese3_bridge.v1 import geometry_pb2, odometry_pb2  # noqa: E402

HALF = math.sqrt(0.5)


def pose(x, y, yaw_90, parent, child):
    """A pose on the ground, turned by a multiple of 90 degrees."""
    angle = yaw_90 * math.pi / 4
    return geometry_pb2.Pose(parent_frame=parent, child_frame=child, position=geometry_pb2.Vector3(x=x, y=y),
                             orientation=geometry_pb2.Quaternion(w=math.cos(angle), z=math.sin(angle)))


def body(in_odom, in_map):
    numbers = [float(n) for n in range(36)]
    velocity = geometry_pb2.Twist(linear=geometry_pb2.Vector3(x=0.5), angular=geometry_pb2.Vector3(z=0.1))
    return odometry_pb2.TrackedBody(
        odom_pose=geometry_pb2.PoseWithCovariance(pose=in_odom, covariance=numbers),
        map_pose=geometry_pb2.PoseWithCovariance(pose=in_map, covariance=numbers[::-1]),
        velocity=geometry_pb2.TwistWithCovariance(twist=velocity, covariance=[0.25] * 36))


def update(status="TRACKING"):
    return odometry_pb2.TrackUpdate(
        timestamp_ns=1_500_000_000, status=odometry_pb2.TrackStatus.Value(f"TRACK_STATUS_{status}"),
        camera=body(pose(9, 9, 0, "odom", "camera"), pose(8, 8, 0, "map", "camera")),
        base=body(pose(1, 0, 0, "odom", "base_link"), pose(2, 3, 1, "map", "base_link")),
        map_from_odom=pose(2, 2, 1, "map", "odom"))


def test_odometry_is_that_of_the_base_with_its_covariances():
    message = answers.odometry_message(update(), Odometry)
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1, 500_000_000)
    assert message.pose.pose.position.x == 1.0 and message.twist.twist.linear.x == 0.5
    assert message.pose.covariance == [float(n) for n in range(36)]
    assert message.twist.covariance == [0.25] * 36

    # Without a velocity, as at the first frame, its variance is unknown.
    first = update()
    first.base.ClearField("velocity")
    assert answers.odometry_message(first, Odometry).twist.covariance[7] == 9999.0


@pytest.mark.parametrize("status", ["DEGRADED", "LOST", "RELOCALIZING"])
def test_a_pose_in_the_map_is_only_published_while_tracking(status):
    tracked = answers.pose_message(update(), PoseWithCovarianceStamped)
    assert tracked.header.frame_id == "map" and tracked.pose.covariance[0] == 35.0
    frames = [found.header.frame_id for found in answers.transforms(update(), TransformStamped)]
    assert frames == ["odom", "map"]

    other = update(status)
    assert answers.pose_message(other, PoseWithCovarianceStamped) is None
    assert [found.header.frame_id for found in answers.transforms(other, TransformStamped)] == ["odom"]
    assert answers.map_transform(other, pose(5, 0, 0, "", ""), "odom", TransformStamped) is None


def test_the_map_is_moved_to_the_robots_own_odometry():
    """In the robot's odometry the base is at (5, 0), not turned; in the map at (2, 3), turned left. What is at the robot's
    origin is 5 behind the base, and so 5 below it in the map: at (2, -2), turned left."""
    found = answers.map_transform(update(), pose(5, 0, 0, "", ""), "wheel_odom", TransformStamped)
    assert (found.header.frame_id, found.child_frame_id) == ("map", "wheel_odom")
    translation, rotation = found.transform.translation, found.transform.rotation
    assert (translation.x, translation.y) == pytest.approx((2.0, -2.0))
    assert (rotation.w, rotation.z) == pytest.approx((HALF, HALF))
    assert answers.map_transform(update(), None, "odom", TransformStamped) is None


def test_a_token_is_only_sent_over_tls(tmp_path):
    token = tmp_path / "token"
    token.write_text("secret\n")
    plain = {"server": "127.0.0.1:1", "tls_ca": "", "tls_cert": "", "tls_key": "", "token_file": ""}
    connection.channel(plain).close()
    assert connection.metadata(plain) == ()
    assert connection.metadata({**plain, "token_file": str(token)}) == (("authorization", "Bearer secret"),)
    for given in ({"token_file": str(token)}, {"tls_cert": "x"}, {"tls_cert": "x", "tls_key": "y"}):
        with pytest.raises(ValueError, match="tls"):
            connection.channel({**plain, **given})
