"""`diffproj experiment`: the paper's Table 1 and Fig. 7."""

import argparse
from dataclasses import replace

from rich.markup import escape
from rich.table import Table

from diffproj._core.atomic import write_whole
from diffproj.calibration.results.calibration import CalibrationError
from diffproj.cli.inputs import check_folder, writing
from diffproj.cli.photographs import photographs, search
from diffproj.cli.terminal import RESULTS, as_json, in_options, progress_bars, result, working
from diffproj.cli.units import heading
from diffproj.files.save import save_camera
from diffproj.paper.experiment import Experiment, choose, default_split, parse_split, run_experiment
from diffproj.paper.setup import paper_setup
from diffproj.targets import synthetic
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.examples import example_views
from diffproj.targets.views import Views


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
    with working("Calibrating"):
        outcome = run_experiment(fit, test, board, options.distortion, options.strict)
    outcome = replace(outcome, fit=replace(outcome.fit, unit=options.square.unit))
    with working("Fitting the board's shape"):
        measured, why = _on_the_measured_board(fit, test, board, options)
    files = {"table1.csv": outcome.to_csv().encode()}
    if measured is not None:
        files["table1_measured_board.csv"] = measured.to_csv().encode()
    files["fig7.png"] = figures.png(figures.fig7(outcome))
    with writing("--output", options.output):
        options.output.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_whole(options.output / name, content)
        save_camera(options.output / "camera.json", outcome.fit)
    names = [*files, "camera.json"]
    if options.json:
        as_json(
            {
                "output": str(options.output),
                "files": names,
                "unit": options.square.unit,
                "table": outcome.to_dict(),
                "table_measured_board": None if measured is None else measured.to_dict(),
                "why_no_measured_board": why or None,
                "camera": outcome.fit.to_dict(),
                "warnings": options.warned,
            }
        )
        return 0
    RESULTS.print(_table(outcome, "board as designed"))
    if measured is None:
        result(f"\nThe board as it was printed: {why}")
    else:
        RESULTS.print(_table(measured, "board as printed, its corners where the fitting views have them"))
    result(f"\n{outcome.fit.summary()}")
    result(f"\nWritten to {options.output}: {', '.join(names)}")
    return 0


def _on_the_measured_board(
    fit: Views, test: Views, board: Chessboard, options: argparse.Namespace
) -> tuple[Experiment | None, str]:
    """The same with the board's shape as the fitting views tell it; `None` where they do not, and why."""
    try:
        outcome = run_experiment(fit, test, board, options.distortion, options.strict, "free")
    except CalibrationError as error:
        return None, in_options(str(error))
    return replace(outcome, fit=replace(outcome.fit, unit=options.square.unit)), ""


def _corners(options: argparse.Namespace) -> tuple[Views, Chessboard, tuple[list[int], list[int]]]:
    """The views, the board and the default split that the options ask for."""
    columns, rows = options.board
    board = Chessboard(columns, rows, options.square.value, axes="paper")
    if options.images is None and (columns, rows) != (9, 6):
        raise ValueError(f"--board: want 9x6 for --data, got {columns}x{rows}; --images takes your own photographs")
    if options.images is not None:
        with progress_bars() as bars:
            folders = [path for path in options.images if path.is_dir()]
            views = search(photographs(options.images), board, bars, in_folders=folders).views
        return views, board, default_split(len(views))
    if options.data == "synthetic":
        setup = paper_setup()
        with progress_bars() as bars:
            cameras = [setup.cameras[i] for i in range(len(setup.names))]
            images = [
                synthetic.photograph(camera, setup.board, seed=i).numpy()
                for i, camera in enumerate(bars.track(cameras, description="Rendering"))
            ]
            views = search(images, setup.board, bars).views
        named = Views(views.pixels, views.visible, setup.names, views.size, views.told)
        count = len(setup.fit.R)
        return named, board, (list(range(count)), list(range(count, len(named))))
    views = example_views(options.data)
    return views, board, default_split(len(views))


def _table(outcome: Experiment, board: str) -> Table:
    unit = heading(outcome.fit.unit) or "world units"
    table = Table(title=f"Table 1. Errors on the board ({unit}), mean ± standard deviation; {board}")
    table.add_column("view", overflow="fold")
    table.add_column("corners", justify="right", no_wrap=True)
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
