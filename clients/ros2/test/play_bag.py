"""Records a drawn room as a bag of ROS 2, plays it into the bridge beside a server, and compares what comes out with the truth.

    play_bag.py --images STORE/images/ROOM --numpy EXPORTED --server ADDRESS --room ROOM --adapter NAME

The bag is a real one (sqlite3, CDR), written and read by the library rosbags; the bridge runs against stand-ins of rclpy. Images
come compressed and raw by turns, with CameraInfo, the odometry of wheels that are 2 % too large, and an accelerometer.
"""

import argparse
import io
import tempfile
import time
from pathlib import Path

import numpy
import stand_in
from PIL import Image as Picture
from rosbags.rosbag2 import Reader, Writer

stand_in.install()

from nav_msgs.msg import Odometry  # noqa: E402
from seese3_bridge.v1 import catalog_pb2, stub  # noqa: E402
from seese3_bridge import node as bridge_node  # noqa: E402
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu  # noqa: E402

# The camera on the base, and the direction of gravity in the room: any will do, and none is the identity.
BASE_FROM_CAMERA = [0.2, 0.0, 0.4, -0.5, 0.5, -0.5, 0.5]
GRAVITY_IN_MAP = numpy.array([0.0, 0.6, -0.8])
PERIOD_NS = 33_333_333
WHEEL_SCALE = 1.02


def matrix(numbers):
    """The 4x4 matrix of x, y, z and the quaternion x, y, z, w."""
    x, y, z, i, j, k, w = numbers
    rotation = [[1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
                [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
                [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)]]
    found = numpy.eye(4)
    found[:3, :3], found[:3, 3] = rotation, (x, y, z)
    return found


def quaternion(rotation):
    """x, y, z, w of a rotation matrix, by the eigenvector of Bar-Itzhack's matrix."""
    r = rotation
    symmetric = numpy.array([
        [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
        [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
        [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]]])
    return numpy.linalg.eigh(symmetric)[1][:, -1]


def stamped(kind, row, frame_id):
    message = kind()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod((row + 1) * PERIOD_NS, 1_000_000_000)
    message.header.frame_id = frame_id
    return message


def image_messages(row, file, camera):
    """An image as a compressed and as a raw message, and the CameraInfo of its camera."""
    picture = Picture.open(file).convert("RGB")
    encoded = io.BytesIO()
    picture.save(encoded, "JPEG", quality=95)
    compressed = stamped(CompressedImage, row, "camera_optical_frame")
    compressed.format, compressed.data = "jpeg", encoded.getvalue()

    raw = stamped(Image, row, "camera_optical_frame")
    raw.width, raw.height, raw.encoding, raw.step = *picture.size, "bgr8", 3 * picture.size[0]
    raw.data = numpy.asarray(picture)[:, :, ::-1].tobytes()

    info = stamped(CameraInfo, row, "camera_optical_frame")
    (info.width, info.height), pixels = picture.size, picture.size[0] / camera.width
    info.k = [camera.fx * pixels, 0.0, camera.cx * pixels - 0.5, 0.0, camera.fy * pixels, camera.cy * pixels - 0.5,
              0.0, 0.0, 1.0]
    return compressed, raw, info


def turn_rate(before, base):
    """The angular velocity in the base's axes from one pose to the next, rad/s."""
    turn = before[:3, :3].T @ base[:3, :3]
    axis = numpy.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    sine = numpy.linalg.norm(axis)
    return axis / max(sine, 1e-12) * numpy.arcsin(min(1.0, sine)) / (PERIOD_NS * 1e-9)


def acceleration(row, bases):
    """The acceleration of the base in the room, by central differences; 0 at the ends."""
    if row in (0, len(bases) - 1):
        return numpy.zeros(3)
    before, now, after = bases[row - 1:row + 2, :3, 3]
    return (before - 2 * now + after) / (PERIOD_NS * 1e-9) ** 2


def sensor_messages(row, bases, has_acceleration):
    base, begin = bases[row], bases[0]
    wheels = stamped(Odometry, row, "wheel_odom")
    since = numpy.linalg.inv(begin) @ base
    position, orientation = wheels.pose.pose.position, wheels.pose.pose.orientation
    position.x, position.y, position.z = WHEEL_SCALE * since[:3, 3]
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion(since[:3, :3])

    imu = stamped(Imu, row, "base_link")
    imu.orientation_covariance[0] = -1.0
    seen = imu.linear_acceleration
    moved = acceleration(row, bases) if has_acceleration else numpy.zeros(3)
    seen.x, seen.y, seen.z = base[:3, :3].T @ (moved - 9.81 * GRAVITY_IN_MAP)
    rate = imu.angular_velocity
    rate.x, rate.y, rate.z = turn_rate(bases[max(0, row - 1)], base)
    return wheels, imu


def record(path, images, bases, camera, has_acceleration):
    """Writes the bag: what sensors say before the image of the same time."""
    with Writer(path, version=9) as writer:
        connections = {}

        def write(topic, message, row):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.type_name, typestore=stand_in.STORE)
            data = stand_in.STORE.serialize_cdr(stand_in.to_bag(message), message.type_name)
            writer.write(connections[topic], (row + 1) * PERIOD_NS, data)

        for row, file in enumerate(images):
            compressed, raw, info = image_messages(row, file, camera)
            wheels, imu = sensor_messages(row, bases, has_acceleration)
            write("/camera_info", info, row)
            write("/wheels", wheels, row)
            write("/imu", imu, row)
            # The second camera's images come before the first one's and after them by turns.
            own = ("/image_raw", raw) if row % 2 else ("/image", compressed)
            other = ("/second/image", compressed)
            for topic, message in (own, other) if row % 3 else (other, own):
                write(topic, message, row)


def camera_of(channel, room):
    """The camera that a room was mapped with, in any unit of pixels."""
    return stub("CatalogService", channel).GetRoom(catalog_pb2.GetRoomRequest(room=room)).camera


def play(path, node):
    """Plays the bag as fast as the node answers."""
    images = 0
    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            topic = f"~{connection.topic}"
            node.deliver(topic, stand_in.STORE.deserialize_cdr(data, connection.msgtype))
            if topic in ("~/image", "~/image_raw"):
                # One frame may wait for its second image.
                wait_for_answers(node, images)
                images += 1
    wait_for_answers(node, images)
    return images


def wait_for_answers(node, count):
    until = time.monotonic() + 60
    while node.counts["updates"] + node.counts["refusals"] < count:
        assert time.monotonic() < until, f"no answer to image {count}: {node.logger.lines}"
        time.sleep(0.001)


def main():
    parser = argparse.ArgumentParser()
    for name in ("images", "numpy", "server", "room", "adapter"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--inertial", action="store_true", help="integrate the samples of ~/imu")
    given = parser.parse_args()

    stand_in.Node.given = {
        "server": given.server, "room": given.room, "adapter": given.adapter, "use_camera_info": True,
        "base_from_camera": BASE_FROM_CAMERA, "gravity_in_map": [float(value) for value in GRAVITY_IN_MAP],
        "other_cameras": ["second"], "second.base_from_camera": BASE_FROM_CAMERA, "inertial": given.inertial,
    }
    node = bridge_node.Bridge()
    assert node.trigger_configure() == "success"
    sent = []
    offer = node.stream.offer
    node.stream.offer = lambda request: (sent.append(request.frame) if request.HasField("frame") else None) or offer(request)
    assert not node.call("~/reset").success
    assert node.trigger_activate() == "success"

    bases = numpy.load(Path(given.numpy) / "poses.npy") @ numpy.linalg.inv(matrix(BASE_FROM_CAMERA))
    images = sorted(Path(given.images).glob("*.png"))
    assert len(images) == len(bases), f"{len(images)} images, {len(bases)} poses"
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder) / "bag", images, bases, camera_of(node.channel, given.room), given.inertial)
        count = play(Path(folder) / "bag", node)

    poses = node.published["~/pose"].messages
    rows = [((message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec) // PERIOD_NS) - 1 for message in poses]
    found = numpy.array([[getattr(message.pose.pose.position, axis) for axis in "xyz"] for message in poses])
    off = numpy.linalg.norm(found - bases[rows, :3, 3], axis=1)
    standing = numpy.linalg.norm(bases[:, :3, 3] - bases[0, :3, 3], axis=1)
    states = [message.status[0].message.split(":")[0] for message in node.published["/diagnostics"].messages]
    tracking = states.count("TRACKING") / count

    print(f"{count} images, {node.counts['refusals']} refused, {len(poses)} poses of base_link; median error "
          f"{numpy.median(off):.3f} m, of standing still {numpy.median(standing):.3f} m; TRACKING {tracking:.2f}")
    assert node.counts["refusals"] == 0, node.logger.lines
    assert len(sent) == count and all(len(frame.other_views) == 1 for frame in sent)
    assert all(frame.HasField("odometry") and frame.HasField("gravity") != given.inertial for frame in sent)
    # Where the path jumps from one visit to the next, the acceleration is none that the server takes.
    with_samples = sum(len(frame.inertial_samples) == 1 for frame in sent)
    assert count - 4 <= with_samples <= count if given.inertial else with_samples == 0
    assert len(node.published["~/odom"].messages) == count and tracking > 0.6
    assert numpy.median(off) < 0.05 < numpy.median(standing)
    assert any(len(transforms) == 2 for transforms in node.broadcaster.sent), "TF of map was never sent"

    # An encoding that cannot be read is said, and the stream goes on.
    node.deliver("~/image_raw", Image(width=2, height=2, step=2, encoding="bayer_rggb8", data=b"abcd"))
    assert "bayer_rggb8" in node.logger.lines[-1] and node.counts["images not sent"] == 1

    lifecycle(node, given.room)


def lifecycle(node, room):
    """Tracking restarts, the room is set again, and the node is stopped, started and cleaned up."""
    def ends_with(status):
        until = time.monotonic() + 60
        while time.monotonic() < until:
            messages = node.published["/diagnostics"].messages
            if messages and messages[-1].status[0].message.startswith(status):
                return
            time.sleep(0.01)
        raise AssertionError(f"no {status}: {messages[-1].status[0].message}")

    assert node.call("~/reset").success
    assert not node.set_parameters(tf="none").successful
    assert not node.set_parameters(room="nowhere", wheel_drift=0.1).successful and node.config.room == room
    assert node.set_parameters(room="nowhere").successful
    ends_with("NOT_FOUND")
    assert node.set_parameters(room=room).successful
    assert node.trigger_deactivate() == "success" and node.thread is None
    assert node.trigger_activate() == "success" and node.thread.is_alive()
    assert node.trigger_deactivate() == "success"
    assert node.trigger_cleanup() == "success"
    assert not node.published and not node.subscribed and not node.services


if __name__ == "__main__":
    main()
