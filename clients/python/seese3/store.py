"""Stores in a folder, without a server. Rooms and adapters are read here, and written by the program.

    rooms/NAME/objects/…               tensors as safetensors; the file name contains the hash
    rooms/NAME/revisions/000001.json   the manifest, with the checksum of its own body; written last
    adapters/NAME/…                    the same for an adapter
    defaults/000001.json               which revisions an operator chose

What is read is checked against its checksums: a file that is truncated or altered raises a `DamagedError`.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load, save

from .answers import Camera, FeatureSource
from .errors import DamagedError, SeeseError
from .geometry import Array, real
from .views import Revision
from .words import FinalNorm, LayerIndexBase, UploadMode

SCHEMA = 1
# Tolerance of the latents of the features that an adapter keeps, with which a reader checks its own arithmetic.
GOLDEN_TOLERANCE = 1e-6
WEIGHTS = ("phi.0.weight", "phi.0.bias", "phi.1.weight", "phi.1.bias", "phi.3.weight", "phi.3.bias", "W.weight")
# The scales of stored keypoints, and the size of a descriptor.
POSITION_STEPS = 65535
MOST_INVERSE_DEPTH = 16.0
DEVIATION_STEPS = 1000
COMPRESSED = 32
# Words of manifests for where layers are numbered from, and for a final normalization.
BASES: dict[Any, LayerIndexBase] = {"0": "zero", "1": "one", "name": "name"}
NORMS: dict[Any, FinalNorm] = {"none": "none", "final": "applied"}
NUMBER = re.compile("[0-9]{1,18}")
PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True, eq=False)
class StoredKeypoints:
    """The keypoints of a room's n frames, k in all, frame after frame.

    Attributes:
        counts: The number of keypoints of each frame, (n,).
        positions: Fractions of the image's width and height, from its top left corner, (k, 2).
        inverse_depths: 1 / z in the camera frame, per meter, (k,).
        deviations: Relative standard deviations of the inverse depths, (k,).
        descriptors: Compressed descriptors of unit length, times 200, (k, 32).
        mean: Compression subtracts it from a descriptor, (d,).
        axes: Compression then multiplies by it, and scales to unit length, (d, 32).
    """

    counts: npt.NDArray[np.int64]
    positions: npt.NDArray[np.float32]
    inverse_depths: npt.NDArray[np.float32]
    deviations: npt.NDArray[np.float32]
    descriptors: npt.NDArray[np.int8]
    mean: npt.NDArray[np.float32]
    axes: npt.NDArray[np.float32]

    def rows(self, frame: int) -> slice:
        """The rows of a frame's keypoints: `keypoints.positions[keypoints.rows(7)]` are those of frame 7."""
        if not 0 <= frame < len(self.counts):
            raise IndexError(f"frame {frame}: the room has {len(self.counts)}")
        first = int(self.counts[:frame].sum())
        return slice(first, first + int(self.counts[frame]))


@dataclass(frozen=True, eq=False)
class StoredRoom:
    """A room of a store.

    Attributes:
        revision: Its name and revision.
        poses: The camera poses world_from_camera, (n, 4, 4), meters.
        features: The features by the name of their set, each (n, d).
        sources: The sources of the features, by the same names.
        names: The recording's own names for the frames; None if it has none.
        images: The paths of the image files; those of a `.sens` recording are its path and the place in it.
        timestamps_ns: The times of the frames, (n,), nanoseconds; None if unknown.
        segments: The uninterrupted segment of each frame, (n,); None if there is only one.
        keypoints: The keypoints of the frames; None if the room has none.
        manifest: The manifest of the revision.
    """

    revision: Revision
    poses: Array
    features: dict[str, npt.NDArray[np.float32]]
    sources: dict[str, FeatureSource]
    names: list[str] | None
    images: list[Path] | None
    timestamps_ns: npt.NDArray[np.int64] | None
    segments: npt.NDArray[np.int64] | None
    keypoints: StoredKeypoints | None
    manifest: dict[str, Any] = field(repr=False)

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True, eq=False)
class StoredAdapter:
    """An adapter of a store. `embed` and `motion` compute with it if it has one chart; others need a server.

    Attributes:
        revision: Its name and revision.
        source: The source of its features.
        tensors: Its tensors, under PyTorch's names.
        manifest: The manifest of the revision, with how it was trained.
    """

    revision: Revision
    source: FeatureSource
    tensors: dict[str, npt.NDArray[Any]]
    manifest: dict[str, Any] = field(repr=False)

    @property
    def training(self) -> dict[str, Any]:
        """How it was trained, with its R² on the test pairs: None where that is not defined."""
        training: dict[str, Any] = self.manifest["training"]
        return training

    @cached_property
    def _weights(self) -> dict[str, Array]:
        if self.training.get("charts", 1) != 1:
            raise SeeseError(f"adapter {self.revision.name!r} has several charts: ask a server for its latents")
        return {name: self.tensors[name].astype(np.float64) for name in WEIGHTS}

    def embed(self, features: npt.ArrayLike) -> Array:
        """The latents (n, k) of features (n, d): Linear, LayerNorm, GELU, Linear."""
        return _embed(self._weights, np.asarray(features, dtype=np.float64))

    def motion(self, first: npt.ArrayLike, second: npt.ArrayLike) -> Array:
        """The motions (n, 6) from latents (n, k) to others: μ + σ W(g₂ − g₁), in meters and radians."""
        step = np.atleast_2d(np.asarray(second, dtype=np.float64) - np.asarray(first, dtype=np.float64))
        mean, deviation = self.tensors["target.mean"], self.tensors["target.deviation"]
        motions: Array = mean + deviation * (step @ self._weights["W.weight"].T)
        return motions


def _embed(weights: Mapping[str, Array], features: Array) -> Array:
    x = features @ weights["phi.0.weight"].T + weights["phi.0.bias"]
    x = (x - x.mean(axis=1, keepdims=True)) / np.sqrt(x.var(axis=1, keepdims=True) + 1e-5)
    x = x * weights["phi.1.weight"] + weights["phi.1.bias"]

    # NumPy has no error function; that of Python is exact and fast enough for 64 columns.
    x = x * 0.5 * (1.0 + np.vectorize(math.erf, otypes=[float])(x / math.sqrt(2.0)))
    latents: Array = x @ weights["phi.3.weight"].T + weights["phi.3.bias"]
    return latents


@contextmanager
def _damaged(what: str) -> Iterator[None]:
    """Turns whatever goes wrong with content that is not as the program writes it into a `DamagedError`."""
    try:
        yield
    except SeeseError:
        raise
    except (ArithmeticError, AttributeError, LookupError, SafetensorError, TypeError, ValueError) as error:
        raise DamagedError(f"{what} has content that is not valid ({type(error).__name__}: {error})") from error


class Store:
    """A store in a folder. Writing makes the folder if it is not there; reading needs it."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)

    def __repr__(self) -> str:
        return f"Store({str(self.folder)!r})"

    # Reading.

    def rooms(self) -> list[str]:
        """The names of the rooms, sorted."""
        return self._names("rooms")

    def adapters(self) -> list[str]:
        """The names of the adapters, sorted."""
        return self._names("adapters")

    def room(self, name: str, revision: int | None = None) -> StoredRoom:
        """A room with all its features: the given revision, or the one that the name alone means."""
        _check_name("room", name)
        body = self._body("rooms", name, revision)
        with _damaged(f"room {name!r}"):
            frames = load(self._object("rooms", name, body["frames"]))
            features, sources = {}, {}
            for entry in body["features"]:
                source = _source(entry["source"])
                features[source.name] = load(self._object("rooms", name, entry["object"]))["features"]
                sources[source.name] = source

            root = Path(body["provenance"].get("images_root", ""))
            images = self._list(name, body.get("images"))
            return StoredRoom(
                revision=Revision(name, body["revision"]),
                poses=frames["world_from_camera"],
                features=features,
                sources=sources,
                names=self._list(name, body["frame_names"]),
                images=None if images is None else [root / image for image in images],
                timestamps_ns=frames.get("timestamps_ns"),
                segments=frames.get("sequences"),
                keypoints=self._keypoints(name, body),
                manifest=body,
            )

    def adapter(self, name: str, revision: int | None = None) -> StoredAdapter:
        """An adapter. One of a single chart is checked: its golden features have to give its golden latents."""
        _check_name("adapter", name)
        body = self._body("adapters", name, revision)
        with _damaged(f"adapter {name!r}"):
            tensors = load(self._object("adapters", name, body["weights"]))
            adapter = StoredAdapter(Revision(name, body["revision"]), _source(body["source"]), tensors, body)
            if body["training"].get("charts", 1) == 1:
                expected = tensors["golden.latents"]
                difference = np.abs(adapter.embed(tensors["golden.features"]) - expected)
                if not (difference <= GOLDEN_TOLERANCE * np.maximum(1.0, np.abs(expected))).all():
                    raise DamagedError(f"adapter {name!r}: its golden features do not give its golden latents")
            return adapter

    def adapter_files(self, name: str, revision: int | None = None) -> tuple[bytes, bytes]:
        """The manifest and the weights of an adapter, as `Client.upload_adapter` takes them."""
        _check_name("adapter", name)
        body = self._body("adapters", name, revision)
        manifest = self._manifest("adapters", name, body["revision"]).read_bytes()
        return manifest, self._object("adapters", name, body["weights"])

    # Writing.

    def write_room(
        self,
        name: str,
        poses: npt.ArrayLike,
        features: Mapping[str | FeatureSource, npt.NDArray[np.floating]],
        *,
        timestamps_ns: npt.ArrayLike | None = None,
        segments: npt.ArrayLike | None = None,
        names: Sequence[str] | None = None,
        camera: Camera | None = None,
        format: str = "",
        license: str = "",
        mode: UploadMode = "create",
    ) -> Revision:
        """Publishes a room, by `seese3 import bundle`.

        Args:
            name: The name of the room.
            poses: The camera poses world_from_camera, (n, 4, 4), meters. Rotations are projected onto SO(3).
            features: Features (n, d) by the name of their set, or by their source.
            timestamps_ns: The times of the frames, (n,), nanoseconds.
            segments: The uninterrupted segment of each frame, (n,).
            names: A name for each frame.
            camera: The camera of the images, if it is known.
            format: The dataset format of the recording; empty for "numpy".
            license: The terms under which the recording may be used.
            mode: "create" refuses a room that has other poses. If the poses are the same, the room keeps what is not
                given here: other features, times, names, images, license and keypoints. "replace" publishes a new
                revision in any case, and "extend" appends the frames.

        Returns:
            The revision.

        Raises:
            CommandError: The program refused the room; the message states what to change.
            ValueError: An array has a wrong shape or type.

        Example:
            >>> Store("store").write_room("kitchen", poses, {"mine": features})
        """
        matrices = real(poses, "poses")
        if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
            raise ValueError(f"poses: are (n, 4, 4), not {matrices.shape}")
        count = len(matrices)
        sets = {}
        for key, values in features.items():
            rows = real(values, "features").astype(np.float32)
            source = key if isinstance(key, FeatureSource) else FeatureSource(str(key), rows.shape[-1])
            if rows.ndim != 2 or len(rows) != count or source.dim != rows.shape[1]:
                raise ValueError(f"features: {source.name!r} is ({count}, {source.dim}), not {rows.shape}")
            if source.name in sets:
                raise ValueError(f"features: two sets have the same name, {source.name!r}")
            sets[source.name] = (source, rows)
        _check_name("room", name)
        for set_name in sets:
            _check_name("set of features", set_name)

        described: dict[str, Any] = {"format": "seese3 bundle 1", "license": license}
        described["recorded_as"] = format or self._recorded_as(name) or "numpy"
        described["features"] = [_stated_source(source) for source, _ in sets.values()]
        if names is not None:
            described["names"] = _texts(names, count)
        if segments is not None:
            described["sequences"] = _column(segments, "segments", count).tolist()
        with tempfile.TemporaryDirectory(prefix="seese3-room-") as temporary:
            folder = Path(temporary)
            np.save(folder / "poses.npy", np.ascontiguousarray(matrices))
            if timestamps_ns is not None:
                np.save(folder / "timestamps.npy", _column(timestamps_ns, "timestamps_ns", count))
            for set_name, (_, rows) in sets.items():
                np.save(folder / f"features_{set_name}.npy", np.ascontiguousarray(rows))
            (folder / "bundle.json").write_text(json.dumps(described), encoding="utf-8")
            arguments: list[object] = ["import", "bundle", folder, "--store", self.folder, "--name", name]
            if camera is not None:
                arguments += ["--camera", _camera_text(camera)]
            if mode != "create":
                arguments.append({"replace": "--replace", "extend": "--extend"}[mode])
            return self._published(name, arguments)

    def write_adapter(
        self,
        name: str,
        weights: Mapping[str, npt.NDArray[np.floating]],
        *,
        source: FeatureSource,
        target_mean: npt.ArrayLike,
        target_deviation: npt.ArrayLike,
        features: npt.NDArray[np.floating],
        rooms: Mapping[str, int],
        stride: int,
        epochs: int,
        preset: str = "elsewhere",
        split: str = "whole",
        seed: int = 0,
    ) -> Revision:
        """Publishes an adapter that was trained elsewhere, for instance in PyTorch, by `seese3 import adapter`.

        Args:
            name: The name of the adapter.
            weights: Its `state_dict` as NumPy arrays: `phi.0.weight` (h, d), `phi.0.bias`, `phi.1.weight` and
                `phi.1.bias` (h,) of the LayerNorm, `phi.3.weight` (k, h), `phi.3.bias`, and `W.weight` (6, k).
            source: The source of its features.
            target_mean: The mean μ of the training motions (v, ω), (6,), meters and radians.
            target_deviation: Their population standard deviation σ (ddof 0), (6,).
            features: Some features (n, d) that it was trained on, with which the program checks it.
            rooms: The revisions of the rooms that it was trained in, by name; evaluations tell by them what leaks.
            stride: The number of frames from source to target.
            epochs: The number of epochs.
            preset: A name for the training settings.
            split: How the test pairs were held out from training.
            seed: The seed of the training run.

        Returns:
            The revision. The adapter has no scores and no error model: a server navigates with it, and does not track.

        Raises:
            CommandError: The program refused the adapter; the message states what to change.
            ValueError: An array has a wrong type, or a name is not valid.

        Example:
            >>> weights = {key: tensor.numpy() for key, tensor in model.state_dict().items()}
            >>> Store("store").write_adapter("mine", weights, source=source, target_mean=mu, target_deviation=sigma,
            ...                              features=rows, rooms={"kitchen": 1}, stride=40, epochs=10)
        """
        _check_name("adapter", name)
        if unknown := [key for key in weights if key not in WEIGHTS]:
            raise ValueError(f"weights: {', '.join(unknown)} are no tensors of an adapter of one chart")
        tensors: dict[str, npt.NDArray[Any]] = {
            key: real(value, f"weights: {key!r}").astype(np.float32) for key, value in weights.items()
        }
        tensors["target.mean"] = real(target_mean, "target_mean")
        tensors["target.deviation"] = real(target_deviation, "target_deviation")
        tensors["features"] = real(features, "features").astype(np.float32)
        described = {
            "format": "seese3 adapter 1",
            "feature_source": _stated_source(source),
            "rooms": {room: int(revision) for room, revision in rooms.items()},
            "stride": int(stride),
            "epochs": int(epochs),
            "seed": int(seed),
            "split": split,
            "preset": preset,
        }
        with tempfile.TemporaryDirectory(prefix="seese3-adapter-") as temporary:
            folder = Path(temporary)
            # The library writes the memory of an array as it lies, whatever its strides are.
            content: bytes = save({key: np.ascontiguousarray(tensor) for key, tensor in tensors.items()})
            (folder / "weights.safetensors").write_bytes(content)
            (folder / "adapter.json").write_text(json.dumps(described), encoding="utf-8")
            arguments: list[object] = ["import", "adapter", folder, "--store", self.folder, "--name", name]
            return self._published(name, arguments)

    def _recorded_as(self, name: str) -> str | None:
        """The format of a room's recording; None if the room is not there."""
        if not self._revisions("rooms", name)[0]:
            return None
        recorded_as: str = self._body("rooms", name, None)["provenance"]["format"]
        return recorded_as

    def _published(self, name: str, arguments: list[object]) -> Revision:
        """Runs a command that publishes, and returns the revision that it states."""
        # The client of the program needs this module.
        from .program import run

        with tempfile.TemporaryDirectory(prefix="seese3-report-") as temporary:
            report = Path(temporary) / "report.json"
            run("--quiet", *arguments, "--json", report)
            return Revision(name, int(json.loads(report.read_text())["revision"]))

    # Files.

    def _names(self, kind: str) -> list[str]:
        if not self.folder.is_dir():
            raise SeeseError(f"store {str(self.folder)!r} does not exist")
        folders = (self.folder / kind).glob("*") if (self.folder / kind).is_dir() else []
        return sorted(folder.name for folder in folders if self._revisions(kind, folder.name)[0])

    def _manifest(self, kind: str, name: str, revision: int) -> Path:
        return self.folder / kind / name / "revisions" / f"{revision:06}.json"

    def _revisions(self, kind: str, name: str) -> tuple[list[int], int]:
        """The revisions that are there, and the highest number that was ever given."""
        present, highest = [], 0
        for file in (self.folder / kind / name / "revisions").glob("*"):
            number = int(file.stem) if NUMBER.fullmatch(file.stem) else 0
            if number and file.name in (f"{number:06}.json", f"{number:06}.gone"):
                highest = max(highest, number)
                if file.suffix == ".json":
                    present.append(number)
        return sorted(present), highest

    def _body(self, kind: str, name: str, revision: int | None) -> dict[str, Any]:
        what = kind.removesuffix("s")
        present = self._revisions(kind, name)[0]
        if not present:
            known = ", ".join(self._names(kind)) or "none"
            raise SeeseError(f"{what} {name!r} is not in the store; it has {known}")
        if revision is None:
            revision = self._defaults().get(f"{what}_revisions", {}).get(name, present[-1])
        if revision not in present:
            raise SeeseError(f"{what} {name!r} has no revision {revision}; it has {present}")
        path = self._manifest(kind, name, revision)
        manifest = _read_manifest(path)
        if (manifest.get(what), manifest.get("revision")) != (name, revision):
            raise DamagedError(f"{path} is the manifest of another {what} or revision")
        return manifest

    def _defaults(self) -> dict[str, Any]:
        files = [file for file in (self.folder / "defaults").glob("*.json") if NUMBER.fullmatch(file.stem)]
        files.sort(key=lambda file: int(file.stem))
        defaults: dict[str, Any] = _read_manifest(files[-1])["defaults"] if files else {}
        return defaults

    def _object(self, kind: str, name: str, reference: dict[str, Any]) -> bytes:
        path = self.folder / kind / name / "objects" / reference["file"]
        if path.name != reference["file"]:
            raise DamagedError(
                f"the manifest of {name!r} names the file {reference['file']!r}, which is none of its own"
            )
        try:
            content: bytes = path.read_bytes()
        except FileNotFoundError:
            raise DamagedError(f"{path} is missing; restore it, or publish again") from None
        except IsADirectoryError:
            raise DamagedError(f"{path} is a folder; restore it, or publish again") from None
        if len(content) != reference["bytes"] or hashlib.sha256(content).hexdigest() != reference["sha256"]:
            raise DamagedError(f"{path} is truncated or altered: it has another checksum than its manifest states")
        return content

    def _keypoints(self, name: str, body: dict[str, Any]) -> StoredKeypoints | None:
        entry = body.get("keypoints")
        if entry is None:
            return None
        tensors, frame_count = load(self._object("rooms", name, entry["object"])), body["frame_count"]
        counts, positions = tensors["counts"], tensors["positions"]
        inverse_depths, deviations = tensors["inverse_depths"], tensors["deviations"]
        descriptors, mean, axes = tensors["descriptors"], tensors["basis.mean"], tensors["basis.axes"]

        total = int(counts.sum())
        shapes = ((frame_count,), (total, 2), (total,), (total,), (total, COMPRESSED), (*mean.shape, COMPRESSED))
        arrays = (counts, positions, inverse_depths, deviations, descriptors, axes)
        if tuple(array.shape for array in arrays) != shapes or (counts < 0).any():
            raise DamagedError(f"room {name!r} has keypoints whose tensors contradict each other or its frames")
        per_meter = MOST_INVERSE_DEPTH / POSITION_STEPS / entry["unit_m"]
        return StoredKeypoints(
            counts=counts,
            positions=(positions / POSITION_STEPS).astype(np.float32),
            inverse_depths=(np.maximum(inverse_depths, 1) * per_meter).astype(np.float32),
            deviations=(np.maximum(deviations, 1) / DEVIATION_STEPS).astype(np.float32),
            descriptors=descriptors,
            mean=mean,
            axes=axes,
        )

    def _list(self, name: str, reference: dict[str, Any] | None) -> list[str] | None:
        if reference is None:
            return None
        names: list[str] = json.loads(self._object("rooms", name, reference))
        return names


def _read_manifest(path: Path) -> dict[str, Any]:
    """The body of a manifest, whose checksum is that of the body's text exactly as it stands in the file."""
    try:
        text = path.read_text(encoding="utf-8")
        envelope = json.loads(text)
        stated, body = envelope["sha256"], envelope["body"]
        start = text.index("{", text.index('"body"'))
        _, end = json.JSONDecoder().raw_decode(text, start)
        schema = body["schema"]
    except (ValueError, KeyError, TypeError, IsADirectoryError) as error:
        raise DamagedError(f"{path} is not a valid manifest ({error}): it was truncated or altered") from None
    if hashlib.sha256(text[start:end].encode()).hexdigest() != stated:
        raise DamagedError(f"{path} does not have the checksum that it states: it was altered")
    if not isinstance(schema, int) or schema > SCHEMA:
        raise SeeseError(f"{path} was written by a newer version (schema {schema}); update this package")
    result: dict[str, Any] = body
    return result


def _source(entry: dict[str, Any]) -> FeatureSource:
    plain = {key: entry[key] for key in FeatureSource.__dataclass_fields__ if key in entry}
    return FeatureSource(
        **plain, layer_index_base=BASES.get(entry.get("base")), final_norm=NORMS.get(entry.get("norm"))
    )


def _check_name(what: str, name: str) -> None:
    if not isinstance(name, str) or not PLAIN_NAME.fullmatch(name):
        raise ValueError(f"{name!r} cannot be the name of a {what}: use 1 to 100 letters, digits, '.', '-' or '_'")


def _stated_source(source: FeatureSource) -> dict[str, Any]:
    """A source as the program reads it."""
    entry = asdict(source)
    bases = {word: stated for stated, word in BASES.items()}
    norms = {word: stated for stated, word in NORMS.items()}
    entry["base"] = bases.get(entry.pop("layer_index_base"), "unspecified")
    entry["norm"] = norms.get(entry.pop("final_norm"), "unspecified")
    return entry | {"dim": int(source.dim)}


def _camera_text(camera: Camera) -> str:
    """A camera as the option --camera of the program."""
    x = camera.width / 2 if camera.cx is None else camera.cx
    y = camera.height / 2 if camera.cy is None else camera.cy
    fy = camera.fx if camera.fy is None else camera.fy
    text = (
        f"{float(camera.width)!r}x{float(camera.height)!r},{float(camera.fx)!r},{float(fy)!r},{float(x)!r},{float(y)!r}"
    )
    numbers = [repr(number) for number in camera.distortion]
    if camera.distortion_model == "kannala_brandt":
        return f"{text},fisheye={':'.join(numbers)}"
    lens = zip(("k1", "k2", "p1", "p2", "k3"), numbers, strict=False)
    return ",".join([text, *(f"{key}={number}" for key, number in lens)])


def _column(values: npt.ArrayLike, name: str, count: int) -> npt.NDArray[np.int64]:
    column = np.asarray(values)
    if column.shape != (count,) or not np.issubdtype(column.dtype, np.integer):
        raise ValueError(f"{name}: is ({count},) of integers, not {column.dtype} of shape {column.shape}")
    if column.dtype == np.uint64 and column.size and int(column.max()) >= 1 << 63:
        raise ValueError(f"{name}: has a number over 2⁶³ - 1")
    return column.astype(np.int64)


def _texts(names: Sequence[str], count: int) -> list[str]:
    if isinstance(names, str) or len(names) != count:
        raise ValueError(f"names: is a list of {count} names, one for each pose, not {names!r:.100}")
    for row, name in enumerate(names):
        if not isinstance(name, str):
            raise ValueError(f"names: row {row} is {name!r}, and no text")
    return list(names)
