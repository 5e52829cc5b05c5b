"""What commands say and where: results on standard output, progress, warnings and failures on standard error."""

import math
import re
from collections.abc import Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from diffproj.calibration.result import CalibrationError
from diffproj.calibration.solver import Status

RESULTS = Console(highlight=False, emoji=False)
NOTES = Console(stderr=True, highlight=False, emoji=False)

HUGE = 1e5
"""Standard deviation from which numbers are shown with a power of ten, as for points close to the horizon."""


REMEDIES = {
    FileNotFoundError: "; check its name and its folder",
    IsADirectoryError: "; want a file in its place",
    PermissionError: "; choose another place, or change who may use it",
}
"""What to do about errors of the system."""


def note(text: str) -> None:
    """One line on standard error, however long."""
    NOTES.print(f"diffproj: {text}", markup=False, soft_wrap=True)


def result(text: str) -> None:
    """A line on standard output; what holds a path is not broken."""
    RESULTS.print(text, markup=False, soft_wrap=True)


def counted(count: int, thing: str) -> str:
    """`1 file`, `2 files`."""
    return f"{count} {thing}" + "s" * (count != 1)


def in_options(text: str) -> str:
    """What the library says, with the command's options in place of Python's, and without what it has not."""
    text = re.sub(r"^(calibrate|refine|locate|measure): ", "", text)
    text = re.sub(r", or (let fixed or priors hold|fix) the principal point and the lens( \([^)]*\))?", "", text)
    return (
        text.replace("distortion=", "--distortion ")
        .replace("shape=", "--shape ")
        .replace("skew=True", "--skew")
        .replace("reject_outliers=True", "--reject-outliers")
        .replace("'auto'", "auto")
        .replace("give legacy=True", "give --legacy")
        .replace("give legacy=False", "leave --legacy out")
    )


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
    return " ".join(str(error).split())


def progress_bars() -> Progress:
    """Bars that vanish when done; nothing where standard error is no terminal."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=NOTES,
        transient=True,
        disable=not NOTES.is_terminal,
    )


def rounded(value: float, deviation: float) -> tuple[str, str]:
    """A value and its standard deviation, both to the second digit of the standard deviation."""
    if not (math.isfinite(deviation) and deviation > 0):
        return f"{value:.6g}", "unknown"
    if deviation >= HUGE:
        return f"{value:.2e}", f"{deviation:.1e}"
    decimals = max(0, 1 - math.floor(math.log10(deviation)))
    return f"{value:.{decimals}f}", f"{deviation:.{decimals}f}"


def aligned(numbers: Sequence[str]) -> list[str]:
    """Numbers with their decimal points below each other."""
    width = max(len(number.partition(".")[0]) for number in numbers)
    return [" " * (width - len(number.partition(".")[0])) + number for number in numbers]
