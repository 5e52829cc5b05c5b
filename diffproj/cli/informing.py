"""The work of `diffproj info`: what is in a camera file, and whether it can be right."""

import argparse
import math
import textwrap
from typing import Any, NamedTuple

import torch

from diffproj._core.shown import plain
from diffproj.calibration.results.calibration import Calibration
from diffproj.cli.converting import name_in, named
from diffproj.cli.terminal import alert, as_json, in_words, result
from diffproj.files.document import Document
from diffproj.files.formats import CONVENTIONS, format_of, name_of
from diffproj.files.load import content_of, found_in
from diffproj.files.own_json import holds_fleet
from diffproj.files.writing import has_pose
from diffproj.geometry.camera import Camera
from diffproj.lens.models import model_of

OFF_CENTER = 0.1
"""How far the principal point may be from the middle, as a part of the side, before it is remarked on."""

UNEQUAL = 0.05
"""How different the two focal lengths may be."""

NARROW, WIDE = 3.0, 150.0
"""Horizontal fields of view, in degrees, beyond which a perspective camera is remarked on."""

STEPS = 400


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    document = Document.read(options.file)
    found = found_in(document, options.source)
    one = named(found, options.camera)
    if one is None:
        cameras, aside = found.cameras, list(found.aside)
    else:
        try:
            cameras, aside = {str(one): found.chosen(one)}, []
        except ValueError as error:
            raise ValueError(f"{options.file}: --{error}") from error
    format_ = name_of(format_of(document, options.source))
    whole = format_ == "json" and not (holds_fleet(document) and one is None)  # of a fleet, one at a time
    content = content_of(document, name_in(found, one)) if whole else None
    calibration = content if isinstance(content, Calibration) else None
    told = {
        "file": str(options.file),
        "format": format_,
        "conventions": CONVENTIONS[format_],
        "cameras": {name: _described(name, camera) for name, camera in cameras.items()},
        "aside": aside,
        "calibration": None if calibration is None else _of_calibration(calibration),
    }
    doubts = _doubts(told["cameras"])
    if options.json:
        as_json({**told, "warnings": [*options.warned, *doubts]})
    else:
        _say(told)
    for doubt in doubts:
        alert(doubt)
    return 0


def _doubts(cameras: dict[str, Any]) -> list[str]:
    """What looks wrong, each once: frames of one camera have the same doubts."""
    names: dict[str, list[str]] = {}
    for name, camera in cameras.items():
        for doubt in () if camera is None else camera["doubts"]:
            names.setdefault(doubt.removeprefix(f"{name}: "), []).append(name)
    others = {doubt: f" and {len(which) - 1} more" * (len(which) > 1) for doubt, which in names.items()}
    return [f"{which[0]}{others[doubt]}: {doubt}" for doubt, which in names.items()]


def _of_calibration(calibration: Calibration) -> dict[str, Any]:
    verdict = None if calibration.views.batch_shape else in_words(calibration.verdict, calibration.unit)
    return {
        "views": len(calibration.views),
        "rms": calibration.rms.flatten().tolist(),
        "unit": calibration.unit,
        "verdict": verdict,
    }


def _described(name: str, camera: Camera) -> dict[str, Any] | None:
    """A camera, or the first of a batch; `None` where it is empty."""
    many = camera.batch_shape.numel() if camera.batch_shape else None
    if many == 0:
        return None
    while camera.batch_shape:
        camera = camera[0]
    camera = camera.to(torch.float64)
    (f_x, skew, c_x), (_, f_y, c_y), _ = camera.K.tolist()
    model = model_of(camera.distortion)
    numbers = [] if camera.distortion is None else camera.distortion.coefficients.tolist()  # type: ignore[attr-defined]
    view = None if camera.size is None else _view(name, camera)
    return {
        "side_by_side": many,
        "size": None if camera.size is None else list(camera.size),
        "focal_lengths": [f_x, f_y],
        "skew": skew,
        "principal_point": [c_x, c_y],
        "lens": model.name,
        "coefficients": dict(zip(model.coefficient_names, numbers, strict=camera.distortion is not None)),
        "centre": camera.center.tolist() if has_pose(camera) else None,
        "field_of_view": None if view is None else view.angles,
        "lens_reaches": None if view is None else view.reach,
        "doubts": [] if view is None else view.doubts,
    }


def _say(told: dict[str, Any]) -> None:
    """Print what is in the file."""
    result(f"{told['file']}: {told['format']}")
    result(f"  {told['conventions']}")
    for name, camera in told["cameras"].items():
        if camera is None:
            result(f"{name}: no camera")
        else:
            _say_camera(name, camera)
    if told["aside"]:
        result(f"to be asked for by --camera: {', '.join(told['aside'])}")
    if told["calibration"] is not None:
        rms = ", ".join(f"{value:.4f}" for value in told["calibration"]["rms"][:4])
        views = told["calibration"]["views"]
        unit = f"; lengths in {told['calibration']['unit']}" if told["calibration"]["unit"] else ""
        result(f"a calibration of {views} view{'s' * (views != 1)}, RMS {rms} px{unit}")
        if told["calibration"]["verdict"] is not None:
            result(textwrap.fill(told["calibration"]["verdict"], 79))


def _say_camera(name: str, camera: dict[str, Any]) -> None:
    many, skew = camera["side_by_side"] or 1, camera["skew"]
    (f_x, f_y), (c_x, c_y) = camera["focal_lengths"], camera["principal_point"]
    result(f"{name}" + (f": {many} cameras side by side, of which the first is" * (many > 1)))
    result("  size             " + ("unknown" if camera["size"] is None else "{} x {} px".format(*camera["size"])))
    result(f"  focal lengths    {f_x:.6g}, {f_y:.6g} px" + (f", skew {skew:.4g}" * bool(skew)))
    result(f"  principal point  {c_x:.6g}, {c_y:.6g} px")
    numbers = " ".join(f"{key} {x:.5g}" for key, x in camera["coefficients"].items())
    result(f"  lens             {camera['lens']}: {numbers}" if numbers else "  lens             none in the file")
    if camera["centre"] is not None:
        result(f"  centre           {', '.join(plain(x) for x in camera['centre'])} in the world")
    if camera["size"] is None:
        return
    angles = camera["field_of_view"]
    if angles is None:
        result("  field of view    unknown, for the lens does not reach the edges of the image")
    else:
        result("  field of view    {:.1f} x {:.1f} degrees".format(*angles))
    if camera["lens_reaches"] >= 1:
        result("  lens             reaches all corners of the image")


class _View(NamedTuple):
    """What a camera sees: its field of view in degrees, how far the lens reaches, and what looks wrong."""

    angles: list[float] | None
    reach: float
    doubts: list[str]


def _view(name: str, camera: Camera) -> _View:
    width, height = camera.size or (0, 0)
    (f_x, _, c_x), (_, f_y, c_y), _ = camera.K.tolist()
    ends = [(-0.5, c_y), (width - 0.5, c_y), (c_x, -0.5), (c_x, height - 0.5)]
    angles = _off_axis(camera, ends)
    across, down = sum(angles[:2]), sum(angles[2:])
    corners = [(-0.5, -0.5), (width - 0.5, -0.5), (-0.5, height - 0.5), (width - 0.5, height - 0.5)]
    reach = min(_reach(camera, corner) for corner in corners)
    doubts = []
    if reach < 1:
        doubts.append(
            f"{name}: the lens folds at {100 * reach:.0f} % of the way from the principal point to a corner; pixels "
            "beyond have no direction. Were corners or K of another size?"
        )
    if abs(c_x - (width - 1) / 2) > OFF_CENTER * width or abs(c_y - (height - 1) / 2) > OFF_CENTER * height:
        doubts.append(
            f"{name}: the principal point ({c_x:.1f}, {c_y:.1f}) is far from the middle of {width} x {height} px; the "
            "size may be exchanged, or that of another video mode, or the image a crop"
        )
    if abs(f_x / f_y - 1) > UNEQUAL:
        doubts.append(f"{name}: the focal lengths {f_x:.5g} and {f_y:.5g} px differ; was the image stretched?")
    if model_of(camera.distortion).perspective and not NARROW < across < WIDE and math.isfinite(across):
        doubts.append(
            f"{name}: a field of view of {across:.1f} degrees is unusual; is K that of an image of this size?"
        )
    return _View([across, down] if math.isfinite(across + down) else None, reach, doubts)


def _off_axis(camera: Camera, pixels: list[tuple[float, float]]) -> list[float]:
    """The angles between pixels and the optical axis in degrees; NaN where the lens does not reach them."""
    directions, valid = camera.directions(torch.tensor(pixels, dtype=torch.float64, device="cpu"))
    across = directions[:, :2].norm(dim=-1)
    angle = torch.rad2deg(torch.atan2(across, directions[:, 2]))
    return torch.where(valid, angle, torch.nan).tolist()


def _reach(camera: Camera, corner: tuple[float, float]) -> float:
    """How far towards a corner the lens reaches, from 0 at the principal point to 1."""
    steps = torch.linspace(0, 1, STEPS + 1, dtype=torch.float64, device="cpu")[:, None]
    middle = camera.K[:2, 2]
    _, valid = camera.directions(middle + steps * (torch.tensor(corner, dtype=torch.float64, device="cpu") - middle))
    return 1.0 if bool(valid.all()) else float(steps[int((~valid).nonzero()[0])])
