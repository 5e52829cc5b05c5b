"""The command line of `diffproj measure`; `measuring.py` does the work."""

import argparse
import functools
from pathlib import Path

from diffproj.cli.common_options import (
    add_camera,
    add_photograph,
    add_plane,
    add_pose,
    add_said,
    describe,
    pixel_noise,
)
from diffproj.cli.drawing import drawing
from diffproj.cli.inputs import DETECTOR, HAND, numbers, some_path
from diffproj.cli.measure_page import page_file
from diffproj.cli.which_board import check_board

TABLES = (".csv", ".tsv", ".txt")
"""Endings of files that somebody may have points in."""

DESCRIPTION = """\
Turns pixels of a photograph into points on a plane, and prints them with the
lengths between successive points, and from three points on the area that they
enclose in their order, each with its standard deviation and 95 % interval.

Where the camera stood is taken from a board in the photograph (--board and
--square, or another board), or from a view that the camera file knows (--view):
one that it was calibrated with, or the one that 'diffproj locate' found from
landmarks.
"""

EPILOG = """\
pixels:
  u runs to the right and v down; 0,0 is the middle of the first pixel. They may
  be negative or lie outside the photograph; one without a point on the plane is
  named, and is no failure. Each is taken to be off by 0.5 px,
  as points picked by hand are: --pixel-sigma tells another noise. A file of
  points has a line name,u,v for each, or u,v; a first line of titles, such as
  v,u or row,column, gives another order.

the plane:
  It is the board's face, unless --height or --plane say another. Heights count
  from the face towards the camera: --height 12 is the top of a box 12 high that
  lies on the board, and --height -3 the table below a board 3 thick. For a file
  from 'diffproj locate' it is z = 0 in the landmarks' world, --height 7 z = 7.

the board's frame, for --plane and for the points:
  The origin is the first inner corner, x runs to the right along the board's
  rows, y down its columns, and z into the board, away from the camera: above
  the board z is negative. The first corner touches two dark squares: one
  inside the first four corners, one diagonally outside. The unit is that of
  --square. --view has the frame of the calibration: this one for a file from
  'diffproj calibrate'; for one from 'diffproj experiment', x runs down, y to
  the right and z towards the camera. --draw shows the frame in the photograph.

examples:
  diffproj measure photo.jpg --camera camera.json --board 9x6 --square 25mm \\
      --points 210.5,133 402,140.5 395,300 --draw measured.png
  diffproj measure --camera camera.json --view left01.jpg \\
      --points 210,133 402,140
  diffproj measure --camera located.json --view mast.jpg --points 2000,1000
  diffproj measure photo.jpg --camera camera.json --board 9x6 --square 25mm \\
      --page measure.html
  diffproj measure photo.jpg --camera camera.yaml --board 9x6 --square 25mm \\
      --points-file points.csv --height 12 --pixel-sigma 0.7 --csv > box.csv
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    usage = (
        "%(prog)s PHOTO --camera FILE --board CxR --square SIDE\n"
        "                        --points u,v ... [options]\n"
        "       %(prog)s --camera FILE --view NAME --points u,v ... [options]\n"
        "       %(prog)s PHOTO --camera FILE (--view NAME | --board ...) --page F"
    )
    describe(command, DESCRIPTION, EPILOG, usage)
    add_photograph(command, "the photograph, with --board; --view needs none")
    add_camera(command)
    pixels = command.add_mutually_exclusive_group()
    pixels.add_argument(
        "--points",
        type=_pixel,
        nargs="+",
        action="extend",
        metavar="u,v",
        help="the pixels to measure, in order (these, --points-file or --page)",
    )
    pixels.add_argument(
        "--points-file",
        type=some_path,
        metavar="FILE",
        help="a CSV file with the pixels to measure, a line name,u,v for each",
    )
    add_pose(command)
    add_plane(command)
    more = command.add_argument_group("more")
    more.add_argument(
        "--pixel-sigma",
        type=_pixel_sigma,
        default=None,
        metavar="S",
        help=f"standard deviation of u and of v of each point, in px; or '{DETECTOR}', the noise of the board's "
        f"corners, for pixels that a program found as well as these (default: {HAND}, for points picked by hand)",
    )
    more.add_argument(
        "--draw",
        type=drawing,
        metavar="FILE",
        help="draw the board's corners and axes, the points and the lengths into the photograph: a .png, .svg or .pdf, "
        "replaced if there is one",
    )
    more.add_argument(
        "--page",
        type=page_file,
        metavar="FILE",
        help="write an .html page in which anyone measures in PHOTO by clicks, offline, with these error bars; with "
        "--view PHOTO is that view's photograph",
    )
    forms = add_said(command)
    forms.add_argument("--csv", action="store_true", help="print one table for spreadsheets")
    command.set_defaults(work="measuring", check=functools.partial(_check_which_pose, command))


def _pixel(text: str) -> tuple[float, ...]:
    values = numbers(text, 2)
    if values is None:
        kind = Path(text.strip()).suffix.lower()
        hint = "a file of them goes with --points-file" if kind in TABLES else "the photograph comes first"
        raise argparse.ArgumentTypeError(
            f"want pixels as u,v without a space, such as 320.5,240, got {text.strip()!r}; {hint}"
        )
    return values


def _pixel_sigma(text: str) -> float | str:
    if text.strip() == DETECTOR:
        return DETECTOR
    noise = pixel_noise(text)
    if noise is None:
        raise argparse.ArgumentTypeError(f"want a positive number of pixels, such as 0.5, or {DETECTOR}, got {text!r}")
    return noise


def _check_which_pose(command: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Check that a photograph comes with its board, and a view alone."""
    if options.points is None and options.points_file is None and options.page is None:
        command.error("one of the arguments --points --points-file --page is required")
    if options.view is not None and options.photograph is None and options.page is not None:
        command.error("PHOTO: want the photograph of --view for --page, got none")
    if options.view is not None and options.photograph is not None and options.page is None:
        command.error(
            "PHOTO: not with --view, whose pose the camera file holds; leave the photograph out, or give --board and "
            "--square"
        )
    if options.view is not None and options.square is not None:
        command.error("--square: goes with --board, not with --view")
    if options.view is None and options.photograph is None:
        command.error("PHOTO: want a photograph that shows the board, got none")
    check_board(command, options)
