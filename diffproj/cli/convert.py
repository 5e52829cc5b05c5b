"""`diffproj convert`: camera files from one program's format to another's."""

import argparse
import functools
from pathlib import Path
from typing import get_args

from diffproj.calibration.result import Calibration
from diffproj.cli.terminal import result
from diffproj.files.document import Document
from diffproj.files.formats import FormatName
from diffproj.files.load import found_in, load, load_camera
from diffproj.files.save import save_camera
from diffproj.geometry.camera import Camera

DESCRIPTION = """\
Reads a camera file of one program and writes that of another. The conventions
of both are obeyed: half pixels, axes, directions of poses, orders of
coefficients. What the new format cannot hold is refused, not dropped.
"""

EPILOG = """\
formats:
  The one that is read is told by the content of the file. The one that is
  written goes with the suffix: .json for diffproj's own, .yaml, .yml and .xml
  for OpenCV's, .npz for numpy's, .txt for COLMAP's (cameras.txt, or with poses
  images.txt). --to names another: ros, kalibr, nerfstudio, or opencv for .json.
  Only read are kitti, nuscenes, open3d, mrcal, matlab, metashape, settings.

examples:
  diffproj convert cameras.txt camera.yaml
  diffproj convert camchain.yaml left.json --camera cam0
  diffproj convert calibration.npz ost.yaml --to ros --size 1280x720
  diffproj convert camera.json sparse/images.txt

exit codes: 0 done; 1 it failed, one line says why; 2 the command was not
understood
"""

REMEDIES = (
    ("or save camera.without_pose()", "or give --without-pose"),
    ("or without_pose()", "or give --without-pose"),
    ("use .json, or save them one by one", "write .json, or choose one by --camera"),
    ("Camera(..., size=(width, height))", "give --size WxH"),
    ("Camera(..., size=(w, h))", "give --size WxH"),
    ("camera: want", "--camera: want"),
)
"""What Python's users are advised to, and what those of the command line are instead."""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    command.description, command.epilog = DESCRIPTION, EPILOG
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    names = get_args(FormatName)
    command.add_argument("input", type=Path, metavar="IN", help="the camera file to read")
    command.add_argument("output", type=Path, metavar="OUT", help="the camera file to write; its folder must exist")
    command.add_argument(
        "--from",
        dest="source",
        choices=names,
        metavar="FORMAT",
        help="format of IN, where its content does not tell it",
    )
    command.add_argument(
        "--to", choices=names, metavar="FORMAT", help="format of OUT, where its suffix does not tell it"
    )
    command.add_argument("--camera", metavar="NAME", help="which camera of IN, by its name, or its number from 0")
    command.add_argument("--size", type=image_size, metavar="WxH", help="size of the image in px, where IN has none")
    command.add_argument(
        "--without-pose", action="store_true", help="leave the pose out, and put the world in the camera"
    )
    command.set_defaults(run=functools.partial(run, command))


def image_size(text: str) -> tuple[int, int]:
    """Read a size such as `640x480`."""
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(
            f"want the size of the image as WIDTHxHEIGHT in px, such as 640x480, got {text!r}"
        )
    return int(width), int(height)


def run(_: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """Run the command."""
    try:
        found = _wanted(options)
        save_camera(options.output, found, options.to)
    except ValueError as error:
        said = str(error)
        for python, remedy in REMEDIES:
            said = said.replace(python, remedy)
        raise ValueError(said) from error
    camera = found.camera if isinstance(found, Calibration) else found
    lens = "no lens" if camera.distortion is None else type(camera.distortion).__name__
    many = f"{camera.batch_shape.numel()} cameras" if camera.batch_shape else "one camera"
    size = "of unknown size" if camera.size is None else f"of {camera.size[0]} x {camera.size[1]} px"
    result(f"{options.output}: {many} {size}, {lens}")
    return 0


def _wanted(options: argparse.Namespace) -> Camera | Calibration:
    """What to write: a whole calibration where nothing of it is to change."""
    plain = options.source is None and options.camera is None and options.size is None and not options.without_pose
    found = load(options.input) if plain else _camera(options)
    return found if isinstance(found, Calibration) else _sized(found, options)


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
