"""What the measuring page has to know of a camera, as plain numbers: all that `measure` takes from a calibration.

The page's script works with independent errors of deviation 1. They are the columns of a root of the joint covariance
of intrinsics, lens and pose; where the lens is extrapolated, it projects through the cameras that are three deviations
off along each of them (see `lens_reach`), whose domains are found here.
"""

import math
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from diffproj._core.arguments import number
from diffproj.calibration.problem.parametrisation import POSE, Parametrisation, moved
from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.camera import Camera, as_camera
from diffproj.geometry.plane import Plane, as_plane
from diffproj.lens.models import coefficients_of, model_of
from diffproj.measurement.choices import HAND_PX, chosen_view, detector_noise, doubts
from diffproj.measurement.doubt import NEGLIGIBLE
from diffproj.measurement.lens_reach import STEP
from diffproj.measurement.measure import at_view
from diffproj.measurement.propagation import root
from diffproj.targets.views import view_number


def as_one(
    calibration: Calibration | Camera | PinholeCamera, view: int | str | None
) -> tuple[Calibration | Camera, int]:
    """A calibration and the number of the view, or one camera and 0.

    Raises:
        TypeError: neither a calibration nor a camera.
        ValueError: there are many cameras, no such view, or none was said of several.
    """
    if isinstance(calibration, Calibration):
        if calibration.views.batch_shape:
            shape = tuple(calibration.views.batch_shape)
            raise ValueError(f"calibration: want one camera, got batch shape {shape}; index it")
        if not bool(calibration.converged):
            raise ValueError(f"calibration: want one that converged, got one that did not: {calibration.message}")
        return calibration, view_number(chosen_view(calibration, view), calibration.views.names)
    camera = as_camera(calibration, "calibration").upright()
    if camera.batch_shape == (1,):  # as Kornia's always are
        camera = camera[0]
    if camera.batch_shape:
        raise ValueError(f"calibration: want one camera, got batch shape {tuple(camera.batch_shape)}; index it")
    if camera.K.is_meta:
        raise ValueError("calibration: want a camera with values, got one on the device meta")
    return camera, 0


def measuring_model(
    calibration: Calibration | Camera, view: int, plane: Plane | None, pixel_sigma: float | str
) -> dict[str, Any]:
    """The numbers of one camera at one view, as `as_one` gives them, ready for JSON; `None` stands for infinity.

    Args:
        calibration: or a camera, whose own uncertainty is then not included.
        view: its number.
        plane: what to measure on at first; the board's face if `None`.
        pixel_sigma: px, or `"detector"`.

    Raises:
        TypeError: a lens of another package, or no plane.
        ValueError: several planes, or a noise that is none.
    """
    known, middle = None, None
    if isinstance(calibration, Calibration):
        camera, known, middle = at_view(calibration, view)
    else:
        camera = calibration
    camera = camera.to(torch.float64).detach()
    with torch.no_grad():
        parameters = Parametrisation.of(camera)
        if isinstance(calibration, Calibration):
            parameters = calibration.parameters.of_camera
        factor = camera.K.new_zeros(0, 0) if known is None else root(known)
        arm = camera.t.new_zeros(3) if middle is None else middle.to(camera.t).reshape(-1, 3)[0]
        return {
            "camera": _camera(camera),
            "skew": parameters.skew,
            "root": factor.tolist(),
            "undetermined": [] if known is None else known.diagonal().isinf().nonzero().flatten().tolist(),
            "middle": arm.tolist(),
            "moved": _moved(camera, parameters, factor, arm),
            **_of_calibration(calibration, view, known is not None),
            "planes": _planes(calibration, camera, plane),
            **_noise(calibration, view, pixel_sigma),
        }


def _of_calibration(calibration: Calibration | Camera, view: int, has_covariance: bool) -> dict[str, Any]:
    """What only a calibration knows: the region, degrees of freedom, the view's other pose, doubts."""
    if not isinstance(calibration, Calibration):
        return {"region": None, "freedom": None, "other": None, "doubts": "", "includes": "pixels"}
    freedom = calibration.degrees_of_freedom
    other = None
    if calibration.has_alternatives:
        probability = float(calibration.other_poses.probability[view])
        there = calibration.alternatives[view]
        if probability > NEGLIGIBLE:
            ambiguous = bool(calibration.ambiguous[view])
            other = {"R": there.R.tolist(), "t": there.t.tolist(), "probability": probability, "ambiguous": ambiguous}
    includes = "camera" if has_covariance and calibration.knows_intrinsics else "pose" if has_covariance else "pixels"
    return {
        "region": None if calibration.region is None else calibration.region.tolist(),
        "freedom": None if freedom is None else _finite(freedom),
        "other": other,
        "doubts": doubts(calibration, view),
        "includes": includes,
    }


def _camera(camera: Camera) -> dict[str, Any]:
    model = model_of(camera.distortion)
    kind = "fisheye" if not model.perspective else "brown" if model.count else "none"
    domain = None if camera.distortion is None else _finite(camera.distortion.domain)
    coefficients = coefficients_of(camera.distortion, camera.K[..., 0, :0]).tolist()
    lens = {"kind": kind, "coefficients": coefficients, "domain": domain}
    return {"K": camera.K.tolist(), "R": camera.R.tolist(), "t": camera.t.tolist(), "lens": lens}


def _moved(camera: Camera, parameters: Parametrisation, factor: Tensor, arm: Tensor) -> list[dict[str, Any]]:
    """The cameras that are three deviations off along each column of the root; all to one side, then to the other."""
    if factor.numel() == 0:
        return []
    steps = STEP * torch.cat([factor.mT, -factor.mT])
    count = len(steps)
    turning = camera.R.expand(count, 3, 3), (camera.t + camera.R @ arm).expand(count, 3)
    R, t = moved(turning, steps[:, -POSE:])
    shared = parameters.pack(camera) + steps[:, : parameters.size]
    cameras = parameters.unpack(shared, (R, t - R @ arm))
    return [_camera(cameras[number]) for number in range(count)]


def _planes(calibration: Calibration | Camera, camera: Camera, plane: Plane | None) -> list[dict[str, Any]]:
    """The planes to choose from, the first one first."""
    found = []
    if plane is not None:
        plane = as_plane(plane).like(camera.K)
        if plane.normal.is_meta:
            raise ValueError("plane: want values, got tensors on the device meta")
        plane = plane.to(torch.float64)
        if plane.batch_shape:
            raise ValueError(f"plane: want one plane, got batch shape {tuple(plane.batch_shape)}")
        found.append({"name": "given", "normal": plane.normal.tolist(), "offset": plane.offset.item()})
    name, z = "z = 0", 0.0
    if isinstance(calibration, Calibration) and calibration.landmarks is None and len(calibration.nominal):
        heights = calibration.nominal[:, 2].to(torch.float64)
        size = float((calibration.nominal.amax(0) - calibration.nominal.amin(0)).max())
        if float(heights.max() - heights.min()) <= 1e-9 * size:
            name, z = "board", float(heights.mean())
    face = {"name": name, "normal": [0.0, 0.0, 1.0], "offset": z}
    same = bool(found) and found[0]["normal"] == face["normal"] and found[0]["offset"] == z
    return [face] if same or not found else [*found, face]


def _noise(calibration: Calibration | Camera, view: int, pixel_sigma: float | str) -> dict[str, Any]:
    """The deviation of a picked pixel in px, and whether the calibration's residuals told it."""
    if isinstance(pixel_sigma, str):
        if pixel_sigma != "detector":
            raise ValueError(f"pixel_sigma: want px, or 'detector' for the noise of the corners, got {pixel_sigma!r}")
        level = detector_noise(calibration, view) if isinstance(calibration, Calibration) else None
        if level is None or not math.isfinite(float(level)):
            raise ValueError(f"pixel_sigma: want px, for this camera does not know its detector's noise: {HAND_PX:g}")
        return {"sigma": float(level), "pixels_too": True}
    return {"sigma": number("pixel_sigma", pixel_sigma, "a standard deviation in px", above=0), "pixels_too": False}


def _finite(value: Tensor) -> float | None:
    return value.item() if bool(value.isfinite()) else None
