"""`diffproj measure`: points, lengths and an area on a plane, with error bars, from pixels of a photograph."""

import argparse
import functools
import json
import math
from pathlib import Path

import torch

from diffproj.cli.inputs import add_orientation, board_size, camera_file, numbers, square_side
from diffproj.cli.measure_document import document
from diffproj.cli.measure_tables import say
from diffproj.cli.scene import new_photograph, stored_view
from diffproj.cli.terminal import result
from diffproj.geometry.plane import Plane
from diffproj.measurement.measure import measure

DESCRIPTION = """\
Turns pixels of a photograph into points on a plane, and prints them with the
lengths between successive points, and from three points on the area that they
enclose in their order, each with its standard deviation and 95 % interval.

Where the camera stood is taken from a board in the photograph (--board and
--square), or from a view that the camera was calibrated with (--view).
"""

EPILOG = """\
pixels:
  u runs to the right and v down; 0,0 is the middle of the first pixel. They may
  be negative or lie outside the photograph.

the board's frame:
  The origin is the first inner corner, x runs to the right along the board's
  rows, y down its columns, and z into the board, away from the camera: heights
  above the board are negative. The first corner touches two dark squares: one
  inside the first four corners, one diagonally outside. The unit is that of
  --square. --view has the frame of the calibration: this one for a file from
  'diffproj calibrate'; for one from 'diffproj experiment', x runs down, y to
  the right and z towards the camera.

examples:
  diffproj measure photo.jpg --camera camera.json --board 9x6 --square 25 \\
      --points 210.5,133 402,140.5 395,300
  diffproj measure --camera camera.json --view left01.jpg \\
      --points 210,133 402,140
  diffproj measure photo.jpg --camera camera.yaml --board 9x6 --square 25 \\
      --points 210,133 402,140 --plane 0,0,1,-12 --pixel-sigma 0.7 --json

  The last one measures on top of a box 12 high that lies on the board.

exit codes: 0 done, also where pixels have no point on the plane, which the
output names; 1 it failed, one line says why; 2 the command was not understood
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    command.description, command.epilog = DESCRIPTION, EPILOG
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    command.usage = (
        "%(prog)s PHOTO --camera FILE --board CxR --square SIDE\n"
        "                        --points u,v ... [options]\n"
        "       %(prog)s --camera FILE --view NAME --points u,v ... [options]"
    )
    photograph = command.add_argument(
        "photograph", type=Path, metavar="PHOTO", help="the photograph, with --board; --view needs none"
    )
    # Not nargs="?": argparse would fill that with nothing as soon as an option comes before the photograph.
    photograph.required = False
    command.add_argument(
        "--camera",
        type=camera_file,
        required=True,
        metavar="FILE",
        help="the camera file. A .json from 'diffproj calibrate' brings the camera's own uncertainty along; .yaml, "
        ".yml or .xml as OpenCV writes them do not (required)",
    )
    command.add_argument(
        "--points",
        type=_pixel,
        nargs="+",
        action="extend",
        required=True,
        metavar="u,v",
        help="the pixels to measure, in order (required)",
    )
    pose = command.add_argument_group("where the camera stood: a board in PHOTO, or a view of the calibration")
    either = pose.add_mutually_exclusive_group(required=True)
    either.add_argument(
        "--board",
        type=board_size,
        metavar="CxR",
        help="inner corners of the board, columns x rows: a board of 10 by 7 squares has 9x6",
    )
    either.add_argument("--view", metavar="NAME", help="name of the view, such as left01.jpg")
    pose.add_argument(
        "--square",
        type=square_side,
        metavar="SIDE",
        help="side of a square of the board, measured on the print; its unit becomes that of all results",
    )
    more = command.add_argument_group("more")
    more.add_argument(
        "--plane",
        type=_plane,
        default=(0.0, 0.0, 1.0, 0.0),
        metavar="a,b,c,d",
        help="the plane a x + b y + c z = d in the board's frame (default: 0,0,1,0, the board itself)",
    )
    more.add_argument(
        "--pixel-sigma",
        type=_pixel_sigma,
        metavar="S",
        help="standard deviation of u and of v of each point, in px. The default is that of the board's corners, which "
        "a program found to a fraction of a pixel: for points picked by hand, give 0.5 to 1",
    )
    add_orientation(more)
    more.add_argument("--json", action="store_true", help="print one JSON document, with null for what is not known")
    command.set_defaults(run=functools.partial(run, command))


def run(command: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """Run the command."""
    _check_which_pose(command, options)
    scene = stored_view(options) if options.view is not None else new_photograph(options)
    sigma = scene.calibration.pixel_sigma if options.pixel_sigma is None else options.pixel_sigma
    if sigma is None or not math.isfinite(sigma):
        raise ValueError(f"--pixel-sigma: want the noise of the pixels in px, for {options.camera} does not tell it")
    plane = Plane(torch.tensor(options.plane[:3], dtype=torch.float64, device="cpu"), options.plane[3])
    pixels = torch.tensor(options.points, dtype=torch.float64, device="cpu")
    measured = measure(pixels, scene.calibration, plane, scene.view, options.pixel_sigma)
    found = document(scene, plane, float(sigma), pixels, measured)
    if options.json:
        result(json.dumps(found, indent=1, allow_nan=False))
    else:
        say(found, scene)
    return 0


def _pixel(text: str) -> tuple[float, ...]:
    values = numbers(text, 2)
    if values is None:
        raise argparse.ArgumentTypeError(
            f"want pixels as u,v without a space, such as 320.5,240, got {text.strip()!r}; the photograph comes first"
        )
    return values


def _plane(text: str) -> tuple[float, ...]:
    values = numbers(text, 4)
    if values is None or not any(values[:3]):
        raise argparse.ArgumentTypeError(
            "want a plane a x + b y + c z = d as a,b,c,d without spaces, a, b and c not all 0, such as 0,0,1,25, "
            f"got {text.strip()!r}"
        )
    return values


def _pixel_sigma(text: str) -> float:
    values = numbers(text, 1)
    if values is None or values[0] <= 0:
        raise argparse.ArgumentTypeError(f"want a positive number of pixels, such as 0.5, got {text!r}")
    return values[0]


def _check_which_pose(command: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Check that a photograph comes with its board, and a view alone."""
    if options.view is not None and options.photograph is not None:
        command.error(
            "PHOTO: not with --view, whose pose the camera file holds; leave the photograph out, or give --board and "
            "--square"
        )
    if options.view is not None and options.square is not None:
        command.error("--square: goes with --board, not with --view")
    if options.board is not None and options.photograph is None:
        command.error("PHOTO: want a photograph that shows the board, got none")
    if options.board is not None and options.square is None:
        command.error("--square: want the side of the board's squares along with --board, got none")
