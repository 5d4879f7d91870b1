"""Plants mistakes in the poses of rooms, and counts which of them `seese3 import` names: the table of
docs/rooms-and-encoders.md.

python planted.py STORE [ROOM]...: rooms with images, as `seese3 studio --keep-images` draws them; all of the store's if
none is named. Needs Pillow.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import seese3
from PIL import Image, ImageOps

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
ROS = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
RANDOM = np.random.default_rng(79)
ROWS_LATE = 5


def turned(poses: np.ndarray, quarter_turns: int) -> np.ndarray:
    """The poses of a camera whose images were turned clockwise by so many quarters afterwards."""
    turn = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return poses @ np.linalg.matrix_power(turn, quarter_turns)


def with_translations(poses: np.ndarray, translations: np.ndarray) -> np.ndarray:
    return np.concatenate([np.concatenate([poses[:, :3, :3], translations[..., None]], axis=2), poses[:, 3:]], axis=1)


def scalar_first(poses: np.ndarray) -> np.ndarray:
    """Quaternions (w, x, y, z) that were read as (x, y, z, w)."""
    read = poses.copy()
    for pose in read:
        q = seese3.geometry._quaternion_wxyz(pose[:3, :3])
        # Their first number is taken for x, and the last one for w.
        x, y, z, w = q
        pose[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    return read


def lost(poses: np.ndarray) -> np.ndarray:
    """Ten poses are the identity, as recorders write when tracking is lost."""
    read = poses.copy()
    read[RANDOM.choice(np.arange(5, len(read)), 10, replace=False)] = np.eye(4)
    return read


def another(poses: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.concatenate([other] * -(-len(poses) // len(other)))[: len(poses)]


def mistakes(poses: np.ndarray, other: np.ndarray) -> dict[str, tuple[np.ndarray, str, str]]:
    """By name: the poses as they are written, the verdict, and a word of the option or the warning that names it."""
    inverse, t = np.linalg.inv, poses[:, :3, 3]
    transposed = with_translations(poses.transpose(0, 2, 1), t)
    transposed[:, 3] = (0, 0, 0, 1)
    named = "other_convention"
    return {
        "nothing": (poses, "agrees", ""),
        "inverted": (inverse(poses), named, "--poses camera_from_world"),
        "OpenGL's axes": (poses @ inverse(OPENGL), named, "--convention opengl"),
        "OpenGL, inverted": (inverse(poses @ inverse(OPENGL)), named, "--convention opengl --poses camera_from_world"),
        "ROS axes": (poses @ inverse(ROS), named, "--convention ros"),
        "ROS, inverted": (inverse(poses @ inverse(ROS)), named, "--convention ros --poses camera_from_world"),
        "images turned by 90": (turned(poses, 1), named, "--images-turned 90"),
        "images turned by 180": (turned(poses, 2), named, "--images-turned 180"),
        "scalar first": (scalar_first(poses), named, "--quaternions wxyz"),
        "millimeters": (with_translations(poses, 1000 * t), "warning", "millimeters"),
        "centimeters": (with_translations(poses, 100 * t), "warning", "centimeters"),
        "a scale of .137": (with_translations(poses, 0.137 * t), "warning", "in meters?"),
        "y and z exchanged": (with_translations(poses, t[:, [0, 2, 1]]), "other_translations", "(x, z, y)"),
        "translations of the inverse": (
            with_translations(poses, inverse(poses)[:, :3, 3]),
            "other_translations",
            "camera_from_world",
        ),
        "rotations transposed": (transposed, "transposed_rotations", ""),
        "images mirrored": (poses, "mirrored_images", ""),
        "shuffled": (poses[RANDOM.permutation(len(poses))], "unrelated", ""),
        f"{ROWS_LATE} rows late": (np.roll(poses, ROWS_LATE, axis=0), "other_rows", ""),
        "another room's": (another(poses, other), "unrelated", ""),
        "all the same": (np.tile(poses[:1], (len(poses), 1, 1)), "warning", "all poses are identical"),
        "ten identities": (lost(poses), "warning", "10 poses are exactly the identity"),
    }


def is_named(report: dict[str, Any], verdict: str, word: str) -> bool:
    images, warnings = report["images"], report["warnings"]
    if verdict == "agrees":
        # A folder is one sequence: that the camera jumps from one visit to the next is true.
        return images["verdict"] == verdict and all("jumps once" in warning for warning in warnings)
    if verdict == "warning":
        return word in " ".join(warnings)
    if images["verdict"] != verdict:
        return False
    if verdict == "other_convention":
        return bool(images["likely"][0] == word)
    if verdict == "other_translations":
        return word in images["translations"]
    return verdict != "other_rows" or abs(abs(images["rows"]) - ROWS_LATE) <= 1


def checked(
    folder: Path, images: list[Path], poses: np.ndarray, prepare: Callable[[Path, Path], object]
) -> dict[str, Any]:
    """What `seese3 import folder --json -` says of these poses and images."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "images").mkdir(parents=True)
    for number, image in enumerate(images):
        prepare(image, folder / "images" / f"{number:06}{image.suffix}")
    np.save(folder / "poses.npy", poses)
    said = seese3.run(
        "import", "folder", folder, "--room", "x", "--store", folder / "store", "--allow-contradicted", "--json", "-"
    )
    report: dict[str, Any] = json.loads(said)
    return report


def mirror(image: Path, to: Path) -> None:
    ImageOps.mirror(Image.open(image).convert("RGB")).save(to)


def link(image: Path, to: Path) -> None:
    # A link that leads out of the folder is refused; a hard link is a file of it.
    to.hardlink_to(image)


def main() -> None:
    store = seese3.Store(sys.argv[1])
    rooms = [store.room(name) for name in sys.argv[2:] or store.rooms()]
    counts: dict[str, int] = {}
    shares: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as work:
        for number, room in enumerate(rooms):
            assert room.images is not None, f"{room.revision.name} has no images"
            other = rooms[(number + 1) % len(rooms)].poses
            for mistake, (poses, verdict, word) in mistakes(room.poses, other).items():
                prepare = mirror if mistake == "images mirrored" else link
                report = checked(Path(work) / "folder", room.images, poses, prepare)
                counts[mistake] = counts.get(mistake, 0) + is_named(report, verdict, word)
                shares.setdefault(mistake, []).append(report["images"]["explained"])

    print("| planted | named | explained as they are, median |\n| --- | --- | --- |")
    for mistake, count in counts.items():
        print(f"| {mistake} | {count} of {len(rooms)} | {np.median(shares[mistake]):.2f} |")


if __name__ == "__main__":
    main()
