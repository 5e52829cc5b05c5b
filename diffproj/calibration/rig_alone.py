"""Each camera of a rig on its own: intrinsics where none are given, and the target as each of its views sees it."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj._core.arguments import called
from diffproj.calibration.ambiguity import OtherPoses
from diffproj.calibration.constraints import held_at
from diffproj.calibration.locate import located
from diffproj.calibration.one_lens import calibrated
from diffproj.calibration.options import Options, calibration_options
from diffproj.calibration.parametrisation import Parametrisation
from diffproj.calibration.result import Calibration, CalibrationError
from diffproj.calibration.rig_start import Seen
from diffproj.calibration.rig_views import RigViews
from diffproj.calibration.solver import Status
from diffproj.geometry.camera import Camera, as_camera
from diffproj.lens.models import LensModel, model_named, model_of
from diffproj.targets.target import Target
from diffproj.targets.views import Views


def checked_cameras(cameras: object, names: tuple[str, ...]) -> dict[str, Camera]:
    """The cameras that are known beforehand, by name, each one camera.

    Raises:
        TypeError: no mapping from names to cameras.
        ValueError: a name of none of the rig's, or a batch of cameras.
    """
    cameras = getattr(cameras, "cameras", cameras)
    if cameras is None:
        return {}
    if not isinstance(cameras, Mapping):
        raise TypeError(f"cameras: want a mapping from names to dp.Camera, or a calibrated rig, got {called(cameras)}")
    found = {}
    for name, camera in cameras.items():
        if name not in names:
            raise ValueError(f"cameras: want names of cameras, {', '.join(names)}, got {name!r}")
        found[name] = as_camera(camera.camera if isinstance(camera, Calibration) else camera, f"cameras[{name!r}]")
        if found[name].batch_shape:
            raise ValueError(f"cameras[{name!r}]: want one camera, got batch shape {tuple(found[name].batch_shape)}")
        model_of(found[name].distortion)
        K = found[name].K
        if bool(K[1, 0] != 0) or bool((K.diagonal()[:2] < 0).all()):
            found[name] = found[name].upright()
    return found


def lenses(distortion: LensModel | Mapping[str, LensModel], names: tuple[str, ...]) -> dict[str, LensModel]:
    """The lens to fit, by camera.

    Raises:
        ValueError: no such lens, or none for a camera.
    """
    chosen: dict[str, LensModel] = (
        dict(distortion) if isinstance(distortion, Mapping) else dict.fromkeys(names, distortion)
    )
    lacking = [name for name in names if name not in chosen]
    if lacking or set(chosen) - set(names):
        raise ValueError(f"distortion: want a lens for each of {', '.join(names)}, got one for {', '.join(chosen)}")
    for lens in chosen.values():
        model_named(lens)
    return {name: chosen[name] for name in names}


class Alone(NamedTuple):
    """A camera on its own.

    Attributes:
        parameters: which its own are.
        seen: they, and the target in each view.
        rms: RMS reprojection error in pixels.
        remark: what is to be known of it, in one text; computed when called.
        others: the other pose of each of its views, from the target's own frame; computed when called.
    """

    parameters: Parametrisation
    seen: Seen
    rms: float
    remark: Callable[[], str]
    others: Callable[[], OtherPoses]


def alone(
    views: RigViews,
    target: Target,
    lens: Mapping[str, LensModel],
    known: Mapping[str, Camera],
    fixed: Mapping[str, tuple[str, ...]],
    options: Options,
    who: str,
) -> dict[str, Alone]:
    """Each camera on its own.

    Args:
        views: of all cameras.
        target: that they saw.
        lens: to fit, by camera.
        known: cameras that are known beforehand.
        fixed: names of the parameters that are held, by camera.
        options: checked.
        who: was asked, for messages.

    Raises:
        CalibrationError: the views of a camera do not determine it.
        ValueError: photographs of unknown size, or nothing is known of what is to be held.
    """
    found: dict[str, Alone] = {}
    alike: dict[Any, list[str]] = {}
    for name in views.names:
        own = views.data[name].views
        if name in known:
            found[name] = _located(views, name, target, known[name], fixed[name], options, who)
        elif own.size is None:
            raise ValueError(f"views_by_camera[{name!r}]: want the photographs' size, got None; give Views(..., size=)")
        else:
            alike.setdefault((lens[name], own.size, fixed[name]), []).append(name)
    for (model, _, held), cameras in alike.items():
        free = {"fixed": held, "reject_outliers": options.reject_outliers, "throw": False}
        chosen = calibration_options(who, _limits(options) | free)
        try:
            found |= _calibrated(views, cameras, target, model, chosen, who)
        except ValueError as error:
            if not str(error).startswith("fixed:"):
                raise
            raise ValueError(
                f"fixed: want cameras={{{cameras[0]!r}: ...}} with it, for of its {', '.join(held)} nothing is known"
            ) from None
    return {name: found[name] for name in views.names}


def _limits(options: Options) -> dict[str, Any]:
    return {name: getattr(options, name) for name in ("loss", "max_iterations", "tolerance")}


def _located(
    views: RigViews,
    name: str,
    target: Target,
    camera: Camera,
    fixed: tuple[str, ...],
    options: Options,
    who: str,
) -> Alone:
    """The views of a camera that is known."""
    data = views.data[name]
    weights = None if data.weights is None else data.weights[0]
    try:
        found = located(data.views, target, camera, weights=weights, throw=False, **_limits(options))
    except ValueError as error:
        raise ValueError(str(error).replace("camera:", f"cameras[{name!r}]:", 1)) from None
    if bool(found.status != Status.CONVERGED):
        raise CalibrationError(f"{who}: {name!r} with the camera that was given: {found.message}", found)
    R, t = found.cameras.R.detach(), found.cameras.t.detach()
    shared = found.shared.detach()
    if fixed:  # what is held stays as it was given
        shared = held_at(shared.unsqueeze(0), shared.unsqueeze(0), found.parameters, fixed)[0]
    seen = Seen(shared, *data.frame.pose(R, t), found.used)
    return Alone(found.parameters, seen, float(found.rms), str, partial(_others, found))


def _calibrated(
    views: RigViews, cameras: list[str], target: Target, lens: LensModel, options: Options, who: str
) -> dict[str, Alone]:
    """Cameras alike, calibrated side by side; those with fewer views get some in which nothing is seen."""
    own = [views.data[name] for name in cameras]
    most = max(len(data.views) for data in own)

    def filled(part: Tensor) -> Tensor:
        return torch.cat([part, part.new_zeros(most - len(part), *part.shape[1:])])

    pixels, visible = (
        torch.stack([filled(part[0]) for part in parts])
        for parts in ([data.pixels for data in own], [data.views.visible.unsqueeze(0) for data in own])
    )
    weights = None
    if any(data.weights is not None for data in own):
        ones = [data.weights if data.weights is not None else torch.ones_like(data.pixels[..., 0]) for data in own]
        weights = torch.stack([filled(part[0]) for part in ones])
    together = Views.unchecked(pixels, visible, tuple(map(str, range(most))), own[0].views.size)
    found = calibrated(together, target, lens, options.but(weights=weights), who)
    alone = {}
    for i, name in enumerate(cameras):
        if bool(found.status[i] != Status.CONVERGED):
            _refuse(views, name, target, lens, options, who)
        count = len(own[i].views)
        R, t = found.cameras.R[i, :count].detach(), found.cameras.t[i, :count].detach()
        seen = Seen(
            found.shared[i].detach(),
            *own[i].frame.pose(R, t),
            found.used[i, :count],
        )
        alone[name] = Alone(
            found.parameters,
            seen,
            float(found.rms[i]),
            partial(_remark, found, i),
            partial(_others, found, (i, slice(count))),
        )
    return alone


def _refuse(views: RigViews, name: str, target: Target, lens: LensModel, options: Options, who: str) -> None:
    """Say why a camera is not determined by its own views, with their names."""
    data = views.data[name]
    weights = None if data.weights is None else data.weights[0]
    found = calibrated(data.views, target, lens, options.but(weights=weights), who)
    raise CalibrationError(
        f"{who}: camera {name!r} on its own: {found.message}; or give its intrinsics, cameras={{{name!r}: ...}} with "
        f"fixed=({name + '.intrinsics'!r},)",
        found,
    )


def _others(found: Calibration, which: tuple[int | slice, ...] = ()) -> OtherPoses:
    others = found.other_poses
    return OtherPoses(others.R[which], others.t[which], others.ratio[which])


def _remark(found: Calibration, number: int) -> str:
    return found.remarks[number]
