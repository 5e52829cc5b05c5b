"""`diffproj experiment`: the paper's Table 1 and Fig. 7."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import get_args

from rich.markup import escape
from rich.table import Table

from diffproj._core.atomic import write_whole
from diffproj.cli.inputs import board_size, check_folder, some_path
from diffproj.cli.photographs import find_corners, photographs
from diffproj.cli.terminal import RESULTS, progress_bars, result
from diffproj.cli.units import Square, heading, square_side
from diffproj.files.save import save_camera
from diffproj.lens.models import LensModel
from diffproj.paper.experiment import Experiment, choose, default_split, parse_split, run_experiment
from diffproj.paper.setup import paper_setup
from diffproj.targets import synthetic
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.examples import example_views
from diffproj.targets.views import Views

DESCRIPTION = (
    "Calibrates a camera from views of a chessboard, finds the pose of each test view, puts every corner of it back on "
    "the board's plane and compares it with its known place. Prints Table 1 and writes table1.csv, fig7.png and "
    "camera.json (the whole calibration) to the output folder."
)


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    command.description = DESCRIPTION
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
        default=Square(25.0, "mm"),
        metavar="SIDE",
        help="side of a square, such as 25mm or 1in; its unit is that of all results (default: 25mm)",
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
        type=some_path,
        default=Path("diffproj-experiment"),
        metavar="FOLDER",
        help="where the files go (default: diffproj-experiment)",
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    from diffproj import figures  # here, for matplotlib takes long to load; first of all, for it may be missing

    check_folder("--output", options.output)
    views, board, split = _corners(options)
    if options.split is not None:
        try:
            split = parse_split(options.split, len(views))
        except ValueError as error:
            raise ValueError(f"--{error}") from None
    fit, test = choose(views, split)
    outcome = run_experiment(fit, test, board, options.distortion, options.strict)
    outcome = replace(outcome, fit=replace(outcome.fit, unit=options.square.unit))
    RESULTS.print(_table(outcome))
    result(f"\n{outcome.fit.summary()}")
    options.output.mkdir(parents=True, exist_ok=True)
    write_whole(options.output / "table1.csv", outcome.to_csv())
    write_whole(options.output / "fig7.png", figures.png(figures.fig7(outcome)))
    save_camera(options.output / "camera.json", outcome.fit)
    result(f"\nWritten to {options.output}: table1.csv, fig7.png, camera.json")
    return 0


def _corners(options: argparse.Namespace) -> tuple[Views, Chessboard, tuple[list[int], list[int]]]:
    """The views, the board and the default split that the options ask for."""
    columns, rows = options.board
    board = Chessboard(columns, rows, options.square.side, axes="paper")
    if options.images is None and (columns, rows) != (9, 6):
        raise ValueError(f"--board: want 9x6 for --data, got {columns}x{rows}; --images takes your own photographs")
    if options.images is not None:
        with progress_bars() as bars:
            views = find_corners(photographs(options.images), board, bars)
        return views, board, default_split(len(views))
    if options.data == "synthetic":
        setup = paper_setup()
        with progress_bars() as bars:
            cameras = [setup.cameras[i] for i in range(len(setup.names))]
            images = [
                synthetic.photograph(camera, setup.board, seed=i).numpy()
                for i, camera in enumerate(bars.track(cameras, description="Rendering"))
            ]
            views = find_corners(images, setup.board, bars)
        named = Views(views.pixels, views.visible, setup.names, views.size)
        count = len(setup.fit.R)
        return named, board, (list(range(count)), list(range(count, len(named))))
    views = example_views(options.data)
    return views, board, default_split(len(views))


def _table(outcome: Experiment) -> Table:
    unit = heading(outcome.fit.unit) or "world units"
    table = Table(title=f"Table 1. Errors on the board ({unit}), mean ± standard deviation")
    table.add_column("view", overflow="fold")
    table.add_column("corners", justify="right")
    for axis in ("E_x", "E_y", "E_z"):
        table.add_column(axis, justify="right", no_wrap=True)
    *rows, total = outcome.rows
    for row in (*rows, total):
        if row is total:
            table.add_section()
        pairs = zip(row.mean, row.deviation, strict=True)
        table.add_row(escape(row.view), str(row.corners), *(_pair(mean, deviation) for mean, deviation in pairs))
    return table


def _pair(mean: float, deviation: float) -> str:
    """Both to four decimals; what is there only by rounding shows its size."""
    return f"{mean:.4f} ± {deviation:.4f}" if mean == 0 or mean >= 5e-5 else f"{mean:.0e} ± {deviation:.0e}"
