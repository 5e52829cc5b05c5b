"""The command line of `diffproj rectify`; `rectifying.py` does the work."""

import argparse
import functools
from pathlib import Path

from diffproj.cli.common_options import add_camera, add_photograph, add_plane, add_pose, add_said, describe
from diffproj.cli.inputs import file_ending
from diffproj.cli.units import Length, is_extent, length, place
from diffproj.cli.which_board import check_board

DESCRIPTION = """\
Makes the metric top view of a plane in a photograph: an image in which all
pixels are squares of one size on the plane, the lens and the slant taken out.
What the photograph does not show is transparent.

Where the camera stood is taken from a board in the photograph (--board and
--square, or another board), or from a view that the camera file knows (--view):
one that it was calibrated with, or the one that 'diffproj locate' found from
landmarks.
"""

EPILOG = """\
the top view:
  It is seen from the camera's side of the plane, never mirrored. --extent is in
  the frame of the board, or of the landmarks, and in their unit where it names
  none. --height and --plane say which plane, as for 'diffproj measure'; what
  stands above it leans away. On a plane that is not z = const, --extent is
  along two axes in it, from its place nearest to the origin, which the output
  names.

on a map:
  --world-file writes where the pixels are: six lines, in a .pgw for a .png and
  a .tfw for a .tif, which GIS programs read along with the image. Coordinates
  are x and y of the world: of landmarks on a map, the map's.

examples:
  diffproj rectify photo.jpg --camera camera.json --board 9x6 --square 25mm
  diffproj rectify photo.jpg --camera camera.json --board 9x6 --square 25mm \\
      --extent -50mm,-50mm,250mm,175mm --resolution 0.25mm -o board.png
  diffproj rectify mast.jpg --camera located.json --view mast.jpg \\
      --resolution 0.05 --world-file -o ground.tif
"""

EXTENT = (
    "want x0,y0,x1,y1 without spaces, x1 above x0 and y1 above y0, with their units or without, "
    "such as -50mm,-50mm,250mm,175mm"
)


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    usage = (
        "%(prog)s PHOTO --camera FILE --board CxR --square SIDE [options]\n"
        "       %(prog)s PHOTO --camera FILE --view NAME [options]"
    )
    describe(command, DESCRIPTION, EPILOG, usage)
    add_photograph(command, "the photograph, with --view the one that the view was found in")
    add_camera(command)
    add_pose(command)
    plane = add_plane(command)
    plane.add_argument(
        "--extent",
        type=_extent,
        metavar="x0,y0,x1,y1",
        help="what of the plane is shown (default: the board or the landmarks, and half as much around them)",
    )
    plane.add_argument(
        "--resolution",
        type=length,
        metavar="R",
        help="the side of a pixel on the plane, such as 0.5mm; sides of --extent that are no multiples of it grow "
        "(default: about what a pixel of the photograph covers in its middle)",
    )
    output = command.add_argument_group("the files")
    output.add_argument(
        "-o",
        "--output",
        type=file_ending(".png", ".tif", ".tiff"),
        default=Path("top.png"),
        metavar="FILE",
        help="the top view: a .png, .tif or .tiff, replaced if there is one (default: top.png)",
    )
    output.add_argument("--world-file", action="store_true", help="write where it is on the map, too, for GIS")
    output.add_argument(
        "--north-up",
        action="store_true",
        help="y grows upwards, as on maps, from whichever side the camera looks",
    )
    add_said(command)
    command.set_defaults(work="rectifying", check=functools.partial(_check_pose, command))


def _extent(text: str) -> tuple[Length, ...]:
    places = [place(part) for part in text.split(",")]
    read = [each for each in places if each is not None]
    alike = len({each.unit for each in read}) == 1  # else only the board's unit tells which is larger
    if len(read) != 4 or len(places) != 4 or (alike and not is_extent([each.value for each in read])):
        raise argparse.ArgumentTypeError(f"{EXTENT}, got {text.strip()!r}")
    return tuple(read)


def _check_pose(command: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Check that there is a photograph, and that a board is measured."""
    if options.photograph is None:
        command.error("PHOTO: want the photograph, got none")
    check_board(command, options)
