"""Poses and motions as NumPy arrays.

- A pose is a (4, 4) matrix `target_from_source`, meters; the camera's axes are x right, y down, z forward.
- A twist is (6,), ordered (v, ω): meters and radians, in the body frame of the source camera.
- A covariance of a pose is (6, 6) in ROS's order: x, y, z and rotations about x, y, z of the room's world frame.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from .v1 import geometry_pb2 as pb

Array = npt.NDArray[np.float64]


def real(values: npt.ArrayLike, what: str) -> Array:
    """The numbers as a new C-ordered array of doubles; refused if they are complex or masked, or no numbers."""
    if np.iscomplexobj(values) or np.ma.isMaskedArray(values):
        raise ValueError(f"{what}: complex numbers and masked arrays are not taken")
    try:
        return np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: {error}") from None


def pose_matrix(pose: pb.Pose) -> Array:
    """The (4, 4) matrix of a pose from the wire."""
    p, q = pose.position, pose.orientation
    w, x, y, z = q.w, q.x, q.y, q.z
    # Not a number is within no bound.
    if not (abs(w * w + x * x + y * y + z * z - 1) < 1e-3 and abs(p.x) + abs(p.y) + abs(p.z) < math.inf):
        raise ValueError("a pose has no finite position, or no unit quaternion")
    # Row by row: from a flat tuple NumPy makes a matrix in half the time.
    # fmt: off
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), p.x,
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), p.y,
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), p.z,
        0.0, 0.0, 0.0, 1.0,
    )
    # fmt: on
    return np.array(rows).reshape(4, 4)


def wire_pose(matrix: npt.ArrayLike, parent_frame: str = "", child_frame: str = "") -> pb.Pose:
    """The pose of a (4, 4) matrix. Its rotation is checked, and refused if it is none."""
    m = real(matrix, "a pose")
    if m.shape != (4, 4) or not np.isfinite(m).all():
        raise ValueError(f"a pose is a (4, 4) matrix of finite numbers, not {m.shape}")
    rotation = m[:3, :3]
    deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if np.abs(m[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise ValueError("the last row of a pose is 0, 0, 0, 1; is the matrix transposed?")
    if deviation > 1e-2:
        raise ValueError(f"a pose is a rotation and a translation; R Rᵀ differs from the identity by {deviation:.1e}")
    if np.linalg.det(rotation) < 0:
        raise ValueError("a pose is a rotation and a translation; this matrix mirrors: its determinant is -1")

    w, x, y, z = _quaternion_wxyz(rotation)
    return pb.Pose(
        parent_frame=parent_frame,
        child_frame=child_frame,
        position=pb.Vector3(x=m[0, 3], y=m[1, 3], z=m[2, 3]),
        orientation=pb.Quaternion(w=w, x=x, y=y, z=z),
    )


def _quaternion_wxyz(rotation: Array) -> Array:
    """The unit quaternion of a rotation, exact for every angle: the largest eigenvector of Bar-Itzhack's matrix."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0.0, r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2]],
            [0.0, 0.0, r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2]],
            [0.0, 0.0, 0.0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    quaternion: Array = np.linalg.eigh(k, UPLO="U").eigenvectors[:, -1]
    return quaternion if quaternion[0] >= 0 else -quaternion


def vector(coordinates: pb.Vector3) -> Array:
    """The three coordinates, (3,)."""
    return np.array([coordinates.x, coordinates.y, coordinates.z])


def twist_vector(twist: pb.Twist) -> Array:
    """The (6,) vector of a twist from the wire."""
    v, omega = twist.linear, twist.angular
    if not abs(v.x) + abs(v.y) + abs(v.z) + abs(omega.x) + abs(omega.y) + abs(omega.z) < math.inf:
        raise ValueError("a twist is not finite")
    return np.array([v.x, v.y, v.z, omega.x, omega.y, omega.z])


def wire_twist(vector: npt.ArrayLike) -> pb.Twist:
    """The twist of a (6,) vector."""
    xi = real(vector, "a twist")
    if xi.shape != (6,):
        raise ValueError(f"a twist is six numbers (v, ω), not an array of shape {xi.shape}")
    return pb.Twist(linear=wire_vector(xi[:3]), angular=wire_vector(xi[3:]))


def wire_vector(vector: npt.ArrayLike) -> pb.Vector3:
    """The vector of three numbers."""
    numbers = real(vector, "a vector")
    if numbers.shape != (3,):
        raise ValueError(f"a vector is three numbers, not an array of shape {numbers.shape}")
    x, y, z = numbers
    return pb.Vector3(x=x, y=y, z=z)


def covariance_matrix(values: Any) -> Array | None:
    """The (6, 6) matrix of 36 numbers; None if the server sent none."""
    return np.array(values).reshape(6, 6) if values else None


def exp_se3(twist: npt.ArrayLike) -> Array:
    """The pose of a motion: the exponential of a twist.

    Args:
        twist: (6,) or (n, 6), ordered (v, ω), meters and radians.

    Returns:
        `first_from_second`, (4, 4) or (n, 4, 4).

    Raises:
        ValueError: The array has another shape.

    Example:
        >>> world_from_second = world_from_first @ exp_se3(motion)
    """
    xi = real(twist, "a twist")
    if xi.shape[-1:] != (6,) or xi.ndim > 2:
        raise ValueError(f"a twist is (6,) or (n, 6), not {xi.shape}")
    rows = np.atleast_2d(xi)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    for pose, row in zip(poses, rows, strict=True):
        hat = _hat(row[3:])
        a, b, c = _coefficients(float(np.linalg.norm(row[3:])))
        pose[:3, :3] += a * hat + b * hat @ hat
        pose[:3, 3] = row[:3] + b * hat @ row[:3] + c * hat @ hat @ row[:3]
    return poses if xi.ndim == 2 else poses[0]


def log_se3(pose: npt.ArrayLike) -> Array:
    """The motion of a pose: the logarithm of `first_from_second`.

    Args:
        pose: (4, 4) or (n, 4, 4): rotations of less than 180 degrees and translations, meters.

    Returns:
        The twist (6,) or (n, 6), ordered (v, ω), meters and radians.

    Raises:
        ValueError: The array has another shape, or a matrix is no pose.

    Example:
        >>> motion = log_se3(np.linalg.inv(poses[0]) @ poses[1])
    """
    matrices = real(pose, "a pose")
    if matrices.shape[-2:] != (4, 4) or matrices.ndim > 3:
        raise ValueError(f"a pose is (4, 4) or (n, 4, 4), not {matrices.shape}")
    rows = matrices.reshape(-1, 4, 4)
    twists = np.zeros((len(rows), 6))
    for twist, matrix in zip(twists, rows, strict=True):
        orientation = wire_pose(matrix).orientation
        axis = np.array([orientation.x, orientation.y, orientation.z])
        sine = float(np.linalg.norm(axis))
        angle = 2 * math.atan2(sine, orientation.w)
        omega = axis * (angle / sine if sine > 1e-12 else 2.0)
        a, b, _ = _coefficients(angle)
        # The inverse of V(ω); its last coefficient tends to 1/12.
        last = (1 - a / (2 * b)) / angle**2 if angle > 1e-4 else 1 / 12
        hat = _hat(omega)
        t = matrix[:3, 3]
        twist[:3] = t - hat @ t / 2 + last * hat @ hat @ t
        twist[3:] = omega
    return twists if matrices.ndim == 3 else twists[0]


def _hat(omega: Array) -> Array:
    x, y, z = omega
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _coefficients(angle: float) -> tuple[float, float, float]:
    """sin θ / θ, (1 − cos θ) / θ² and (θ − sin θ) / θ³, by series near 0."""
    square = angle * angle
    if angle < 1e-2:
        return (
            1 - square / 6 + square**2 / 120,
            0.5 - square / 24 + square**2 / 720,
            1 / 6 - square / 120 + square**2 / 5_040,
        )
    return math.sin(angle) / angle, (1 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
