"""What commands say and where: results on standard output, progress, warnings and failures on standard error."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from diffproj.calibration import CalibrationError, Status

RESULTS = Console(highlight=False, emoji=False)
NOTES = Console(stderr=True, highlight=False, emoji=False)


def note(text: str) -> None:
    """One line on standard error, however long."""
    NOTES.print(f"diffproj: {text}", markup=False, soft_wrap=True)


def result(text: str) -> None:
    """A line on standard output; what holds a path is not broken."""
    RESULTS.print(text, markup=False, soft_wrap=True)


def failure(error: Exception) -> str:
    """An error as one line that fits the command line."""
    if isinstance(error, CalibrationError) and error.calibration is not None:
        found = error.calibration
        if bool((found.status == Status.MAX_ITERATIONS).any()):
            return (
                f"--distortion: the error was still falling after {int(found.iterations.max())} steps; choose a lens "
                "with fewer coefficients, add photographs, or look for mixed-up corners"
            )
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
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
