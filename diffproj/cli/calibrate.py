"""The command line of `diffproj calibrate`; `calibrating.py` does the work."""

import argparse
import functools
from pathlib import Path
from typing import get_args

from diffproj.calibration.problem.shape_names import Shape
from diffproj.cli.common_options import add_said, describe
from diffproj.cli.drawing import drawing
from diffproj.cli.inputs import add_orientation, camera_file, some_path
from diffproj.cli.reporting import report_file
from diffproj.cli.which_board import add_kinds, add_measures, check_board
from diffproj.lens.names import LensModel

MOST_FOLDS, MOST_FRAMES = 1000, 1_000_000
"""More are mistakes."""
FLEET_SUFFIX = ".jsonl"
MOST_WORKERS = 1024

DESCRIPTION = """\
Finds a camera from photographs of a board: focal lengths, principal point
and lens with their standard deviations, and where the camera stood. Prints what
it found and writes a camera file.

Take 10 to 20 photographs with one focus and one zoom, the board flat, sharp,
wholly in view and tilted by 20 to 50 degrees this way and that, so that it
reaches every part of the image in some of them. A photograph in which no board
is found is named and skipped; so are, in a folder, files that cannot be read,
hidden files and those that are no photographs. Copies count once. A video gives
sharp frames in which the board has moved.

With --fleet, each folder in a folder holds the photographs of one camera. They
are calibrated on all cores, and one line of JSON is written for each. A run
that was stopped goes on where it was; cameras that failed are tried again, and
so are those whose photographs were added, removed or changed since.
"""

EPILOG = """\
examples:
  diffproj calibrate photos/ --board 9x6 --square 25mm
  diffproj calibrate photos/ --board 9x6 --square 25mm --report report.html
  diffproj calibrate left*.jpg --board 9x6 --square 25mm -o camera.yaml
  diffproj calibrate board.mp4 --board 9x6 --square 25mm --folds 5 --json
  diffproj calibrate wide/ --board 11x8 --square 3cm --distortion auto \\
      --draw wide.png
  diffproj calibrate photos/ --charuco 8x6 --square 25mm --marker 18mm \\
      --dictionary 5X5_100
  diffproj calibrate photos/ --aprilgrid 6x6 --tag 88mm --spacing 0.3
  diffproj calibrate photos/ --circles 11x4 --asymmetric --spacing 20mm \\
      --diameter 15mm
  diffproj calibrate --fleet cameras/ --board 9x6 --square 25mm -o cameras.jsonl

The file is for diffproj.load_camera("camera.json") in Python; OpenCV reads the
YAML and XML by cv2.FileStorage: camera_matrix, distortion_coefficients.
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    describe(command, DESCRIPTION, EPILOG, "%(prog)s PHOTO [PHOTO ...] --board CxR --square SIDE [options]")
    command.add_argument(
        "photographs",
        nargs="*",
        type=some_path,
        metavar="PHOTO",
        help="photographs by one camera, folders of them, or videos (.mp4, .mov, .avi, .mkv, .webm, ...)",
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
    lens.add_argument(
        "--folds",
        type=_folds,
        metavar="K",
        help="calibrate K times more, without every K-th view, and tell the errors on the views left out",
    )
    add_orientation(lens)
    lens.add_argument(
        "--frames",
        type=_every,
        metavar="N",
        help="of a video, take every N-th frame, sharp or not (default: sharp ones from all its parts, at most 60)",
    )
    file = command.add_argument_group("the files")
    file.add_argument(
        "-o",
        "--output",
        type=_output,
        metavar="FILE",
        help="the camera file, replaced if there is one. Its ending says what it holds: .json the whole calibration; "
        ".yaml, .yml or .xml what OpenCV's calibration program writes (default: camera.json). With --fleet a .jsonl, "
        "which gets the cameras that it has not yet (default: cameras.jsonl)",
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
    many = command.add_argument_group("many cameras")
    many.add_argument(
        "--fleet", type=some_path, metavar="DIR", help="a folder with a folder of photographs for each camera"
    )
    many.add_argument(
        "--workers",
        type=_workers,
        metavar="N",
        help="processes that search the photographs of a fleet (default: one for each core)",
    )
    many.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="search them on a Dask cluster instead, by its scheduler's address; its workers see the same folder",
    )
    add_said(command)
    command.set_defaults(work="calibrating", check=functools.partial(_check_together, command))


def _output(text: str) -> Path:
    """Read the name of a camera file, or of a fleet's."""
    return Path(text) if Path(text).suffix.lower() == FLEET_SUFFIX else camera_file(text)


def _workers(text: str) -> int:
    """Read a number of processes."""
    if not (text.isdecimal() and 1 <= int(text) <= MOST_WORKERS):
        raise argparse.ArgumentTypeError(f"want a number of processes from 1 to {MOST_WORKERS}, got {text!r}")
    return int(text)


def _check_together(command: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Check that the board is measured, that the file can hold what is fitted, and what goes with many cameras."""
    check_board(command, options)
    if options.fleet is None:
        if not options.photographs:
            command.error("the following arguments are required: PHOTO (or --fleet DIR)")
        for name in ("workers", "dask"):
            if getattr(options, name):
                command.error(f"--{name}: goes with --fleet")
    else:
        options.work = "calibrating_fleet"
        if options.photographs:
            command.error(f"--fleet: want it without other photographs, got {options.photographs[0]}")
        for name in ("draw", "report", "folds", "frames"):
            if getattr(options, name) is not None:
                command.error(f"--{name}: goes with one camera, not with --fleet")
        if options.dask is not None and options.workers is not None:
            command.error("--dask: want it without --workers")
    options.output = options.output or Path("camera.json" if options.fleet is None else f"cameras{FLEET_SUFFIX}")
    suffix = options.output.suffix.lower()
    if (suffix == FLEET_SUFFIX) != (options.fleet is not None):
        want = ".json, .yaml, .yml or .xml for one camera" if options.fleet is None else f"{FLEET_SUFFIX} with --fleet"
        command.error(f"--output: want a {want}, got {options.output}")
    if options.skew and suffix not in (".json", FLEET_SUFFIX):
        command.error(f"--output: want a .json with --skew, which OpenCV's formats do not hold, got {options.output}")


def _folds(text: str) -> int:
    if not text.isdecimal() or not 2 <= int(text[:9]) <= MOST_FOLDS:
        raise argparse.ArgumentTypeError(f"want a whole number from 2 to {MOST_FOLDS}, such as 5, got {text!r}")
    return int(text)


def _every(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text[:9]) <= MOST_FRAMES:
        raise argparse.ArgumentTypeError(f"want a whole number from 1 to {MOST_FRAMES}, such as 15, got {text!r}")
    return int(text)
