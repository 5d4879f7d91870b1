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
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from safetensors.numpy import load, save

from .answers import Camera, FeatureSource, Revision
from .errors import DamagedError, SeeseError
from .geometry import Array

SCHEMA = 1
# Rotations that are further from SO(3) are taken for a mistake, as by `seese3 import`.
WORST_ROTATION = 1e-2
# Adapters keep some features with what they give for them, by which a reader checks that it computes the same.
GOLDEN_ROWS = 8
GOLDEN_TOLERANCE = 1e-6
WEIGHTS = ("phi.0.weight", "phi.0.bias", "phi.1.weight", "phi.1.bias", "phi.3.weight", "phi.3.bias", "W.weight")
PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True, eq=False)
class StoredRoom:
    """A room: poses world_from_camera (n, 4, 4), metres, and features (n, d) by the name of their source."""

    revision: Revision
    poses: Array
    features: dict[str, npt.NDArray[np.float32]]
    sources: dict[str, FeatureSource]
    names: list[str] | None
    images: list[Path] | None
    timestamps_ns: npt.NDArray[np.int64] | None
    sequences: npt.NDArray[np.int64] | None
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
        body = self._body("rooms", name, revision)
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
            manifest=body,
        )

    def adapter(self, name: str, revision: int | None = None) -> StoredAdapter:
        """An adapter. One of a single chart is checked: its golden features have to give its golden latents."""
        body = self._body("adapters", name, revision)
        tensors = load(self._object("adapters", name, body["weights"]))
        adapter = StoredAdapter(Revision(name, body["revision"]), _source(body["source"]), tensors, body)
        if body["training"].get("charts", 1) == 1:
            expected = tensors["golden.latents"]
            difference = np.abs(adapter.embed(tensors["golden.features"]) - expected)
            if (difference > GOLDEN_TOLERANCE * np.maximum(1.0, np.abs(expected))).any():
                raise DamagedError(f"adapter {name!r}: its golden features do not give its golden latents")
        return adapter

    def adapter_files(self, name: str, revision: int | None = None) -> tuple[bytes, bytes]:
        """The manifest and the weights of an adapter, as `Client.publish_adapter` takes them."""
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
        names: list[str] | None = None,
        camera: Camera | None = None,
        format: str = "numpy",
        licence: str = "",
    ) -> Revision:
        """Publishes a room: poses world_from_camera (n, 4, 4) in metres, and features (n, d) by name or source.

        Rotations are projected onto SO(3). The newest revision is kept beside the new one; if it has the same poses,
        what is not given here (features of other names, times, names, images) is carried over. The poses are not
        compared with images: `seese3 check room` does that where the room has some.
        """
        _check_name("room", name)
        matrices, deviation = _checked_poses(poses)
        columns: dict[str, npt.NDArray[Any]] = {"world_from_camera": matrices}
        for column, values in (("timestamps_ns", timestamps_ns), ("sequences", sequences)):
            if values is not None:
                columns[column] = _column(values, column, len(matrices))
        if names is not None and len(names) != len(matrices):
            raise ValueError(f"names: has {len(names)} entries, there are {len(matrices)} poses")
        sets = [_checked_features(key, values, len(matrices)) for key, values in features.items()]

        newest = self._newest_of_same_poses(name, matrices)
        if newest is not None:
            known = load(self._object("rooms", name, newest["frames"]))
            columns = {**known, **columns, "world_from_camera": known["world_from_camera"]}

        entries = {
            source.name: {
                "source": asdict(source),
                "object": self._write(
                    "rooms", name, f"features-{source.name}", "safetensors", save({"features": rows})
                ),
            }
            for source, rows in sets
        }
        for entry in newest["features"] if newest else []:
            entries.setdefault(entry["source"]["name"], entry)

        provenance: dict[str, Any] = {
            "format": format,
            "licence": licence,
            "images_root": newest["provenance"].get("images_root", "") if newest else "",
            "worst_rotation_deviation": deviation,
        }
        if camera is not None:
            provenance["camera"] = _stored_camera(camera)
        elif newest and "camera" in newest["provenance"]:
            provenance["camera"] = newest["provenance"]["camera"]

        body = {
            "schema": SCHEMA,
            "room": name,
            "revision": 0,
            "created": "",
            "frame_count": len(matrices),
            "frames": self._write("rooms", name, "frames", "safetensors", save(columns)),
            "frame_names": self._write_list(name, "frame-names", names, newest),
            "images": newest.get("images") if newest else None,
            "features": [entries[key] for key in sorted(entries)],
            "provenance": provenance,
        }
        return self._publish("rooms", name, body)

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
        tensors = {key: np.ascontiguousarray(weights[key], dtype=np.float32) for key in WEIGHTS if key in weights}
        if missing := [key for key in WEIGHTS if key not in weights]:
            raise ValueError(f"weights: lack {', '.join(missing)}")
        hidden, dim = tensors["phi.0.weight"].shape
        latent = tensors["phi.3.weight"].shape[0]
        shapes = ((hidden, dim), (hidden,), (hidden,), (hidden,), (latent, hidden), (latent,), (6, latent))
        for key, shape in zip(WEIGHTS, shapes, strict=True):
            if tensors[key].shape != shape or not np.isfinite(tensors[key]).all():
                raise ValueError(f"weights: {key!r} is {shape} of finite numbers, not {tensors[key].shape}")
        if source.dim != dim:
            raise ValueError(f"source: has {source.dim} columns, the weights take {dim}")

        mean, deviation = (np.array(values, dtype=np.float64) for values in (target_mean, target_deviation))
        if mean.shape != (6,) or deviation.shape != (6,) or not (deviation > 0).all() or not np.isfinite(mean).all():
            raise ValueError("target_mean and target_deviation: are six numbers each, the deviations above 0")

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
            "stride": stride,
            "rooms": [[room, revision] for room, revision in rooms.items()],
            "epochs": epochs,
            "batch": 0,
            "learning_rate": 0.0,
            "weight_decay": 0.0,
            "clip_norm": 0.0,
            "hidden": hidden,
            "latent": latent,
            "seed": seed,
            "pair_count": 0,
            "test": unknown,
            "train": unknown,
            "train_mean_r2": None,
        }
        body = {
            "schema": SCHEMA,
            "adapter": name,
            "revision": 0,
            "created": "",
            "source": asdict(source),
            "weights": self._write("adapters", name, "weights", "safetensors", save(content)),
            "twist_frame": "body",
            "deviation_ddof": 0,
            "training": training,
        }
        return self._publish("adapters", name, body)

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
            number = int(file.stem) if file.stem.isdigit() else 0
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
        return _read_manifest(self._manifest(kind, name, revision))

    def _defaults(self) -> dict[str, Any]:
        files = sorted((self.folder / "defaults").glob("[0-9]*.json"), key=lambda file: int(file.stem))
        defaults: dict[str, Any] = _read_manifest(files[-1])["defaults"] if files else {}
        return defaults

    def _object(self, kind: str, name: str, reference: dict[str, Any]) -> bytes:
        path = self.folder / kind / name / "objects" / reference["file"]
        try:
            content: bytes = path.read_bytes()
        except FileNotFoundError:
            raise DamagedError(f"{path} is missing; restore it, or publish again") from None
        if len(content) != reference["bytes"] or hashlib.sha256(content).hexdigest() != reference["sha256"]:
            raise DamagedError(f"{path} is truncated or altered: it has another checksum than its manifest states")
        return content

    def _list(self, name: str, reference: dict[str, Any] | None) -> list[str] | None:
        if reference is None:
            return None
        names: list[str] = json.loads(self._object("rooms", name, reference))
        return names

    def _newest_of_same_poses(self, name: str, poses: Array) -> dict[str, Any] | None:
        present = self._revisions("rooms", name)[0]
        if not present:
            return None
        body = self._body("rooms", name, present[-1])
        stored = load(self._object("rooms", name, body["frames"]))["world_from_camera"]
        same = stored.shape == poses.shape and np.abs(stored - poses).max() < 1e-12
        return body if same else None

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

    def _publish(self, kind: str, name: str, body: dict[str, Any]) -> Revision:
        """Writes the manifest under the next free number, or returns the newest revision if it says the same."""
        while True:
            present, highest = self._revisions(kind, name)
            if present:
                newest = _read_manifest(self._manifest(kind, name, present[-1]))
                if {**newest, "created": "", "revision": 0} == _as_written(body):
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


def _as_written(body: dict[str, Any]) -> Any:
    """The body as it reads when it was written as JSON."""
    return json.loads(json.dumps(body))


def _temporary(folder: Path, content: bytes) -> str:
    """A file in `folder` with this content, on the disk."""
    descriptor, path = tempfile.mkstemp(dir=folder, prefix=".", suffix=".tmp")
    with os.fdopen(descriptor, "wb") as file:
        os.fchmod(descriptor, 0o644)
        file.write(content)
        file.flush()
        os.fsync(descriptor)
    return path


def _read_manifest(path: Path) -> dict[str, Any]:
    """The body of a manifest, whose checksum is that of the body's text exactly as it stands in the file."""
    try:
        text = path.read_text(encoding="utf-8")
        envelope = json.loads(text)
        stated, body = envelope["sha256"], envelope["body"]
        start = text.index("{", text.index('"body"'))
        _, end = json.JSONDecoder().raw_decode(text, start)
    except FileNotFoundError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedError(f"{path} is not a valid manifest ({error}): it was truncated or altered") from None
    if hashlib.sha256(text[start:end].encode()).hexdigest() != stated:
        raise DamagedError(f"{path} does not have the checksum that it states: it was altered")
    if body["schema"] > SCHEMA:
        raise SeeseError(f"{path} was written by a newer version (schema {body['schema']}); update this package")
    result: dict[str, Any] = body
    return result


def _source(entry: dict[str, Any]) -> FeatureSource:
    return FeatureSource(**{key: entry[key] for key in FeatureSource.__dataclass_fields__ if key in entry})


def _stored_camera(camera: Camera) -> dict[str, Any]:
    """A camera as manifests state it: lengths in image widths."""
    x = camera.width / 2 if camera.centre_x is None else camera.centre_x
    y = camera.height / 2 if camera.centre_y is None else camera.centre_y
    return {
        "focal": camera.focal / camera.width,
        "height": camera.height / camera.width,
        "centre": [x / camera.width, y / camera.width],
    }


def _check_name(what: str, name: str) -> None:
    if not PLAIN_NAME.fullmatch(name):
        raise ValueError(f"{name!r} cannot name a {what}: use 1 to 100 letters, digits, '.', '-' or '_'")


def _checked_poses(poses: npt.ArrayLike) -> tuple[Array, float]:
    """The poses with their rotations projected onto SO(3), and how far the worst was from it."""
    matrices = np.array(poses, dtype=np.float64)
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or len(matrices) == 0:
        raise ValueError(f"poses: are (n, 4, 4) with at least one frame, not {matrices.shape}")
    if not np.isfinite(matrices).all():
        row = int(np.argwhere(~np.isfinite(matrices).all(axis=(1, 2)))[0, 0])
        raise ValueError(f"poses: row {row} has a number that is not finite")
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


def _column(values: npt.ArrayLike, name: str, count: int) -> npt.NDArray[np.int64]:
    column = np.asarray(values)
    if column.shape != (count,) or not np.issubdtype(column.dtype, np.integer):
        raise ValueError(f"{name}: is ({count},) of integers, not {column.dtype} of shape {column.shape}")
    return column.astype(np.int64)


def _checked_features(
    key: str | FeatureSource, values: npt.NDArray[np.floating], count: int | None
) -> tuple[FeatureSource, npt.NDArray[np.float32]]:
    rows = np.ascontiguousarray(values, dtype=np.float32)
    name = key if isinstance(key, str) else key.name
    _check_name("set of features", name)
    if rows.ndim != 2 or rows.size == 0 or count not in (None, len(rows)):
        raise ValueError(f"features: {name!r} is ({count or 'n'}, d), not {rows.shape}")
    if not np.isfinite(rows).all():
        row = int(np.argwhere(~np.isfinite(rows).all(axis=1))[0, 0])
        raise ValueError(f"features: {name!r} has a number in row {row} that is not finite")
    source = FeatureSource(name, rows.shape[1]) if isinstance(key, str) else key
    if source.dim != rows.shape[1]:
        raise ValueError(f"features: {name!r} has {rows.shape[1]} columns, its source says {source.dim}")
    return source, rows
