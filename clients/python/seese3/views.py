"""What a camera sees, in the forms that a server takes.

A view is one of these:

- an `int`: the row of a stored frame of the room;
- a NumPy array (d,): a feature of the encoder that the adapter was trained on;
- a `Feature`: the same, with the name of its source, which the server then checks;
- a `Latent`: an adapter's latent, from `encode` or an earlier answer;
- `bytes` or a `pathlib.Path`: an image, as the content of a JPEG or PNG file or its path.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from .v1 import geometry_pb2 as pb


@dataclass(frozen=True)
class Feature:
    """A feature (d,), and the name of the set of features that it belongs to."""

    values: npt.NDArray[np.floating]
    source_name: str = ""


@dataclass(frozen=True)
class Latent:
    """A latent (k,) of an adapter."""

    values: npt.NDArray[np.float64]


View: TypeAlias = "int | np.integer | npt.NDArray[np.floating] | Feature | Latent | bytes | Path"


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
    if isinstance(view, Path):
        return pb.View(image=view.read_bytes())
    if isinstance(view, Latent):
        return pb.View(latent=pb.Latent(values=_row(view.values, "a latent").tolist()))
    if isinstance(view, Feature):
        return _packed_feature(view.values, view.source_name)
    if isinstance(view, np.ndarray):
        return _packed_feature(view, "")

    kind = type(view).__name__
    raise TypeError(
        f"a view is a frame's row (int), a feature (a NumPy array), a Latent, an image (bytes) or its path "
        f"(pathlib.Path), not {kind}"
    )


def _row(values: npt.ArrayLike, what: str) -> npt.NDArray[np.floating]:
    row = np.asarray(values)
    if row.ndim != 1 or not np.issubdtype(row.dtype, np.floating):
        raise ValueError(f"{what} is one row of floating-point numbers, not {row.dtype} of shape {row.shape}")
    return row


def _packed_feature(values: npt.ArrayLike, source_name: str) -> pb.View:
    """A feature by its bytes: a list of numbers through protobuf costs twenty times as much."""
    numbers = _row(values, "a feature").astype("<f4").tobytes()
    feature = b"\x0a" + _varint(len(numbers)) + numbers
    if source_name:
        name = source_name.encode()
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
