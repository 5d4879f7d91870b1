"""Stores in a folder, without a server: rooms and adapters are read and written as the program does it.

    rooms/NAME/objects/…               tensors as safetensors; the file name contains the hash
    rooms/NAME/revisions/000001.json   the manifest, with the checksum of its own body; written last
    adapters/NAME/…                    the same for an adapter
    defaults/000001.json               which revisions an operator chose

What is read is checked against its checksums: a file that is truncated or altered raises a `DamagedError`. What is
written becomes visible with its manifest, as a whole or not at all, and never replaces a revision.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
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
from .words import FinalNorm, LayerIndexBase

SCHEMA = 1
# Rotations that are further from SO(3) are taken for a mistake, as by `seese3 import`.
WORST_ROTATION = 1e-2
# The longest distance of a camera from its world's origin, metres: that of the program.
LONGEST_M = 1e6
LICENCE_BYTES = 10_000
# Adapters keep some features with what they give for them, by which a reader checks that it computes the same.
GOLDEN_ROWS = 8
GOLDEN_TOLERANCE = 1e-6
WEIGHTS = ("phi.0.weight", "phi.0.bias", "phi.1.weight", "phi.1.bias", "phi.3.weight", "phi.3.bias", "W.weight")
SPLITS = ("time", "blocks", "pairs", "whole", "dataset", "fold1", "fold2", "fold3", "fold4", "fold5")
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

    - `counts` (n,): the number of keypoints of each frame.
    - `positions` (k, 2): fractions of the image's width and height, from its top left corner.
    - `inverse_depths` (k,): 1 / z in the camera frame, per metre.
    - `deviations` (k,): relative standard deviations of the inverse depths.
    - `descriptors` (k, 32): compressed descriptors of unit length, times 200. `mean` (d,) and `axes` (d, 32) compress
      others: the mean is subtracted, the rest multiplied by the axes and scaled to unit length.
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
    """A room: poses world_from_camera (n, 4, 4), metres, and features (n, d) by the name of their source.

    `images` are the paths of image files; those of a `.sens` recording are its path and the place in it.
    `keypoints` is None if the room has none.
    """

    revision: Revision
    poses: Array
    features: dict[str, npt.NDArray[np.float32]]
    sources: dict[str, FeatureSource]
    names: list[str] | None
    images: list[Path] | None
    timestamps_ns: npt.NDArray[np.int64] | None
    sequences: npt.NDArray[np.int64] | None
    keypoints: StoredKeypoints | None
    manifest: dict[str, Any] = field(repr=False)

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True, eq=False)
class StoredAdapter:
    """An adapter: its tensors under PyTorch's names, and the manifest with how it was trained.

    `embed` and `motion` compute with them, for adapters of one chart; the others need a server.
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
        """The motions (n, 6) from latents (n, k) to others: μ + σ W(g₂ − g₁), in metres and radians."""
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
                sequences=frames.get("sequences"),
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
        """The manifest and the weights of an adapter, as `Client.publish_adapter` takes them."""
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
        sequences: npt.ArrayLike | None = None,
        names: Sequence[str] | None = None,
        camera: Camera | None = None,
        format: str = "",
        licence: str = "",
    ) -> Revision:
        """Publishes a room: poses world_from_camera (n, 4, 4) in metres, and features (n, d) by name or source.

        Rotations are projected onto SO(3). The newest revision is kept beside the new one; if it has the same poses,
        what is not given here (features of other names, times, names, images, licence) is carried over, and so are its
        keypoints, unless another camera is given, or features of another encoder under the name of theirs. The poses
        are not compared with images: `seese3 check room` does that where the room has some.
        """
        _check_name("room", name)
        matrices, deviation = _checked_poses(poses)
        columns: dict[str, npt.NDArray[Any]] = {"world_from_camera": matrices}
        if timestamps_ns is not None:
            columns["timestamps_ns"] = _column(
                timestamps_ns, "timestamps_ns", len(matrices), range(-(1 << 63), 1 << 63)
            )
        if sequences is not None:
            columns["sequences"] = _column(sequences, "sequences", len(matrices), range(1 << 32))
        listed = _checked_names(names, len(matrices))
        sets = [_checked_features(key, values, len(matrices)) for key, values in features.items()]
        if len({source.name for source, _ in sets}) < len(sets):
            raise ValueError("features: two sets have the same name")
        for argument, text in (("format", format), ("licence", licence)):
            if not isinstance(text, str) or len(text.encode()) > LICENCE_BYTES:
                raise ValueError(f"{argument}: is a text of at most {LICENCE_BYTES} bytes, not {text!r}")

        new = _NewRoom(matrices, deviation, columns, listed, sets, camera, format, licence)
        return self._publish("rooms", name, lambda newest: self._room_body(name, new, newest))

    def _room_body(self, name: str, new: _NewRoom, newest: dict[str, Any] | None) -> dict[str, Any]:
        """The manifest of a room, with what the newest revision has and is not given, if it has the same poses."""
        columns = new.columns
        if newest is not None:
            known = load(self._object("rooms", name, newest["frames"]))
            stored = known["world_from_camera"]
            if stored.shape == new.poses.shape and np.abs(stored - new.poses).max() < 1e-12:
                columns = {**known, **columns, "world_from_camera": stored}
            else:
                newest = None

        entries = {}
        for source, rows in new.features:
            content = _safetensors({"features": rows})
            stored_as = self._write("rooms", name, f"features-{source.name}", "safetensors", content)
            entries[source.name] = {"source": _stored_source(source), "object": stored_as}
        for entry in newest["features"] if newest else []:
            entries.setdefault(entry["source"]["name"], entry)

        provenance: dict[str, Any] = {
            "format": new.format or (newest["provenance"]["format"] if newest else "numpy"),
            "licence": new.licence or (newest["provenance"].get("licence", "") if newest else ""),
            "images_root": newest["provenance"].get("images_root", "") if newest else "",
            "worst_rotation_deviation": new.worst_rotation_deviation,
        }
        if new.camera is not None:
            provenance["camera"] = _stored_camera(new.camera)
        elif newest and "camera" in newest["provenance"]:
            provenance["camera"] = newest["provenance"]["camera"]

        body = {
            "schema": SCHEMA,
            "room": name,
            "revision": 0,
            "created": "",
            "frame_count": len(new.poses),
            "frames": self._write("rooms", name, "frames", "safetensors", _safetensors(columns)),
            "frame_names": self._write_list(name, "frame-names", new.names, newest),
            "images": newest.get("images") if newest else None,
            "features": [entries[key] for key in sorted(entries)],
            "provenance": provenance,
        }
        if newest and _are_valid_for(newest.get("keypoints"), body):
            body["keypoints"] = newest["keypoints"]
        return body

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
        """Publishes an adapter that was trained elsewhere, for instance in PyTorch: its `state_dict` as NumPy arrays.

        - `weights`: `phi.0.weight` (h, d), `phi.0.bias`, `phi.1.weight` and `phi.1.bias` (h,) of the LayerNorm,
          `phi.3.weight` (k, h), `phi.3.bias`, and `W.weight` (6, k).
        - `target_mean`, `target_deviation`: μ and σ (6,) of the training motions (v, ω), metres and radians; σ has no
          correction for small samples (ddof 0).
        - `features`: some features (n, d) that it was trained on, from which golden vectors are made.
        - `rooms`: the revisions of the rooms that it was trained in, by name; evaluations tell by them what leaks.

        It has no scores and no error model: a server navigates with it, and does not track.
        """
        _check_name("adapter", name)
        _check_training(split, stride, epochs, seed, preset, rooms)
        tensors = _checked_weights(weights, source)
        hidden, latent = tensors["phi.0.weight"].shape[0], tensors["phi.3.weight"].shape[0]

        mean, deviation = real(target_mean, "target_mean"), real(target_deviation, "target_deviation")
        is_finite = np.isfinite(mean).all() and np.isfinite(deviation).all()
        if mean.shape != (6,) or deviation.shape != (6,) or not is_finite or not (deviation > 0).all():
            raise ValueError("target_mean and target_deviation: are six finite numbers each, the deviations above 0")

        rows = _checked_features(source, features, None)[1]
        golden = np.ascontiguousarray(rows[:: -(-len(rows) // GOLDEN_ROWS)])
        draft = StoredAdapter(
            Revision(name, 0), source, {**tensors, "target.mean": mean, "target.deviation": deviation}, {"training": {}}
        )
        latents = draft.embed(golden)
        content = {
            **draft.tensors,
            "golden.features": golden,
            "golden.latents": latents,
            "golden.twists": draft.motion(latents[:1], latents),
        }
        unknown = {
            "n": 0,
            "components": [None] * 6,
            "overall": None,
            "translation": None,
            "rotation": None,
            "direction": None,
            "magnitude": None,
            "direction_pairs_dropped": 0,
        }
        training = {
            "preset": preset,
            "split": split,
            "stride": int(stride),
            "range": None,
            "rooms": [[room, int(revision)] for room, revision in rooms.items()],
            "calibrated_on": [],
            "epochs": int(epochs),
            "batch": 0,
            "learning_rate": 0.0,
            "weight_decay": 0.0,
            "clip_norm": 0.0,
            "hidden": hidden,
            "latent": latent,
            "charts": 1,
            "mixing": "gate",
            "loss": "mse",
            "standardise": False,
            "noise": 0.0,
            "average": 0.0,
            "through_zero": False,
            "seed": int(seed),
            "correctors": [],
            "pair_count": 0,
            "test": unknown,
            "train": unknown,
            "room_tests": [],
            "train_mean_r2": None,
        }
        body = {
            "schema": SCHEMA,
            "adapter": name,
            "revision": 0,
            "created": "",
            "source": _stored_source(source),
            "weights": self._write("adapters", name, "weights", "safetensors", _safetensors(content)),
            "twist_frame": "body",
            "deviation_ddof": 0,
            "training": training,
        }
        return self._publish("adapters", name, lambda newest: body)

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
        per_metre = MOST_INVERSE_DEPTH / POSITION_STEPS / entry["unit_m"]
        return StoredKeypoints(
            counts=counts,
            positions=(positions / POSITION_STEPS).astype(np.float32),
            inverse_depths=(np.maximum(inverse_depths, 1) * per_metre).astype(np.float32),
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

    def _write_list(
        self, name: str, stem: str, names: list[str] | None, newest: dict[str, Any] | None
    ) -> dict[str, Any] | None:
        if names is None:
            return newest["frame_names"] if newest else None
        content = json.dumps(names, ensure_ascii=False, separators=(",", ":")).encode()
        return self._write("rooms", name, stem, "json", content)

    def _write(self, kind: str, name: str, stem: str, extension: str, content: bytes) -> dict[str, Any]:
        """Writes an object, whose name contains its hash, and returns the reference to it."""
        sha256 = hashlib.sha256(content).hexdigest()
        file = f"{stem}-{sha256[:16]}.{extension}"
        folder = self.folder / kind / name / "objects"
        folder.mkdir(parents=True, exist_ok=True)
        os.replace(_temporary(folder, content), folder / file)
        return {"file": file, "sha256": sha256, "bytes": len(content)}

    def _publish(self, kind: str, name: str, body_after: Callable[[dict[str, Any] | None], dict[str, Any]]) -> Revision:
        """Writes a manifest under the next free number, or returns the newest revision if it says the same.

        `body_after` makes the manifest from that of the newest revision. It is asked again if somebody else published
        one meanwhile, so that nothing that they added is lost.
        """
        while True:
            present, highest = self._revisions(kind, name)
            newest = _read_manifest(self._manifest(kind, name, present[-1])) if present else None
            body = body_after(newest)
            if newest is not None and {**newest, "created": "", "revision": 0} == _as_written(body):
                return Revision(name, present[-1])

            revision = highest + 1
            dated = {**body, "revision": revision, "created": datetime.now(timezone.utc).isoformat()}
            text = json.dumps(dated, ensure_ascii=False, indent=2)
            sha256 = hashlib.sha256(text.encode()).hexdigest()
            manifest = f'{{\n  "sha256": "{sha256}",\n  "body": {text}\n}}'

            path = self._manifest(kind, name, revision)
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = _temporary(path.parent, manifest.encode())
            try:
                # A link is made only if nothing has this name: of several writers one gets the number.
                os.link(temporary, path)
                return Revision(name, revision)
            except FileExistsError:
                continue
            finally:
                os.unlink(temporary)


@dataclass(frozen=True, eq=False)
class _NewRoom:
    """What `write_room` was given, checked."""

    poses: Array
    worst_rotation_deviation: float
    columns: dict[str, npt.NDArray[Any]]
    names: list[str] | None
    features: list[tuple[FeatureSource, npt.NDArray[np.float32]]]
    camera: Camera | None
    format: str
    licence: str


def _safetensors(tensors: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """Tensors as a file. The library writes the memory of an array as it lies, whatever its strides are."""
    content: bytes = save({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()})
    return content


def _as_written(body: dict[str, Any]) -> Any:
    """The body as it reads when it was written as JSON."""
    return json.loads(json.dumps(body))


def _temporary(folder: Path, content: bytes) -> str:
    """A file in `folder` with this content, on the disk."""
    descriptor, path = tempfile.mkstemp(dir=folder, prefix=".", suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(descriptor, 0o644)
            file.write(content)
            file.flush()
            os.fsync(descriptor)
    except BaseException:
        os.unlink(path)
        raise
    return path


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


def _stored_source(source: FeatureSource) -> dict[str, Any]:
    """A source as a manifest has it."""
    entry = asdict(source)
    stored_base = {word: stored for stored, word in BASES.items()}
    stored_norm = {word: stored for stored, word in NORMS.items()}
    entry["base"] = stored_base.get(entry.pop("layer_index_base"), "unspecified")
    entry["norm"] = stored_norm.get(entry.pop("final_norm"), "unspecified")
    return entry


def _are_valid_for(keypoints: dict[str, Any] | None, body: dict[str, Any]) -> bool:
    """Whether there are keypoints, of the camera of `body`, and not of features that it replaces."""
    if keypoints is None or keypoints["camera"] != _as_written(body["provenance"].get("camera")):
        return False
    feature = _source(keypoints["source"]["feature"])
    sources = [_source(entry["source"]) for entry in body["features"]]
    return all(source == feature for source in sources if source.name == feature.name)


def _stored_camera(camera: Camera) -> dict[str, Any]:
    """A camera as manifests state it: lengths in image widths."""
    x = camera.width / 2 if camera.cx is None else camera.cx
    y = camera.height / 2 if camera.cy is None else camera.cy
    fy = camera.fx if camera.fy is None else camera.fy
    distortion: dict[str, Any] = {"model": camera.distortion_model or "none"}
    if camera.distortion_model is not None:
        count = 5 if camera.distortion_model == "brown_conrady" else 4
        distortion["coefficients"] = [*camera.distortion, *[0.0] * (count - len(camera.distortion))]
    return {
        "focal": [float(camera.fx / camera.width), float(fy / camera.width)],
        "height": float(camera.height / camera.width),
        "center": [float(x / camera.width), float(y / camera.width)],
        "distortion": distortion,
    }


def _check_name(what: str, name: str) -> None:
    if not isinstance(name, str) or not PLAIN_NAME.fullmatch(name):
        raise ValueError(f"{name!r} cannot be the name of a {what}: use 1 to 100 letters, digits, '.', '-' or '_'")


def _checked_poses(poses: npt.ArrayLike) -> tuple[Array, float]:
    """The poses with their rotations projected onto SO(3), and how far the worst was from it."""
    matrices = real(poses, "poses")
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or len(matrices) == 0:
        raise ValueError(f"poses: are (n, 4, 4) with at least one frame, not {matrices.shape}")
    if not np.isfinite(matrices).all():
        row = int(np.argwhere(~np.isfinite(matrices).all(axis=(1, 2)))[0, 0])
        raise ValueError(f"poses: row {row} has a number that is not finite")
    distances = np.linalg.norm(matrices[:, :3, 3], axis=1)
    if distances.max() > LONGEST_M:
        row = int(distances.argmax())
        raise ValueError(f"poses: row {row} is {distances[row]:.1e} m from the origin; are these metres?")
    if np.abs(matrices[:, 3] - (0, 0, 0, 1)).max() > 1e-6:
        raise ValueError("poses: the last row of each has to be 0, 0, 0, 1; are they transposed?")

    rotations = matrices[:, :3, :3]
    deviations = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    worst = int(deviations.argmax())
    mirrored = np.linalg.det(rotations) < 0
    if deviations[worst] > WORST_ROTATION or mirrored.any():
        row = int(mirrored.argmax()) if mirrored.any() else worst
        raise ValueError(
            f"poses: row {row} is no rotation and translation: R Rᵀ is {deviations[row]:.1e} off, or it mirrors"
        )
    u, _, vt = np.linalg.svd(rotations)
    matrices[:, :3, :3] = u @ vt
    matrices[:, 3] = (0, 0, 0, 1)
    return matrices, float(deviations[worst])


def _column(values: npt.ArrayLike, name: str, count: int, within: range) -> npt.NDArray[np.int64]:
    column = np.asarray(values)
    if column.shape != (count,) or not np.issubdtype(column.dtype, np.integer):
        raise ValueError(f"{name}: is ({count},) of integers, not {column.dtype} of shape {column.shape}")
    if int(column.min()) not in within or int(column.max()) not in within:
        raise ValueError(f"{name}: has a number that is not from {within.start} to {within.stop - 1}")
    return column.astype(np.int64)


def _checked_names(names: Sequence[str] | None, count: int) -> list[str] | None:
    if names is None:
        return None
    if isinstance(names, str) or len(names) != count:
        raise ValueError(f"names: is a list of {count} names, one for each pose, not {names!r:.100}")
    listed = list(names)
    for row, name in enumerate(listed):
        if not isinstance(name, str):
            raise ValueError(f"names: row {row} is {name!r}, and no text")
    return [str(name) for name in listed]


def _check_training(split: str, stride: int, epochs: int, seed: int, preset: str, rooms: Mapping[str, int]) -> None:
    """What a manifest states about a training, as the program reads it."""
    if split not in SPLITS:
        raise ValueError(f"split: {split!r} is none of {', '.join(SPLITS)}")
    for argument, value, within in (
        ("stride", stride, range(1, 1 << 32)),
        ("epochs", epochs, range(1 << 32)),
        ("seed", seed, range(1 << 64)),
    ):
        if not isinstance(value, (int, np.integer)) or int(value) not in within:
            raise ValueError(f"{argument}: {value!r} is no whole number from {within.start} to {within.stop - 1}")
    _check_name("preset", preset)
    for room, revision in rooms.items():
        _check_name("room", room)
        if not isinstance(revision, (int, np.integer)) or revision < 1:
            raise ValueError(f"rooms: {room!r} has the revision {revision!r}, which is no number from 1 on")


def _checked_weights(
    weights: Mapping[str, npt.NDArray[np.floating]], source: FeatureSource
) -> dict[str, npt.NDArray[np.float32]]:
    """The tensors of an adapter, as the program reads them."""
    if missing := [key for key in WEIGHTS if key not in weights]:
        raise ValueError(f"weights: lack {', '.join(missing)}")
    if unknown := [key for key in weights if key not in WEIGHTS]:
        raise ValueError(f"weights: {', '.join(unknown)} are no tensors of an adapter of one chart")

    tensors = {key: real(weights[key], f"weights: {key!r}").astype(np.float32) for key in WEIGHTS}
    if tensors["phi.0.weight"].ndim != 2 or tensors["phi.3.weight"].ndim != 2:
        raise ValueError("weights: 'phi.0.weight' is (h, d) and 'phi.3.weight' is (k, h)")
    hidden, dim = tensors["phi.0.weight"].shape
    latent = tensors["phi.3.weight"].shape[0]
    shapes = ((hidden, dim), (hidden,), (hidden,), (hidden,), (latent, hidden), (latent,), (6, latent))
    for key, shape in zip(WEIGHTS, shapes, strict=True):
        if tensors[key].shape != shape:
            raise ValueError(f"weights: {key!r} is {shape}, not {tensors[key].shape}")
        if not np.isfinite(tensors[key]).all():
            raise ValueError(f"weights: {key!r} has a number that is not finite")
    if source.dim != dim:
        raise ValueError(f"source: has {source.dim} columns, the weights take {dim}")
    if np.linalg.matrix_rank(tensors["W.weight"]) < 6:
        raise ValueError("weights: 'W.weight' has a rank below 6: some motions would be read as none")
    return tensors


def _checked_features(
    key: str | FeatureSource, values: npt.NDArray[np.floating], count: int | None
) -> tuple[FeatureSource, npt.NDArray[np.float32]]:
    rows = real(values, "features").astype(np.float32)
    name = key if isinstance(key, str) else key.name
    _check_name("set of features", name)
    if rows.ndim != 2 or rows.size == 0 or count not in (None, len(rows)):
        raise ValueError(f"features: {name!r} is ({count or 'n'}, d), not {rows.shape}")
    if not np.isfinite(rows).all():
        row = int(np.argwhere(~np.isfinite(rows).all(axis=1))[0, 0])
        raise ValueError(f"features: {name!r} has a number in row {row} that is not finite")
    source = FeatureSource(name, rows.shape[1]) if isinstance(key, str) else _checked_source(key)
    if source.dim != rows.shape[1]:
        raise ValueError(f"features: {name!r} has {rows.shape[1]} columns, its source says {source.dim}")
    return source, rows


def _checked_source(source: FeatureSource) -> FeatureSource:
    texts = {key: value for key, value in asdict(source).items() if key != "dim"}
    for key, value in texts.items():
        if not isinstance(value, str) and not (value is None and key in ("layer_index_base", "final_norm")):
            raise ValueError(f"features: {key} of the source {source.name!r} is {value!r}, and no text")
    if not isinstance(source.dim, (int, np.integer)) or source.dim < 1:
        raise ValueError(f"features: the source {source.name!r} has {source.dim!r} columns")
    return replace(source, dim=int(source.dim))
