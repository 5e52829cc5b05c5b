"""`diffproj calibrate --fleet`: every camera of a folder of folders, a line of JSON each.

Workers search the photographs, a camera a task; the cameras that come are calibrated here in batches of like ones while
the others are searched.
"""

import argparse
import os
import re
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from diffproj.calibration.calibrate import calibrate_and_tell
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.cli.fleet_file import append, done_before, leave_out_replaced, line_of
from diffproj.cli.fleet_folder import Folder, Searched, on_one_core, searched, state_of
from diffproj.cli.inputs import check_writable, writing
from diffproj.cli.terminal import RESULTS, as_json, counted, failure, in_words, note, progress_bars, result
from diffproj.cli.units import Length
from diffproj.cli.which_board import KINDS, NEEDS, TAKES, given_board
from diffproj.targets.boards import Board
from diffproj.targets.tasks import as_done

TOGETHER = 32
"""Cameras that are calibrated at once, and lost if the run is killed before."""
WORST = 10
"""Cameras in the table."""
CONNECTS = 10
"""Seconds in which a scheduler must answer."""


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    begin = time.perf_counter()
    check_writable("--output", options.output)
    board, side, _ = given_board(options)
    folders = _folders(options.fleet)
    asked = _asked(options)
    states = {folder.name: state_of(folder) for folder in folders}  # before any is searched: later ones count as new
    done, changed = done_before(options.output, asked, states)
    lines = [done[folder.name] for folder in folders if folder.name in done]
    left = [folder for folder in folders if folder.name not in done]
    if lines:
        note(f"{counted(len(lines), 'camera')} of {len(folders)} done before, by {options.output}")
    unread = [name for name in done if not states.get(name, "?")]
    if unread:
        which = ", ".join(unread[:WORST]) + f" and {len(unread) - WORST} more" * (len(unread) > WORST)
        note(f"{which}: cannot be looked into now; what {options.output} says stays")
    if changed:
        which = ", ".join(changed[:WORST]) + f" and {len(changed) - WORST} more" * (len(changed) > WORST)
        note(f"{which}: photographs were added, removed or changed since {options.output} was written; done anew")
    with progress_bars() as bars, _workers(options, len(left)) as executor:
        task = bars.add_task("Calibrating", total=len(folders), completed=len(lines))
        waiting: list[tuple[str, Searched]] = []
        work = [Folder(folder, board, options.orientation) for folder in left]

        def keep() -> None:
            """Calibrate the cameras that came, and write their lines."""
            new = _calibrated(waiting, board, options, asked, states, side.unit)
            with writing("--output", options.output):
                append(options.output, new)
            lines.extend(new)
            waiting.clear()
            bars.update(task, completed=len(lines))

        try:
            for number, (place, one) in enumerate(as_done(searched, work, executor), start=1):
                waiting.append((left[place].name, one))
                if len(waiting) == TOGETHER or number == len(left):
                    keep()
        except Exception as error:
            if not _was_killed(error):
                raise
            if waiting:
                keep()
            raise ChildProcessError(_about_killed(options, len(lines), len(folders))) from error
    if changed:
        with writing("--output", options.output):
            leave_out_replaced(options.output)
    _tell(options, lines, len(left), time.perf_counter() - begin, side.unit)
    return 0 if any("camera" in line for line in lines) else 1


def _folders(fleet: Path) -> list[Path]:
    """The folders in a folder, in natural order.

    Raises:
        ValueError: there is no such folder, or none in it.
    """
    if not fleet.is_dir():
        raise ValueError(f"--fleet: want a folder with a folder of photographs for each camera, got {fleet}")
    found = [folder for folder in fleet.iterdir() if folder.is_dir() and not folder.name.startswith(".")]
    if not found:
        raise ValueError(f"--fleet: want a folder of photographs for each camera in {fleet}, found no folder in it")
    parts = {folder: re.split(r"(\d+)", folder.name) for folder in found}
    return sorted(found, key=lambda folder: [int(p) if p.isdecimal() else p for p in parts[folder]])


def _asked(options: argparse.Namespace) -> dict[str, Any]:
    """The options that a camera depends on, as plain values."""
    about_board = dict.fromkeys(name for names in (KINDS, *NEEDS.values(), *TAKES.values()) for name in names)
    names = (*about_board, "shape", "distortion", "skew", "reject_outliers", "orientation")
    values = {name: getattr(options, name) for name in names}
    return {name: _plain(value) for name, value in values.items() if value is not None and value is not False}


def _plain(value: Any) -> bool | str:
    """An option as it is kept and told; lengths keep all their digits."""
    if isinstance(value, Length):
        return f"{repr(value.value).removesuffix('.0')}{value.unit or ''}"
    if isinstance(value, tuple):
        return "x".join(map(str, value))
    return value if isinstance(value, bool) else str(value)


@contextmanager
def _workers(options: argparse.Namespace, cameras: int) -> Iterator[Executor | None]:
    """What searches the photographs: a cluster, or processes; nothing where there is one to be, for this one does."""
    if options.dask is not None:
        try:
            from distributed import Client
        except ImportError:
            raise ValueError("--dask: want the package distributed; pip install 'diffproj[dask]'") from None
        try:
            client = Client(options.dask, timeout=CONNECTS)
        except (OSError, ValueError) as error:
            raise ValueError(
                f"--dask: want the address of a scheduler that answers, such as tcp://host:8786, got {options.dask}: "
                f"no answer in {CONNECTS} s, or none that is one; is it running, and can it be reached from here?"
            ) from error
        with client:
            yield client.get_executor()
        return
    count = min(options.workers or os.cpu_count() or 1, cameras)
    if count <= 1:
        yield None
        return
    pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=on_one_core)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _was_killed(error: Exception) -> bool:
    """Whether a process that searched photographs was ended from outside; on a cluster, those that tried in turn."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"


def _about_killed(options: argparse.Namespace, done: int, cameras: int) -> str:
    """What ended a run, what is kept of it, and what to do."""
    fewer = (
        "a smaller --workers, or smaller photographs, need less" if options.dask is None else "give workers more of it"
    )
    kept = "no camera is done yet"
    if done:
        held = f"{options.output} holds {counted(done, 'camera')} of {cameras}"
        kept = f"{held}, and the same command goes on from there"
    return f"a process that searched photographs was killed, as happens where memory runs out: {fewer}; {kept}"


def _calibrated(
    cameras: list[tuple[str, Searched]],
    board: Board,
    options: argparse.Namespace,
    asked: dict[str, Any],
    states: dict[str, str],
    unit: str | None,
) -> list[dict[str, Any]]:
    """The lines of cameras that were searched."""
    begin = time.perf_counter()
    views = {name: one.views for name, one in cameras if one.views is not None}
    choices: dict[str, Any] = {name: getattr(options, name) for name in ("shape", "skew", "reject_outliers")}
    try:
        found = calibrate_and_tell(list(views.values()), board, options.distortion, **choices) if views else []
        ends: dict[str, Calibration | CalibrationError | ValueError] = dict(zip(views, found, strict=True))
    except ValueError as error:  # what speaks against every one of them
        ends = dict.fromkeys(views, error)
    each = (time.perf_counter() - begin) / max(1, len(views))
    lines = []
    for name, one in cameras:
        begin = time.perf_counter()
        end = ends.get(name, ValueError(one.error))
        said = replace(end, unit=unit) if isinstance(end, Calibration) else failure(end)
        line = line_of(name, asked, states[name], one, said, each)
        line["seconds"]["report"] = round(time.perf_counter() - begin, 4)
        lines.append(line)
    return lines


def _tell(options: argparse.Namespace, lines: list[dict[str, Any]], new: int, seconds: float, unit: str | None) -> None:
    """What came of it: how many, the worst, and the time by stage."""
    good = [line for line in lines if "camera" in line]
    failed = [line for line in lines if "camera" not in line]
    stages = {
        stage: sum(line["seconds"].get(stage, 0.0) for line in lines[len(lines) - new :])
        for stage in ("search", "calibration", "report")
    }
    worst = sorted(good, key=lambda line: (line["verdict"].startswith("Good"), -line["summary"]["rms"]))[:WORST]
    if options.json:
        document = {
            "cameras": len(lines),
            "calibrated": len(good),
            "failed": {line["name"]: line["error"] for line in failed},
            "worst": [{"name": w["name"], "verdict": in_words(w["verdict"], unit), **w["summary"]} for w in worst],
            "seconds": {"elapsed": round(seconds, 3), **{name: round(value, 3) for name, value in stages.items()}},
            "unit": unit,
            "notes": {line["name"]: line["notes"] for line in lines if line["notes"]},
            "output": str(options.output),
            "warnings": options.warned,
        }
        as_json(document)
        return
    if worst:
        table = Table(title="The worst", title_justify="left")
        for title in ("camera", "views", "RMS in px", "f_x in px", "verdict"):
            words = title in ("camera", "verdict")
            table.add_column(title, overflow="fold", justify="left" if words else "right", no_wrap=not words)
        for line in worst:
            found = line["summary"]
            sure = f"{found['f_x']:.1f} ± {found['f_x_deviation']:.1f}"
            views = f"{found['views']} of {line['photographs']}"
            verdict = in_words(line["verdict"].partition(". ")[0], unit)
            table.add_row(escape(line["name"]), views, f"{found['rms']:.4f}", sure, escape(verdict))
        RESULTS.print(table)
    for line in failed:
        result(f"{line['name']}: {line['error']}")
    noted = [line["name"] for line in good if line["notes"]]
    if noted:
        which = ", ".join(noted[:WORST]) + f" and {len(noted) - WORST} more" * (len(noted) > WORST)
        result(f'Notes on photographs of {which}: see "notes" in the file')
    result(
        f"\n{counted(len(good), 'camera')} calibrated, {len(failed)} failed, in {seconds:.1f} s; seconds of work: "
        f"{stages['search']:.1f} to search, {stages['calibration']:.1f} to calibrate, {stages['report']:.1f} to report"
    )
    result(f"Written to {options.output}; dp.load_calibration({str(options.output)!r}, camera=...) reads one")
    if failed:  # the exit code is 0 where others did not
        result(f'{len(failed)} of {counted(len(lines), "camera")} failed: see "error" in the file, or above')
