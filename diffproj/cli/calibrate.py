"""The command line of `diffproj calibrate`; `calibrating.py` does the work."""

import argparse
import functools
from pathlib import Path
from typing import get_args

from diffproj.calibration.shape_names import Shape
from diffproj.cli.drawing import drawing
from diffproj.cli.inputs import add_orientation, camera_file, some_path
from diffproj.cli.reporting import report_file
from diffproj.cli.which_board import add_kinds, add_measures, check_board
from diffproj.lens.names import LensModel

DESCRIPTION = """\
Finds a camera from photographs of a board: focal lengths, principal point
and lens with their standard deviations, and where the camera stood. Prints what
it found and writes a camera file.

Take 10 to 20 photographs with one focus and one zoom, the board flat, sharp,
wholly in view and tilted by 20 to 50 degrees this way and that, so that it
reaches every part of the image in some of them. A photograph in which no board
is found is named and skipped; so are, in a folder, files that cannot be read,
hidden files and those that are no photographs. Copies count once.
"""

EPILOG = """\
examples:
  diffproj calibrate photos/ --board 9x6 --square 25mm
  diffproj calibrate photos/ --board 9x6 --square 25mm --report report.html
  diffproj calibrate left*.jpg --board 9x6 --square 25mm -o camera.yaml
  diffproj calibrate wide/ --board 11x8 --square 3cm --distortion auto \\
      --draw wide.png
  diffproj calibrate photos/ --charuco 8x6 --square 25mm --marker 18mm \\
      --dictionary 5X5_100
  diffproj calibrate photos/ --aprilgrid 6x6 --tag 88mm --spacing 0.3
  diffproj calibrate photos/ --circles 11x4 --asymmetric --spacing 20mm \\
      --diameter 15mm

The file is for diffproj.load_camera("camera.json") in Python; OpenCV reads the
YAML and XML by cv2.FileStorage: camera_matrix, distortion_coefficients.

exit codes: 0 done; 1 it failed, one line says why, nothing is written; 2 the
command was not understood
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    command.description, command.epilog = DESCRIPTION, EPILOG
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    command.usage = "%(prog)s PHOTO [PHOTO ...] --board CxR --square SIDE [options]"
    command.add_argument(
        "photographs", nargs="+", type=some_path, metavar="PHOTO", help="photographs by one camera, or folders of them"
    )
    board = command.add_argument_group("the board")
    add_kinds(board.add_mutually_exclusive_group(required=True))
    add_measures(board)
    board.add_argument(
        "--shape",
        choices=get_args(Shape),
        default="flat",
        help="of the print: flat, as it was designed; bow, bent a little: fit how far its middle stands off its edges, "
        "too; free: fit where each corner is, too, which takes six views and more (default: flat)",
    )
    board.add_argument("--bow", action="store_const", const="bow", dest="shape", help="the same as --shape bow")
    lens = command.add_argument_group("the camera")
    lens.add_argument(
        "--distortion",
        choices=(*get_args(LensModel), "auto"),
        default="brown5",
        metavar="LENS",
        help="the lens that is fitted: none; brown4, brown5, brown8, brown12 or brown14, which are OpenCV's model with "
        "that many coefficients; fisheye, OpenCV's for wide angles; or auto, which compares lenses by their errors on "
        "corners held out and takes the simplest that is no worse than the best (default: brown5)",
    )
    lens.add_argument(
        "--skew",
        action="store_true",
        help="the sensor's rows and columns may not be at right angles: fit the skew, too",
    )
    lens.add_argument(
        "--reject-outliers",
        action="store_true",
        help="leave out corners that lie more than 5 standard deviations off, and name them",
    )
    add_orientation(lens)
    file = command.add_argument_group("the files")
    file.add_argument(
        "-o",
        "--output",
        type=camera_file,
        default=Path("camera.json"),
        metavar="FILE",
        help="the camera file, replaced if there is one. Its ending says what it holds: .json the whole calibration; "
        ".yaml, .yml or .xml what OpenCV's calibration program writes (default: camera.json)",
    )
    file.add_argument(
        "--draw",
        type=drawing,
        metavar="FILE",
        help="draw where in the image the corners lie and how far off they are: a .png, .svg or .pdf, replaced if "
        "there is one",
    )
    file.add_argument(
        "--report",
        type=report_file,
        metavar="FILE",
        help="write a report: one .html file for any browser, with the verdict, what to photograph next, the "
        "photographs with their corners, residuals, lens, accuracy and views held out; replaced if there is one",
    )
    command.set_defaults(work="calibrating", check=functools.partial(_check_together, command))


def _check_together(command: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Check that the board is measured, and that the file can hold what is fitted."""
    check_board(command, options)
    if options.skew and options.output.suffix.lower() != ".json":
        command.error(f"--output: want a .json with --skew, which OpenCV's formats do not hold, got {options.output}")
