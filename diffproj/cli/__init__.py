"""The `diffproj` command: joins calibration, measurement, experiment, figures and files.

Each command is two modules: its command line, with `add_options`, and its work, with `run`, which is imported only when
the command line was understood. So help and mistakes wait neither for PyTorch nor for other commands.

Exit codes: 0 done, 1 the work failed (one line says what and what to do), 2 the command was not understood, 130
interrupted from the keyboard.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from importlib import import_module

from diffproj import __version__

COMMANDS = {
    "board": "write a page with a board to print at true scale",
    "calibrate": "find a camera from photographs of a board, and write a camera file",
    "measure": "measure points, lengths and an area on a plane in a photograph, with error bars",
    "locate": "find where a camera stood from surveyed landmarks that a photograph shows",
    "convert": "turn a camera file of one program into that of another",
    "info": "tell what is in a camera file, and whether it can be right",
    "experiment": "calibrate, put corners back on the board, and print the errors (the paper's Table 1 and Fig. 7)",
}
"""What each command does; the module of its command line has its name."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["help"]:  # `diffproj help measure` is `diffproj measure --help`
        given = [*given[1:], "--help"]
    options = _parser(given).parse_args(shielded(given))
    if "check" in options:  # what options mean together
        options.check(options)
    from diffproj.cli.running import run

    return run(options)


def shielded(arguments: Sequence[str]) -> list[str]:
    """Put a space before lists of numbers such as `-5,3`, so that argparse does not take them for options.

    A single negative number needs no shield.
    """
    return [f" {text}" if re.match(r"-[.\d][^,]*,", text) else text for text in arguments]


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of the command line, with the options of the command that is called."""
    parser = argparse.ArgumentParser(
        prog="diffproj",
        description="Pixels of one calibrated camera to world coordinates on known planes.",
        epilog="'diffproj help COMMAND' tells more about a command.",
    )
    parser.add_argument("--version", action="version", version=f"diffproj {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    called = next((text for text in arguments if not text.startswith("-")), None)
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary)
        if name == called:
            import_module(f"diffproj.cli.{name}").add_options(command)
    return parser
