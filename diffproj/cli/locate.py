"""The command line of `diffproj locate`; `locating.py` does the work."""

import argparse
from pathlib import Path

from diffproj.cli.common_options import add_camera, add_photograph, add_said, describe, pixel_noise
from diffproj.cli.drawing import drawing
from diffproj.cli.inputs import add_orientation, some_path
from diffproj.cli.known_beforehand import field_of_view, fixed, prior
from diffproj.cli.units import METRES

DESCRIPTION = """\
Finds where a camera stood from surveyed points that a photograph shows: on the
ground, on a facade, anywhere in space. Prints its position, tilt, roll and
heading with their standard deviations, and how far off each landmark is.
Four landmarks that do not lie on a line are enough where the camera is known;
fewer, or more unknowns, where something of the camera is known beforehand.
"""

EPILOG = """\
the landmarks:
  A CSV file whose first line has the titles of the columns, in any order:

    name,u,v,x,y,z
    mast,2521.9,483.7,902062.638,274683.639,7.432

  u, v     the pixel that shows it, u to the right and v down; 0,0 is the middle
           of the first pixel. Both empty: not in this photograph
  x, y, z  where it is, in any unit and as far from the origin as UTM is; x
           east or right, y north or ahead, z up. Without z all lie on z = 0
  lat, lon in place of x and y: degrees of a GPS (WGS 84), which become metres
           east and north on a map, the UTM zone that they lie in or --crs
  name, sigma or sigma_x,sigma_y,sigma_z, pixel_sigma
           may be there: its name, how well it is known (standard deviations in
           the unit of x), and how well the pixel is. Other columns are passed
           over; semicolons or tabs may separate, with decimal commas

the focal length:
  --free focal lets it be another than in the camera file, and --free focal,k1
  the first coefficient of the lens too. Both need six landmarks or more that do
  not lie on a plane; what they do not tell is said.

what is known beforehand:
  --prior height=12+-0.02 says that the camera stands at z = 12, with a standard
  deviation of 0.02; --fixed roll=0 that something is certain. Names are height
  (the camera's z, over z = 0), x, y, tilt (degrees below the horizon), roll (by
  which the horizon sinks to the right) and heading (clockwise from y); --prior
  takes focal, f_x, f_y, c_x, c_y, k1 and so on too, and finds them along.
  Priors weigh against the pixels: give --pixel-sigma along. Both may be given
  several times, and with them fewer than four landmarks may be enough.

without a camera file:
  --fov 70+-5 takes its place, along with PHOTO, whose size counts: square
  pixels, the principal point in the middle of the image, and a lens that may
  bend. How far each may be off is printed, and counts in all deviations;
  --prior takes the place of each, as k1=-0.3+-0.05 or c_x=960+-10. Few
  landmarks, or ones on a plane, leave large deviations. --fov 70 alone is a
  start: --free focal then finds what the landmarks tell. Give --pixel-sigma
  along. To calibrate the camera is better, where one can.

examples:
  diffproj locate beach.jpg --camera drone.yaml --landmarks survey.csv \\
      -o located.json --draw located.png
  diffproj locate river.jpg --camera camera.yaml --landmarks gcp.csv \\
      --free focal,k1 --pixel-sigma 2
  diffproj locate mast.jpg --camera camera.yaml --landmarks marks.csv \\
      --prior height=12.30+-0.02 --prior focal=1550+-50 --fixed roll=0 \\
      --pixel-sigma 1
  diffproj locate yard.jpg --fov 70+-5 --landmarks marks.csv --pixel-sigma 1 \\
      -o located.json
  diffproj measure --camera located.json --view beach.jpg --points 2000,1000

The file that -o writes is the camera at its place, with its error bars, for
'diffproj measure' and dp.load_calibration; the last example measures on z = 0.
"""


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command its description and its options."""
    describe(command, DESCRIPTION, EPILOG, "%(prog)s [PHOTO] (--camera FILE | --fov DEG) --landmarks FILE ...")
    add_photograph(
        command,
        "the photograph: its size is compared with the camera's, or --fov is of it, and --draw draws into it; not "
        "needed otherwise",
    )
    either = command.add_mutually_exclusive_group()
    add_camera(either, "--fov")
    either.add_argument(
        "--fov",
        type=field_of_view,
        metavar="DEG+-S",
        help="where there is no camera file, what PHOTO shows from its left edge to its right one, in degrees, with a "
        "standard deviation, such as 70+-5; or exif, where its EXIF data tell a focal length of 35 mm film",
    )
    command.add_argument(
        "--landmarks",
        type=some_path,
        required=True,
        metavar="FILE",
        help="a CSV file with columns name, u, v, x, y, z, or lat and lon in place of x and y (required)",
    )
    more = command.add_argument_group("how")
    more.add_argument(
        "--free",
        type=_names,
        default=(),
        metavar="NAMES",
        help="what else is to be found, with commas between: focal, f_x, f_y, principal_point, or coefficients of the "
        "lens such as k1 (default: the pose alone)",
    )
    more.add_argument(
        "--prior",
        type=prior,
        action="append",
        default=[],
        metavar="NAME=VALUE+-S",
        help="what is known beforehand, with its standard deviation, such as height=12+-0.02 or focal=1550+-50; may be "
        "given several times",
    )
    more.add_argument(
        "--fixed",
        type=fixed,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="what is certain of where the camera stood and looked, such as roll=0; may be given several times",
    )
    more.add_argument(
        "--pixel-sigma",
        type=_pixel_sigma,
        metavar="S",
        help="standard deviation of u and of v in px, for landmarks without one of their own in the file (default: the "
        "residuals tell it)",
    )
    more.add_argument(
        "--reject-outliers",
        action="store_true",
        help="leave out landmarks that lie more than 5 standard deviations off, and name them",
    )
    more.add_argument(
        "--crs",
        metavar="MAP",
        help="the map that columns lat and lon become metres of, such as EPSG:32630 (default: the UTM zone that they "
        "lie in)",
    )
    more.add_argument(
        "--unit", choices=METRES, metavar="UNIT", help="unit of x, y and z, for tables and the file, such as m"
    )
    add_orientation(more)
    output = command.add_argument_group("what comes out")
    output.add_argument(
        "-o",
        "--output",
        type=_located_file,
        metavar="FILE",
        help="write the camera at its place with its error bars: a .json, replaced if there is one",
    )
    output.add_argument(
        "--draw",
        type=drawing,
        metavar="FILE",
        help="draw the landmarks, and where the camera sees them, into the photograph: a .png, .svg or .pdf, replaced "
        "if there is one",
    )
    add_said(command)
    command.set_defaults(work="locating")


def _names(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    if not all(name.isidentifier() for name in names):
        raise argparse.ArgumentTypeError(f"want names with commas between, such as focal or focal,k1, got {text!r}")
    return names


def _pixel_sigma(text: str) -> float:
    noise = pixel_noise(text)
    if noise is None:
        raise argparse.ArgumentTypeError(f"want a positive number of pixels, such as 0.5, got {text!r}")
    return noise


def _located_file(text: str) -> Path:
    if Path(text).suffix.lower() != ".json":
        raise argparse.ArgumentTypeError(f"want a file ending in .json, which holds the pose too, got {text!r}")
    return Path(text)
