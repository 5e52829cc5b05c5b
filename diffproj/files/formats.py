"""The formats by name and suffix."""

import os
from pathlib import Path
from typing import Literal

Format = Literal["opencv", "json"]


_SUFFIXES: dict[str, Format] = {".yml": "opencv", ".yaml": "opencv", ".xml": "opencv", ".json": "json"}


PathLike = str | os.PathLike[str]


def named(path: Path, format: str | None) -> Format:  # noqa: A002
    """The format that the caller named, or else the one that goes with the suffix.

    Raises:
        ValueError: there is no such format, or none with this suffix.
    """
    if format is None:
        if path.suffix.lower() not in _SUFFIXES:
            raise ValueError(f"{path}: want a suffix of {', '.join(_SUFFIXES)}, or format='opencv' or 'json'")
        return _SUFFIXES[path.suffix.lower()]
    if format not in ("opencv", "json"):
        raise ValueError(f"format: want 'opencv' or 'json', got {format!r}")
    return format
