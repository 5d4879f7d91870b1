"""Poses and views on the wire."""

import struct
import zlib

import numpy as np
import pytest
from seese3.answers import Camera
from seese3.geometry import exp_se3, log_se3, pose_matrix, wire_pose, wire_twist
from seese3.requests import DepthImage, wire_camera
from seese3.v1 import geometry_pb2 as pb
from seese3.views import Feature, wire_view


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_a_pose_comes_back_from_the_wire_for_every_angle() -> None:
    random = np.random.default_rng(1)
    for angle in (0.0, 1e-9, 0.3, 2.0, np.pi - 1e-9, np.pi):
        pose = np.eye(4)
        pose[:3, :3] = rotation_about(random.normal(size=3), angle)
        pose[:3, 3] = random.normal(size=3)
        np.testing.assert_allclose(pose_matrix(wire_pose(pose)), pose, atol=1e-12)


def test_a_quarter_turn_about_z_is_the_quaternion_of_the_textbook() -> None:
    pose = np.eye(4)
    pose[:2, :2] = [[0, -1], [1, 0]]
    q = wire_pose(pose).orientation
    np.testing.assert_allclose([q.w, q.x, q.y, q.z], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)


@pytest.mark.parametrize("pose", [np.eye(3), np.full((4, 4), np.nan), np.diag([1, 1, -1, 1]), 2 * np.eye(4)])
def test_what_is_no_pose_is_refused(pose: np.ndarray) -> None:
    with pytest.raises(ValueError, match="a pose"):
        wire_pose(pose)
    with pytest.raises(ValueError, match="a twist is six numbers"):
        wire_twist(np.zeros(5))


@pytest.mark.parametrize("columns", [1, 31, 32, 768, 5000])
def test_a_feature_packed_by_its_bytes_is_the_message_that_protobuf_makes(columns: int) -> None:
    row = np.random.default_rng(columns).normal(size=columns).astype(np.float32)
    expected = pb.View(feature=pb.Feature(values=row.tolist(), feature_set="größe"))
    assert wire_view(Feature(row, "größe")) == expected
    assert wire_view(row.astype(np.float64)).feature.values == expected.feature.values


def test_depths_are_a_png_of_millimeters() -> None:
    """By the definition of PNG: the header, and rows of big-endian values behind the number of their filter."""
    depths = np.array([[0.0, 1.5], [np.nan, 65.535], [-1.0, 70.0]])
    message = DepthImage(depths, 0.01).message()
    assert message.deviation_m == 0.01 and message.png[:8] == b"\x89PNG\r\n\x1a\n"
    assert message.png[12:29] == b"IHDR" + struct.pack(">IIBBBBB", 2, 3, 16, 0, 0, 0, 0)
    begins = message.png.index(b"IDAT") + 4
    rows = zlib.decompress(message.png[begins:])
    assert rows == struct.pack(">" + 3 * "BHH", 0, 0, 1500, 0, 0, 65_535, 0, 0, 0)
    with pytest.raises(ValueError, match="depth.depths"):
        DepthImage([1.0, 2.0]).message()


def test_a_view_that_is_nothing_of_the_kind_is_refused() -> None:
    with pytest.raises(FileNotFoundError, match="nowhere.jpg"):
        wire_view("nowhere.jpg")
    for view in (True, None, [1.0, 2.0]):
        with pytest.raises(TypeError, match="a view is"):
            wire_view(view)  # type: ignore[arg-type]
    for rows in (np.zeros((2, 3)), np.arange(3)):
        with pytest.raises(ValueError, match="a feature is one row"):
            wire_view(rows)


def test_a_camera_comes_back_from_the_wire() -> None:
    for camera in (
        Camera(640, 480, 525.0, 530.0, 330.0, 250.0),
        Camera(640, 480, 525.0, distortion_model="brown_conrady", distortion=(0.1, -0.2, 0.001, -0.002, 0.03)),
        Camera(640, 480, 525.0, distortion_model="kannala_brandt", distortion=(-0.03, 0.01, -0.002, 0.0005)),
    ):
        message = wire_camera(camera)
        assert message is not None and Camera.of(message) == camera

    # By hand: numbers that are left out are absent on the wire.
    message = wire_camera(Camera(640, 480, 525.0))
    assert message == pb.CameraIntrinsics(width=640, height=480, fx=525.0)


def test_motions_are_those_of_the_matrix_exponential() -> None:
    """The series Σ Xⁿ/n! of the 4×4 matrix of a twist, and back."""
    random = np.random.default_rng(3)
    for angle in (0.0, 1e-9, 1e-3, 0.3, 2.0, 3.1):
        axis = random.normal(size=3)
        twist = np.concatenate([random.normal(size=3), angle * axis / np.linalg.norm(axis)])
        x, y, z = twist[3:]
        matrix = np.zeros((4, 4))
        matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        matrix[:3, 3] = twist[:3]
        expected, term = np.eye(4), np.eye(4)
        for n in range(1, 60):
            term = term @ matrix / n
            expected = expected + term
        np.testing.assert_allclose(exp_se3(twist), expected, atol=1e-12)
        np.testing.assert_allclose(log_se3(expected), twist, atol=1e-9)
    several = random.normal(size=(5, 6)) / 3
    np.testing.assert_allclose(log_se3(exp_se3(several)), several, atol=1e-9)
    for bad in (np.zeros(5), np.zeros((2, 2, 6))):
        with pytest.raises(ValueError):
            exp_se3(bad)


def test_pixels_are_a_png_that_opencv_reads() -> None:
    cv2 = pytest.importorskip("cv2")
    pixels = np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    read = cv2.imdecode(np.frombuffer(wire_view(pixels).image, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(read[:, :, ::-1], pixels)
    gray = cv2.imdecode(np.frombuffer(wire_view(pixels[:, :, 0]).image, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(gray, pixels[:, :, 0])
    with pytest.raises(ValueError, match="an image is"):
        wire_view(pixels[:, :, :2])
