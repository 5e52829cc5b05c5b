"""`diffproj calibrate`: from photographs of a board to a camera file."""

import argparse
import textwrap
from dataclasses import replace

from rich.markup import escape
from rich.table import Table

from diffproj.calibration.calibrate import calibrate
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.results.account import SENTENCES, told_of
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.validation import CrossValidation, cross_validate
from diffproj.cli.calibrate_document import document
from diffproj.cli.drawing import check_drawing, check_no_photograph, write_drawing
from diffproj.cli.inputs import check_writable, writing
from diffproj.cli.photographs import photographs, search
from diffproj.cli.reporting import check_report, kept_for, report_text, write_page
from diffproj.cli.terminal import (
    RESULTS,
    aligned,
    as_json,
    detail,
    in_words,
    progress_bars,
    result,
    rounded,
    sentence,
    working,
)
from diffproj.cli.which_board import given_board
from diffproj.files.save import save_camera
from diffproj.lens.models import model_of


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    check_writable("--output", options.output)
    check_drawing(options.draw)
    check_report(options.report)
    board, side, _ = given_board(options)
    sources = photographs(options.photographs, options.frames)
    check_no_photograph(options.draw, sources)
    lens = {"shape": options.shape, "skew": options.skew, "reject_outliers": options.reject_outliers}
    with progress_bars() as bars:
        folders = [path for path in options.photographs if path.is_dir()]
        kept = kept_for(options.report, len(sources), board)
        found = search(sources, board, bars, orientation=options.orientation, in_folders=folders, beside=kept)
        views = found.views
        if options.folds is not None and options.folds > len(views):
            raise ValueError(f"--folds: want at most the number of views, {len(views)}, got {options.folds}")
        task = bars.add_task("Solving", total=None)
        calibration = calibrate(
            views,
            board,
            options.distortion,
            progress=lambda done, total: bars.update(task, completed=done, total=total),
            **lens,
        )
    detail(f"Solving: {calibration.message}")
    calibration = replace(calibration, unit=side.unit)
    folds = None
    if options.folds is not None:
        with working("Leaving views out"):
            model = model_of(calibration.camera.distortion).name
            folds = cross_validate(views, board, model, options.folds, **lens)
    page = ""
    if options.report is not None:
        with working("Writing the report"):
            page = report_text(calibration, options, found, board, folds)
    try:
        _write(options, calibration, page)
    except OSError:
        if not options.json:  # what took long to find is not lost
            _say(calibration, folds, options.reject_outliers)
        raise
    # Written before it is told: who reads only the first lines has the file.
    if options.json:
        as_json(document(options, calibration, folds))
        return 0
    _say(calibration, folds, options.reject_outliers)
    lost = "; the unit, the poses and the error bars are read from a .json file only"
    result(f"\nWritten to {options.output}{'' if options.output.suffix.lower() == '.json' else lost}")
    if options.draw is not None:
        result(f"Drawn to {options.draw}")
    if options.report is not None:
        result(f"Report in {options.report}, for any browser")
    return 0


def _write(options: argparse.Namespace, calibration: Calibration, page: str) -> None:
    """Write the files, with the report where one is asked for.

    Raises:
        OSError: one cannot be written.
    """
    if options.draw is not None:
        from diffproj import figures  # here, for it loads matplotlib

        write_drawing(options.draw, figures.corners(calibration))
    with writing("--output", options.output):
        save_camera(options.output, calibration)
    if options.report is not None:
        write_page(options.report, page)


def _say(calibration: Calibration, folds: CrossValidation | None, reject_outliers: bool) -> None:
    """Print what was found."""
    if calibration.comparison is not None:
        result(f"Lenses compared\n{calibration.comparison.summary()}\n")
    RESULTS.print(_views_table(calibration))
    result("")
    RESULTS.print(_parameters_table(calibration))
    if folds is not None:
        result(f"\nErrors on views left out; world: {calibration.unit or 'the unit of --square'} on the board")
        result(folds.summary())
    _say_how_it_ended(calibration, reject_outliers)


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
    names = calibration.parameters.few_names
    known = calibration.covariance.deviations
    pairs = [
        rounded(value, float(known[name])) for name, value in zip(names, calibration.shared.tolist(), strict=False)
    ]
    table = Table(title="Camera", title_justify="left")
    table.add_column("parameter")
    table.add_column("value", no_wrap=True)
    table.add_column("standard deviation", no_wrap=True)
    for name, *pair in zip(names, *(aligned(column) for column in zip(*pairs, strict=True)), strict=True):
        table.add_row(_title(name, calibration.unit), *pair)
    if calibration.displacements is not None:
        off, sure = (part.square().mean(0).sqrt() for part in (calibration.displacements, calibration.points_deviation))
        for axis, *pair in zip("xyz", off.tolist(), sure.tolist(), strict=True):
            title = f"board's corners off the grid along {axis} (RMS), {calibration.unit or 'unit of --square'}"
            table.add_row(title, *rounded(*pair))
    return table


def _title(name: str, unit: str | None) -> str:
    """What a parameter is, with its unit."""
    if name.startswith("bow"):
        return f"board's bow along {name[-1]}, {unit or 'unit of --square'}"
    if name == "skew":
        return "skew, px"
    titles = {"f": "focal length {}, px", "c": "principal point {}, px"}
    return titles.get(name[0], "lens {}").format(name)


def _say_how_it_ended(calibration: Calibration, reject_outliers: bool) -> None:
    corners, views = int(calibration.used.sum()), int(calibration.used.any(-1).sum())
    result(f"\nRMS reprojection error {float(calibration.rms):.4f} px over {corners} corners in {views} views")
    if reject_outliers:
        count = int(calibration.rejected.sum())
        result(f"{count or 'no'} corner{'s' * (count > 1)} rejected as outlier{'s' * (count > 1)}".capitalize())
    result(f"Solver {SENTENCES[Status.CONVERGED]}")  # else there is a failure in its place
    for remark in told_of(calibration):
        result(textwrap.fill(sentence(in_words(remark, calibration.unit)), 79))
    result("\n" + textwrap.fill(in_words(calibration.verdict, calibration.unit), 79))
