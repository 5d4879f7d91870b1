"""What the robot's sensors say, as messages of the server's protocol."""

import collections
import io
import math

import numpy
from PIL import Image as Picture
from .v1 import geometry_pb2, odometry_pb2

# Encodings of sensor_msgs/Image, as Pillow names the modes of the picture and of its bytes.
ENCODINGS = {"rgb8": ("RGB", "RGB"), "bgr8": ("RGB", "BGR"), "rgba8": ("RGB", "RGBX"), "bgra8": ("RGB", "BGRX"),
             "mono8": ("L", "L"), "8UC1": ("L", "L"), "8UC3": ("RGB", "BGR")}
# Encodings of depths: the type of a value, and the depth of the value 1, meters.
DEPTHS = {"16UC1": ("u2", 0.001), "32FC1": ("f4", 1.0)}
# The server's limits of angular velocities and accelerations, rad/s and m/s².
MOST = 100.0, 1_000.0
# The acceleration of a robot that drives is averaged over this time for the direction of gravity, seconds.
AVERAGED_S = 1.0
# What another sensor said so long ago says nothing of a frame, nanoseconds.
OLD_NS = 50_000_000
# Odometry is interpolated over at most this time, nanoseconds.
LONGEST_GAP_NS = 200_000_000


def nanoseconds(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def view_of_compressed(image):
    """The view of a sensor_msgs/CompressedImage: the server reads JPEG and PNG."""
    return geometry_pb2.View(image=bytes(image.data))


def view_of_raw(image):
    """The view of a sensor_msgs/Image, as PNG.

    Raises ValueError for an encoding that is none of ENCODINGS, and for data that are too short."""
    if image.encoding not in ENCODINGS:
        raise ValueError(f"encoding '{image.encoding}' is none of: {', '.join(ENCODINGS)}")
    if image.height * image.step > len(image.data) or image.height == 0 or image.width == 0:
        raise ValueError(f"{len(image.data)} bytes are no image of {image.height} rows of {image.step} bytes")

    mode, of_bytes = ENCODINGS[image.encoding]
    picture = Picture.frombytes(mode, (image.width, image.height), bytes(image.data), "raw", of_bytes, image.step)
    encoded = io.BytesIO()
    picture.save(encoded, "PNG", compress_level=1)
    return geometry_pb2.View(image=encoded.getvalue())


def depth_image(image, deviation_m):
    """The depths of a sensor_msgs/Image that is registered to the camera: millimeters in 16UC1, or meters in 32FC1 (REP-118).

    Raises ValueError for another encoding, and for data that are too short."""
    if image.encoding not in DEPTHS:
        raise ValueError(f"encoding '{image.encoding}' of depths is none of: {', '.join(DEPTHS)}")
    kind, unit_m = DEPTHS[image.encoding]
    kind = numpy.dtype(kind).newbyteorder(">" if image.is_bigendian else "<")
    row = image.width * kind.itemsize
    if image.height == 0 or row == 0 or image.step < row or image.height * image.step > len(image.data):
        raise ValueError(f"{len(image.data)} bytes are no depths of {image.height} rows of {image.step} bytes")

    rows = numpy.frombuffer(bytes(image.data), numpy.uint8)[:image.height * image.step].reshape(image.height, image.step)
    values = numpy.ascontiguousarray(rows[:, :row]).view(kind)
    millimeters = numpy.nan_to_num(numpy.round(values * (unit_m * 1000.0)), nan=0, posinf=0, neginf=0)
    millimeters[(millimeters < 0) | (millimeters > 65_535)] = 0
    encoded = io.BytesIO()
    Picture.fromarray(millimeters.astype(numpy.uint16)).save(encoded, "PNG", compress_level=1)
    return odometry_pb2.DepthImage(png=encoded.getvalue(), deviation_m=deviation_m)


def wire_pose(pose, parent, child):
    """A geometry_msgs/Pose as a wire pose."""
    found = geometry_pb2.Pose(parent_frame=parent, child_frame=child)
    for axis in "xyz":
        setattr(found.position, axis, getattr(pose.position, axis))
    for axis in "wxyz":
        setattr(found.orientation, axis, getattr(pose.orientation, axis))
    return found


def mounting(name, numbers):
    """A pose on the base of seven numbers, or None of none."""
    if not numbers:
        return None
    if len(numbers) != 7:
        raise ValueError(f"{name} must be x, y, z and the quaternion x, y, z, w")
    x, y, z, qx, qy, qz, qw = numbers
    return geometry_pb2.Pose(position=geometry_pb2.Vector3(x=x, y=y, z=z),
                             orientation=geometry_pb2.Quaternion(x=qx, y=qy, z=qz, w=qw))


def direction(name, numbers):
    """A vector of three numbers, or None of none."""
    if not numbers:
        return None
    if len(numbers) != 3:
        raise ValueError(f"{name} must be x, y, z")
    return geometry_pb2.Vector3(x=numbers[0], y=numbers[1], z=numbers[2])


def camera(info):
    """The camera of a sensor_msgs/CameraInfo, or None of one that is not calibrated.

    Raises ValueError for a distortion that the server does not know."""
    if info.width == 0 or info.height == 0 or info.k[0] <= 0:
        return None

    model, coefficients = distortion(info.distortion_model, list(info.d))
    # ROS puts the center of the first pixel at (0, 0), the server at (0.5, 0.5).
    return geometry_pb2.CameraIntrinsics(width=info.width, height=info.height, fx=info.k[0], fy=info.k[4],
                                         cx=info.k[2] + 0.5, cy=info.k[5] + 0.5,
                                         distortion_model=model, distortion=coefficients)


def distortion(model, coefficients):
    """The model and the coefficients on the wire of a CameraInfo's distortion_model and d."""
    if model == "equidistant":
        if len(coefficients) != 4:
            raise ValueError(f"distortion_model equidistant has 4 coefficients, not {len(coefficients)}")
        return geometry_pb2.DISTORTION_MODEL_KANNALA_BRANDT, coefficients
    if not any(coefficients):
        return geometry_pb2.DISTORTION_MODEL_UNSPECIFIED, []
    # The first five coefficients of rational_polynomial are those of plumb_bob.
    if model not in ("plumb_bob", "rational_polynomial") or any(coefficients[5:]):
        raise ValueError(f"distortion_model '{model}' with the coefficients {coefficients} is not supported")
    return geometry_pb2.DISTORTION_MODEL_BROWN_CONRADY, coefficients[:5]


def measured_odometry(message, base_frame, drift, with_covariance):
    """The nav_msgs/Odometry of the wheels. `with_covariance` takes the covariance of its twist, unless that is zero."""
    covariance = list(message.twist.covariance) if with_covariance else []
    return odometry_pb2.MeasuredOdometry(pose=wire_pose(message.pose.pose, "", base_frame),
                                         translation_share=drift, rotation_share=drift,
                                         velocity_covariance=covariance if any(covariance) else [])


class Wheels:
    """The odometry of the wheels at the times of images: interpolated between the messages before and after."""

    def __init__(self):
        self.messages = collections.deque(maxlen=200)
        # The time of the message that was last used as it is.
        self.used_ns = None

    def add(self, stamp, measured):
        """Adds a message. One that is older than the last is left out."""
        if not self.messages or stamp > self.messages[-1][0]:
            self.messages.append((stamp, measured))

    def are_awaited(self, stamp):
        """Whether a message after this time may still come: the last one is just before it."""
        return bool(self.messages) and 0 < stamp - self.messages[-1][0] <= OLD_NS

    def at(self, stamp):
        """The odometry at a time; None if it is not known.

        After the last message it is that message's, but only once: sent twice, the robot would stand still in between."""
        before = [message for message in self.messages if message[0] <= stamp]
        after = [message for message in self.messages if message[0] > stamp]
        if before and after and after[0][0] - before[-1][0] <= LONGEST_GAP_NS:
            (start, first), (end, second) = before[-1], after[0]
            return interpolated(first, second, (stamp - start) / (end - start))
        nearest = min((before[-1:] + after[:1]), key=lambda message: abs(message[0] - stamp), default=None)
        if nearest is None or abs(nearest[0] - stamp) > OLD_NS or nearest[0] == self.used_ns:
            return None
        self.used_ns = nearest[0]
        return nearest[1]


def interpolated(first, second, share):
    """Odometry between two measurements, by the share of the time from the first to the second."""
    found = odometry_pb2.MeasuredOdometry()
    found.CopyFrom(second)
    a, b = first.pose, second.pose
    for axis in "xyz":
        start = getattr(a.position, axis)
        setattr(found.pose.position, axis, start + share * (getattr(b.position, axis) - start))

    # Spherical linear interpolation, along the shorter arc.
    p = [getattr(a.orientation, name) for name in "wxyz"]
    q = [getattr(b.orientation, name) for name in "wxyz"]
    cosine = sum(x * y for x, y in zip(p, q))
    if cosine < 0:
        q, cosine = [-y for y in q], -cosine
    angle = math.acos(min(1.0, cosine))
    if angle < 1e-6:
        weights = 1 - share, share
    else:
        weights = math.sin((1 - share) * angle) / math.sin(angle), math.sin(share * angle) / math.sin(angle)
    mixed = [weights[0] * x + weights[1] * y for x, y in zip(p, q)]
    norm = math.sqrt(sum(x * x for x in mixed))
    for name, value in zip("wxyz", mixed):
        setattr(found.pose.orientation, name, value / norm)
    return found


def inertial_sample(imu):
    """The sample of a sensor_msgs/Imu, or None of one without an angular velocity and an acceleration that the server takes."""
    vectors = [[getattr(vector, axis) for axis in "xyz"] for vector in (imu.angular_velocity, imu.linear_acceleration)]
    # A covariance that begins with -1 says that there is no measurement.
    is_missing = imu.angular_velocity_covariance[0] < 0 or imu.linear_acceleration_covariance[0] < 0
    is_usable = all(abs(value) <= most for vector, most in zip(vectors, MOST) for value in vector)
    if is_missing or not is_usable:
        return None
    rate, acceleration = (geometry_pb2.Vector3(x=x, y=y, z=z) for x, y, z in vectors)
    return odometry_pb2.InertialSample(timestamp_ns=nanoseconds(imu.header.stamp),
                                       angular_velocity=rate, linear_acceleration=acceleration)


class Gravity:
    """The direction of gravity of sensor_msgs/Imu messages, in their axes: by the orientation where there is one, else by
    the mean acceleration of a second, which points up at rest and is turned by the angular velocity (a complementary filter). A driver that leaves the orientation and its covariance as
    they are made has none."""

    def __init__(self):
        self.mean, self.stamp = None, None

    def after(self, imu):
        """The direction after a message, or None of one that tells none."""
        q = imu.orientation
        is_plain = (q.x, q.y, q.z) == (0, 0, 0) and not any(imu.orientation_covariance)
        if imu.orientation_covariance[0] >= 0 and not is_plain and any((q.w, q.x, q.y, q.z)):
            # The last row of the rotation: the world's z axis, which points up (REP-103), in the sensor's axes.
            up = (2 * (q.x * q.z - q.w * q.y), 2 * (q.y * q.z + q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y))
        else:
            up = self._mean(imu)
        if up is None or not all(map(math.isfinite, up)) or not any(up):
            return None
        return odometry_pb2.MeasuredGravity(direction=geometry_pb2.Vector3(x=-up[0], y=-up[1], z=-up[2]))

    def _turned(self, rate, seconds):
        """The mean in the sensor's axes after it has turned: what is fixed in the world turns the other way."""
        x, y, z = self.mean
        if not all(map(math.isfinite, (rate.x, rate.y, rate.z))):
            return self.mean
        return (x - seconds * (rate.y * z - rate.z * y), y - seconds * (rate.z * x - rate.x * z),
                z - seconds * (rate.x * y - rate.y * x))

    def _mean(self, imu):
        stamp, seen = nanoseconds(imu.header.stamp), imu.linear_acceleration
        new = (seen.x, seen.y, seen.z)
        if not all(map(math.isfinite, new)):
            return None
        if self.mean is None:
            self.mean = new
        else:
            seconds = max(0.0, (stamp - self.stamp) * 1e-9)
            share = 1 - math.exp(-seconds / AVERAGED_S)
            turned = self._turned(imu.angular_velocity, seconds)
            self.mean = tuple(old + share * (value - old) for old, value in zip(turned, new))
        self.stamp = stamp
        return self.mean
