"""`diffproj info`: the command line of telling what is in a camera file."""

import argparse
from typing import get_args

from diffproj.cli.inputs import some_path
from diffproj.files.names import FormatName

DESCRIPTION = """\
Tells what is in a camera file of any format that is read: the cameras, their
lenses and poses, their fields of view, and whether the lens reaches the
image's corners. Warns where focal lengths or principal point look wrong.
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    command.description = DESCRIPTION
    command.formatter_class = argparse.RawDescriptionHelpFormatter
    command.add_argument("file", type=some_path, metavar="FILE", help="the camera file")
    command.add_argument(
        "--from",
        dest="source",
        choices=get_args(FormatName),
        metavar="FORMAT",
        help="format, where the content does not tell it",
    )
    command.add_argument("--camera", metavar="NAME", help="one camera alone, by its name, or its number from 0")
    command.set_defaults(work="informing")
