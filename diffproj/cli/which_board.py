"""The options that tell which board hangs on the wall, in several commands, and the board that they mean."""

import argparse
from typing import TYPE_CHECKING, NamedTuple

from diffproj.cli.inputs import board_size, counts, some_path
from diffproj.cli.units import Length, in_unit, length, square_side

if TYPE_CHECKING:  # they are slow to load
    from diffproj.targets.boards import Board

KINDS = ("board", "charuco", "aprilgrid", "circles", "target")
"""The options that name a kind of board, without their dashes."""

NEEDS = {
    "board": ("square",),
    "charuco": ("square", "marker", "dictionary"),
    "aprilgrid": ("tag", "spacing"),
    "circles": ("spacing", "diameter"),
    "target": (),
}
"""Options that each kind of board needs."""

TAKES = {"board": (), "charuco": ("legacy",), "aprilgrid": (), "circles": ("asymmetric",), "target": ("diameter",)}
"""Options that each kind of board may have."""


class Given(NamedTuple):
    """The board that is meant.

    Attributes:
        board: it.
        side: what measures it: the side of a square or a tag, or the spacing of circles; its unit is the world's.
        option: which option gave that.
    """

    board: "Board"
    side: Length
    option: str


def add_kinds(group: argparse._MutuallyExclusiveGroup | argparse._ArgumentGroup) -> None:
    """Give a command the options that name the board."""
    group.add_argument(
        "--board",
        type=board_size,
        metavar="CxR",
        help="a chessboard by its inner corners, columns x rows: one of 10 by 7 squares has 9x6; with --square",
    )
    group.add_argument(
        "--charuco",
        type=counts,
        metavar="CxR",
        help="a ChArUco board by its squares, as OpenCV counts them; with --square, --marker and --dictionary",
    )
    group.add_argument(
        "--aprilgrid", type=counts, metavar="CxR", help="Kalibr's AprilGrid by its tags; with --tag and --spacing"
    )
    group.add_argument(
        "--circles", type=counts, metavar="CxR", help="a grid of circles by its circles; with --spacing and --diameter"
    )
    group.add_argument(
        "--target", type=some_path, metavar="FILE", help="the board of a target file of Kalibr, in metres"
    )


def add_measures(group: argparse._ArgumentGroup) -> None:
    """Give a command the options that measure the board."""
    group.add_argument(
        "--square",
        type=square_side,
        metavar="SIDE",
        help="side of a square, measured on the print, such as 25mm, 2.5cm or 1in; its unit becomes the world's",
    )
    group.add_argument("--marker", type=length, metavar="SIDE", help="side of a marker, such as 18mm")
    group.add_argument("--dictionary", metavar="NAME", help="OpenCV's dictionary of the markers, such as 5X5_100")
    group.add_argument(
        "--legacy", action="store_true", help="a ChArUco board from before OpenCV 4.6, with a white first square"
    )
    group.add_argument("--tag", type=length, metavar="SIDE", help="side of a tag with its black border, such as 88mm")
    group.add_argument(
        "--spacing",
        type=length,
        metavar="S",
        help="gap between tags relative to their side, such as 0.3; or the distance between circles, such as 20mm",
    )
    group.add_argument("--diameter", type=length, metavar="D", help="diameter of a circle, such as 15mm")
    group.add_argument(
        "--asymmetric",
        action="store_true",
        help="every second line of circles is shifted, and --spacing is the distance between two lines",
    )


def kind_of(options: argparse.Namespace) -> str | None:
    """Which kind of board is given."""
    return next((kind for kind in KINDS if getattr(options, kind) is not None), None)


def check_board(command: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Check that a board comes with what measures it, and with nothing else."""
    kind = kind_of(options)
    needs, takes = NEEDS.get(kind or "", ()), TAKES.get(kind or "", ())
    for name in dict.fromkeys(name for names in (*NEEDS.values(), *TAKES.values()) for name in names):
        there = getattr(options, name) not in (None, False)
        if there and name not in (*needs, *takes):
            owners = [f"--{one}" for one in KINDS if name in (*NEEDS[one], *TAKES[one])]
            command.error(f"--{name}: goes with {' or '.join(owners)}, not with {f'--{kind}' if kind else '--view'}")
        if name in needs and not there:
            if name == "square" and kind == "board":
                command.error("--square: want the side of the board's squares along with --board, got none")
            command.error(f"--{name}: want it along with --{kind}, got none")
    if kind == "aprilgrid" and options.spacing.unit is not None:
        command.error(
            f"--spacing: want the gap between tags relative to their side, such as 0.3, got {options.spacing}"
        )


def given_board(options: argparse.Namespace) -> Given:
    """The board that the options mean.

    Raises:
        ValueError: there can be no such board, or its file is none.
        OSError: its file cannot be read.
    """
    from diffproj.files.kalibr_target import read_target
    from diffproj.targets.april_grid import AprilGrid
    from diffproj.targets.charuco import CharucoBoard
    from diffproj.targets.chessboard import Chessboard
    from diffproj.targets.circle_grid import CircleGrid

    kind = kind_of(options)
    try:
        if kind == "target":
            diameter = None if options.diameter is None else _in(options.diameter, "m", "diameter")
            board = read_target(options.target, diameter)
            return Given(board, Length(board.side, "m"), "--target")
        if kind == "charuco":
            side, option = options.square, "square"
            marker = _in(options.marker, side.unit, "marker")
            columns, rows = options.charuco
            board = CharucoBoard(columns, rows, side.value, marker, options.dictionary, options.legacy)
        elif kind == "aprilgrid":
            side, option = options.tag, "tag"
            columns, rows = options.aprilgrid
            board = AprilGrid(columns, rows, side.value, options.spacing.value)
        elif kind == "circles":
            side, option = options.spacing, "spacing"
            diameter = _in(options.diameter, side.unit, "diameter")
            columns, rows = options.circles
            board = CircleGrid(columns, rows, side.value, diameter, options.asymmetric)
        else:
            side, option = options.square, "square"
            columns, rows = options.board
            board = Chessboard(columns, rows, side.value)
    except ValueError as error:
        text = str(error)
        raise ValueError(f"--{text}" if text.partition(":")[0] in options else text) from None
    return Given(board, side, f"--{option}")


def _in(given: Length, unit: str | None, option: str) -> float:
    """A length in the unit of the board."""
    value = in_unit(given, unit)
    if value is None:
        raise ValueError(f"{option}: want it in {unit or 'the unit of the board'}, got {given}; give both with a unit")
    return value
