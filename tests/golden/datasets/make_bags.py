"""Tiny bags of ROS 2, in both of their storages, and a recording of Foxglove, with the camera's poses that a reader must return.
Oracle: rosbags writes and encodes the bag, Foxglove's own schemas with the MCAP project's writer the recording. Poses between
two messages are those of SciPy's Slerp and of a straight line.
Run: python make_bags.py (rosbags 0.11.9, mcap-protobuf-support 0.5.4, foxglove-schemas-protobuf, numpy, scipy, pillow)."""
import io
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage as FoxgloveImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer as FoxgloveWriter
from PIL import Image as Picture
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation, Slerp

HERE = Path(__file__).resolve().parent
STORE = get_typestore(Stores.ROS2_JAZZY)
T = STORE.types
START = 1_700_000_000_000_000_000
PERIOD = 50_000_000
COUNT = 7

# odom_from_base at every period, base_from_camera and map_from_odom as they stand.
random = np.random.default_rng(11)
TIMES = START + PERIOD * np.arange(COUNT)
ROTATIONS = Rotation.from_rotvec(0.4 * random.standard_normal((COUNT, 3)))
POSITIONS = random.standard_normal((COUNT, 3))
BASE_FROM_CAMERA = np.eye(4)
BASE_FROM_CAMERA[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
BASE_FROM_CAMERA[:3, 3] = [0.2, 0.0, 0.4]
MAP_FROM_ODOM = np.eye(4)
MAP_FROM_ODOM[:3, :3] = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
MAP_FROM_ODOM[:3, 3] = [5.0, -3.0, 0.0]
# Images lie between the poses; the last one lies behind the last pose.
IMAGE_TIMES = START + np.array([0, 20_000_000, 75_000_000, 150_000_000, 290_000_000, 300_000_000, 310_000_000])

slerp = Slerp((TIMES - START) * 1e-9, ROTATIONS)


def base(time):
    at = np.eye(4)
    at[:3, :3] = slerp((time - START) * 1e-9).as_matrix()
    at[:3, 3] = [np.interp(time - START, TIMES - START, POSITIONS[:, axis]) for axis in range(3)]
    return at


expected = {
    "times_ns": IMAGE_TIMES[:-1].tolist(),
    "odom_from_base": [base(time).ravel().tolist() for time in IMAGE_TIMES[:-1]],
    "odom_from_camera": [(base(time) @ BASE_FROM_CAMERA).ravel().tolist() for time in IMAGE_TIMES[:-1]],
    "map_from_camera": [(MAP_FROM_ODOM @ base(time) @ BASE_FROM_CAMERA).ravel().tolist() for time in IMAGE_TIMES[:-1]],
}
(HERE / "expected_bags.json").write_text(json.dumps(expected, indent=1))


def header(time, frame):
    stamp = T["builtin_interfaces/msg/Time"](sec=int(time // 10**9), nanosec=int(time % 10**9))
    return T["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def vector(kind, values):
    return T[f"geometry_msgs/msg/{kind}"](*map(float, values))


def quaternion(rotation):
    return vector("Quaternion", Rotation.from_matrix(rotation).as_quat())


def transform(time, parent, child, matrix):
    inner = T["geometry_msgs/msg/Transform"](translation=vector("Vector3", matrix[:3, 3]), rotation=quaternion(matrix[:3, :3]))
    return T["geometry_msgs/msg/TransformStamped"](header=header(time, parent), child_frame_id=child, transform=inner)


def odometry(time, matrix):
    pose = T["geometry_msgs/msg/Pose"](position=vector("Point", matrix[:3, 3]), orientation=quaternion(matrix[:3, :3]))
    with_covariance = T["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
    still = T["geometry_msgs/msg/Twist"](linear=vector("Vector3", np.zeros(3)), angular=vector("Vector3", np.zeros(3)))
    twist = T["geometry_msgs/msg/TwistWithCovariance"](twist=still, covariance=np.zeros(36))
    return T["nav_msgs/msg/Odometry"](header=header(time, "odom"), child_frame_id="base_link", pose=with_covariance, twist=twist)


def pixels(number):
    return np.full((6, 8, 3), (40 * number, 90, 10), np.uint8)


def jpeg(number):
    file = io.BytesIO()
    Picture.fromarray(pixels(number)).save(file, "JPEG", quality=95)
    return file.getvalue()


messages = []
for time, rotation, position in zip(TIMES, ROTATIONS, POSITIONS):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), position
    messages.append((time, "/odom", odometry(time, matrix)))
    messages.append((time, "/tf", T["tf2_msgs/msg/TFMessage"]([transform(time, "odom", "base_link", matrix)])))
static = [transform(START, "base_link", "camera_optical", BASE_FROM_CAMERA), transform(START, "map", "odom", MAP_FROM_ODOM)]
messages.append((START, "/tf_static", T["tf2_msgs/msg/TFMessage"](static)))
for number, time in enumerate(IMAGE_TIMES):
    stamp = header(time, "camera_optical")
    compressed = T["sensor_msgs/msg/CompressedImage"](header=stamp, format="jpeg", data=np.frombuffer(jpeg(number), np.uint8))
    messages.append((time, "/camera/compressed", compressed))
    padded = np.pad(pixels(number)[:, :, ::-1].reshape(6, 24), ((0, 0), (0, 8)))
    raw = T["sensor_msgs/msg/Image"](header=stamp, height=6, width=8, encoding="bgr8", is_bigendian=0, step=32, data=padded.ravel())
    messages.append((time, "/camera/raw", raw))
messages.append((START, "/chatter", T["std_msgs/msg/String"](data="nothing of use")))

for plugin, ending in ((StoragePlugin.MCAP, "mcap"), (StoragePlugin.SQLITE3, "db3")):
    folder = Path(tempfile.mkdtemp())
    writer = Writer(folder / "bag", version=9, storage_plugin=plugin)
    if plugin is StoragePlugin.MCAP:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for time, topic, message in sorted(messages, key=lambda one: one[0]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], int(time), STORE.serialize_cdr(message, kind))
    shutil.copy(next((folder / "bag").glob(f"*.{ending}")), HERE / f"bag.{ending}")
    shutil.rmtree(folder)

with (HERE / "foxglove.mcap").open("wb") as file, FoxgloveWriter(file) as writer:
    for time, rotation, position in zip(TIMES, ROTATIONS, POSITIONS):
        stamp = Timestamp(seconds=int(time // 10**9), nanos=int(time % 10**9))
        pose = PoseInFrame(timestamp=stamp, frame_id="odom")
        transforms = FrameTransforms()
        one = transforms.transforms.add(timestamp=stamp, parent_frame_id="odom", child_frame_id="camera")
        for target, values in ((pose.pose.position, position), (one.translation, position)):
            target.x, target.y, target.z = values
        for target in (pose.pose.orientation, one.rotation):
            target.x, target.y, target.z, target.w = rotation.as_quat()
        writer.write_message("/pose", pose, int(time), int(time))
        writer.write_message("/tf", transforms, int(time), int(time))
    for number, time in enumerate(IMAGE_TIMES):
        stamp = Timestamp(seconds=int(time // 10**9), nanos=int(time % 10**9))
        image = FoxgloveImage(timestamp=stamp, frame_id="camera", format="jpeg", data=jpeg(number))
        writer.write_message("/image", image, int(time), int(time))
