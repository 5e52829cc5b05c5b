"""The `diffproj` command: joins calibration, measurement, experiment, figures and files.

Exit codes: 0 done, 1 the work failed (one line says what and what to do), 2 the command was not understood, 130
interrupted from the keyboard.
"""

import argparse
import sys
import warnings
from collections.abc import Sequence

from diffproj.calibration.result import CalibrationError
from diffproj.cli import calibrate, experiment, measure
from diffproj.cli.inputs import shielded
from diffproj.cli.terminal import failure, note
from diffproj.targets.detection import BoardNotFoundWarning


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    options = _parser().parse_args(shielded(sys.argv[1:] if arguments is None else arguments))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", BoardNotFoundWarning)
            warnings.showwarning = lambda message, *_: note(str(message))
            return options.run(options)
    except (ValueError, OSError, CalibrationError) as error:
        note(failure(error))
        return 1
    except KeyboardInterrupt:
        note("interrupted")
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="diffproj",
        description="Pixels of one calibrated camera to world coordinates on known planes.",
        epilog="'diffproj COMMAND --help' tells more about a command.",
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    calibrate.add_command(commands)
    measure.add_command(commands)
    experiment.add_command(commands)
    return parser
