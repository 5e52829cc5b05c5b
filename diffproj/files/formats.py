"""The formats by name, told apart by what is in a file, and for writing by its suffix."""

import os
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from diffproj._core.arguments import called
from diffproj.calibration.results.calibration import Calibration
from diffproj.files import (
    colmap,
    foreign,
    kalibr,
    kitti,
    matlab,
    metashape,
    mrcal,
    nerfstudio,
    numpy_arrays,
    nuscenes,
    open3d,
    opencv,
    own_json,
    ros,
    settings,
)
from diffproj.files.document import Document
from diffproj.files.found import Found
from diffproj.files.names import FormatName as FormatName
from diffproj.geometry.camera import Camera

PathLike = str | os.PathLike[str]


@runtime_checkable
class Format(Protocol):
    """What the module of a format offers."""

    def recognises(self, document: Document) -> bool:
        """Whether the file says that it is of this format; never fails."""
        ...

    def read(self, document: Document) -> Found:
        """The cameras of the file.

        Raises:
            ValueError: it is not of this format, is damaged, or holds what no camera of this package is.
        """
        ...


@runtime_checkable
class WritableFormat(Format, Protocol):
    """A format that is written too."""

    def write(self, path: Path, item: Camera | Calibration) -> dict[Path, str] | dict[Path, bytes]:
        """The content of each file that is to be written.

        Raises:
            ValueError: the camera has something that the format cannot hold.
        """
        ...


FORMATS: dict[FormatName, Any] = {
    "json": own_json,
    "numpy": numpy_arrays,
    "colmap": colmap,
    "mrcal": mrcal,
    "kitti": kitti,
    "matlab": matlab,
    "metashape": metashape,
    "nerfstudio": nerfstudio,
    "nuscenes": nuscenes,
    "open3d": open3d,
    "kalibr": kalibr,
    "ros": ros,
    "settings": settings,
    "opencv": opencv,
}
"""In the order in which a file is offered to them."""

CONVENTIONS: dict[FormatName, str] = {
    "json": "this package's own: world to camera, pixel centres at whole numbers, coefficients in OpenCV's order",
    "numpy": "arrays as OpenCV has them: pixel centres at whole numbers, coefficients in its order",
    "colmap": "world to camera; the first pixel's centre is at 0.5 there, and half a pixel was taken off",
    "mrcal": "reference frame to camera; pixel centres at whole numbers, coefficients in OpenCV's order",
    "kitti": "rectified images: K and t of P, without a lens; the world is the rectified camera 0",
    "matlab": "MATLAB's principal point is one-based, and 1 was taken off it; Bouguet's is zero-based",
    "metashape": "camera to chunk and one pixel's centre at 0.5 there, both turned; P1 and P2 are exchanged",
    "nerfstudio": "camera to world in OpenGL's axes and the first pixel's centre at 0.5 there, all three turned",
    "nuscenes": "sensor to vehicle there, turned: the world is the vehicle; undistorted images in nuScenes",
    "open3d": "matrices column by column there; world to camera, pixel centres at whole numbers, no lens",
    "kalibr": "IMU or first camera to camera; pixel centres at whole numbers",
    "ros": "K and D of the raw image; --camera rectified is that of the rectified one, by P",
    "settings": "pixel centres at whole numbers, k1 k2 p1 p2 k3 one by one; poses in a body are not taken",
    "opencv": "pixel centres at whole numbers, coefficients in OpenCV's order; with two cameras, R and T from 1 to 2",
}
"""What was turned into the conventions of `Camera`, in a line each."""

SUFFIXES: dict[str, FormatName] = {
    ".json": "json",
    ".yaml": "opencv",
    ".yml": "opencv",
    ".xml": "opencv",
    ".npz": "numpy",
    ".txt": "colmap",
    ".bin": "colmap",
}
"""What is written under a suffix where no format is named."""


def format_of(document: Document, name: str | None = None) -> Format:
    """The format of that name, or else the one that the file is of.

    Raises:
        ValueError: there is no such format, or the file is of none, or of another than the named one.
    """
    if name is not None:
        found = _named(name)
        if not found.recognises(document):
            raise ValueError(f"format: want a file of {name!r}, got another; {foreign.explanation(document)}")
        return found
    for known in FORMATS.values():
        if known.recognises(document):
            return known
    raise ValueError(foreign.explanation(document))


def name_of(found: Format) -> FormatName:
    """What a format is called."""
    return next(name for name, module in FORMATS.items() if module is found)


def format_to_write(path: Path, name: str | None = None) -> WritableFormat:
    """The format of that name, or else the one that goes with the suffix.

    Raises:
        ValueError: there is no such format, it is only read, or none goes with this suffix.
    """
    writable = [known for known, module in FORMATS.items() if isinstance(module, WritableFormat)]
    if name is not None:
        found = _named(name)
        if not isinstance(found, WritableFormat):
            raise ValueError(
                f"format: want {' or '.join(map(repr, writable))} to write, got {name!r}, which is only read"
            )
        return found
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"want a suffix of {', '.join(SUFFIXES)}, or format={' or '.join(map(repr, writable))}")
    return FORMATS[SUFFIXES[path.suffix.lower()]]


def _named(name: str) -> Format:
    if not isinstance(name, str):
        raise TypeError(f"format: want {' or '.join(map(repr, FORMATS))}, got {called(name)}")
    if name not in FORMATS:
        raise ValueError(f"format: want {' or '.join(map(repr, FORMATS))}, got {name!r}")
    return FORMATS[name]  # type: ignore[index]
