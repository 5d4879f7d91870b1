"""What sensors say, as requests. Expectations are by hand, from the definitions of ROS messages."""

import io
import math
import struct

import pytest
import stand_in
from PIL import Image as Picture

stand_in.install()

from nav_msgs.msg import Odometry  # noqa: E402
from seese3_bridge import requests  # noqa: E402
from seese3_bridge.stream import Requests  # noqa: E402
from seese3_bridge.v1 import geometry_pb2, odometry_pb2  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image, Imu  # noqa: E402


def raw(encoding, rows, step):
    return Image(height=len(rows), width=2, encoding=encoding, step=step, data=b"".join(rows))


@pytest.mark.parametrize(("encoding", "bytes_of_red", "expected"), [
    ("rgb8", b"\xff\x00\x00", (255, 0, 0)),
    ("bgr8", b"\x00\x00\xff", (255, 0, 0)),
    ("bgra8", b"\x00\x00\xff\x80", (255, 0, 0)),
    ("mono8", b"\x4c", 76),
])
def test_raw_images_keep_their_colors_and_lose_their_padding(encoding, bytes_of_red, expected):
    row = bytes_of_red * 2 + b"\x99\x99"
    view = requests.view_of_raw(raw(encoding, [row, row, row], len(row)))
    picture = Picture.open(io.BytesIO(view.image))
    assert picture.size == (2, 3)
    assert all(picture.getpixel((x, y)) == expected for x in range(2) for y in range(3))


@pytest.mark.parametrize(("message", "says"), [
    (raw("bayer_rggb8", [b"\x00\x00"], 2), "bayer_rggb8"),
    (raw("rgb8", [b"\x00" * 6], 7), "6 bytes are no image"),
    (raw("rgb8", [], 6), "no image"),
])
def test_what_is_no_image_is_said(message, says):
    with pytest.raises(ValueError, match=says):
        requests.view_of_raw(message)


def depths(message):
    found = requests.depth_image(message, 0.01)
    picture = Picture.open(io.BytesIO(found.png))
    return found.deviation_m, picture.size, [picture.getpixel((x, y)) for y in range(2) for x in range(2)]


def test_depths_are_millimeters_and_unknown_ones_are_zero():
    padding = b"\x99\x99"
    of_16 = [struct.pack("<2H", 0, 1500) + padding, struct.pack("<2H", 65_535, 7) + padding]
    assert depths(raw("16UC1", of_16, 6)) == (0.01, (2, 2), [0, 1500, 65_535, 7])
    of_32 = [struct.pack("<2f", math.nan, 1.5), struct.pack("<2f", math.inf, 70.0)]
    assert depths(raw("32FC1", of_32, 8)) == (0.01, (2, 2), [0, 1500, 0, 0])
    big = raw("16UC1", [struct.pack(">2H", 0, 1500)] * 2, 4)
    big.is_bigendian = 1
    assert depths(big)[2] == [0, 1500, 0, 1500]


@pytest.mark.parametrize(("message", "says"), [
    (raw("mono8", [b"\x00\x00"], 2), "mono8"),
    (raw("16UC1", [b"\x00" * 4], 3), "4 bytes are no depths"),
    (raw("32FC1", [b"\x00" * 4], 8), "4 bytes are no depths"),
])
def test_what_is_no_depth_is_said(message, says):
    with pytest.raises(ValueError, match=says):
        requests.depth_image(message, 0.01)


def test_a_camera_that_is_not_calibrated_is_none():
    assert requests.camera(CameraInfo(width=640, height=480)) is None


K = [525.0, 0.0, 319.5, 0.0, 530.0, 239.5, 0.0, 0.0, 1.0]
UNSPECIFIED, BROWN_CONRADY, KANNALA_BRANDT = range(3)


@pytest.mark.parametrize(("model", "d", "expected_model", "expected"), [
    ("", [], UNSPECIFIED, []),
    ("plumb_bob", [0.0] * 5, UNSPECIFIED, []),
    ("plumb_bob", [0.1, -0.2, 0.001, -0.002, 0.03], BROWN_CONRADY, [0.1, -0.2, 0.001, -0.002, 0.03]),
    ("rational_polynomial", [0.1, -0.2, 0.001, -0.002, 0.03, 0.0, 0.0, 0.0], BROWN_CONRADY,
     [0.1, -0.2, 0.001, -0.002, 0.03]),
    ("equidistant", [-0.03, 0.01, -0.002, 0.0005], KANNALA_BRANDT, [-0.03, 0.01, -0.002, 0.0005]),
    ("equidistant", [0.0] * 4, KANNALA_BRANDT, [0.0] * 4),
])
def test_a_camera_has_its_center_and_its_distortion(model, d, expected_model, expected):
    camera = requests.camera(CameraInfo(width=640, height=480, k=K, distortion_model=model, d=d))
    assert (camera.width, camera.height, camera.fx, camera.fy) == (640, 480, 525.0, 530.0)
    assert (camera.cx, camera.cy) == (320.0, 240.0)
    assert (camera.distortion_model, list(camera.distortion)) == (expected_model, expected)


@pytest.mark.parametrize(("model", "d"), [
    ("rational_polynomial", [0.1, -0.2, 0.001, -0.002, 0.03, 0.1, 0.0, 0.0]),
    ("thin_prism", [0.1]),
    ("equidistant", [0.1]),
])
def test_other_distortions_are_refused(model, d):
    with pytest.raises(ValueError, match=model):
        requests.camera(CameraInfo(width=640, height=480, k=K, distortion_model=model, d=d))


def imu(seconds, acceleration, orientation=None):
    message = Imu()
    message.header.stamp.sec = seconds
    for axis, value in zip("xyz", acceleration):
        setattr(message.linear_acceleration, axis, value)
    message.orientation_covariance[0] = -1.0
    if orientation is not None:
        message.orientation_covariance[0] = 0.0
        for axis, value in zip("xyzw", orientation):
            setattr(message.orientation, axis, value)
    return message


def direction(measured):
    return measured.direction.x, measured.direction.y, measured.direction.z


def test_gravity_points_down():
    # At rest the acceleration points up. A robot that is rolled by +90 degrees about x has up along its own y.
    assert direction(requests.Gravity().after(imu(0, (0.0, 0.0, 9.8)))) == pytest.approx((0, 0, -9.8))
    half = math.sqrt(0.5)
    rolled = requests.Gravity().after(imu(0, (5.0, 5.0, 5.0), (half, 0.0, 0.0, half)))
    assert direction(rolled) == pytest.approx((0, -1, 0), abs=1e-12)
    # Pitched by +90 degrees about y (REP-103: nose down), up is along its own -x.
    pitched = requests.Gravity().after(imu(0, (5.0, 5.0, 5.0), (0.0, half, 0.0, half)))
    assert direction(pitched) == pytest.approx((1, 0, 0), abs=1e-12)


def test_acceleration_is_averaged():
    gravity = requests.Gravity()
    gravity.after(imu(0, (0.0, 0.0, 10.0)))
    share = 1 - math.exp(-1)
    assert direction(gravity.after(imu(1, (4.0, 0.0, 10.0)))) == pytest.approx((-4 * share, 0, -10))


@pytest.mark.parametrize("numbers", [[1.0], [1.0] * 6, [1.0] * 8])
def test_a_mounting_has_seven_numbers(numbers):
    with pytest.raises(ValueError, match="rear.base_from_camera"):
        requests.mounting("rear.base_from_camera", numbers)
    assert requests.mounting("any", []) is None


def test_the_mean_turns_with_the_sensor():
    # Up is along z; the sensor turns by 0.01 rad about x, so that up has a part of 0.1 of 10 along y then.
    gravity = requests.Gravity()
    gravity.after(imu(0, (0.0, 0.0, 10.0)))
    later = imu(0, (0.0, 0.1, 10.0))
    later.header.stamp.nanosec = 10_000_000
    later.angular_velocity.x = 1.0
    assert direction(gravity.after(later)) == pytest.approx((0, -0.1, -10))


def test_what_tells_no_direction_is_not_sent():
    # As a driver makes the message that has no orientation: the identity, and a covariance of zeros.
    plain = imu(0, (0.0, 9.8, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert direction(requests.Gravity().after(plain)) == pytest.approx((0, -9.8, 0))

    gravity = requests.Gravity()
    assert gravity.after(imu(0, (0.0, 0.0, 0.0))) is None
    assert gravity.after(imu(0, (math.nan, 0.0, 9.8))) is None
    assert direction(gravity.after(imu(60, (0.0, 0.0, 9.8)))) == pytest.approx((0, 0, -9.8))


def test_only_the_newest_frames_wait():
    """Oracle: by hand. Requests other than frames keep their order and are not dropped for frames."""
    waiting = Requests()

    def frame(number):
        return odometry_pb2.TrackRequest(frame=odometry_pb2.TrackFrame(sequence_number=number))

    pose = odometry_pb2.TrackRequest(set_initial_pose=odometry_pb2.SetInitialPose())
    assert [waiting.offer(request) for request in (frame(1), pose, frame(2), frame(3))] == [False, False, False, True]

    sent = waiting.of_call(waiting.begin())
    assert next(sent) == pose
    assert [next(sent).frame.sequence_number for _ in range(2)] == [2, 3]
    waiting.offer(frame(4))
    second = waiting.of_call(waiting.begin())
    assert list(sent) == []
    assert next(second).frame.sequence_number == 4


def test_an_inertial_sample_is_what_the_message_says():
    message = imu(2, (0.1, 0.2, 9.8))
    message.header.stamp.nanosec = 5
    message.angular_velocity.y = -0.5
    sample = requests.inertial_sample(message)
    assert sample.timestamp_ns == 2_000_000_005 and sample.angular_velocity.y == -0.5
    assert [getattr(sample.linear_acceleration, axis) for axis in "xyz"] == [0.1, 0.2, 9.8]

    # By REP-145 a covariance that begins with -1 says that there is no such measurement.
    message.angular_velocity_covariance[0] = -1.0
    assert requests.inertial_sample(message) is None
    assert requests.inertial_sample(imu(0, (math.nan, 0.0, 9.8))) is None


def test_the_covariance_of_wheels_is_taken_if_it_is_asked_for():
    message = Odometry()
    message.twist.covariance = [float(number % 7 == 0) for number in range(36)]
    known = [requests.measured_odometry(message, "base_link", 0.05, asked).velocity_covariance for asked in (True, False)]
    assert list(known[0]) == list(message.twist.covariance) and not known[1]
    message.twist.covariance = [0.0] * 36
    assert not requests.measured_odometry(message, "base_link", 0.05, True).velocity_covariance


def turned(degrees, x):
    half = math.radians(degrees) / 2
    pose = geometry_pb2.Pose(position=geometry_pb2.Vector3(x=x),
                             orientation=geometry_pb2.Quaternion(w=math.cos(half), z=math.sin(half)))
    return odometry_pb2.MeasuredOdometry(pose=pose)


def test_wheels_are_interpolated_to_the_time_of_the_image():
    """Oracle: by hand: a quarter of the way from 0 m and 0 degrees to 2 m and 80 degrees."""
    wheels = requests.Wheels()
    wheels.add(100_000_000, turned(0, 0.0))
    assert wheels.are_awaited(110_000_000) and not wheels.are_awaited(100_000_000) and not wheels.are_awaited(500_000_000)
    wheels.add(140_000_000, turned(80, 2.0))
    found = wheels.at(110_000_000).pose
    assert found.position.x == pytest.approx(0.5)
    assert 2 * math.degrees(math.atan2(found.orientation.z, found.orientation.w)) == pytest.approx(20)
    # The other sign of a quaternion is the same rotation.
    other = turned(80, 2.0)
    other.pose.orientation.w, other.pose.orientation.z = -other.pose.orientation.w, -other.pose.orientation.z
    again = requests.interpolated(turned(0, 0.0), other, 0.25).pose
    assert again.orientation.z / again.orientation.w == pytest.approx(found.orientation.z / found.orientation.w)


def test_the_last_message_of_the_wheels_is_used_once():
    wheels = requests.Wheels()
    assert wheels.at(0) is None
    wheels.add(100_000_000, turned(0, 1.0))
    assert wheels.at(120_000_000).pose.position.x == 1.0
    assert wheels.at(140_000_000) is None, "twice the same pose is a robot that stands still"
    assert wheels.at(900_000_000) is None
