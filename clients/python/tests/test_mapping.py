"""A room from a video without poses: a drawn room, whose true poses are known, is filmed and mapped."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import seese3
from seese3 import mapping

FRAMES = 120
RATE_HZ = 30.0
EVERY = 3


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A video of the first visit to a drawn room, and the true positions of the camera."""
    folder = tmp_path_factory.mktemp("filmed")
    drawn = folder / "drawn"
    options = ["--suite", "returns", "--rooms", "1", "--frames", 2 * FRAMES, "--seed", "5", "--encoder", "pixels"]
    seese3.run("studio", *options, "--store", drawn, "--keep-images")
    room = seese3.Store(drawn).room("studio5-0000")
    images = sorted((drawn / "images" / "studio5-0000").glob("*.png"))[:FRAMES]

    video = folder / "walk.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), RATE_HZ, (320, 240))
    for image in images:
        writer.write(cv2.imread(str(image)))
    writer.release()
    return video, room.poses[:FRAMES, :3, 3]


def numbers(names: list[str]) -> np.ndarray:
    return np.array([int(name.removeprefix("frame_").removesuffix(".jpg")) for name in names])


def test_a_video_becomes_a_room(filmed: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    """Oracle: the positions from which the video was drawn."""
    video, truth = filmed
    known = tmp_path / "positions.txt"
    rows = [f"frame_{n:06d}.jpg {truth[n, 0]} {truth[n, 1]} {truth[n, 2]}" for n in (0, 30, 60, 90, 117)]
    known.write_text("# name x y z\n" + "\n".join(rows) + "\n")
    store, out = tmp_path / "store", tmp_path / "out"
    mapped = mapping.map_room(
        video, room="walk", store=store, out=out, scale=mapping.KnownPositions(known), images_per_s=RATE_HZ / EVERY
    )
    assert mapped.images == FRAMES // EVERY
    assert mapped.registered >= 0.9 * mapped.images
    assert mapped.scale_deviation is not None and mapped.scale_deviation < 0.03

    room = seese3.Store(store).room("walk")
    at = numbers(room.names)
    assert room.timestamps_ns is not None
    np.testing.assert_allclose(room.timestamps_ns * 1e-9, at / RATE_HZ, atol=1e-6)
    off = np.linalg.norm(room.poses[:, :3, 3] - truth[at], axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.03

    # The model is kept: another scale takes seconds. Wheels in other axes give the same factor; their times are those
    # of the video.
    turned = truth @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + 5.0
    wheels = tmp_path / "wheels.txt"
    wheels.write_text("".join(f"{n / RATE_HZ} {x} {y} {z} 0 0 0 1\n" for n, (x, y, z) in enumerate(turned)))
    meters = float(np.linalg.norm(truth[90] - truth[0]))
    scales = [mapping.Wheels(wheels), mapping.Distance("frame_000000.jpg", "frame_000090.jpg", meters)]
    for number, scale in enumerate(scales):
        again = mapping.map_room(
            video, room=f"walk{number}", store=store, out=out, scale=scale, images_per_s=RATE_HZ / EVERY
        )
        assert again.factor == pytest.approx(mapped.factor, rel=0.03)

    with pytest.raises(seese3.SeeseError, match="another video or rate"):
        mapping.map_room(video, room="x", store=store, out=out, scale=mapping.Factor(1.0), images_per_s=5.0)
    other = tmp_path / "other"
    other.mkdir()
    for name in room.names:
        (other / name).write_bytes((out / "images" / name).read_bytes() + b" ")
    with pytest.raises(seese3.SeeseError, match="features of other images"):
        mapping.map_room(other, room="x", store=store, out=out, scale=mapping.Factor(1.0))


def test_two_comes_before_ten() -> None:
    assert sorted(["10.jpg", "a/2.jpg", "2.jpg"], key=mapping._natural) == ["2.jpg", "10.jpg", "a/2.jpg"]


def test_what_cannot_be_mapped_is_refused(tmp_path: Path) -> None:
    where = {"room": "x", "store": tmp_path / "store", "scale": mapping.Factor(1.0)}
    with pytest.raises(seese3.SeeseError, match="No such file"):
        mapping.map_room(tmp_path / "no.mp4", out=tmp_path / "a", **where)

    text = tmp_path / "text.mp4"
    text.write_text("no video")
    with pytest.raises(seese3.SeeseError, match="cannot be read as a video"):
        mapping.map_room(text, out=tmp_path / "b", **where)

    photos = tmp_path / "photos"
    photos.mkdir()
    with pytest.raises(seese3.SeeseError, match="0 images"):
        mapping.map_room(photos, out=tmp_path / "c", **where)
    for number in range(4):
        cv2.imwrite(str(photos / f"{number}.png"), np.full((240, 320, 3), 40 * number, np.uint8))
    with pytest.raises(seese3.SeeseError, match="move sideways"):
        mapping.map_room(photos, out=tmp_path / "c", **where)
    assert not (tmp_path / "store").exists()


def test_wheels_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    centers = {f"{n}.jpg": np.array([0.1 * n, 0.0, 0.0]) for n in range(20)}
    times = {f"{n}.jpg": 0.1 * n for n in range(20)}
    file = tmp_path / "wheels.txt"

    def refused(text: str, match: str) -> None:
        file.write_text(text)
        with pytest.raises(seese3.SeeseError, match=match):
            mapping._wheel_factor(file, centers, times)

    # Oracle: by hand. The wheels drive 3 m/s, the camera 1 unit/s.
    file.write_text("".join(f"{0.1 * n:.1f} {0.3 * n:.1f} 0 0 0 0 0 1\n" for n in range(20)))
    factor, spread = mapping._wheel_factor(file, centers, times)
    assert factor == pytest.approx(3.0, rel=1e-6) and spread < 1e-6

    refused("1 2 3\n", "line 1: has 3 columns")
    refused("0 0 0 0 0 0 0 x\n1 0 0 0 0 0 0 1\n", "'x' is not a number")
    refused("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "do not increase")
    refused("100 0 0 0 0 0 0 1\n101 1 0 0 0 0 0 1\n", "fewer than 2 images")
    refused("".join(f"{0.1 * n:.1f} 0 0 0 0 0 0 1\n" for n in range(20)), "only 0 image pairs")
    with pytest.raises(seese3.SeeseError, match="needs the times"):
        mapping._wheel_factor(file, centers, {})
