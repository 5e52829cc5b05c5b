"""Running a command: its warnings and failures as one line each on standard error, and the exit code."""

import argparse
import warnings

from diffproj.calibration.result import CalibrationError
from diffproj.cli.terminal import failure, in_options, note


def run(options: argparse.Namespace) -> int:
    """Run the command that was understood; returns the exit code.

    What was warned of is in `options.warned`, for documents that hold all that was said.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            options.warned = []
            warnings.showwarning = lambda message, *_: _warn(options.warned, in_options(str(message)))
            return options.run(options)
    except (ValueError, OSError, CalibrationError) as error:
        note(failure(error))
        return 1
    except KeyboardInterrupt:
        note("interrupted")
        return 130


def _warn(warned: list[str], text: str) -> None:
    warned.append(text)
    note(text)
