"""The words of closed sets: what arguments take and what answers have. Arguments also take "-" for "_"."""

from __future__ import annotations

from typing import Any, Literal

StepMode = Literal["open_loop", "snap", "closed_loop"]
InverseVariant = Literal["affine", "homogeneous", "literal"]
Split = Literal["time", "fold_1", "fold_2", "fold_3", "fold_4", "fold_5", "blocks", "pairs", "dataset", "whole"]
Planner = Literal["pose_graph", "latent"]
Fusion = Literal["anchors", "none"]
UploadMode = Literal["create", "replace", "extend"]
DistortionModel = Literal["brown_conrady", "kannala_brandt"]
LayerIndexBase = Literal["zero", "one", "name"]
FinalNorm = Literal["none", "applied"]


def enum_value(enum: Any, prefix: str, word: str | None, argument: str) -> Any:
    """The value of an enum by its word: "snap" is STEP_MODE_SNAP; None is the server's default.

    Raises:
        ValueError: the word is none of the enum's; the message lists them.
    """
    if word is None:
        return 0
    words: dict[str, int] = {name.removeprefix(prefix).lower(): number for name, number in enum.items() if number != 0}
    found = words.get(word.lower().replace("-", "_")) if isinstance(word, str) else None
    if found is None:
        raise ValueError(f"{argument}: {word!r} is none of {', '.join(words)}")
    return found


def enum_word(enum: Any, value: int, prefix: str) -> str:
    """A value of an enum as a word: TRACK_STATUS_LOST is "lost"; "unknown_9" of a server that is newer."""
    try:
        name: str = enum.Name(value)
    except ValueError:
        return f"unknown_{value}"
    return name.removeprefix(prefix).lower()
