"""Each camera of a rig on its own: intrinsics where none are given, and the target as each of its views sees it."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj._core.arguments import called
from diffproj.calibration.fitting.data import Data
from diffproj.calibration.fitting.fit import Fit
from diffproj.calibration.fitting.options import Options, calibration_options
from diffproj.calibration.fleet import FILLED, MOST
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.locate import located
from diffproj.calibration.one_lens import calibrated, fitted
from diffproj.calibration.outcome import outcome
from diffproj.calibration.problem.constraints import held_at
from diffproj.calibration.problem.parametrisation import Parametrisation
from diffproj.calibration.results.ambiguity import OtherPoses
from diffproj.calibration.results.calibration import Calibration, CalibrationError
from diffproj.calibration.results.remark import Remarks
from diffproj.calibration.rigs.start import Seen
from diffproj.calibration.rigs.views import RigViews
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
        got = ", ".join(map(str, chosen))
        raise ValueError(f"distortion: want a lens for each of {', '.join(names)}, got one for {got}")
    for lens in chosen.values():
        model_named(lens)
    return {name: chosen[name] for name in names}


class Alone(NamedTuple):
    """A camera on its own.

    Attributes:
        parameters: which its own are.
        seen: they, and the target in each view.
        rms: RMS reprojection error in pixels.
        findings: what is to be known of it; computed when called.
        others: the other pose of each of its views, from the target's own frame; computed when called.
        restrained: whether its terms below the line are held near those of a poorer lens, for without that it folds.
    """

    parameters: Parametrisation
    seen: Seen
    rms: float
    findings: Callable[[], Remarks]
    others: Callable[[], OtherPoses]
    restrained: bool = False


class Asked(NamedTuple):
    """What the cameras of a rig are looked at by, each on its own.

    Attributes:
        views: of all cameras.
        target: that they saw.
        lens: to fit, by camera.
        known: cameras that are known beforehand.
        fixed: names of the parameters that are held, by camera.
        priors: on each camera's own parameters, by camera.
        options: checked.
        who: was asked, for messages.
    """

    views: RigViews
    target: Target
    lens: Mapping[str, LensModel]
    known: Mapping[str, Camera]
    fixed: Mapping[str, tuple[str, ...]]
    priors: Mapping[str, Mapping[str, Any]]
    options: Options
    who: str


def alone(asked: Asked) -> dict[str, Alone]:
    """Each camera of a rig on its own.

    Raises:
        CalibrationError: the views of a camera do not determine it.
        ValueError: photographs of unknown size, or nothing is known of what is to be held.
    """
    found = alone_together([asked])[0]
    if isinstance(found, Exception):
        raise found
    return found


def alone_together(asked: Sequence[Asked]) -> list[dict[str, Alone] | CalibrationError | ValueError]:
    """The same of many rigs, whose cameras alike are calibrated side by side; in the place of a rig, what it lacks."""
    found: list[dict[str, Alone] | CalibrationError | ValueError] = [{} for _ in asked]
    alike: dict[Any, list[tuple[int, str]]] = {}
    for number, one in enumerate(asked):
        try:
            found[number] = _known_ones(one)
        except (CalibrationError, ValueError) as error:
            found[number] = error
            continue
        for name in one.views.names:
            if name not in one.known:
                own = one.views.data[name].views
                alike.setdefault(
                    (one.lens[name], own.size, one.fixed[name], str(one.priors[name]), own.device), []
                ).append((number, name))
    for members in alike.values():
        for batch in _batches(asked, members):
            for (number, name), one in zip(batch, _calibrated(asked, batch), strict=True):
                so_far = found[number]
                if isinstance(one, Exception):
                    found[number] = so_far if isinstance(so_far, Exception) else one
                elif not isinstance(so_far, Exception):
                    so_far[name] = one
    return [
        own if isinstance(own, Exception) else {name: own[name] for name in one.views.names}
        for own, one in zip(found, asked, strict=True)
    ]


def _known_ones(asked: Asked) -> dict[str, Alone]:
    """The cameras of a rig that are known beforehand."""
    found = {}
    for name in asked.views.names:
        if name in asked.known:
            found[name] = _located(asked, name)
        elif asked.views.data[name].views.size is None:
            raise ValueError(f"views_by_camera[{name!r}]: want the photographs' size, got None; give Views(..., size=)")
    return found


def _batches(asked: Sequence[Asked], members: list[tuple[int, str]]) -> list[list[tuple[int, str]]]:
    """Cameras alike, those of one rig together; of many rigs, as many in a batch as have about as many views."""
    if len(asked) == 1:
        return [members]
    counts = {(number, name): len(asked[number].views.data[name].views) for number, name in members}
    batches: list[list[tuple[int, str]]] = []
    for member in sorted(members, key=lambda one: counts[one]):
        if not batches or len(batches[-1]) == MOST or counts[member] > FILLED * counts[batches[-1][0]]:
            batches.append([])
        batches[-1].append(member)
    return batches


def _limits(options: Options) -> dict[str, Any]:
    return {name: getattr(options, name) for name in ("loss", "max_iterations", "tolerance")}


def _located(asked: Asked, name: str) -> Alone:
    """The views of a camera that is known."""
    data, fixed = asked.views.data[name], asked.fixed[name]
    weights = None if data.weights is None else data.weights[0]
    limits = _limits(asked.options)
    try:
        found = located(data.views, asked.target, asked.known[name], weights=weights, throw=False, **limits)
    except ValueError as error:
        raise ValueError(str(error).replace("camera:", f"cameras[{name!r}]:", 1)) from None
    if bool(found.status != Status.CONVERGED):
        raise CalibrationError(f"{asked.who}: {name!r} with the camera that was given: {found.message}", found)
    R, t = found.cameras.R.detach(), found.cameras.t.detach()
    shared = found.shared.detach()
    if fixed:  # what is held stays as it was given
        shared = held_at(shared.unsqueeze(0), shared.unsqueeze(0), found.parameters, fixed)[0]
    seen = Seen(shared, *data.frame.pose(R, t), found.used)
    return Alone(found.parameters, seen, float(found.rms), tuple, partial(getattr, found, "other_poses"))


def _calibrated(
    asked: Sequence[Asked], members: Sequence[tuple[int, str]]
) -> list[Alone | CalibrationError | ValueError]:
    """Cameras alike, calibrated side by side; those with fewer views get some in which nothing is seen."""
    first, name = asked[members[0][0]], members[0][1]
    free = {
        "fixed": first.fixed[name],
        "priors": first.priors[name] or None,
        "reject_outliers": first.options.reject_outliers,
        "throw": False,
    }
    chosen = calibration_options(first.who, _limits(first.options) | free)
    own = [asked[number].views.data[name] for number, name in members]
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
    whole = Views.unchecked(pixels, visible, tuple(map(str, range(most))), own[0].views.size)
    try:
        together, fit = fitted(whole, first.target, first.lens[name], chosen.but(weights=weights))
    except ValueError as error:
        if not str(error).startswith("fixed:"):
            raise
        return [_unknown(asked[number], name) for number, name in members]
    found = outcome(first.who, together, fit, whole.size, throw=False)
    shared, rms = found.shared.detach(), found.rms.tolist()  # of all cameras, each time that they are asked for
    restrained = fit.is_restrained().tolist()
    results: list[Alone | CalibrationError | ValueError] = []
    for row, (number, name) in enumerate(members):
        if bool(found.status[row] != Status.CONVERGED):
            results.append(_refusal(asked[number], name, chosen))
            continue
        data, count = own[row], len(own[row].views)
        R, t = found.cameras.R[row, :count].detach(), found.cameras.t[row, :count].detach()
        seen = Seen(shared[row], *data.frame.pose(R, t), found.used[row, :count])
        part = _Part(first.who, data, fit.alone(row, count))
        results.append(Alone(found.parameters, seen, rms[row], part.findings, part.others, restrained[row]))
    return results


class _Part:
    """One camera of a batch, as it would be alone, with its views by their names; a rig carries it along."""

    def __init__(self, who: str, data: Data, fit: Fit) -> None:
        self._given = who, data, fit

    @cached_property
    def calibration(self) -> Calibration:
        """What is said of it."""
        who, data, fit = self._given
        return outcome(who, data, fit, data.views.size, throw=False)

    def findings(self) -> Remarks:
        """What is to be known of it."""
        return self.calibration.findings[0]

    def others(self) -> OtherPoses:
        """The other pose of each of its views."""
        return self.calibration.other_poses


def _unknown(asked: Asked, name: str) -> ValueError:
    held = ", ".join(asked.fixed[name])
    return ValueError(f"fixed: want cameras={{{name!r}: ...}} with it, for of its {held} nothing is known")


def _refusal(asked: Asked, name: str, options: Options) -> CalibrationError:
    """Why a camera is not determined by its own views, with their names."""
    data = asked.views.data[name]
    weights = None if data.weights is None else data.weights[0]
    found = calibrated(data.views, asked.target, asked.lens[name], options.but(weights=weights), asked.who)
    return CalibrationError(
        f"{asked.who}: camera {name!r} on its own: {found.message}; or give its intrinsics, cameras={{{name!r}: ...}} "
        f"with fixed=({name + '.intrinsics'!r},)",
        found,
    )
