"""The work of `diffproj info`: what is in a camera file, and whether it can be right."""

import argparse
import math

import torch

from diffproj.calibration.result import Calibration
from diffproj.cli.converting import named
from diffproj.cli.terminal import note, result
from diffproj.files.document import Document
from diffproj.files.formats import CONVENTIONS, format_of, name_of
from diffproj.files.load import load, load_camera
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
    one = named(options.file, options.source, options.camera)
    if one is not None:
        cameras = {str(one): load_camera(options.file, options.source, one)}
        aside: dict[str, Camera] = {}
    else:
        load_camera_or_several(options)
        document = Document.read(options.file)
        found = format_of(document, options.source).read(document)
        cameras, aside = found.cameras, found.aside
    document = Document.read(options.file)
    format_ = name_of(format_of(document, options.source))
    result(f"{options.file}: {format_}")
    result(f"  {CONVENTIONS[format_]}")
    for name, camera in cameras.items():
        _say(name, camera)
    if aside:
        result(f"to be asked for by --camera: {', '.join(aside)}")
    if format_ == "json":
        whole = load(options.file)
        if isinstance(whole, Calibration):
            rms = ", ".join(f"{value:.4f}" for value in whole.rms.flatten()[:4].tolist())
            result(f"a calibration of {len(whole.views)} views, RMS {rms} px")
    return 0


def load_camera_or_several(options: argparse.Namespace) -> None:
    """Say in one line what is wrong with a file; that its cameras make no batch is no fault here."""
    try:
        load_camera(options.file, options.source)
    except ValueError as error:
        if "make no batch" not in str(error):
            raise


def _say(name: str, camera: Camera) -> None:
    """A camera, or the first of a batch."""
    many = camera.batch_shape.numel() if camera.batch_shape else 1
    if many == 0:
        result(f"{name}: no camera")
        return
    result(f"{name}" + (f": {many} cameras side by side, of which the first is" * (many > 1)))
    while camera.batch_shape:
        camera = camera[0]
    camera = camera.to(torch.float64)
    (f_x, skew, c_x), (_, f_y, c_y), _ = camera.K.tolist()
    size = "unknown" if camera.size is None else f"{camera.size[0]} x {camera.size[1]} px"
    result(f"  size             {size}")
    result(f"  focal lengths    {f_x:.6g}, {f_y:.6g} px" + (f", skew {skew:.4g}" * bool(skew)))
    result(f"  principal point  {c_x:.6g}, {c_y:.6g} px")
    result(f"  lens             {_lens(camera)}")
    if has_pose(camera):
        result(f"  centre           {', '.join(f'{x:.6g}' for x in camera.center.tolist())} in the world")
    if camera.size is not None:
        _say_view(name, camera)


def _lens(camera: Camera) -> str:
    if camera.distortion is None:
        return "none in the file"
    model = model_of(camera.distortion)
    numbers = camera.distortion.coefficients.tolist()  # type: ignore[attr-defined]
    return f"{model.name}: " + " ".join(
        f"{key} {x:.5g}" for key, x in zip(model.coefficient_names, numbers, strict=True)
    )


def _say_view(name: str, camera: Camera) -> None:
    """Fields of view, how far the lens reaches, and what looks wrong."""
    width, height = camera.size or (0, 0)
    (f_x, _, c_x), (_, f_y, c_y), _ = camera.K.tolist()
    ends = [(-0.5, c_y), (width - 0.5, c_y), (c_x, -0.5), (c_x, height - 0.5)]
    angles = _off_axis(camera, ends)
    across, down = sum(angles[:2]), sum(angles[2:])
    if math.isfinite(across + down):
        result(f"  field of view    {across:.1f} x {down:.1f} degrees")
    else:
        result("  field of view    unknown, for the lens does not reach the edges of the image")
    corners = [(-0.5, -0.5), (width - 0.5, -0.5), (-0.5, height - 0.5), (width - 0.5, height - 0.5)]
    reach = min(_reach(camera, corner) for corner in corners)
    if reach >= 1:
        result("  lens             reaches all corners of the image")
    else:
        note(
            f"{name}: the lens folds at {100 * reach:.0f} % of the way from the principal point to a corner; pixels "
            "beyond have no direction. Were corners or K of another size?"
        )
    if abs(c_x - (width - 1) / 2) > OFF_CENTER * width or abs(c_y - (height - 1) / 2) > OFF_CENTER * height:
        note(
            f"{name}: the principal point ({c_x:.1f}, {c_y:.1f}) is far from the middle of {width} x {height} px; the "
            "size may be exchanged, or that of another video mode, or the image a crop"
        )
    if abs(f_x / f_y - 1) > UNEQUAL:
        note(f"{name}: the focal lengths {f_x:.5g} and {f_y:.5g} px differ; was the image stretched?")
    if model_of(camera.distortion).perspective and not NARROW < across < WIDE and math.isfinite(across):
        note(f"{name}: a field of view of {across:.1f} degrees is unusual; is K that of an image of this size?")


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
