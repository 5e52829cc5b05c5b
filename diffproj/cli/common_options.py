"""What several commands have in common: how they are described, and options that mean the same in all of them."""

import argparse

from diffproj.cli.inputs import LARGEST_NUMBER, add_orientation, numbers, some_path
from diffproj.cli.units import height
from diffproj.cli.which_board import add_kinds, add_measures

EXIT_CODES = """\
exit codes: 0 done; 1 it failed, one line says why and what to do, and no file
is half written; 2 the command was not understood; 130 interrupted
"""


def describe(command: argparse.ArgumentParser, description: str, epilog: str, usage: str | None = None) -> None:
    """Give a command its description, its examples and the exit codes."""
    command.description, command.usage = description, usage
    command.epilog = f"{epilog}\n{EXIT_CODES}"
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    command.set_defaults(command_line=command)


def add_said(command: argparse.ArgumentParser) -> argparse._MutuallyExclusiveGroup:
    """Give a command the options that each has, on what it says.

    Returns:
        The group of `--json`: other forms of the result may join it.
    """
    said = command.add_argument_group("what is said")
    forms = said.add_mutually_exclusive_group()
    forms.add_argument("--json", action="store_true", help="print one JSON document, with null for what is not known")
    how_much = said.add_mutually_exclusive_group()
    how_much.add_argument(
        "-q", "--quiet", action="store_true", help="no progress and no notes: results, warnings and failures alone"
    )
    how_much.add_argument(
        "-v", "--verbose", action="store_true", help="tell each step with its time, and of a failure where it arose"
    )
    return forms


def add_camera(command: argparse._ActionsContainer, otherwise: str = "") -> None:
    """Give a command the camera file that it works with; `otherwise` is the option that may take its place."""
    command.add_argument(
        "--camera",
        type=some_path,
        required=not otherwise,
        metavar="FILE",
        help="the camera file, in any format that 'diffproj info' reads. A .json from 'diffproj calibrate' brings the "
        f"camera's own uncertainty along; other programs' files do not (required{otherwise and f', or {otherwise}'})",
    )


def add_photograph(command: argparse.ArgumentParser, text: str) -> None:
    """Give a command a photograph that may be left out."""
    photograph = command.add_argument("photograph", type=some_path, metavar="PHOTO", help=text)
    # Not nargs="?": argparse would fill that with nothing as soon as an option comes before the photograph.
    photograph.required = False


def add_pose(command: argparse.ArgumentParser) -> None:
    """Give a command the options that tell where the camera stood."""
    pose = command.add_argument_group("where the camera stood: a board in PHOTO, or a view of the calibration")
    either = pose.add_mutually_exclusive_group(required=True)
    add_kinds(either)
    either.add_argument("--view", metavar="NAME", help="name of the view, such as left01.jpg")
    add_measures(pose)
    add_orientation(pose)


def add_plane(command: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """Give a command the options that tell the plane."""
    group = command.add_argument_group("the plane")
    which = group.add_mutually_exclusive_group()
    which.add_argument(
        "--height",
        type=height,
        metavar="H",
        help="a plane parallel to the board, H above its face as the camera sees it, such as 12 or 12mm (default: 0, "
        "the face itself)",
    )
    which.add_argument(
        "--plane", type=_plane, metavar="a,b,c,d", help="the plane a x + b y + c z = d in the board's frame"
    )
    return group


def _plane(text: str) -> tuple[float, ...]:
    values = numbers(text, 4)
    if values is None or max(map(abs, values[:3])) < 1 / LARGEST_NUMBER:
        raise argparse.ArgumentTypeError(
            "want a plane a x + b y + c z = d as a,b,c,d without spaces, a, b and c not all 0, such as 0,0,1,25, "
            f"got {text.strip()!r}"
        )
    return values


def pixel_noise(text: str) -> float | None:
    """Read a standard deviation in px; `None` where it is none that a pixel could have."""
    values = numbers(text, 1)
    return None if values is None or not 1e-6 <= values[0] <= 1e6 else values[0]
