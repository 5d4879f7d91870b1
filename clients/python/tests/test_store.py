"""Stores without a server. What is written here the program reads, and the other way round."""

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import seese3
from conftest import FEATURES, ROOM
from safetensors.numpy import save

RANDOM = np.random.default_rng(3)


def poses(count: int) -> np.ndarray:
    angles = np.linspace(0, 1, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2] = np.sin(angles)
    poses[:, 2, 0] = -np.sin(angles)
    poses[:, :3, 3] = RANDOM.normal(size=(count, 3))
    return poses


def test_a_room_is_read_as_the_program_exports_it(drawn: Path, tmp_path: Path) -> None:
    seese3.run("export", "numpy", "--store", drawn, "--room", ROOM, "--out", tmp_path / "out")
    room = seese3.Store(drawn).room(ROOM)
    np.testing.assert_allclose(room.poses, np.load(tmp_path / "out/poses.npy"), atol=1e-12)
    np.testing.assert_array_equal(room.features[FEATURES], np.load(tmp_path / f"out/features_{FEATURES}.npy"))
    assert room.images is not None and room.images[0].is_file()


def test_a_room_that_is_written_is_exported_by_the_program(tmp_path: Path) -> None:
    store = seese3.Store(tmp_path / "store")
    rows = RANDOM.normal(size=(9, 5)).astype(np.float32)
    stated = poses(9)
    lens = {"distortion_model": "brown_conrady", "distortion": (0.1, -0.2)}
    camera = seese3.Camera(640, 480, 525.0, 530.0, cy=250.0, **lens)  # type: ignore[arg-type]
    times = np.arange(9) * 33_000_000
    assert store.write_room("hall", stated, {"mine": rows}, timestamps_ns=times, camera=camera).revision == 1

    seese3.run("store", "verify", "--store", store.folder)
    seese3.run("export", "numpy", "--store", store.folder, "--room", "hall", "--out", tmp_path / "out")
    np.testing.assert_allclose(np.load(tmp_path / "out/poses.npy"), stated, atol=1e-12)
    np.testing.assert_array_equal(np.load(tmp_path / "out/features_mine.npy"), rows)
    assert json.loads((tmp_path / "out/bundle.json").read_text())["camera"] == {
        "focal": [525 / 640, 530 / 640],
        "height": 0.75,
        "center": [0.5, 250 / 640],
        "distortion": {"model": "brown_conrady", "coefficients": [0.1, -0.2, 0.0, 0.0, 0.0]},
    }

    # The same again is no new revision; other features of the same poses are added to those that were there.
    assert store.write_room("hall", stated, {"mine": rows}, timestamps_ns=times, camera=camera).revision == 1
    assert store.write_room("hall", stated, {"other": rows[:, :2]}).revision == 2
    room = store.room("hall")
    assert list(room.features) == ["mine", "other"]
    np.testing.assert_array_equal(room.timestamps_ns, times)
    assert store.room("hall", 1).features.keys() == {"mine"}
    seese3.run("store", "verify", "--store", store.folder)


def sealed(manifest: Path, body: dict[str, object]) -> None:
    """Writes a manifest with the checksum of its body."""
    text = json.dumps(body)
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    manifest.write_text(f'{{"sha256": "{sha256}", "body": {text}}}')


def room_with_keypoints(store: seese3.Store, tensors: dict[str, np.ndarray]) -> seese3.Camera:
    """A room "hall" of two frames with the features "a", and these tensors as its keypoints."""
    camera = seese3.Camera(640, 480, 525.0)
    store.write_room("hall", poses(2), {"a": np.ones((2, 3))}, camera=camera)
    content = save(tensors)
    sha256 = hashlib.sha256(content).hexdigest()
    file = f"keypoints-{sha256[:16]}.safetensors"
    (store.folder / "rooms/hall/objects" / file).write_bytes(content)

    manifest = store.folder / "rooms/hall/revisions/000001.json"
    body = json.loads(manifest.read_text())["body"]
    outputs = {"positions": "kpt", "reliability": "heat", "descriptors": "fusion", "model_file": ""}
    body["keypoints"] = {
        "source": {"feature": body["features"][0]["source"], **outputs},
        "camera": body["provenance"]["camera"],
        "unit_m": 2.0,
        "epipolar_px": 0.5,
        "noise": {"design_effect": 2.0, "gap_scale": 0.1, "pose_noise": 0.01, "relative_error": 0.01},
        "object": {"file": file, "sha256": sha256, "bytes": len(content)},
    }
    sealed(manifest, body)
    return camera


KEYPOINTS = {
    "counts": np.array([1, 2]),
    "positions": np.array([[0, 65535], [3, 4], [5, 6]], np.uint16),
    "inverse_depths": np.array([65535, 20, 0], np.uint16),
    "deviations": np.array([7, 8, 255], np.uint8),
    "descriptors": np.arange(96, dtype=np.int8).reshape(3, 32),
    "basis.mean": np.ones(4, np.float32),
    "basis.axes": np.ones((4, 32), np.float32),
}


def test_keypoints_are_read_by_their_format(tmp_path: Path) -> None:
    """Oracle: the format, worked by hand, and the program, which checks the same file.

    65535 steps of a position span the image; 65535 / 16 steps of an inverse depth are 1 per unit, 2 m; a step of a
    deviation is 0.001.
    """
    store = seese3.Store(tmp_path)
    camera = room_with_keypoints(store, KEYPOINTS)
    seese3.run("store", "verify", "--store", store.folder)
    keypoints = store.room("hall").keypoints
    assert keypoints is not None
    np.testing.assert_array_equal(keypoints.counts, [1, 2])
    np.testing.assert_allclose(keypoints.positions[0], [0, 1])
    np.testing.assert_allclose(keypoints.positions[2], [5 / 65535, 6 / 65535], rtol=1e-6)
    np.testing.assert_allclose(keypoints.inverse_depths, np.array([65535, 20, 1]) * 8 / 65535, rtol=1e-6)
    np.testing.assert_allclose(keypoints.deviations, [0.007, 0.008, 0.255], rtol=1e-6)
    np.testing.assert_array_equal(keypoints.descriptors[keypoints.rows(1)], KEYPOINTS["descriptors"][1:])
    assert (keypoints.rows(0), keypoints.mean.shape, keypoints.axes.shape) == (slice(0, 1), (4,), (4, 32))
    with pytest.raises(IndexError, match="frame 2"):
        keypoints.rows(2)

    seese3.run("export", "numpy", "--store", store.folder, "--room", "hall", "--out", tmp_path / "out")
    for name in ("counts", "positions", "inverse_depths", "deviations", "descriptors"):
        np.testing.assert_allclose(np.load(tmp_path / f"out/keypoint_{name}.npy"), getattr(keypoints, name), rtol=1e-6)

    # The same frames keep them, as in the program; another camera and another encoder do not.
    stated = store.room("hall").poses
    assert store.write_room("hall", stated, {"b": np.ones((2, 5))}).revision == 2
    assert store.room("hall").keypoints is not None
    seese3.run("store", "verify", "--store", store.folder)
    store.write_room("hall", stated, {seese3.FeatureSource("a", 3, encoder="other"): np.ones((2, 3))})
    assert store.room("hall").keypoints is None
    store.write_room("lab", stated, {"a": np.ones((2, 3))}, camera=camera)
    assert store.room("lab").keypoints is None


def test_keypoints_of_another_camera_are_dropped(tmp_path: Path) -> None:
    """Oracle: the definition of an inverse depth, which depends on the focal length."""
    store = seese3.Store(tmp_path)
    camera = room_with_keypoints(store, KEYPOINTS)
    stated = store.room("hall").poses
    store.write_room("hall", stated, {"a": np.ones((2, 3))}, camera=camera)
    assert store.room("hall").keypoints is not None
    store.write_room("hall", stated, {"a": np.ones((2, 3))}, camera=seese3.Camera(640, 480, 500.0))
    assert store.room("hall").keypoints is None


@pytest.mark.parametrize(
    "change",
    [
        {"counts": np.array([1, 3])},
        {"counts": np.array([4, -1])},
        {"counts": np.array([3])},
        {"positions": KEYPOINTS["positions"][:2]},
        {"inverse_depths": KEYPOINTS["inverse_depths"][:2]},
        {"deviations": KEYPOINTS["deviations"][:2]},
        {"descriptors": np.ones((3, 31), np.int8)},
        {"basis.axes": np.ones((5, 32), np.float32)},
    ],
)
def test_keypoints_that_contradict_each_other_are_damage(tmp_path: Path, change: dict[str, np.ndarray]) -> None:
    store = seese3.Store(tmp_path)
    room_with_keypoints(store, {**KEYPOINTS, **change})
    with pytest.raises(seese3.DamagedError, match="keypoints"):
        store.room("hall")


def test_a_server_serves_what_was_written(tmp_path: Path) -> None:
    """Weights of no meaning: the latents that the server computes are those of the definition."""
    store = seese3.Store(tmp_path)
    rows = RANDOM.normal(size=(20, 6)).astype(np.float32)
    source = seese3.FeatureSource("mine", 6)
    store.write_room("hall", poses(20), {source: rows})
    shapes = {
        "phi.0.weight": (8, 6),
        "phi.0.bias": (8,),
        "phi.1.weight": (8,),
        "phi.1.bias": (8,),
        "phi.3.weight": (7, 8),
        "phi.3.bias": (7,),
        "W.weight": (6, 7),
    }
    weights = {name: RANDOM.normal(size=shape) for name, shape in shapes.items()}
    scale = {"target_mean": np.full(6, 0.1), "target_deviation": np.full(6, 0.2)}
    told = {"source": source, "features": rows, "rooms": {"hall": 1}, "stride": 5, "epochs": 1}
    store.write_adapter("mine", weights, **scale, **told)

    adapter = store.adapter("mine")
    with seese3.serve(store.folder) as server, server.client() as client:
        latents = client.encode(list(rows), adapter="mine").latents
        np.testing.assert_allclose(latents, adapter.embed(rows), atol=1e-9)
        motion = client.motion(3, 9, room="hall").twist
        np.testing.assert_allclose(motion, adapter.motion(latents[3], latents[9])[0], atol=1e-9)
        # Nothing was held out, so there is no R²: None, and not 0.
        assert client.adapter("mine").test.overall is None


def test_damage_is_noticed(store: Path) -> None:
    manifest = store / "rooms" / ROOM / "revisions" / "000001.json"
    text = manifest.read_text()
    manifest.write_text(text.replace('"frame_count": 120', '"frame_count": 121'))
    with pytest.raises(seese3.DamagedError, match="checksum"):
        seese3.Store(store).room(ROOM, 1)
    manifest.write_text(text[:-50])
    with pytest.raises(seese3.DamagedError, match="truncated"):
        seese3.Store(store).room(ROOM, 1)

    weights = next((store / "adapters/robot/objects").iterdir())
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    with pytest.raises(seese3.DamagedError, match="altered"):
        seese3.Store(store).adapter("robot")


def test_unfit_rooms_are_refused_and_leave_nothing(tmp_path: Path) -> None:
    store = seese3.Store(tmp_path / "store")
    good, rows = poses(4), np.zeros((4, 3), np.float32)
    turned = good.transpose(0, 2, 1)
    broken = good.copy()
    broken[2, 0, 3] = np.nan
    far = good.copy()
    far[:, 0, 3] += 2e6
    for wrong, features, problem in (
        (good[:, :3], {"a": rows}, "poses: are"),
        (good, {"a": rows[:3]}, "features: 'a' is"),
        (good, {"../a": rows}, "cannot be the name"),
        (good, {"a": rows, seese3.FeatureSource("a", 3): rows}, "same name"),
    ):
        with pytest.raises(ValueError, match=problem):
            store.write_room("hall", wrong, features)
    # The program refuses what an array of the right shape says.
    for wrong, features, problem in (
        (turned, {"a": rows}, "poses.npy"),
        (broken, {"a": rows}, "frame 2"),
        (good, {"a": rows * np.nan}, "finite"),
        (far, {"a": rows}, "from the origin"),
    ):
        with pytest.raises(seese3.CommandError, match=problem):
            store.write_room("hall", wrong, features)
    for columns, problem in (
        ({"timestamps_ns": np.full(4, 2**63, np.uint64)}, "timestamps_ns"),
        ({"names": ["a", "b", "c", 4]}, "names: row 3"),
        ({"names": "abcd"}, "names: is a list"),
    ):
        with pytest.raises(ValueError, match=problem):
            store.write_room("hall", good, {"a": rows}, **columns)
    with pytest.raises(seese3.CommandError, match="invalid value"):
        store.write_room("hall", good, {"a": rows}, segments=[-1] * 4)
    with pytest.raises(ValueError, match="cannot be the name"):
        store.write_room("../hall", good, {"a": rows})
    assert not store.folder.exists()


def test_a_room_is_replaced_or_extended_only_if_asked(tmp_path: Path) -> None:
    store, first, rows = seese3.Store(tmp_path), poses(4), np.ones((4, 2))
    store.write_room("hall", first, {"a": rows})
    with pytest.raises(seese3.CommandError, match="other frames"):
        store.write_room("hall", poses(4), {"a": rows})
    assert store.write_room("hall", poses(4), {"a": rows}, mode="extend").revision == 2
    room = store.room("hall")
    assert len(room) == 8 and list(room.segments) == [0] * 4 + [1] * 4
    np.testing.assert_allclose(room.poses[:4], first, atol=1e-12)
    assert store.write_room("hall", poses(3), {"a": rows[:3]}, mode="replace").revision == 3
    assert len(store.room("hall")) == 3


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2)])
def test_arrays_are_stored_whatever_their_memory_looks_like(tmp_path: Path, order: tuple[int, int, int]) -> None:
    """Oracle: the program's own export. A transposed view has the numbers of its array in another order in memory."""
    stated, rows = poses(5), RANDOM.normal(size=(5, 3)).astype(np.float32)
    strided = np.ascontiguousarray(stated.transpose(order)).transpose(np.argsort(order))
    np.testing.assert_array_equal(strided, stated)

    store = seese3.Store(tmp_path / "store")
    store.write_room("hall", strided, {"a": np.asfortranarray(rows)[::-1][::-1]}, timestamps_ns=np.arange(10)[::2])
    seese3.run("export", "numpy", "--store", store.folder, "--room", "hall", "--out", tmp_path / "out")
    np.testing.assert_allclose(np.load(tmp_path / "out/poses.npy"), stated, atol=1e-12)
    np.testing.assert_array_equal(np.load(tmp_path / "out/features_a.npy"), rows)
    np.testing.assert_array_equal(store.room("hall").timestamps_ns, [0, 2, 4, 6, 8])


def test_writers_at_once_lose_nothing_of_each_other(tmp_path: Path) -> None:
    store, stated = seese3.Store(tmp_path), poses(3)
    sets = [f"x{number}" for number in range(12)]
    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda name: store.write_room("hall", stated, {name: np.ones((3, 2))}), sets))
    assert sorted(store.room("hall").features) == sorted(sets)
    seese3.run("store", "verify", "--store", store.folder)


def test_a_license_is_kept_by_those_who_add_features(tmp_path: Path) -> None:
    store, stated = seese3.Store(tmp_path), poses(3)
    store.write_room("hall", stated, {"a": np.ones((3, 2))}, license="CC BY 4.0", format="mine")
    store.write_room("hall", stated, {"b": np.ones((3, 2))})
    provenance = store.room("hall").manifest["provenance"]
    assert (provenance["license"], provenance["format"]) == ("CC BY 4.0", "mine")


def test_unfit_adapters_are_refused_and_leave_nothing(tmp_path: Path) -> None:
    store = seese3.Store(tmp_path / "store")
    source = seese3.FeatureSource("mine", 6)
    shapes = [(8, 6), (8,), (8,), (8,), (7, 8), (7,), (6, 7)]
    good = {name: RANDOM.normal(size=shape) for name, shape in zip(seese3.store.WEIGHTS, shapes, strict=True)}
    told = {
        "source": source,
        "features": np.ones((3, 6)),
        "rooms": {"hall": 1},
        "stride": 5,
        "epochs": 1,
        "target_mean": np.zeros(6),
        "target_deviation": np.ones(6),
    }
    for weights, changes, problem in (
        (good, {"split": "block"}, "unknown variant"),
        (good, {"stride": 0}, "stride"),
        (good, {"seed": -1}, "invalid value"),
        (good, {"rooms": {"../hall": 1}}, "adapter.json"),
        (good, {"target_deviation": np.full(6, np.inf)}, "finite"),
        ({**good, "W.weight": np.zeros((6, 7))}, {}, "rank"),
        ({**good, "W.weight": np.full((6, 7), np.nan)}, {}, "finite"),
        ({**good, "phi.0.weight": np.ones(8)}, {}, "phi.0"),
        ({key: value for key, value in good.items() if key != "W.weight"}, {}, "W.weight"),
    ):
        with pytest.raises(seese3.CommandError, match=problem):
            store.write_adapter("mine", weights, **{**told, **changes})
    with pytest.raises(ValueError, match="foo"):
        store.write_adapter("mine", {**good, "foo": np.ones(3)}, **told)
    assert not store.folder.exists()


def test_a_manifest_names_files_of_its_own_alone(tmp_path: Path) -> None:
    """A manifest with a right checksum, made by hand: what it says is not believed for that."""
    store = seese3.Store(tmp_path / "store")
    store.write_room("hall", poses(3), {"a": np.ones((3, 2))}, names=["u", "v", "w"])
    (tmp_path / "outside.json").write_text('["x", "y", "z"]')
    manifest = store.folder / "rooms/hall/revisions/000001.json"
    body = json.loads(manifest.read_text())["body"]
    content = (tmp_path / "outside.json").read_bytes()
    for changes, problem in (
        (
            {
                "frame_names": {
                    "file": "../../../../outside.json",
                    "sha256": hashlib.sha256(content).hexdigest(),
                    "bytes": len(content),
                }
            },
            "none of its own",
        ),
        ({"room": "other"}, "another room"),
        ({"features": [{"source": 3}]}, "not valid"),
    ):
        sealed(manifest, {**body, **changes})
        with pytest.raises(seese3.DamagedError, match=problem):
            store.room("hall")


def test_of_many_writers_each_gets_a_number_of_its_own(tmp_path: Path) -> None:
    store = seese3.Store(tmp_path)
    rooms = [poses(3) for _ in range(12)]
    with ThreadPoolExecutor(6) as pool:
        written = pool.map(lambda one: store.write_room("hall", one, {"a": np.ones((3, 2))}, mode="replace"), rooms)
        revisions = [revision.revision for revision in written]
    assert sorted(revisions) == list(range(1, 13))
    seese3.run("store", "verify", "--store", store.folder)


def test_a_chosen_revision_is_what_the_name_means(tmp_path: Path) -> None:
    store = seese3.Store(tmp_path)
    for _ in range(2):
        store.write_room("hall", poses(3), {"a": np.ones((3, 2))}, mode="replace")
    seese3.run("store", "default", "--store", tmp_path, "rooms/hall/revisions/1")
    assert store.room("hall").revision.revision == 1
    assert json.loads((tmp_path / "rooms/hall/revisions/000002.json").read_text())["body"]["revision"] == 2
