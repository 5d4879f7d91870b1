"""A room from photographs or a video without poses: structure from motion by pycolmap, scale, import.

    python -m seese3.mapping walk.mp4 --room kitchen --store store --out kitchen-map \\
        --distance frame_000000.jpg frame_000090.jpg 1.5

It needs the extra: `pip install "seese3[mapping]"`. Run the same command again to resume after the last completed step.
The steps:

1. A video becomes images, a few a second. A folder of photographs is used as it is.
2. SIFT features, and matches between images that follow each other; between all of them if they are few.
3. Poses and one camera, by incremental mapping. Images that do not fit are left out.
4. The scale: from a known distance, a few known positions, or wheel odometry. A model without one is not imported.
5. `seese3 import colmap`, which compares the poses with the images.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import CommandError, SeeseError
from .program import run

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png"}
# Up to this many images, all pairs are matched.
MAX_EXHAUSTIVE = 40
# Number of images that an image of a longer recording is matched with: the next ones, and some farther ones.
OVERLAP = 15
# Progress is shown every so many images.
SHOWN_EVERY = 25
# Least distance between two images whose wheel odometry is compared, meters, and the least number of such pairs.
LEAST_WHEEL_STEP_M = 0.1
LEAST_WHEEL_PAIRS = 5

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Distance:
    """The distance between the camera positions of two images, meters."""

    first: str
    second: str
    meters: float


@dataclass(frozen=True)
class KnownPositions:
    """A file with the lines `NAME X Y Z`: camera positions in the room, meters. At least three, not on a line.

    The room gets the axes of these positions.
    """

    file: Path


@dataclass(frozen=True)
class Wheels:
    """A file of odometry of the camera in TUM's form, `SECONDS X Y Z QX QY QZ QW`, on the clock of the images, meters.

    Poses of the base have a wrong length where the robot turns.
    """

    file: Path


@dataclass(frozen=True)
class Factor:
    """The factor from the units of the model to meters, if it is known; 1 keeps the arbitrary units."""

    factor: float


Scale = Distance | KnownPositions | Wheels | Factor


@dataclass(frozen=True)
class Mapped:
    """A room that was made.

    - `images`: number of images that were given, and `registered` of those with a pose.
    - `factor`: meters per unit of the model.
    - `scale_deviation`: relative spread of the factor over the pairs of wheel odometry, or the root mean square error
      of the known positions, meters; None for the other sources of the scale.
    - `reprojection_error_px`: mean error of the image points.
    - `printed`: what `seese3 import colmap` printed.
    """

    images: int
    registered: int
    factor: float
    scale_deviation: float | None
    reprojection_error_px: float
    printed: str


def map_room(
    source: str | Path,
    *,
    room: str,
    store: str | Path,
    out: str | Path,
    scale: Scale,
    images_per_s: float = 3.0,
    rate_hz: float | None = None,
    options: Sequence[str] = (),
) -> Mapped:
    """Makes a room of a video, or of a folder of photographs in the order of their names.

    `images_per_s` are taken from a video, whose rate has to be constant. `rate_hz` is the rate of the numbers in the
    names of photographs: the time is the last number over the rate. Without it they have no
    times. `options` are passed on to `seese3 import colmap`.

    Raises a `SeeseError` if too few images get a pose, or if the scale cannot be found.
    """
    pycolmap = _library("pycolmap")
    source, out = Path(source), Path(out)
    if out.exists() and not out.is_dir():
        raise SeeseError(f"{out} is a file: give a folder")
    out.mkdir(parents=True, exist_ok=True)
    # Its progress goes to a file: a thousand lines for a hundred images.
    pycolmap.logging.set_log_destination(pycolmap.logging.INFO, str(out / "colmap-"))
    pycolmap.logging.alsologtostderr = False

    _say("1. images")
    if source.is_dir():
        images = source
        names = sorted(
            path.relative_to(images).as_posix() for path in images.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES
        )
        times = {} if rate_hz is None else {name: _last_number(name) / rate_hz for name in names}
    else:
        images = out / "images"
        times = _video_images(source, images, images_per_s)
        names = sorted(times)
    if len(names) < 3:
        raise SeeseError(f"{source} has {len(names)} images; a map needs at least 3, and better 50")
    if source.is_dir() and len(names) > MAX_EXHAUSTIVE and names != sorted(names, key=_natural):
        raise SeeseError(
            f"the photographs of {source} are not in the order of their names, such as 10.jpg before 2.jpg: write the "
            "numbers with leading zeros"
        )
    _say(f"   {len(names)} images in {images}")

    model = _model(pycolmap, images, names, out)
    registered = {image.name: image for image in model.images.values() if image.has_pose}
    _say(
        f"   {len(registered)} of {len(names)} images have a pose; mean error of the image points "
        f"{model.compute_mean_reprojection_error():.2f} pixels"
    )
    if len(registered) < max(3, len(names) // 2):
        raise SeeseError(
            f"only {len(registered)} of {len(names)} images have a pose: take more images with more overlap, slowly, "
            "and move sideways instead of only turning"
        )

    _say("4. scale")
    centers = {name: np.asarray(image.projection_center(), dtype=np.float64) for name, image in registered.items()}
    factor, deviation = _scaled(pycolmap, model, centers, times, scale)
    _say(f"   one unit of the model is {factor:.4g} m")
    scaled = out / "model"
    scaled.mkdir(exist_ok=True)
    model.write(str(scaled))

    _say("5. import")
    command: list[object] = ["import", "colmap", scaled, "--images", images, "--name", room, "--store", store]
    command += ["--scale", "1"]
    if times:
        file = out / "times.txt"
        file.write_text("".join(f"{times[name]:.9f} {name}\n" for name in registered))
        command += ["--times", file]
    printed = run(*command, *options)
    return Mapped(
        images=len(names),
        registered=len(registered),
        factor=factor,
        scale_deviation=deviation,
        reprojection_error_px=float(model.compute_mean_reprojection_error()),
        printed=printed,
    )


def _library(name: str) -> Any:
    try:
        return __import__(name)
    except ImportError as error:
        raise SeeseError(f"{name} is not installed: pip install 'seese3[mapping]'") from error


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _video_images(video: Path, images: Path, images_per_s: float) -> dict[str, float]:
    """Writes images of a video, and returns their names with their times in seconds."""
    listed = images.parent / "images.json"
    made_with = {"video": str(video.resolve()), "bytes": _size(video), "images_per_s": images_per_s}
    if listed.exists():
        found = _loaded(listed)
        if found["made_with"] != made_with:
            raise SeeseError(f"{images.parent} has images of another video or rate: give another output folder")
        return {str(name): float(time) for name, time in found["times"].items()}

    cv2 = _library("cv2")
    opened = cv2.VideoCapture(str(video))
    rate = opened.get(cv2.CAP_PROP_FPS)
    if not opened.isOpened() or not math.isfinite(rate) or rate <= 0.0:
        raise SeeseError(f"{video} cannot be read as a video")
    images.mkdir(exist_ok=True)
    times: dict[str, float] = {}
    every = max(1, round(rate / images_per_s))
    number = 0
    while opened.grab():
        if number % every == 0:
            is_read, image = opened.retrieve()
            if is_read:
                name = f"frame_{number:06d}.jpg"
                if not cv2.imwrite(str(images / name), image, [cv2.IMWRITE_JPEG_QUALITY, 95]):
                    raise SeeseError(f"{images / name} cannot be written")
                times[name] = number / rate
        number += 1
    opened.release()
    _store(listed, {"made_with": made_with, "times": times})
    return times


def _loaded(file: Path) -> Any:
    try:
        return json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise SeeseError(f"{file} is damaged: give another output folder") from error


def _store(file: Path, content: object) -> None:
    """Writes a file as a whole, or not at all."""
    written = file.with_suffix(".part")
    written.write_text(json.dumps(content, indent=1))
    written.replace(file)


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Key of a name by which 2 comes before 10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError as error:
        raise SeeseError(f"{file}: {error.strerror}") from error


def _model(pycolmap: Any, images: Path, names: list[str], out: Path) -> Any:
    """The largest model of the images, in arbitrary units."""
    database = out / "database.db"
    sparse = out / "sparse"
    done = out / "sparse.json"
    begun = out / "matched.json"
    made_of = {"images": str(images.resolve()), "bytes": {name: _size(images / name) for name in names}}
    if begun.exists():
        if _loaded(begun) != made_of:
            raise SeeseError(f"{out} has features of other images: give another output folder")
    else:
        if database.exists():
            raise SeeseError(f"{database} is not of this command: give another output folder")
        _store(begun, made_of)
    if done.exists() and (sparse / str(_loaded(done)["largest"])).is_dir():
        _say("2., 3. the model is there")
        return pycolmap.Reconstruction(str(sparse / str(_loaded(done)["largest"])))

    _say("2. features and matches")
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    for begin in range(0, len(names), SHOWN_EVERY):
        # All images are of one camera, also of an earlier, interrupted run.
        if database.exists():
            with pycolmap.Database.open(database) as opened:
                cameras = opened.read_all_cameras()
            if cameras:
                reader.existing_camera_id = cameras[0].camera_id
        pycolmap.extract_features(
            database,
            images,
            image_names=names[begin : begin + SHOWN_EVERY],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
        )
        _say(f"   features of {min(begin + SHOWN_EVERY, len(names))} of {len(names)} images")
    if len(names) <= MAX_EXHAUSTIVE:
        pycolmap.match_exhaustive(database)
    else:
        pairing = pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True)
        pycolmap.match_sequential(database, pairing_options=pairing)

    _say("3. poses")
    sparse.mkdir(exist_ok=True)
    placed = 0

    def count() -> None:
        nonlocal placed
        placed += 1
        if placed % SHOWN_EVERY == 0:
            _say(f"   {placed} images placed")

    models = pycolmap.incremental_mapping(database, images, sparse, next_image_callback=count)
    if not models:
        raise SeeseError("no two images see the same scene from different places: move sideways, slowly")
    largest = max(models, key=lambda number: models[number].num_reg_images())
    if len(models) > 1:
        _say(f"   {len(models)} models were made; the one with the most images is used")
    _store(done, {"largest": largest})
    return models[largest]


def _scaled(
    pycolmap: Any, model: Any, centers: dict[str, Floats], times: dict[str, float], scale: Scale
) -> tuple[float, float | None]:
    """Converts a model to meters; returns the factor, and its spread or the error in meters."""
    deviation: float | None = None
    match scale:
        case KnownPositions(file):
            named = _known_positions(file, centers)
            given = np.stack([position for _, position in named])
            found = np.stack([centers[name] for name, _ in named])
            if np.linalg.matrix_rank(given - given.mean(axis=0), tol=0.05) < 2:
                raise SeeseError(
                    f"the positions of {file} are nearly on a line: the rotation about that line is undetermined"
                )
            world_from_model = pycolmap.estimate_sim3d(found, given)
            if world_from_model is None:
                raise SeeseError(f"no similarity transform aligns the model with the positions of {file}")
            moved = np.stack([world_from_model * center for center in found])
            deviation = float(np.sqrt(np.mean(np.sum((moved - given) ** 2, axis=1))))
            _say(f"   {len(named)} known positions are {deviation:.3f} m off (root mean square)")
            model.transform(world_from_model)
            return float(world_from_model.scale), deviation
        case Distance(first, second, meters):
            length = float(np.linalg.norm(_center(centers, first) - _center(centers, second)))
            if meters <= 0.0 or length <= 0.0:
                raise SeeseError("the known distance must be above 0, between two images of different places")
            factor = meters / length
        case Wheels(file):
            factor, deviation = _wheel_factor(file, centers, times)
        case Factor(factor):
            if not math.isfinite(factor) or factor <= 0.0:
                raise SeeseError("the factor must be above 0")
    model.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3)))
    return factor, deviation


def _center(centers: dict[str, Floats], name: str) -> Floats:
    if name not in centers:
        raise SeeseError(f"{name} has no pose; images with a pose: {_some(centers)}")
    return centers[name]


def _some(centers: dict[str, Floats]) -> str:
    names = sorted(centers)
    return ", ".join(names[:3]) + (f", … {names[-1]}" if len(names) > 3 else "")


def _known_positions(file: Path, centers: dict[str, Floats]) -> list[tuple[str, Floats]]:
    named = []
    for number, words in _rows(file, 4):
        name = words[0]
        _center(centers, name)
        named.append((name, np.array([_number(file, number, word) for word in words[1:]])))
    if len(named) < 3:
        raise SeeseError(f"{file} has {len(named)} positions; at least 3 are needed")
    return named


def _wheel_factor(file: Path, centers: dict[str, Floats], times: dict[str, float]) -> tuple[float, float]:
    """Meters per unit, by the lengths of the ways between images; and the relative spread."""
    if not times:
        raise SeeseError("wheel odometry needs the times of the images: a video, or --rate of the photographs")
    rows = [(number, [_number(file, number, word) for word in words]) for number, words in _rows(file, 8)]
    if len(rows) < 2:
        raise SeeseError(f"{file} has no path")
    stamps = np.array([values[0] for _, values in rows])
    if np.any(np.diff(stamps) <= 0.0):
        raise SeeseError(f"the times of {file} do not increase")
    path = np.array([values[1:4] for _, values in rows])

    order = sorted((name for name in centers if stamps[0] <= times[name] <= stamps[-1]), key=lambda name: times[name])
    if len(order) < 2:
        raise SeeseError(
            f"fewer than 2 images lie in the time range of {file}, {stamps[0]:.1f} to {stamps[-1]:.1f} s; the images "
            f"are of {min(times.values()):.1f} to {max(times.values()):.1f} s"
        )
    at = np.array([times[name] for name in order])
    driven = np.stack([np.interp(at, stamps, path[:, axis]) for axis in range(3)], axis=1)
    seen = np.stack([centers[name] for name in order])

    # Straight distances over a tenth of a meter: odometry has little drift there.
    ratios, begin = [], 0
    for end in range(1, len(order)):
        meters = float(np.linalg.norm(driven[end] - driven[begin]))
        units = float(np.linalg.norm(seen[end] - seen[begin]))
        if meters >= LEAST_WHEEL_STEP_M and units > 0.0:
            ratios.append(meters / units)
            begin = end
    if len(ratios) < LEAST_WHEEL_PAIRS:
        raise SeeseError(
            f"only {len(ratios)} image pairs are {LEAST_WHEEL_STEP_M} m apart by the wheels of {file}; at least "
            f"{LEAST_WHEEL_PAIRS} are needed"
        )
    logarithms = np.log(ratios)
    spread = float(1.4826 * np.median(np.abs(logarithms - np.median(logarithms))))
    _say(f"   {len(ratios)} steps by the wheels agree within {100.0 * spread:.1f} %")
    return float(np.exp(np.median(logarithms))), spread


def _rows(file: Path, columns: int) -> list[tuple[int, list[str]]]:
    """The lines of a file with their numbers; empty lines and comments are left out."""
    try:
        text = file.read_text()
    except OSError as error:
        raise SeeseError(f"{file}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SeeseError(f"{file} is not a text file in UTF-8") from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != columns:
            raise SeeseError(f"{file}, line {number}: has {len(words)} columns, not {columns}")
        rows.append((number, words))
    return rows


def _number(file: Path, line: int, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise SeeseError(f"{file}, line {line}: '{word}' is not a number")
    return value


def _last_number(name: str) -> float:
    digits = "".join(letter if letter.isdigit() else " " for letter in name).split()
    if not digits:
        raise SeeseError(f"{name} has no number in its name, which --rate needs")
    return float(digits[-1])


def main(arguments: Sequence[str] | None = None) -> None:
    """The command `python -m seese3.mapping`."""
    parser = argparse.ArgumentParser(
        prog="python -m seese3.mapping", description="Makes a room of a video or of photographs without poses."
    )
    parser.add_argument("source", type=Path, help="a video, or a folder of photographs in the order of their names")
    parser.add_argument("--room", required=True, help="name of the new room")
    parser.add_argument("--store", required=True, help="the store")
    parser.add_argument("--out", required=True, type=Path, help="folder of the images, matches and model; kept")
    parser.add_argument("--images-per-second", type=float, default=3.0, help="images taken from a video; %(default)s")
    parser.add_argument(
        "--rate", type=float, help="rate of the numbers in the names of photographs: time = last number / rate, seconds"
    )
    scales = parser.add_mutually_exclusive_group(required=True)
    scales.add_argument(
        "--distance", nargs=3, metavar=("IMAGE", "IMAGE", "METERS"), help="distance between two camera positions"
    )
    scales.add_argument("--positions", type=Path, help="file of known camera positions: lines NAME X Y Z, meters")
    scales.add_argument("--wheels", type=Path, help="file of wheel odometry: lines SECONDS X Y Z QX QY QZ QW, meters")
    scales.add_argument("--scale", type=float, help="meters per unit of the model, if it is known")
    parser.add_argument("--option", action="append", default=[], help="passed on to `seese3 import colmap`")
    given = parser.parse_args(arguments)

    try:
        for name in ("images_per_second", "rate"):
            value = getattr(given, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise SeeseError(f"--{name.replace('_', '-')} must be above 0")
        mapped = map_room(
            given.source,
            room=given.room,
            store=given.store,
            out=given.out,
            scale=_scale_of(given),
            images_per_s=given.images_per_second,
            rate_hz=given.rate,
            options=given.option,
        )
    except (SeeseError, CommandError) as error:
        sys.exit(f"seese3.mapping: {error}")
    print(mapped.printed, end="")


def _scale_of(given: argparse.Namespace) -> Scale:
    if given.distance:
        first, second, meters = given.distance
        return Distance(first, second, _number(Path("--distance"), 1, meters))
    if given.positions:
        return KnownPositions(given.positions)
    if given.wheels:
        return Wheels(given.wheels)
    return Factor(given.scale)


if __name__ == "__main__":
    main()
