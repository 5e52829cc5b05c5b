"""Running a command: its warnings and failures as one line each on standard error, and the exit code."""

import argparse
import warnings

from diffproj.calibration.ambiguity import AmbiguousPoseWarning
from diffproj.calibration.result import CalibrationError
from diffproj.cli.terminal import failure, note
from diffproj.targets.detection import BoardNotFoundWarning


def run(options: argparse.Namespace) -> int:
    """Run the command that was understood; returns the exit code."""
    try:
        with warnings.catch_warnings():
            for kind in (AmbiguousPoseWarning, BoardNotFoundWarning):
                warnings.simplefilter("always", kind)
            warnings.showwarning = lambda message, *_: note(str(message))
            return options.run(options)
    except (ValueError, OSError, CalibrationError) as error:
        note(failure(error))
        return 1
    except KeyboardInterrupt:
        note("interrupted")
        return 130
