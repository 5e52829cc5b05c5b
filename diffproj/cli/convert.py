"""`diffproj convert`: the command line of turning camera files from one program's format into another's."""

import argparse
from typing import get_args

from diffproj.cli.common_options import add_said, describe
from diffproj.cli.inputs import some_path
from diffproj.files.names import FormatName

DESCRIPTION = """\
Reads a camera file of one program and writes that of another. The conventions
of both are obeyed: half pixels, axes, directions of poses, orders of
coefficients. What the new format cannot hold is refused, not dropped.
"""

EPILOG = """\
formats:
  The one that is read is told by the content of the file. The one that is
  written goes with the suffix: .json for diffproj's own, .yaml, .yml and .xml
  for OpenCV's, .npz for numpy's, .txt and .bin for COLMAP's (cameras.txt, or
  with poses images.txt). --to names another: ros, kalibr, nerfstudio, or
  opencv for .json.
  Only read are kitti, nuscenes, open3d, mrcal, matlab, metashape, settings.

examples:
  diffproj convert cameras.txt camera.yaml
  diffproj convert camchain.yaml left.json --camera cam0
  diffproj convert calibration.npz ost.yaml --to ros --size 1280x720
  diffproj convert located.json sparse/images.txt --view mast.jpg
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    describe(command, DESCRIPTION, EPILOG)
    names = get_args(FormatName)
    command.add_argument("input", type=some_path, metavar="IN", help="the camera file to read")
    command.add_argument("output", type=some_path, metavar="OUT", help="the file to write; its folder must exist")
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
    pose = command.add_mutually_exclusive_group()
    pose.add_argument(
        "--view",
        metavar="NAME",
        help="of a whole calibration, the camera where it stood in this view, such as the one that 'diffproj locate' "
        "found (default: the camera without a pose)",
    )
    pose.add_argument("--without-pose", action="store_true", help="leave the pose out, and put the world in the camera")
    add_said(command)
    command.set_defaults(work="converting")


def image_size(text: str) -> tuple[int, int]:
    """Read a size such as `640x480`."""
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(
            f"want the size of the image as WIDTHxHEIGHT in px, such as 640x480, got {text!r}"
        )
    return int(width), int(height)
