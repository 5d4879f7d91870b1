"""Calls a second by this package and by the raw stubs, by turns, against one server; the ratio is the package's cost.

python rates.py [SECONDS]: so long is each measured; 2 s if nothing is said. Features of 768 columns, 1,000 frames.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import grpc
import numpy as np
import seese3
from seese3.v1 import (
    geometry_pb2,
    localization_pb2,
    localization_pb2_grpc,
    navigation_pb2,
    navigation_pb2_grpc,
)

COLUMNS, FRAMES, BATCH = 768, 1000, 100
ROUNDS = 3
MOTION = (0.1, 0.0, 0.2, 0.0, 0.1, 0.0)


def make_store(folder: Path) -> None:
    """A room of smooth features on a wavy path, and an adapter of random weights: speed does not ask what they mean."""
    random = np.random.default_rng(0)
    times = np.arange(FRAMES) / 30.0
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = np.sin(times), np.cos(0.7 * times)
    waves = np.sin(times[:, None] * random.uniform(0.2, 2.0, COLUMNS) + random.uniform(0, 6, COLUMNS))
    source = seese3.FeatureSource("waves", COLUMNS)
    store = seese3.Store(folder)
    store.write_room("room", poses, {source: waves})
    shapes = [(64, COLUMNS), (64,), (64,), (64,), (20, 64), (20,), (6, 20)]
    weights = {name: random.normal(size=shape) / 8 for name, shape in zip(seese3.store.WEIGHTS, shapes, strict=True)}
    store.write_adapter(
        "adapter",
        weights,
        source=source,
        target_mean=np.zeros(6),
        target_deviation=np.full(6, 0.1),
        features=waves,
        rooms={"room": 1},
        stride=10,
        epochs=1,
    )


def rate(call: Callable[[int], object], seconds: float) -> float:
    """Calls a second."""
    begun, calls = time.perf_counter(), 0
    while time.perf_counter() - begun < seconds:
        call(calls)
        calls += 1
    return calls / (time.perf_counter() - begun)


def cases(client: seese3.Client, address: str, rows: np.ndarray) -> dict[str, tuple[Callable[[int], object], ...]]:
    """By name: the package's way, and that of the stubs, with protobuf's lists as their documentation has it."""
    channel = grpc.insecure_channel(address)
    navigation = navigation_pb2_grpc.NavigationServiceStub(channel)  # type: ignore[no-untyped-call]
    localization = localization_pb2_grpc.LocalizationServiceStub(channel)  # type: ignore[no-untyped-call]

    def view(row: int) -> geometry_pb2.View:
        return geometry_pb2.View(feature=geometry_pb2.Feature(values=rows[row % FRAMES]))

    def question(source: geometry_pb2.View) -> navigation_pb2.NavigateRequest:
        v, w = MOTION[:3], MOTION[3:]
        linear, angular = geometry_pb2.Vector3(x=v[0], y=v[1], z=v[2]), geometry_pb2.Vector3(x=w[0], y=w[1], z=w[2])
        motion = navigation_pb2.Displacement(twist=geometry_pb2.Twist(linear=linear, angular=angular))
        return navigation_pb2.NavigateRequest(room="room", source=source, displacement=motion, steps=4)

    def numbered(row: int) -> geometry_pb2.View:
        return geometry_pb2.View(frame_id=row % FRAMES)

    def batch(row: int) -> navigation_pb2.BatchNavigateRequest:
        requests = [question(numbered(one)) for one in range(row, row + BATCH)]
        return navigation_pb2.BatchNavigateRequest(requests=requests)

    return {
        "navigate, from a stored frame": (
            lambda n: client.navigate("room", n % FRAMES, twist=MOTION, steps=4),
            lambda n: navigation.Navigate(question(numbered(n))),
        ),
        "navigate, from a feature": (
            lambda n: client.navigate("room", rows[n % FRAMES], twist=MOTION, steps=4),
            lambda n: navigation.Navigate(question(view(n))),
        ),
        f"navigate_batch of {BATCH}": (
            lambda n: client.navigate_batch(
                "room", [seese3.Question(one % FRAMES, twist=MOTION, steps=4) for one in range(n, n + BATCH)]
            ),
            lambda n: navigation.BatchNavigate(batch(n)),
        ),
        "localize a feature": (
            lambda n: client.localize(rows[n % FRAMES], rooms="room"),
            lambda n: localization.Localize(localization_pb2.LocalizeRequest(rooms=["room"], view=view(n))),
        ),
    }


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 2.0
    with tempfile.TemporaryDirectory() as folder:
        make_store(Path(folder))
        rows = seese3.Store(folder).room("room").features["waves"]
        with seese3.serve(folder) as server, server.client() as client:
            print("| calls a second | seese3 | raw stubs | ratio |\n| --- | --- | --- | --- |")
            for name, ways in cases(client, server.address, rows).items():
                for way in ways:
                    rate(way, 0.2)
                rates = np.median([[rate(way, seconds) for way in ways] for _ in range(ROUNDS)], axis=0)
                print(f"| {name} | {rates[0]:,.0f} | {rates[1]:,.0f} | {rates[0] / rates[1]:.2f} |")


if __name__ == "__main__":
    main()
