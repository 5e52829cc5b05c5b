"""The `diffproj` command: joins experiment, figures and files.

Exit codes: 0 done, 1 the work failed (one line says what and what to do), 2 the command was not understood.
"""

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from diffproj import figures, synthetic
from diffproj._atomic import write_whole
from diffproj.board import BoardNotFoundWarning, Chessboard, Views, detect, example_views
from diffproj.calibration import CalibrationError, LensModel
from diffproj.experiment import Experiment, choose, default_split, parse_split, run_experiment
from diffproj.files import save_camera

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".pgm", ".webp")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    options = _parser().parse_args(arguments)
    errors = Console(stderr=True, highlight=False, soft_wrap=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", BoardNotFoundWarning)
            warnings.showwarning = lambda message, *_: errors.print(f"diffproj: {message}", markup=False)
            return options.run(options)
    except (ValueError, OSError, CalibrationError) as error:
        errors.print(f"diffproj: {error}", markup=False)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="diffproj",
        description="Pixels of one calibrated camera to world coordinates on known planes.",
        epilog="'diffproj COMMAND --help' tells more about a command.",
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_experiment(commands)
    return parser


def _add_experiment(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    command = commands.add_parser(
        "experiment",
        help="calibrate, put corners back on the board, and print the errors (the paper's Table 1 and Fig. 7)",
        description=(
            "Calibrates a camera from views of a chessboard, finds the pose of each test view, puts every corner of it "
            "back on the board's plane and compares it with its known place. Prints Table 1 and writes table1.csv, "
            "fig7.png and camera.json (the whole calibration) to the output folder."
        ),
    )
    source = command.add_mutually_exclusive_group()
    source.add_argument(
        "--data",
        choices=["left", "right", "synthetic"],
        default="left",
        help="corners measured in real photographs by the left or right camera of a stereo pair, which come with the "
        "package; or photographs rendered with known truth (default: left)",
    )
    source.add_argument(
        "--images", nargs="+", type=Path, metavar="PHOTO", help="your own photographs, or folders of them"
    )
    command.add_argument(
        "--board", type=_board_size, default=(9, 6), metavar="CxR", help="inner corners of your board (default: 9x6)"
    )
    command.add_argument(
        "--square", type=float, default=25.0, help="side of a square; its unit is the unit of all results (default: 25)"
    )
    command.add_argument(
        "--distortion", choices=get_args(LensModel), default="brown5", help="the lens that is fitted (default: brown5)"
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
        type=Path,
        default=Path("diffproj-experiment"),
        metavar="FOLDER",
        help="where the files go (default: diffproj-experiment)",
    )
    command.set_defaults(run=_experiment)


def _board_size(text: str) -> tuple[int, int]:
    columns, separator, rows = text.lower().partition("x")
    if not (separator and columns.isdecimal() and rows.isdecimal()):
        raise argparse.ArgumentTypeError(f"want inner corners as COLUMNSxROWS, such as 9x6, got {text!r}")
    return int(columns), int(rows)


def _experiment(options: argparse.Namespace) -> int:
    console = Console(highlight=False)
    views, board, split = _corners(options)
    if options.split is not None:
        split = parse_split(options.split, len(views))
    fit, test = choose(views, split)
    outcome = run_experiment(fit, test, board, options.distortion, options.strict)
    console.print(_table(outcome))
    console.print(outcome.fit.summary(), markup=False)
    options.output.mkdir(parents=True, exist_ok=True)
    write_whole(options.output / "table1.csv", outcome.to_csv())
    write_whole(options.output / "fig7.png", figures.png(figures.fig7(outcome)))
    save_camera(options.output / "camera.json", outcome.fit)
    console.print(f"\nWritten to {options.output}: table1.csv, fig7.png, camera.json", markup=False, soft_wrap=True)
    return 0


def _corners(options: argparse.Namespace) -> tuple[Views, Chessboard, tuple[list[int], list[int]]]:
    """The views, the board and the default split that the options ask for."""
    columns, rows = options.board
    board = Chessboard(columns, rows, options.square, axes="paper")
    if options.images is None and (columns, rows) != (9, 6):
        raise ValueError(f"--board: want 9x6 for --data, got {columns}x{rows}; --images takes your own photographs")
    if options.images is not None:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("Finding corners")
            photos = _photographs(options.images)
            views = detect(photos, board, lambda done, total: progress.update(task, completed=done, total=total))
        return views, board, default_split(len(views))
    if options.data == "synthetic":
        setup = synthetic.paper_setup()
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("Rendering and finding corners")
            photographs = [setup.cameras[i] for i in range(len(setup.names))]
            images = [synthetic.photograph(camera, setup.board, seed=i).numpy() for i, camera in enumerate(photographs)]
            views = detect(images, setup.board, lambda done, total: progress.update(task, completed=done, total=total))
        named = Views(views.pixels, views.visible, setup.names, views.size)
        count = len(setup.fit.R)
        return named, board, (list(range(count)), list(range(count, len(named))))
    views = example_views(options.data)
    return views, board, default_split(len(views))


def _photographs(paths: Sequence[Path]) -> list[Path]:
    """Files as they are, and the photographs in folders, by name."""
    photos: list[Path] = []
    for path in paths:
        inside = sorted(p for p in path.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES) if path.is_dir() else [path]
        if not inside:
            raise ValueError(f"--images: want photographs ({', '.join(PHOTO_SUFFIXES)}), got a folder without: {path}")
        photos += inside
    return photos


def _table(outcome: Experiment) -> Table:
    table = Table(title="Table 1. Errors on the board (world units), mean ± standard deviation")
    table.add_column("view")
    table.add_column("corners", justify="right")
    for axis in ("E_x", "E_y", "E_z"):
        table.add_column(axis, justify="right")
    *rows, total = outcome.rows
    for row in (*rows, total):
        if row is total:
            table.add_section()
        pairs = zip(row.mean, row.deviation, strict=True)
        table.add_row(row.view, str(row.corners), *(_pair(mean, deviation) for mean, deviation in pairs))
    return table


def _pair(mean: float, deviation: float) -> str:
    """Both to four decimals; what is there only by rounding shows its size."""
    return f"{mean:.4f} ± {deviation:.4f}" if mean == 0 or mean >= 5e-5 else f"{mean:.0e} ± {deviation:.0e}"


if __name__ == "__main__":
    sys.exit(main())
