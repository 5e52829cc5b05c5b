"""What commands say and where: results on standard output, progress, warnings and failures on standard error."""

import json
import math
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column, Table

from diffproj._core import shown
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.results.calibration import CalibrationError
from diffproj.cli.command_line import leave_output

LEAST = 16
"""Characters that a column of words has at most in a table that is wider than the terminal."""


class _Results(Console):
    """Standard output: what it does not take is a failure of the command."""

    def print(self, *arguments: Any, **options: Any) -> None:
        for table in (one for one in arguments if isinstance(one, Table)):
            _keep_whole(table, self.width)
            options["crop"] = False
        try:
            super().print(*arguments, **options)
        except OSError as error:
            leave_output()
            raise OSError(f"standard output: {error.strerror}; send it elsewhere") from error


def _keep_whole(table: Table, width: int) -> None:
    """Let a table be wider than the terminal where columns that are not to be wrapped, as of numbers, take more."""

    def room(column: Column) -> int:
        cells = [str(cell) for cell in (column.header, *column.cells)]
        if column.no_wrap:
            return max(map(cell_len, cells))
        words = [cell_len(word) for cell in cells for word in cell.split()]
        return min(max(words, default=1), LEAST)

    needed = 1 + sum(3 + room(column) for column in table.columns)
    if needed > width:
        table.width = needed


RESULTS = _Results(highlight=False, emoji=False)
NOTES = Console(stderr=True, highlight=False, emoji=False)

WORDS = (
    (r"^(calibrate|refine|locate|measure): ", ""),
    (r", or (let fixed or priors hold|fix) the principal point and the lens( \([^)]*\))?", ""),
    (r", or give priors=\{[^}]*\}( where it is known roughly)?", ""),
    (r"priors=\{[^}]*\} or (other views)", r"\1"),
    (r"; or say how well the target was printed, such as priors=\{[^}]*\}", ""),
    (r": fixed=\([^)]*\) fits as well", ""),
    (r"; fix (it|them), or take a simpler lens", "; take a simpler lens"),
    (r"\b(distortion|shape|orientation)=(['\"]?)(\w*)\2", r"--\1 \3"),
    (r"'(none|brown\d+|fisheye|auto)'", r"\1"),
    (r"\bpaper=\((\d+), (\d+)\)", r"--paper \1,\2"),
    (r"\bformat='", "--to '"),
    (r"\bpixel_sigma=", "--pixel-sigma "),
    (r"\bskew=True", "--skew"),
    (r"\breject_outliers=True with pixel_sigma", "--reject-outliers with --pixel-sigma"),
    (r"\breject_outliers=True", "--reject-outliers"),
    (r"give legacy=True", "give --legacy"),
    (r"give legacy=False", "leave --legacy out"),
    (r"give Chessboard\((\d+), (\d+), \.\.\.\)", r"give --board \1x\2"),
    (r"\bCheck target, and that", "Check the board's options, and that"),
)
"""What the library says, as patterns, and what the command line says in its place."""


@dataclass
class Voice:
    """How much is said on standard error, from when on."""

    quiet: bool = False
    verbose: bool = False
    began: float = field(default_factory=time.monotonic)


VOICE = Voice()
"""Of the command that runs; see `speak`."""

HUGE = 1e5
"""Standard deviation from which numbers are shown with a power of ten, as for points close to the horizon."""


REMEDIES = {
    FileNotFoundError: "; check its name and its folder",
    IsADirectoryError: "; want a file in its place",
    PermissionError: "; choose another place, or change who may use it",
}
"""What to do about errors of the system."""


def speak(quiet: bool = False, verbose: bool = False) -> None:
    """Say how much is to be said from now on."""
    VOICE.quiet, VOICE.verbose, VOICE.began = quiet, verbose, time.monotonic()


def alert(text: str) -> None:
    """A warning or a failure: one line on standard error, however long."""
    NOTES.print(f"diffproj: {text}", markup=False, soft_wrap=True)


def note(text: str) -> None:
    """What is good to know: one line on standard error, unless the command is to be quiet."""
    if not VOICE.quiet:
        alert(text)


def detail(text: str) -> None:
    """What was done, and when: one line on standard error, where the command is to be verbose."""
    if VOICE.verbose:
        alert(f"{time.monotonic() - VOICE.began:.2f} s: {text}")


def as_json(told: Mapping[str, Any]) -> None:
    """One JSON document on standard output; numbers that are not finite are not known, and `null`."""
    result(json.dumps(_finite(told), indent=1, allow_nan=False))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return known(value) if isinstance(value, float) else value


def known(number: float) -> float | None:
    """A number as a JSON document has it: `None` where it is not known."""
    return number if math.isfinite(number) else None


def result(text: str) -> None:
    """A line on standard output; what holds a path is not broken."""
    RESULTS.print(text, markup=False, soft_wrap=True)


def counted(count: int, thing: str) -> str:
    """`1 file`, `2 files`."""
    return f"{count} {thing}" + "s" * (count != 1)


def in_options(text: str) -> str:
    """What the library says, with the command's options in place of Python's, and without what it has not."""
    for python, option in WORDS:
        text = re.sub(python, option, text)
    return text


def in_words(text: str, unit: str | None) -> str:
    """What the library says of results, with the command's options, and with the world's unit by its name."""
    text = in_options(text)
    return text if unit is None else text.replace("world units", unit)


def sentence(text: str) -> str:
    """A remark with a capital letter, unless it begins with the name of a parameter, such as k1 or f_x."""
    return text if re.match(r"[a-z]+\d|[a-z]+_[xy]\b", text) else text[:1].upper() + text[1:]


def failure(error: Exception) -> str:
    """An error as one line that fits the command line."""
    if isinstance(error, CalibrationError) and error.calibration is not None:
        found = error.calibration
        if bool((found.status == Status.MAX_ITERATIONS).any()):
            return (
                f"--distortion: the error was still falling after {int(found.iterations.max())} steps; choose a lens "
                "with fewer coefficients, add photographs, or look for mixed-up corners"
            )
        return in_options(" ".join(str(error).split()))
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}" + REMEDIES.get(type(error), "")
    return in_options(" ".join(str(error).split()))


def progress_bars() -> Progress:
    """Bars that vanish when done; nothing where standard error is no terminal, or the command is to be quiet."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=NOTES,
        transient=True,
        disable=VOICE.quiet or not NOTES.is_terminal,
    )


@contextmanager
def working(title: str) -> Iterator[None]:
    """A bar under which work is done whose end is not known."""
    with progress_bars() as bars:
        bars.add_task(title, total=None)
        yield
    detail(f"{title}: done")


def rounded(value: float, deviation: float) -> tuple[str, str]:
    """A value and its standard deviation, both to the second digit of the standard deviation."""
    if not (math.isfinite(deviation) and deviation > 0):
        return shown.plain(value), "unknown"
    if deviation >= HUGE:
        return f"{value:.2e}", f"{deviation:.1e}"
    return shown.rounded(value, deviation)


def aligned(numbers: Sequence[str]) -> list[str]:
    """Numbers with their decimal points below each other."""
    width = max(len(number.partition(".")[0]) for number in numbers)
    return [" " * (width - len(number.partition(".")[0])) + number for number in numbers]
