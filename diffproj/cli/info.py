"""`diffproj info`: the command line of telling what is in a camera file."""

import argparse
from typing import get_args

from diffproj.cli.common_options import add_said, describe
from diffproj.cli.inputs import some_path
from diffproj.files.names import FormatName

DESCRIPTION = """\
Tells what is in a camera file of any format that is read: the cameras, their
lenses and poses, their fields of view, and whether the lens reaches the
image's corners. Warns where focal lengths or principal point look wrong.
"""

EPILOG = """\
examples:
  diffproj info camera.json
  diffproj info camchain.yaml --camera cam1
  diffproj info calib.txt --from kitti --json
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    describe(command, DESCRIPTION, EPILOG)
    command.add_argument("file", type=some_path, metavar="FILE", help="the camera file")
    command.add_argument(
        "--from",
        dest="source",
        choices=get_args(FormatName),
        metavar="FORMAT",
        help="format, where the content does not tell it",
    )
    command.add_argument("--camera", metavar="NAME", help="one camera alone, by its name, or its number from 0")
    add_said(command)
    command.set_defaults(work="informing")
