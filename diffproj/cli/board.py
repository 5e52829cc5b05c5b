"""The command line of `diffproj board`; `printing.py` does the work."""

import argparse
import functools

from diffproj.cli.common_options import add_said, describe
from diffproj.cli.inputs import LARGEST_NUMBER, file_ending, numbers
from diffproj.cli.which_board import add_kinds, add_measures, check_board

DESCRIPTION = """\
Writes a page with a board to print at true scale, with a ruler to check the
print by. Print it at 100 % ("actual size"), measure the ruler, and glue the
sheet to something flat and stiff.
"""

EPILOG = """\
examples:
  diffproj board board.pdf --board 9x6 --square 25mm
  diffproj board board.pdf --charuco 8x6 --square 25mm --marker 18mm \\
      --dictionary 5X5_100 --paper A3
  diffproj board board.png --aprilgrid 6x6 --tag 22mm --spacing 0.3 --dpi 300
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    describe(command, DESCRIPTION, EPILOG, "%(prog)s FILE --board CxR --square SIDE [options]")
    command.add_argument(
        "file",
        type=file_ending(".pdf", ".svg", ".png"),
        metavar="FILE",
        help="the page: a .pdf, .svg or .png, replaced if there is one",
    )
    board = command.add_argument_group("the board")
    add_kinds(board.add_mutually_exclusive_group(required=True))
    add_measures(board)
    page = command.add_argument_group("the page")
    page.add_argument(
        "--paper",
        default="A4",
        type=_paper,
        metavar="NAME",
        help="A0 to A5, letter, legal, tabloid, or width,height in mm (default: A4)",
    )
    page.add_argument("--dpi", type=_dpi, default=600.0, metavar="N", help="pixels per inch of a .png (default: 600)")
    add_said(command)
    command.set_defaults(work="printing", check=functools.partial(check_board, command))


def _paper(text: str) -> str | tuple[float, ...]:
    return numbers(text, 2) or text


def _dpi(text: str) -> float:
    values = numbers(text, 1)
    if values is None or not 50 <= values[0] <= min(5000, LARGEST_NUMBER):
        raise argparse.ArgumentTypeError(f"want pixels per inch from 50 to 5000, got {text!r}")
    return values[0]
