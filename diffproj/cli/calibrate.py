"""`diffproj calibrate`: from photographs of a chessboard to a camera file."""

import argparse
import tempfile
import textwrap
from pathlib import Path
from typing import get_args

from rich.markup import escape
from rich.table import Table

from diffproj.calibration.calibrate import calibrate
from diffproj.calibration.result import Calibration
from diffproj.cli.inputs import add_orientation, board_size, camera_file, find_corners, photographs, square_side
from diffproj.cli.terminal import RESULTS, aligned, in_options, progress_bars, result, rounded
from diffproj.files.save import save_camera
from diffproj.lens.models import LensModel
from diffproj.targets.chessboard import Chessboard

DESCRIPTION = """\
Finds a camera from photographs of a chessboard: focal lengths, principal point
and lens with their standard deviations, and where the camera stood. Prints what
it found and writes a camera file.

Take 10 to 20 photographs with one focus and one zoom, the board flat, sharp,
wholly in view and tilted by 20 to 50 degrees this way and that, so that it
reaches every part of the image in some of them. A photograph in which no board
is found is named and skipped.
"""

EPILOG = """\
examples:
  diffproj calibrate photos/ --board 9x6 --square 25
  diffproj calibrate left*.jpg --board 9x6 --square 25 -o camera.yaml
  diffproj calibrate wide/ --board 11x8 --square 0.03 --distortion auto

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
        "photographs", nargs="+", type=Path, metavar="PHOTO", help="photographs by one camera, or folders of them"
    )
    board = command.add_argument_group("the board")
    board.add_argument(
        "--board",
        type=board_size,
        required=True,
        metavar="CxR",
        help="its inner corners, columns x rows: a board of 10 by 7 squares has 9x6 (required)",
    )
    board.add_argument(
        "--square",
        type=square_side,
        required=True,
        metavar="SIDE",
        help="side of a square, measured on the print; its unit, such as mm, becomes the world's (required)",
    )
    board.add_argument(
        "--bow",
        action="store_true",
        help="the board may be bent a little: fit how far its middle stands off its edges, too",
    )
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
        "--reject-outliers",
        action="store_true",
        help="leave out corners that lie more than 5 standard deviations off, and name them",
    )
    add_orientation(lens)
    file = command.add_argument_group("the file")
    file.add_argument(
        "-o",
        "--output",
        type=camera_file,
        default=Path("camera.json"),
        metavar="FILE",
        help="the camera file, replaced if there is one. Its ending says what it holds: .json the whole calibration; "
        ".yaml, .yml or .xml what OpenCV's calibration program writes (default: camera.json)",
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    _check_writable(options.output)
    columns, rows = options.board
    board = Chessboard(columns, rows, options.square)
    with progress_bars() as bars:
        views = find_corners(photographs(options.photographs), board, bars, orientation=options.orientation)
        task = bars.add_task("Solving", total=None)
        calibration = calibrate(
            views,
            board,
            options.distortion,
            bow=options.bow,
            reject_outliers=options.reject_outliers,
            progress=lambda done, total: bars.update(task, completed=done, total=total),
        )
    if calibration.comparison is not None:
        result(f"Lenses compared\n{calibration.comparison.summary()}\n")
    RESULTS.print(_views_table(calibration))
    result("")
    RESULTS.print(_parameters_table(calibration))
    _say_how_it_ended(calibration, options.reject_outliers)
    try:
        save_camera(options.output, calibration)
    except OSError as error:
        raise OSError(f"--output: could not write {options.output} ({error.strerror}); choose another place") from error
    more = "" if options.output.suffix.lower() == ".json" else "; a .json file would hold the whole calibration"
    result(f"\nWritten to {options.output}{more}")
    return 0


def _check_writable(path: Path) -> None:
    """Find out before the long work, and not after it, whether the file can be written."""
    if path.is_dir():
        raise ValueError(f"--output: want a file, got a folder: {path}")
    if not path.parent.is_dir():
        raise ValueError(f"--output: no such folder: {path.parent}; make it first, or choose another")
    try:
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise OSError(
            f"--output: cannot write to the folder {path.parent} ({error.strerror}); choose another"
        ) from error


def _views_table(calibration: Calibration) -> Table:
    rejected = calibration.rejected
    table = Table(title="Views", title_justify="left")
    table.add_column("view", overflow="fold")
    table.add_column("corners", justify="right", no_wrap=True)
    table.add_column("RMS in px", justify="right", no_wrap=True)
    if bool(rejected.any()):
        table.add_column("rejected: number (u, v)", no_wrap=True)
    seen, used = calibration.views.visible.sum(-1).tolist(), calibration.used.sum(-1).tolist()
    for view, name in enumerate(calibration.views.names):
        row = [escape(name), f"{used[view]} of {seen[view]}"]
        row.append(f"{float(calibration.view_rms[view]):.4f}" if used[view] else "left out")
        if bool(rejected.any()):
            numbers = rejected[view].nonzero().flatten().tolist()
            places = calibration.views.pixels[view, numbers].tolist()
            texts = [f"{number} ({u:.0f}, {v:.0f})" for number, (u, v) in zip(numbers, places, strict=True)]
            row.append("\n".join("  ".join(texts[i : i + 2]) for i in range(0, len(texts), 2)))
        table.add_row(*row)
    return table


def _parameters_table(calibration: Calibration) -> Table:
    values = calibration.shared.tolist()
    known = calibration.covariance.deviations
    pairs = [rounded(value, float(deviation)) for value, deviation in zip(values, known.values(), strict=True)]
    table = Table(title="Camera", title_justify="left")
    table.add_column("parameter")
    table.add_column("value", no_wrap=True)
    table.add_column("standard deviation", no_wrap=True)
    for name, *pair in zip(known, *(aligned(column) for column in zip(*pairs, strict=True)), strict=True):
        table.add_row(_title(name), *pair)
    return table


def _title(name: str) -> str:
    """What a parameter is, with its unit."""
    if name.startswith("bow"):
        return f"board's bow along {name[-1]}, unit of --square"
    titles = {"f": "focal length {}, px", "c": "principal point {}, px"}
    return titles.get(name[0], "lens {}").format(name)


def _say_how_it_ended(calibration: Calibration, reject_outliers: bool) -> None:
    corners, views = int(calibration.used.sum()), int(calibration.used.any(-1).sum())
    result(f"\nRMS reprojection error {float(calibration.rms):.4f} px over {corners} corners in {views} views")
    if reject_outliers:
        count = int(calibration.rejected.sum())
        result(f"{count or 'no'} corner{'s' * (count > 1)} rejected as outlier{'s' * (count > 1)}".capitalize())
    how, *remarks = calibration.message.split("; ")
    result(f"Solver {how}")
    for remark in remarks:
        result(textwrap.fill(in_options(remark[0].upper() + remark[1:]), 79))
