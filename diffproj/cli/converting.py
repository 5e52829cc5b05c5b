"""The work of `diffproj convert`: camera files from one program's format to another's."""

import argparse
from pathlib import Path

from diffproj.calibration.result import Calibration
from diffproj.calibration.rig_result import RigCalibration
from diffproj.cli.terminal import result
from diffproj.files.document import Document
from diffproj.files.load import found_in, load, load_camera
from diffproj.files.names import FormatName
from diffproj.files.save import save_camera
from diffproj.geometry.camera import Camera

REMEDIES = (
    ("or save camera.without_pose()", "or give --without-pose"),
    ("or without_pose()", "or give --without-pose"),
    ("use .json, or save them one by one", "write .json, or choose one by --camera"),
    ("Camera(..., size=(width, height))", "give --size WxH"),
    ("Camera(..., size=(w, h))", "give --size WxH"),
    ("camera: want", "--camera: want"),
)
"""What Python's users are advised to, and what those of the command line are instead."""


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    try:
        found = _wanted(options)
        save_camera(options.output, found, options.to)
    except ValueError as error:
        said = str(error)
        for python, remedy in REMEDIES:
            said = said.replace(python, remedy)
        raise ValueError(said) from error
    if isinstance(found, RigCalibration):
        result(f"{options.output}: a rig of {', '.join(found.names)}")
        return 0
    camera = found.camera if isinstance(found, Calibration) else found
    lens = "no lens" if camera.distortion is None else type(camera.distortion).__name__
    many = f"{camera.batch_shape.numel()} cameras" if camera.batch_shape else "one camera"
    size = "of unknown size" if camera.size is None else f"of {camera.size[0]} x {camera.size[1]} px"
    result(f"{options.output}: {many} {size}, {lens}")
    return 0


def _wanted(options: argparse.Namespace) -> Camera | Calibration | RigCalibration:
    """What to write: a whole calibration or rig where nothing of it is to change."""
    plain = options.source is None and options.camera is None and options.size is None and not options.without_pose
    found = load(options.input) if plain else _camera(options)
    return found if isinstance(found, Calibration | RigCalibration) else _sized(found, options)


def _camera(options: argparse.Namespace) -> Camera:
    return load_camera(options.input, options.source, named(options.input, options.source, options.camera))


def named(path: Path, source: FormatName | None, name: str | None) -> str | int | None:
    """The camera that is asked for: by a name that the file has, or else by its number."""
    if name is None or not name.isdecimal():
        return name
    try:
        found = found_in(Document.read(path), source)
    except ValueError:
        return name  # and reading it says why
    return name if name in found.cameras or name in found.aside else int(name)


def _sized(camera: Camera, options: argparse.Namespace) -> Camera:
    if options.without_pose:
        camera = camera.without_pose()
    if options.size is None:
        return camera
    if camera.size is not None and camera.size != options.size:
        width, height = camera.size
        raise ValueError(
            f"--size: want {width}x{height} as {options.input} says, got another; in Python, camera.resized(...) and "
            "camera.cropped(...) change it"
        )
    return Camera(camera.K, camera.R, camera.t, camera.distortion, options.size)
