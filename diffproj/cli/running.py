"""Running a command: its warnings and failures as one line each on standard error, and the exit code."""

import argparse
import io
import os
import sys
import traceback
import warnings
from importlib import import_module
from pathlib import Path

from diffproj.calibration.results.calibration import CalibrationError
from diffproj.cli.terminal import NOTES, VOICE, alert, failure, in_options, speak


def run(options: argparse.Namespace) -> int:
    """Run the command that was understood; returns the exit code.

    What was warned of is in `options.warned`, for documents that hold all that was said.
    """
    for stream in (sys.stdout, sys.stderr):  # a terminal that has no ± shows a question mark
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # of a damaged video one line of ours says it
    speak(options.quiet, options.verbose)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            options.warned = []
            warnings.showwarning = lambda message, *_: _warn(options.warned, in_options(str(message)))
            return import_module(f"diffproj.cli.{options.work}").run(options)
    except (ValueError, OSError, CalibrationError) as error:
        _say_where(error)
        alert(failure(error))
        return 1
    except KeyboardInterrupt:
        alert("interrupted")
        return 130
    except ImportError:  # of what the command line needs, see `__main__`
        raise
    except Exception as error:  # a mistake of ours; who calls the command has no use for its traceback
        *_, (frame, line) = traceback.walk_tb(error.__traceback__)
        where = f"{Path(frame.f_code.co_filename).name}:{line}"
        _say_where(error)
        alert(f"unexpected {type(error).__name__} at {where}: {failure(error)}; please report it with the command")
        return 1


def _warn(warned: list[str], text: str) -> None:
    """Say a warning, once."""
    if text not in warned:
        warned.append(text)
        alert(text)


def _say_where(error: Exception) -> None:
    """Of a failure all that Python knows, where the command is to be verbose."""
    if VOICE.verbose:
        NOTES.print("".join(traceback.format_exception(error)), markup=False, soft_wrap=True, end="")
