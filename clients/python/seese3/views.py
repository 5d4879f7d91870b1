"""What a camera sees, in the forms that a server takes.

A view is one of these:

- an `int`: the row of a stored frame of the room;
- a NumPy array (d,) of floating-point numbers: a feature of the encoder that the adapter was trained on;
- a `Feature`: the same, with the name of its feature set, which the server then checks;
- a `Latent`: an adapter's latent, from `encode` or an earlier answer;
- an image: `bytes`, the content of a JPEG or PNG file; `str` or `os.PathLike`, its path; or a NumPy array of bytes
  (uint8), (h, w, 3) in the order red, green, blue, or (h, w) gray.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .errors import understood
from .v1 import geometry_pb2 as pb


@dataclass(frozen=True)
class Feature:
    """A feature: one row of encoder output.

    Attributes:
        values: The numbers, (d,).
        feature_set: The name of the feature set that it belongs to, which the server then checks; empty for no check.
    """

    values: npt.NDArray[np.floating]
    feature_set: str = ""


@dataclass(frozen=True)
class Revision:
    """A published version of a room or an adapter, which never changes.

    Attributes:
        name: The name of the room or adapter.
        revision: The number of the version, counted from 1.
    """

    name: str
    revision: int

    @classmethod
    @understood
    def of(cls, message: pb.Revision) -> Revision:
        return cls(message.name, message.revision)


@dataclass(frozen=True)
class Latent:
    """A latent of an adapter.

    Attributes:
        values: The coordinates, (k,).
        adapter: The adapter that made it, as `encode` states it. A request that names no adapter uses this one.
    """

    values: npt.NDArray[np.float64]
    adapter: Revision | None = None

    def message(self) -> pb.Latent:
        of = None if self.adapter is None else pb.Revision(name=self.adapter.name, revision=self.adapter.revision)
        return pb.Latent(values=_row(self.values, "a latent").tolist(), adapter=of)


View: TypeAlias = "int | np.integer | npt.NDArray[Any] | Feature | Latent | bytes | str | os.PathLike[str]"


def wire_view(view: View) -> pb.View:
    """The view on the wire."""
    if isinstance(view, (bool, np.bool_)):
        raise TypeError("a view is no truth value: give a frame's row, a feature, a latent or an image")
    if isinstance(view, (int, np.integer)):
        if not 0 <= view < 1 << 32:
            raise ValueError(f"a view that is a number is a frame's row, from 0 to 2³² - 1, not {view}")
        return pb.View(frame_id=int(view))
    if isinstance(view, bytes):
        return pb.View(image=view)
    if isinstance(view, (str, os.PathLike)):
        return pb.View(image=Path(view).read_bytes())
    if isinstance(view, Latent):
        return pb.View(latent=view.message())
    if isinstance(view, Feature):
        return _packed_feature(view.values, view.feature_set)
    if isinstance(view, np.ndarray) and view.dtype == np.uint8 and view.ndim in (2, 3):
        return pb.View(image=png(view))
    if isinstance(view, np.ndarray):
        return _packed_feature(view, "")

    kind = type(view).__name__
    raise TypeError(
        f"a view is a frame's row (int), a feature (a NumPy array), a Latent, or an image: bytes, a path, or a NumPy "
        f"array of bytes; not {kind}"
    )


def _row(values: npt.ArrayLike, what: str) -> npt.NDArray[np.floating]:
    row = np.asarray(values)
    if row.ndim != 1 or not np.issubdtype(row.dtype, np.floating):
        raise ValueError(f"{what} is one row of floating-point numbers, not {row.dtype} of shape {row.shape}")
    return row


def _packed_feature(values: npt.ArrayLike, feature_set: str) -> pb.View:
    """A feature by its bytes: a list of numbers through protobuf costs twenty times as much."""
    numbers = _row(values, "a feature").astype("<f4").tobytes()
    feature = b"\x0a" + _varint(len(numbers)) + numbers
    if feature_set:
        name = feature_set.encode()
        feature += b"\x12" + _varint(len(name)) + name
    view: pb.View = pb.View.FromString(b"\x12" + _varint(len(feature)) + feature)
    return view


def _varint(number: int) -> bytes:
    """A number as protobuf writes lengths: seven bits a byte, the lowest first."""
    octets = bytearray()
    while number > 0x7F:
        octets.append(number & 0x7F | 0x80)
        number >>= 7
    octets.append(number)
    return bytes(octets)


def png(pixels: npt.NDArray[Any]) -> bytes:
    """A PNG of gray values (h, w) of 8 or 16 bits, or of colors (h, w, 3) of 8 bits.

    Raises:
        ValueError: the array has another shape or type.
    """
    is_color = pixels.ndim == 3 and pixels.shape[2] == 3 and pixels.dtype == np.uint8
    is_gray = pixels.ndim == 2 and pixels.dtype in (np.uint8, np.uint16)
    if not (is_color or is_gray) or 0 in pixels.shape:
        raise ValueError(f"an image is (h, w) or (h, w, 3) of uint8, not {pixels.dtype} of shape {pixels.shape}")

    height, width = pixels.shape[:2]
    bits = 8 * pixels.dtype.itemsize
    lines = np.ascontiguousarray(pixels.astype(f">u{pixels.dtype.itemsize}")).view(np.uint8).reshape(height, -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)

    # Each row begins with the number of its filter, 0 for none.
    rows = np.zeros((height, 1 + lines.shape[1]), np.uint8)
    rows[:, 1:] = lines
    header = struct.pack(">IIBBBBB", width, height, bits, 2 if is_color else 0, 0, 0, 0)
    compressed = zlib.compress(rows.tobytes(), 1)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", compressed) + chunk(b"IEND", b"")
