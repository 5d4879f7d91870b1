"""Calls or frames a second by this package and by the raw stubs, by turns, against one server.

What the ratio is below 1 is the package's cost.

python rates.py [SECONDS]: so long is each measured; 2 s if nothing is said. Features of 768 columns, 1,000 frames.
"""

from __future__ import annotations

import queue
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

import grpc
import numpy as np
import seese3
from seese3.v1 import geometry_pb2, localization_pb2, navigation_pb2, odometry_pb2, stub

COLUMNS, FRAMES, BATCH = 768, 1000, 100
ROOM, CALIBRATION_ROOMS = "room", ("other-0", "other-1")
STREAMED = 100
AHEAD = 16
PERIOD_NS = 33_333_333
ROUNDS = 3

Cases: TypeAlias = dict[str, tuple[Callable[[int], object], ...]]
MOTION = (0.1, 0.0, 0.2, 0.0, 0.1, 0.0)


def make_store(folder: Path) -> None:
    """Rooms whose features are waves of the camera's pose, and an adapter that was trained and calibrated in them."""
    random = np.random.default_rng(0)
    frequencies, phases = random.uniform(0.2, 2.0, (4, COLUMNS)), random.uniform(0, 6, COLUMNS)
    store = seese3.Store(folder)
    for number, room in enumerate((ROOM, *CALIBRATION_ROOMS)):
        times = np.arange(FRAMES) / 30.0 + 100.0 * number
        headings = np.sin(0.8 * times)
        poses = np.tile(np.eye(4), (FRAMES, 1, 1))
        poses[:, 0, 0], poses[:, 0, 2] = np.cos(headings), np.sin(headings)
        poses[:, 2, 0], poses[:, 2, 2] = -np.sin(headings), np.cos(headings)
        poses[:, :3, 3] = np.stack([np.sin(times), 0.2 * np.cos(1.3 * times), np.cos(0.7 * times)], axis=1)

        causes = np.concatenate([poses[:, :3, 3], headings[:, None]], axis=1)
        waves = np.sin(causes @ frequencies + phases) + 0.01 * random.normal(size=(FRAMES, COLUMNS))
        store.write_room(room, poses, {"waves": waves}, timestamps_ns=(times * 1e9).astype(int))

    calibration = [word for room in CALIBRATION_ROOMS for word in ("--calibrate-on", room)]
    options = ["--preset", "steady", "--split", "whole", "--stride", "10", "--name", "adapter", *calibration]
    seese3.run("train", "--quiet", "--store", folder, "--room", ROOM, "--features", "waves", *options)


def rate(call: Callable[[int], object], seconds: float) -> float:
    """Calls a second, or frames a second of calls that stream some."""
    begun, calls = time.perf_counter(), 0
    while time.perf_counter() - begun < seconds:
        call(calls)
        calls += 1
    return calls * getattr(call, "frames", 1) / (time.perf_counter() - begun)


def streams(client: seese3.Client, channel: grpc.Channel, rows: np.ndarray) -> Cases:
    """Tracking, frame by frame as a camera is followed, and a recording, whose frames are all there."""
    odometry = stub("OdometryService", channel)
    config = seese3.TrackConfig(room=ROOM)

    def messages() -> Iterator[odometry_pb2.TrackRequest]:
        yield odometry_pb2.TrackRequest(config=odometry_pb2.TrackConfig(room=ROOM, token_every=1))
        for row in range(STREAMED):
            view = geometry_pb2.View(feature=geometry_pb2.Feature(values=rows[row]))
            frame = odometry_pb2.TrackFrame(sequence_number=row + 1, timestamp_ns=row * PERIOD_NS, view=view)
            yield odometry_pb2.TrackRequest(frame=frame)

    def by_steps(_: int) -> None:
        with client.track(config) as track:
            for row in range(STREAMED):
                track.step(rows[row], row * PERIOD_NS)

    def ahead(_: int) -> None:
        with client.track(config) as track:
            for _update in track.follow(((row * PERIOD_NS, rows[row]) for row in range(STREAMED)), ahead=AHEAD):
                pass

    def raw_by_steps(_: int) -> None:
        waiting: queue.Queue[odometry_pb2.TrackRequest | None] = queue.Queue()
        answers = odometry.Track(iter(waiting.get, None))
        for message in messages():
            waiting.put(message)
            next(answers)
        waiting.put(None)

    def raw_ahead(_: int) -> None:
        for _answer in odometry.Track(messages()):
            pass

    for call in (by_steps, ahead, raw_by_steps, raw_ahead):
        call.frames = STREAMED  # type: ignore[attr-defined]
    return {
        "track, frames one by one": (by_steps, raw_by_steps),
        f"track, {AHEAD} frames ahead": (ahead, raw_ahead),
    }


def cases(client: seese3.Client, address: str, rows: np.ndarray) -> Cases:
    """By name: the package's way, and that of the stubs, with protobuf's lists as their documentation has it."""
    channel = grpc.insecure_channel(address)
    navigation = stub("NavigationService", channel)
    localization = stub("LocalizationService", channel)

    def view(row: int) -> geometry_pb2.View:
        return geometry_pb2.View(feature=geometry_pb2.Feature(values=rows[row % FRAMES]))

    def question(source: geometry_pb2.View) -> navigation_pb2.NavigateRequest:
        v, w = MOTION[:3], MOTION[3:]
        linear, angular = geometry_pb2.Vector3(x=v[0], y=v[1], z=v[2]), geometry_pb2.Vector3(x=w[0], y=w[1], z=w[2])
        motion = navigation_pb2.RequestedMotion(twist=geometry_pb2.Twist(linear=linear, angular=angular))
        return navigation_pb2.NavigateRequest(room=ROOM, source=source, motion=motion, steps=4)

    def numbered(row: int) -> geometry_pb2.View:
        return geometry_pb2.View(frame_id=row % FRAMES)

    def batch(row: int) -> navigation_pb2.BatchNavigateRequest:
        requests = [question(numbered(one)) for one in range(row, row + BATCH)]
        return navigation_pb2.BatchNavigateRequest(requests=requests)

    calls = {
        "navigate, from a stored frame": (
            lambda n: client.navigate(ROOM, n % FRAMES, twist=MOTION, steps=4),
            lambda n: navigation.Navigate(question(numbered(n))),
        ),
        "navigate, from a feature": (
            lambda n: client.navigate(ROOM, rows[n % FRAMES], twist=MOTION, steps=4),
            lambda n: navigation.Navigate(question(view(n))),
        ),
        f"navigate_batch of {BATCH}": (
            lambda n: [
                (answer.frame.id, answer.frame.pose)
                for answer in client.navigate_batch(
                    ROOM, [seese3.NavigationQuery(one % FRAMES, twist=MOTION, steps=4) for one in range(n, n + BATCH)]
                )
            ],
            lambda n: [
                (result.response.steps[-1].frames[0].frame_id, result.response.steps[-1].frames[0].pose)
                for result in navigation.BatchNavigate(batch(n)).results
            ],
        ),
        "localize a feature": (
            lambda n: client.localize(rows[n % FRAMES], rooms=ROOM),
            lambda n: localization.Localize(localization_pb2.LocalizeRequest(rooms=[ROOM], view=view(n))),
        ),
    }
    return {**calls, **streams(client, channel, rows)}


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 2.0
    with tempfile.TemporaryDirectory() as folder:
        make_store(Path(folder))
        rows = seese3.Store(folder).room(ROOM).features["waves"]
        with seese3.serve(folder) as server, server.client() as client:
            print("| calls or frames a second | seese3 | raw stubs | ratio |\n| --- | --- | --- | --- |")
            for name, ways in cases(client, server.address, rows).items():
                for way in ways:
                    rate(way, 0.2)
                rates = np.median([[rate(way, seconds) for way in ways] for _ in range(ROUNDS)], axis=0)
                print(f"| {name} | {rates[0]:,.0f} | {rates[1]:,.0f} | {rates[0] / rates[1]:.2f} |")


if __name__ == "__main__":
    main()
