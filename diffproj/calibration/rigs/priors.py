"""The priors of a rig by name: of its cameras' own parameters, as in `calibrate`, and of their places."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from diffproj._core.arguments import called, tensor_of
from diffproj.calibration.problem.constraints import Priors, make_prior, of_camera
from diffproj.calibration.problem.parametrisation import Parametrisation
from diffproj.calibration.rigs.knowledge import BASELINE, CENTER, ROTATION, KnownPlace, RigKnowledge
from diffproj.calibration.rigs.options import owner_of, place_in_rig, positions_of
from diffproj.calibration.rigs.parameters import RigParameters
from diffproj.calibration.rigs.views import RigViews
from diffproj.geometry.camera import Camera

PLACES = (ROTATION, CENTER, BASELINE)


def own_priors(parameters: RigParameters, priors: Priors | None) -> dict[str, dict[str, Any]]:
    """What is known of each camera by itself: of its intrinsics, its lens and its place, by bare names.

    What is said of one camera counts before what is said of all.

    Raises:
        ValueError: a name that no camera has.
    """
    found: dict[str, dict[str, Any]] = {camera: {} for camera in parameters.cameras}
    said = [(*owner_of(parameters, entry), entry, value) for entry, value in (of_camera(priors) or {}).items()]
    for owner, what, entry, value in sorted(said, key=lambda one: one[0] is not None):
        having = [
            camera
            for number, (camera, kind) in enumerate(zip(parameters.cameras, parameters.kinds, strict=True))
            if owner in (None, camera) and (number > 0 if what in PLACES else len(positions_of(kind, what)) > 0)
        ]
        if not having:
            offered = ", ".join((*PLACES, "focal", "principal_point", "distortion", *parameters.kinds[0].names))
            raise ValueError(
                f"priors: want 'points', or names from {offered}, of all cameras, or of one, as "
                f"'{parameters.cameras[-1]}.baseline', got {entry!r}; the first camera's place is the rig's frame"
            )
        for camera in having:
            found[camera][what] = value
    return found


def rig_knowledge(
    parameters: RigParameters,
    own: Mapping[str, Mapping[str, Any]],
    known: Mapping[str, Camera],
    placed: Mapping[str, Camera],
    views: RigViews,
    held: Sequence[int],
) -> RigKnowledge | None:
    """What is known of the shared unknowns; `None` where nothing is.

    Args:
        parameters: the shared unknowns.
        own: priors by camera and bare name, of `own_priors`.
        known: cameras that are known beforehand: priors without a mean are about them.
        placed: those of them that stand somewhere.
        views: of all cameras.
        held: positions of the shared unknowns that are.

    Raises:
        TypeError: no numbers.
        ValueError: values that cannot be, nothing to be about, or something that is held as well.
    """
    like, first = views.points, placed.get(parameters.cameras[0])
    numbers: list[Tensor] = []
    places: list[KnownPlace] = []
    for c, (name, kind) in enumerate(zip(parameters.cameras, parameters.kinds, strict=True)):
        alone = {what: value for what, value in own[name].items() if what not in PLACES}
        start = parameters.intrinsics(c).start
        if alone:
            about = _reference(kind, known.get(name), views.data[name].views.size, like)
            try:
                prior = make_prior(alone, about.unsqueeze(0), kind, (), tied_focal=False)
            except ValueError as error:
                raise ValueError(_with_owner(str(error), name, alone)) from None
            mean, precision = prior.mean[0].detach(), prior.precision[0].diagonal().detach()  # type: ignore[union-attr]
            for i in (precision > 0).nonzero().flatten().tolist():
                _check_free(start + i, held, parameters)
                numbers.append(torch.stack([like.new_tensor(float(start + i)), mean[i], precision[i].rsqrt()]))
        for what in PLACES:
            if what in own[name]:
                at = parameters.pose(c).start
                _check_free(at, held, parameters)
                there = place_in_rig(first, placed[name]) if first is not None and name in placed else None
                places.append(_place(c, what, at, f"{name}.{what}", own[name][what], there, like))
    if not numbers and not places:
        return None
    where, mean, deviation = torch.stack(numbers).T if numbers else like.new_zeros(3, 0)
    return RigKnowledge(where.long(), mean.unsqueeze(0), deviation.unsqueeze(0), tuple(places), like.new_ones(1))


def _reference(kind: Parametrisation, known: Camera | None, size: tuple[int, int] | None, like: Tensor) -> Tensor:
    """What priors without a mean are about `(s_c,)`: what `fixed` would keep; NaN where nothing is known."""
    if known is not None:
        return kind.pack(known.to(torch.float64)).detach().to(like)
    about = like.new_zeros(kind.size)
    about[:4] = torch.nan
    if size is not None:
        about[2:4] = (like.new_tensor(size) - 1) / 2
    return about


def _place(
    camera: int, what: str, at: int, entry: str, value: Any, there: tuple[Tensor, Tensor] | None, like: Tensor
) -> KnownPlace:
    """A prior on a camera's place, about its place in the rig `there` if no mean is said."""
    count = 1 if what == BASELINE else 3
    pair = value if isinstance(value, tuple) else (None, value)
    if len(pair) != 2:
        raise ValueError(f"priors: want a deviation or (mean, deviation) for {entry!r}, got {called(value)}")
    deviation = _numbers(entry, pair[1], count, like)
    if not bool((deviation > 0).all()):
        raise ValueError(f"priors: want a positive standard deviation for {entry!r}, got {called(pair[1])}")
    if pair[0] is not None:
        mean = _numbers(entry, pair[0], count, like)
        if what == BASELINE and not bool(mean > 0):
            raise ValueError(
                f"priors: want a distance from the first camera, more than 0, for {entry!r}, got {pair[0]}"
            )
        if what == ROTATION:
            mean = axis_angle_to_rotation_matrix(mean.deg2rad().unsqueeze(0))[0]
    elif there is None:
        raise ValueError(
            f"priors: want (mean, deviation) for {entry!r}, or cameras= with it and the first camera at their poses, "
            "got a deviation alone; calibrations stand nowhere"
        )
    else:
        R, t = (part.to(like) for part in there)
        center = -(R.mT @ t)
        mean = {ROTATION: R, CENTER: center, BASELINE: center.norm().unsqueeze(0)}[what]
    deviation = deviation.deg2rad() if what == ROTATION else deviation
    return KnownPlace(camera, what, at, mean.unsqueeze(0), deviation.unsqueeze(0))


def _numbers(entry: str, value: Any, count: int, like: Tensor) -> Tensor:
    """`(count,)` finite numbers."""
    tensor = tensor_of(f"priors[{entry!r}]", value)
    if tensor.is_complex() or tensor.is_meta:
        raise TypeError(f"priors: want real numbers for {entry!r}, got {tensor.dtype} on {tensor.device}")
    try:
        tensor = tensor.detach().to(like).expand(count)
    except RuntimeError:
        got = tuple(tensor.shape)
        raise ValueError(f"priors: want {entry!r} to broadcast to {(count,)}, got {got}") from None
    if not bool(tensor.isfinite().all()):
        raise ValueError(f"priors: want finite numbers for {entry!r}, got {called(value)}")
    return tensor


def _check_free(position: int, held: Sequence[int], parameters: RigParameters) -> None:
    if position in held:
        raise ValueError(f"fixed: want what has no prior, got {parameters.names[position]!r}, also in priors")


def _with_owner(text: str, camera: str, names: Mapping[str, Any]) -> str:
    """A message about a parameter of one camera, with the camera's name before the parameter's."""
    for name in names:
        text = text.replace(f"for {name!r}", f"for '{camera}.{name}'").replace(
            f"want {name!r}", f"want '{camera}.{name}'"
        )
    return text
