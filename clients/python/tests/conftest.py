"""A store of drawn rooms with an adapter that can track, and a server of it: the tests ask the real program."""

import shutil
from pathlib import Path

import pytest
import seese3

ROOMS = ("studio7-0000", "studio7-0001", "studio7-0002")
ROOM = ROOMS[0]
FEATURES = "pixels"


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store as it was made. Tests that change one take a copy."""
    store = tmp_path_factory.mktemp("drawn") / "store"
    seese3.run("studio", "--rooms", "3", "--frames", "120", "--store", store, "--keep-images")
    for room in ROOMS:
        seese3.run("encode", "--store", store, "--room", room, "--encoder", FEATURES)
    calibration = [word for room in ROOMS[1:] for word in ("--calibrate-on", room)]
    options = ["--preset", "steady", "--split", "whole", "--stride", "10", "--name", "robot", *calibration]
    seese3.run("train", "--store", store, "--room", ROOM, "--features", FEATURES, *options)
    return store


@pytest.fixture
def store(drawn: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(drawn, tmp_path / "store"))


@pytest.fixture(scope="session")
def server(drawn: Path):
    with seese3.serve(drawn, "--encoder", FEATURES) as server:
        yield server


@pytest.fixture
def client(server: seese3.Server):
    with server.client() as client:
        yield client
