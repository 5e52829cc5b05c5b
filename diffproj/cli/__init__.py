"""The `diffproj` command: joins calibration, measurement, experiment, figures and files.

Each command is two modules: its command line, with `add_options`, and its work, with `run`, which is imported only when
the command line was understood. So help and mistakes wait neither for PyTorch nor for other commands.

Exit codes: 0 done, 1 the work failed (one line says what and what to do), 2 the command was not understood, 130
interrupted from the keyboard. A command whose output is no longer read ends without a word, with 1.
"""

import os
import re
import sys
from argparse import RawDescriptionHelpFormatter
from collections.abc import Sequence
from importlib import import_module

from diffproj import __version__
from diffproj.cli.command_line import CommandLine, leave_output

COMMANDS = {
    "board": "write a page with a board to print at true scale",
    "calibrate": "find a camera from photographs of a board, and write a camera file",
    "measure": "measure points, lengths and an area on a plane in a photograph, with error bars",
    "rectify": "make a metric top view of a plane in a photograph, for GIS too",
    "locate": "find where a camera stood from surveyed landmarks that a photograph shows",
    "convert": "turn a camera file of one program into that of another",
    "info": "tell what is in a camera file, and whether it can be right",
    "experiment": "calibrate, put corners back on the board, and print the errors (the paper's Table 1 and Fig. 7)",
}
"""What each command does; the module of its command line has its name."""


EPILOG = """\
'diffproj help COMMAND' tells more about a command, with examples.

examples:
  diffproj board board.pdf --board 9x6 --square 25mm
  diffproj calibrate photos/ --board 9x6 --square 25mm -o camera.json
  diffproj measure part.jpg --camera camera.json --board 9x6 --square 25mm \\
      --points 210,133 402,140

Results go to standard output, with --json as one document; progress, notes,
warnings and failures to standard error.

exit codes:
  0    done
  1    it failed, one line says why and what to do, and no file is half written
  2    the command was not understood
  130  interrupted from the keyboard
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["help"]:  # `diffproj help measure` is `diffproj measure --help`
        given = [*given[1:], "--help"]
    if "_ARGCOMPLETE" in os.environ:
        return _complete()
    parser = _parser(given)
    try:
        options, unknown = parser.parse_known_args(shielded(given))
    except OSError as error:  # of the help, on standard output
        leave_output()
        if not isinstance(error, BrokenPipeError):
            print(f"diffproj: standard output: {error.strerror}; send it elsewhere", file=sys.stderr)
        return 1
    if unknown:
        options.command_line.refuse(unknown, given)
    if "check" in options:  # what options mean together
        options.check(options)
    from diffproj.cli.running import run

    return run(options)


def shielded(arguments: Sequence[str]) -> list[str]:
    """Put a space before values such as `-5,3`, `-3mm` and `-1e-3`, so that argparse does not take them for options.

    A plain negative number needs no shield. `--points=-5,3` comes apart: argparse would take nothing behind it along.
    """
    apart = (re.fullmatch(r"(--[a-z-]+)=(-?[.\d][^,]*,.*)", text) for text in arguments)
    parts = [
        part for text, found in zip(arguments, apart, strict=True) for part in (found.groups() if found else [text])
    ]
    lists, lengths = r"-[.\d][^,]*,.*", r"-[.\d]+((e[+-]?\d+)? ?[a-zµμ]{1,2}|e[+-]?\d+)"
    other = r"-(\d+(\.\d+)?|\.\d+)(e[+-]?\d+)? ?([a-zµμ]+|[\"']+)"  # units that are not known, for a message on them
    return [f" {text}" if re.fullmatch(f"{lists}|{lengths}|{other}", text, re.IGNORECASE) else text for text in parts]


def _complete() -> int:
    """Answer the shell, which asks by `_ARGCOMPLETE` for what may come next; nothing without argcomplete."""
    try:
        argcomplete = import_module("argcomplete")
    except ModuleNotFoundError:
        return 1
    argcomplete.autocomplete(_parser(os.environ.get("COMP_LINE", "").split()[1:]))
    return 1


def _parser(arguments: Sequence[str]) -> CommandLine:
    """The parser of the command line, with the options of the command that is called."""
    parser = CommandLine(
        prog="diffproj",
        description="Pixels of one calibrated camera to world coordinates on known planes.",
        epilog=EPILOG,
        formatter_class=RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"diffproj {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    called = next((text for text in arguments if not text.startswith("-")), None)
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary)
        if name == called:
            import_module(f"diffproj.cli.{name}").add_options(command)
    return parser
