"""The command line of `diffproj experiment`; `experimenting.py` does the work."""

import argparse
from pathlib import Path
from typing import get_args

from diffproj.cli.common_options import add_said, describe
from diffproj.cli.inputs import board_size, some_path
from diffproj.cli.units import Length, square_side
from diffproj.lens.names import LensModel

DESCRIPTION = """\
Calibrates a camera from views of a chessboard, finds the pose of each test
view, puts every corner of it back on the board's plane and compares it with its
known place. Prints Table 1, for the board as it was designed and as it was
printed, whose corners the fitting views tell, and writes both as CSV, fig7.png
and camera.json (the whole calibration) to the output folder.
"""

EPILOG = """\
examples:
  diffproj experiment
  diffproj experiment --data right --strict --output right
  diffproj experiment --images photos/ --board 9x6 --square 25mm --split 8
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    describe(command, DESCRIPTION, EPILOG, "%(prog)s [options]")
    source = command.add_mutually_exclusive_group()
    source.add_argument(
        "--data",
        choices=["left", "right", "synthetic"],
        default="left",
        help="corners measured in real photographs by the left or right camera of a stereo pair, which come with the "
        "package; or photographs rendered with known truth (default: left)",
    )
    source.add_argument(
        "--images", nargs="+", type=some_path, metavar="PHOTO", help="your own photographs, or folders of them"
    )
    command.add_argument(
        "--board", type=board_size, default=(9, 6), metavar="CxR", help="inner corners of your board (default: 9x6)"
    )
    command.add_argument(
        "--square",
        type=square_side,
        default=Length(25.0, "mm"),
        metavar="SIDE",
        help="side of a square, such as 25mm or 1in; its unit is that of all results (default: 25mm)",
    )
    command.add_argument(
        "--distortion",
        choices=get_args(LensModel),
        default="brown5",
        metavar="LENS",
        help="the lens that is fitted, as for 'diffproj calibrate' (default: brown5)",
    )
    command.add_argument(
        "--split",
        metavar="N or LIST/LIST",
        help="which views fit and which test: 8 for the first eight, or numbers from 1 as in 1-5,9/6-8 "
        "(default: the first 8 of 13 fit, others in proportion; synthetic: the first 10 of 15)",
    )
    command.add_argument(
        "--strict", action="store_true", help="find each pose from every second corner and measure the others"
    )
    command.add_argument(
        "--output",
        type=some_path,
        default=Path("diffproj-experiment"),
        metavar="FOLDER",
        help="where the files go (default: diffproj-experiment)",
    )
    add_said(command)
    command.set_defaults(work="experimenting")
