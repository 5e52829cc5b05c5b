"""`diffproj measure`: points, lengths and an area on a plane, with error bars, from pixels of a photograph."""

import argparse
import functools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from diffproj.calibration.locate import locate
from diffproj.calibration.result import Calibration, CalibrationError
from diffproj.cli.inputs import Commands, board_size, camera_file, find_corners, numbers, photographs, square_side
from diffproj.cli.terminal import RESULTS, aligned, progress_bars, result, rounded
from diffproj.files.load import load_calibration, load_camera
from diffproj.geometry.back_projection import Reason, explain
from diffproj.geometry.camera import Camera
from diffproj.geometry.plane import Plane
from diffproj.measurement.measure import Measurement, Quantity, measure
from diffproj.targets.chessboard import Chessboard

DESCRIPTION = """\
Turns pixels of a photograph into points on a plane, and prints them with the
lengths between successive points, and from three points on the area that they
enclose in their order, each with its standard deviation and 95 % interval.

Where the camera stood is taken from a board in the photograph (--board and
--square), or from a view that the camera was calibrated with (--view).
"""

EPILOG = """\
pixels:
  u runs to the right and v down; 0,0 is the middle of the first pixel. They may
  be negative or lie outside the photograph.

the board's frame:
  The origin is the first inner corner, x runs to the right along the board's
  rows, y down its columns, and z into the board, away from the camera: heights
  above the board are negative. The first corner touches two dark squares: one
  inside the first four corners, one diagonally outside. The unit is that of
  --square. --view has the frame of the calibration: this one for a file from
  'diffproj calibrate'; for one from 'diffproj experiment', x runs down, y to
  the right and z towards the camera.

examples:
  diffproj measure photo.jpg --camera camera.json --board 9x6 --square 25 \\
      --points 210.5,133 402,140.5 395,300
  diffproj measure --camera camera.json --view left01.jpg \\
      --points 210,133 402,140
  diffproj measure photo.jpg --camera camera.yaml --board 9x6 --square 25 \\
      --points 210,133 402,140 --plane 0,0,1,-12 --pixel-sigma 0.7 --json

  The last one measures on top of a box 12 high that lies on the board.

exit codes: 0 done, also where pixels have no point on the plane, which the
output names; 1 it failed, one line says why; 2 the command was not understood
"""

REASONS = {
    Reason.NOT_FINITE: "the pixel is no number",
    Reason.OUTSIDE_LENS: "no ray comes through the lens to this pixel",
    Reason.CAMERA_ON_PLANE: "the camera itself lies in the plane",
    Reason.PARALLEL: "its ray runs parallel to the plane, as to the horizon",
    Reason.BEHIND: "its ray meets the plane only behind the camera, as above the horizon",
}

EXACT = 1e-9
"""Part of a coordinate below which its deviation is rounding: the plane alone says what the coordinate is."""


def add_command(commands: Commands) -> None:
    """Add the command to the parser's."""
    command = commands.add_parser(
        "measure",
        help="measure points, lengths and an area on a plane in a photograph, with error bars",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="%(prog)s PHOTO --camera FILE --board CxR --square SIDE\n"
        "                        --points u,v ... [options]\n"
        "       %(prog)s --camera FILE --view NAME --points u,v ... [options]",
    )
    photograph = command.add_argument(
        "photograph", type=Path, metavar="PHOTO", help="the photograph, with --board; --view needs none"
    )
    # Not nargs="?": argparse would fill that with nothing as soon as an option comes before the photograph.
    photograph.required = False
    command.add_argument(
        "--camera",
        type=camera_file,
        required=True,
        metavar="FILE",
        help="the camera file. A .json from 'diffproj calibrate' brings the camera's own uncertainty along; .yaml, "
        ".yml or .xml as OpenCV writes them do not (required)",
    )
    command.add_argument(
        "--points",
        type=_pixel,
        nargs="+",
        action="extend",
        required=True,
        metavar="u,v",
        help="the pixels to measure, in order (required)",
    )
    pose = command.add_argument_group("where the camera stood: a board in PHOTO, or a view of the calibration")
    either = pose.add_mutually_exclusive_group(required=True)
    either.add_argument(
        "--board",
        type=board_size,
        metavar="CxR",
        help="inner corners of the board, columns x rows: a board of 10 by 7 squares has 9x6",
    )
    either.add_argument("--view", metavar="NAME", help="name of the view, such as left01.jpg")
    pose.add_argument(
        "--square",
        type=square_side,
        metavar="SIDE",
        help="side of a square of the board, measured on the print; its unit becomes that of all results",
    )
    more = command.add_argument_group("more")
    more.add_argument(
        "--plane",
        type=_plane,
        default=(0.0, 0.0, 1.0, 0.0),
        metavar="a,b,c,d",
        help="the plane a x + b y + c z = d in the board's frame (default: 0,0,1,0, the board itself)",
    )
    more.add_argument(
        "--pixel-sigma",
        type=_pixel_sigma,
        metavar="S",
        help="standard deviation of u and of v of each point, in px. The default is that of the board's corners, which "
        "a program found to a fraction of a pixel: for points picked by hand, give 0.5 to 1",
    )
    more.add_argument("--json", action="store_true", help="print one JSON document, with null for what is not known")
    command.set_defaults(run=functools.partial(run, command))


def _pixel(text: str) -> tuple[float, ...]:
    values = numbers(text, 2)
    if values is None:
        raise argparse.ArgumentTypeError(
            f"want pixels as u,v without a space, such as 320.5,240, got {text.strip()!r}; the photograph comes first"
        )
    return values


def _plane(text: str) -> tuple[float, ...]:
    values = numbers(text, 4)
    if values is None or not any(values[:3]):
        raise argparse.ArgumentTypeError(
            "want a plane a x + b y + c z = d as a,b,c,d without spaces, a, b and c not all 0, such as 0,0,1,25, "
            f"got {text.strip()!r}"
        )
    return values


def _pixel_sigma(text: str) -> float:
    values = numbers(text, 1)
    if values is None or values[0] <= 0:
        raise argparse.ArgumentTypeError(f"want a positive number of pixels, such as 0.5, got {text!r}")
    return values[0]


def run(command: argparse.ArgumentParser, options: argparse.Namespace) -> int:
    """Run the command."""
    if options.view is not None and options.photograph is not None:
        command.error(
            "PHOTO: not with --view, whose pose the camera file holds; leave the photograph out, or give --board and "
            "--square"
        )
    if options.view is not None and options.square is not None:
        command.error("--square: goes with --board, not with --view")
    if options.board is not None and options.photograph is None:
        command.error("PHOTO: want a photograph that shows the board, got none")
    if options.board is not None and options.square is None:
        command.error("--square: want the side of the board's squares along with --board, got none")
    scene = _stored_view(options) if options.view is not None else _new_photograph(options)
    sigma = scene.calibration.pixel_sigma if options.pixel_sigma is None else options.pixel_sigma
    if sigma is None or not math.isfinite(sigma):
        raise ValueError(f"--pixel-sigma: want the noise of the pixels in px, for {options.camera} does not tell it")
    plane = Plane(torch.tensor(options.plane[:3], dtype=torch.float64), options.plane[3])
    pixels = torch.tensor(options.points, dtype=torch.float64)
    measured = measure(pixels, scene.calibration, plane, scene.view, sigma)
    document = _document(scene, options, float(sigma), pixels, plane, measured)
    if options.json:
        result(json.dumps(document, indent=1, allow_nan=False))
    else:
        _say(document, scene)
    return 0


# ------------------------------------------------------------------------------------------------------- the camera


@dataclass(frozen=True)
class _Scene:
    """The camera at its pose.

    Attributes:
        calibration: whose view it is.
        view: the number of the view.
        includes: what the deviations hold.
        title: where the pose comes from, and how well it fits.
        unit: what the world's unit is.
    """

    calibration: Calibration
    view: int
    includes: tuple[str, ...]
    title: str
    unit: str


def _load(path: Path) -> tuple[Camera, Calibration | None]:
    """The camera, and the whole calibration where the file holds one."""
    found = load_camera(path)
    if found.batch_shape:
        raise ValueError(f"--camera: want one camera, got {found.batch_shape.numel()} side by side in {path}")
    # A damaged calibration must not pass for a camera without one.
    if path.suffix.lower() == ".json" and "calibration" in json.loads(path.read_text(encoding="utf-8")):
        return found, load_calibration(path)
    return found, None


def _stored_view(options: argparse.Namespace) -> _Scene:
    path, name = options.camera, options.view
    _, calibration = _load(path)
    if calibration is None:
        raise ValueError(
            f"--view: want a .json with a whole calibration, got a camera without views in {path}; give a photograph "
            "with --board and --square"
        )
    names = calibration.views.names
    if name not in names:
        listed = ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")
        raise ValueError(f"--view: want a view of {path}, got {name!r}; it has {listed}")
    if names.count(name) > 1:
        raise ValueError(
            f"--view: want a name of one view, got {name!r}, which {names.count(name)} views of {path} have; give the "
            "photograph with --board and --square"
        )
    number = names.index(name)
    if not bool(calibration.used[number].any()):
        raise ValueError(f"--view: {name!r} was left out of the calibration in {path}, so its pose is not known")
    includes = ("pixels", "pose", "camera") if calibration.has_covariance else ("pixels",)
    title = f"{path}: view {name}\nRMS {float(calibration.view_rms[number]):.4f} px"
    return _Scene(calibration, number, includes, title, "the calibration's unit")


def _new_photograph(options: argparse.Namespace) -> _Scene:
    camera, calibration = _load(options.camera)
    sources = photographs([options.photograph])
    if len(sources) > 1:
        raise ValueError(f"PHOTO: want one photograph, got {len(sources)} in {options.photograph}")
    columns, rows = options.board
    board = Chessboard(columns, rows, options.square)
    with progress_bars() as bars:
        views = find_corners(sources, board, bars)
    if camera.size is not None and camera.size != views.size:
        (w, h), (width, height) = views.size or (0, 0), camera.size
        raise ValueError(
            f"PHOTO: want {width} x {height} px as in {options.camera}, got {w} x {h} px in {options.photograph}; take "
            "it with the camera as it was calibrated, and do not resize or crop it"
        )
    try:
        located = locate(views, board, camera if calibration is None else calibration)
    except CalibrationError as error:
        raise ValueError(
            f"{options.photograph}: no pose of the board explains its corners; check --camera, --board and --square"
        ) from error
    own = calibration is not None and calibration.has_covariance
    includes = ("pixels", "pose", "camera") if own else ("pixels", "pose")
    title = f"{options.photograph}: board found\nRMS {float(located.rms):.4f} px over {int(located.used.sum())} corners"
    if calibration is not None:
        title += f" ({float(calibration.rms):.4f} px in the calibration)"
    return _Scene(located, 0, includes, title, "the unit of --square")


# --------------------------------------------------------------------------------------------------- what is printed


def _document(
    scene: _Scene,
    options: argparse.Namespace,
    sigma: float,
    pixels: torch.Tensor,
    plane: Plane,
    measured: Measurement,
) -> dict[str, Any]:
    """Everything that was measured; points count from 1, and what is not known is None."""
    camera = scene.calibration.cameras[scene.view]
    reasons = [Reason(code) for code in explain(pixels, camera, plane).tolist()]
    points, deviations = measured.points.tolist(), measured.deviations.tolist()
    rows, remarks = [], []
    for number, (pixel, reason) in enumerate(zip(pixels.tolist(), reasons, strict=True), start=1):
        valid = reason == Reason.VALID
        row = {"number": number, "pixel": pixel, "valid": valid, "reason": None if valid else reason.name}
        row["world"] = [_known(x) for x in points[number - 1]] if valid else None
        row["deviation"] = [_known(x) for x in deviations[number - 1]] if valid else None
        rows.append(row)
        if not valid:
            remarks.append(f"Point {number} is not on the plane: {REASONS[reason]}.")
        elif camera.size is not None and not all(-0.5 <= x < n - 0.5 for x, n in zip(pixel, camera.size, strict=True)):
            width, height = camera.size
            remarks.append(f"Point {number} lies outside the photograph of {width} x {height} px.")
    found = _quantities(measured.lengths()) if len(rows) > 1 else []
    lengths = [{"from": number, "to": number + 1, **length} for number, length in enumerate(found, start=1)]
    for number, length in enumerate(lengths, start=1):
        if length["significant"] is False:
            remarks.append(f"The length {number} to {number + 1} is below three deviations: it cannot be told from 0.")
    area = _quantities(measured.area())[0] if len(rows) > 2 else None
    if area is not None and area["value"] is not None and _crosses(points, options.plane):
        remarks.append("The outline crosses itself, so its area means little: give the points in order around it.")
    elif area is not None and area["significant"] is False:
        remarks.append("The area is below three deviations: it cannot be told from 0.")
    return {
        "camera": str(options.camera),
        "photograph": None if options.photograph is None else str(options.photograph),
        "view": scene.calibration.views.names[scene.view],
        "view_rms": _known(float(scene.calibration.view_rms[scene.view])),
        "plane": list(options.plane),
        "pixel_sigma": sigma,
        "deviations_include": list(scene.includes),
        "points": rows,
        "lengths": lengths,
        "area": area,
        "remarks": remarks,
    }


def _known(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _quantities(found: Quantity) -> list[dict[str, Any]]:
    low, high = found.interval(0.95)
    columns = (found.value, found.deviation, low, high, found.significant & (found.value > 0))
    return [
        {
            "value": _known(value),
            "deviation": _known(deviation),
            "interval_95": [below, above] if math.isfinite(below) and math.isfinite(above) else None,
            "significant": significant if math.isfinite(value) else None,
        }
        for value, deviation, below, above, significant in zip(*(column.tolist() for column in columns), strict=True)
    ]


def _crosses(points: list[list[float]], plane: tuple[float, ...]) -> bool:
    """Whether two sides of the outline cross, seen along the axis that the plane's normal is nearest to."""
    away = max(range(3), key=lambda axis: abs(plane[axis]))
    flat = [[x for axis, x in enumerate(point) if axis != away] for point in points]
    n = len(flat)
    sides = [(flat[i], flat[(i + 1) % n]) for i in range(n)]

    def turn(a: list[float], b: list[float], c: list[float]) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    return any(
        turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0
        for i, (a, b) in enumerate(sides)
        for c, d in sides[i + 2 :]
    )


def _say(document: dict[str, Any], scene: _Scene) -> None:
    result(f"{scene.title}\n")
    RESULTS.print(_points_table(document, scene.unit))
    if document["lengths"]:
        result("")
        RESULTS.print(_lengths_table(document["lengths"]))
    area = document["area"]
    if area is not None:
        value, deviation, interval = _shown(area)
        known = f"{value} ± {deviation}, 95 % interval {interval}"
        text = "not known, for not all points are on the plane" if area["value"] is None else known
        result(f"\nArea of the outline 1 to {len(document['points'])}: {text}")
    if document["remarks"]:
        result("")
    for remark in document["remarks"]:
        RESULTS.print(remark, markup=False)
    result("")
    noise = f"the pixels' noise of {document['pixel_sigma']:.2g} px"
    sentence = {
        3: f"The deviations hold {noise}, and how surely the pose and the camera are known.",
        2: f"The deviations hold {noise} and how surely the pose is known, but NOT how surely the camera is, for its "
        "file does not tell: the truth may lie further off. A .json from 'diffproj calibrate' tells it.",
        1: f"The deviations hold {noise} ONLY, and not how surely the pose and the camera are known, for the file does "
        "not tell: the truth may lie further off. A .json from 'diffproj calibrate' tells it.",
    }
    RESULTS.print(sentence[len(document["deviations_include"])], markup=False)


def _points_table(document: dict[str, Any], unit: str) -> Table:
    table = Table(title=f"Points on the plane {_equation(document['plane'])}, in {unit}", title_justify="left")
    table.add_column("point", justify="right")
    table.add_column("pixel u, v", no_wrap=True)
    found = [row for row in document["points"] if row["valid"]]
    columns = []
    for axis, name in enumerate("xyz"):
        table.add_column(f"{name} ± deviation", overflow="fold")
        pairs = [_coordinate(row["world"], row["deviation"], axis) for row in found]
        starts = aligned([value for value, _ in pairs]) if pairs else []
        columns.append([start + rest for start, (_, rest) in zip(starts, pairs, strict=True)])
    cells = iter(zip(*columns, strict=True))
    for row in document["points"]:
        u, v = row["pixel"]
        table.add_row(str(row["number"]), f"{u:g}, {v:g}", *(next(cells) if row["valid"] else ("none",) * 3))
    return table


def _coordinate(world: list[float], deviations: list[float | None], axis: int) -> tuple[str, str]:
    """A coordinate and what follows it; bare where the plane alone says what it is."""
    value, deviation = world[axis], deviations[axis]
    scale = max(map(abs, world))
    if deviation is None:
        return f"{value:.6g}", " ± unknown"
    if deviation <= EXACT * max(scale, 1e-300):
        return ("0" if abs(value) <= EXACT * scale else f"{value:.6g}"), ""
    text, spread = rounded(value, deviation)
    return text, f" ± {spread}"


def _lengths_table(lengths: list[dict[str, Any]]) -> Table:
    table = Table(title="Lengths", title_justify="left")
    for name in ("from, to", "length", "standard deviation", "95 % interval"):
        table.add_column(name, overflow="fold")
    rows = [_shown(length) for length in lengths]
    values, deviations = (aligned(column) for column in zip(*((row[0], row[1]) for row in rows), strict=True))
    for length, value, deviation, (_, _, interval) in zip(lengths, values, deviations, rows, strict=True):
        table.add_row(f"{length['from']}, {length['to']}", value, deviation, interval)
    return table


def _shown(quantity: dict[str, Any]) -> tuple[str, str, str]:
    """A quantity, its deviation and its interval, all to the deviation's second digit."""
    value, deviation, interval = quantity["value"], quantity["deviation"], quantity["interval_95"]
    if value is None:
        return "none", "", ""
    if deviation is None or interval is None:
        return f"{value:.6g}", "unknown", "unknown"
    if deviation == 0:
        return f"{value:.6g}", "0", ""
    low, high = (rounded(bound, deviation)[0] for bound in interval)
    return (*rounded(value, deviation), f"{low} to {high}")


def _equation(plane: list[float]) -> str:
    """The plane's equation for people: `z = 0`, `0.6 x + 0.8 z = 5`."""
    *normal, offset = plane
    terms = [(factor, name) for factor, name in zip(normal, "xyz", strict=True) if factor]
    text = " ".join(
        f"{'-' if factor < 0 else '+'} {'' if abs(factor) == 1 else f'{abs(factor):g} '}{name}"
        for factor, name in terms
    )
    text = text.removeprefix("+ ") if text.startswith("+") else text.replace("- ", "-", 1)
    return f"{text} = {offset:g}"
