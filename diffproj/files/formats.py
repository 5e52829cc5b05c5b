"""The formats by name, and by the suffix of a file."""

import os
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from diffproj._core.arguments import called
from diffproj.calibration.result import Calibration
from diffproj.files import opencv, own_json
from diffproj.geometry.camera import Camera

FormatName = Literal["opencv", "json"]
PathLike = str | os.PathLike[str]


@runtime_checkable
class Format(Protocol):
    """What the module of a format offers."""

    SUFFIXES: tuple[str, ...]
    """Of its files, in lower case."""

    def dumps(self, path: Path, item: Camera | Calibration) -> str:
        """A camera or a calibration as the text of the file.

        Raises:
            ValueError: it has something that the format cannot hold.
        """
        ...

    def read_camera(self, path: Path) -> Camera:
        """The camera in a file; of a calibration, the one without a pose.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is not of this format, or damaged.
        """
        ...


FORMATS: dict[FormatName, Format] = {"opencv": opencv, "json": own_json}


def format_of(path: Path, name: str | None = None) -> Format:
    """The format of that name, or else the one that goes with the suffix.

    Raises:
        ValueError: there is no such format, or none with this suffix.
    """
    names = " or ".join(map(repr, FORMATS))
    if name is not None:
        if not isinstance(name, str):
            raise TypeError(f"format: want {names}, got {called(name)}")
        if name not in FORMATS:
            raise ValueError(f"format: want {names}, got {name!r}")
        return FORMATS[name]
    for known in FORMATS.values():
        if path.suffix.lower() in known.SUFFIXES:
            return known
    suffixes = ", ".join(suffix for known in FORMATS.values() for suffix in known.SUFFIXES)
    raise ValueError(f"{path}: want a suffix of {suffixes}, or format={names}")
