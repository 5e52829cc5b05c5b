"""`Knowledge`: which parameters of a camera are to be found, which keep their values, and what is known of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffproj._core.arguments import called, words
from diffproj._core.copying import ordinary
from diffproj._core.numerics import check_tensor, in_float64
from diffproj.calibration.evidence.pose_parameters import ANGLES, PLACE, TURNS, PoseParameters
from diffproj.calibration.least_squares.solver import Prior
from diffproj.calibration.problem.constraints import Priors, check_focal
from diffproj.calibration.problem.parametrisation import POSE, Parametrisation
from diffproj.geometry.camera import Camera
from diffproj.geometry.cayley import turn_between
from diffproj.geometry.mounting import mounting_of

MOST_TILT = 180.0
"""Tilt in degrees beyond which it is none; between 90 and this a camera leans over backwards."""
STEEPEST = 89.9
"""Tilt in degrees, down or up, from which on roll and heading turn about the same axis."""


@dataclass(frozen=True)
class Known:
    """A prior on some parameters.

    Attributes:
        name: as the caller said it.
        where: which parameters.
        mean: `(*B, n)`; the camera's own values if `None`.
        deviation: `(*B, n)`.
    """

    name: str
    where: tuple[int, ...]
    mean: Tensor | None
    deviation: Tensor


@dataclass(frozen=True)
class Knowledge:
    """What moves, and what is known.

    Attributes:
        camera: intrinsics and lens as names.
        angles: whether tilt, roll and heading are parameters; a turn of the camera if not.
        columns: the parameters that move.
        tied: whether `f_x : f_y` keeps its ratio.
        priors: on some of them.
    """

    camera: Parametrisation
    angles: bool
    columns: tuple[int, ...]
    tied: bool
    priors: tuple[Known, ...]

    def parameters(self, R: Tensor) -> PoseParameters:
        """The parameters of cameras that start at these rotations `(P, 3, 3)`."""
        return PoseParameters(self.camera, None if self.angles else R)

    def basis(self, values: Tensor) -> Tensor:
        """The directions in which the parameters `(P, q)` move `(P, q, r)`."""
        moving = [i for i in self.columns if not (self.tied and i == 1)]
        identity = torch.eye(values.shape[-1], dtype=values.dtype, device=values.device)
        basis = identity[:, moving].expand(len(values), -1, -1).clone()
        if self.tied:
            basis[:, 1, moving.index(0)] = (values[:, 1] / values[:, 0]).detach()
        return basis

    def about(self, own: Tensor, batch: Sequence[int]) -> "Knowledge":
        """The same with priors about these values `(P, q)`, of P cameras of batch shape `*B`, where none was said."""
        told = [
            replace(one, mean=own[:, list(one.where)].reshape(*batch, -1)) if one.mean is None else one
            for one in self.priors
        ]
        return replace(self, priors=tuple(told))

    def prior(self, own: Tensor, batch: Sequence[int]) -> Prior:
        """The priors about the camera's own values `(P, q)`, with their graph; P cameras of this batch shape."""
        mean, precision = own, torch.zeros_like(own)
        for known in self.priors:
            where = torch.tensor(known.where, device=own.device)
            n = len(known.where)
            if known.mean is not None:
                middle = known.mean.to(own).expand(*batch, n).reshape(-1, n)
                mean = mean.index_copy(1, where, middle)
            deviation = known.deviation.to(own).expand(*batch, n).reshape(-1, n)
            precision = precision.index_copy(1, where, deviation.square().reciprocal())
        return Prior(torch.where(precision > 0, mean, 0.0), torch.diag_embed(precision))

    def begin(self, own: Tensor, prior: Prior) -> Tensor:
        """Where to start `(P, q)`: at the means of the priors, elsewhere at the camera's own values."""
        known = prior.precision.diagonal(dim1=-2, dim2=-1) > 0
        start = torch.where(known, prior.mean, own)
        if self.tied:
            start = torch.cat([start[:, :1], start[:, :1] * own[:, 1:2] / own[:, :1], start[:, 2:]], dim=-1)
        return start

    def moves(self, name: str) -> bool:
        """Whether a parameter of the pose is to be found."""
        return self._at(name) in self.columns

    def given(self, name: str) -> bool:
        """Whether a parameter of the pose is held, or has a prior."""
        at = self._at(name)
        return at not in self.columns or any(at in known.where for known in self.priors)

    @property
    def turns_freely(self) -> bool:
        """Whether the camera turns about its own axes, all of them, and nothing is known of how far from its start."""
        return not self.angles and not any(self.given(name) for name in TURNS)

    def turned_to(self, R: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        """How cameras that began at rotations `first (..., 3, 3)`, and that turns tell, come to look along R.

        Returns:
            The rotations that turns are about, and the turns `(..., 3)` in degrees: R itself and 0, unless something is
            known of turns, which are about where the camera began then; those that are held are 0.
        """
        first = first.expand_as(R)
        if self.turns_freely:
            return R, torch.zeros_like(R[..., 0])
        turn = turn_between(first, R).rad2deg().nan_to_num(0.0, 0.0, 0.0)
        return first, turn * torch.tensor([self.moves(name) for name in TURNS], device=R.device).to(turn)

    def _at(self, name: str) -> int:
        return (*self.camera.names, *(ANGLES if self.angles else TURNS), *PLACE).index(name)


def knowledge(
    camera: Camera, priors: Priors | None, fixed: Sequence[str], free: Sequence[str], tied_focal: bool
) -> Knowledge:
    """What the caller said, checked.

    Raises:
        TypeError: priors are no mapping, or hold no numbers.
        ValueError: an unknown name, one that is said twice, or values that cannot be.
    """
    if priors is not None and not isinstance(priors, Mapping):
        raise TypeError(f"priors: want a mapping from names, got {called(priors)}")
    said = {} if priors is None else dict(priors)
    words("priors", tuple(said), "names of parameters")
    mentioned = {*said, *fixed}
    angles, turns = mentioned & {*ANGLES, "mounting"}, mentioned & {*TURNS, "turn"}
    if angles and turns:
        raise ValueError(f"priors: want tilt, roll and heading, or turns, got both {min(angles)!r} and {min(turns)!r}")
    shared = Parametrisation.of(camera)
    names = PoseParameters(shared, None if angles else torch.empty(0, dtype=torch.float64, device=camera.device))
    known = tuple(_known(names, name, value, tied_focal, camera.batch_shape) for name, value in said.items())
    taken: set[int] = set()
    for one in known:
        if taken & set(one.where):
            raise ValueError(f"priors: want each parameter once, got {one.name!r} in two of them")
        taken |= set(one.where)
    held = {at for name in fixed for at in names.positions("fixed", name)}
    asked = {at for name in free for at in names.positions("free", name)}
    for at in sorted(held & (asked | taken)):
        other = "priors" if at in taken else "free"
        raise ValueError(f"fixed: want what has neither a prior nor is free, got {names.names[at]!r}, also in {other}")
    pose = set(range(shared.size, shared.size + POSE)) - held
    columns = pose | asked | taken
    tied = tied_focal and ("focal" in free or "focal" in said) and "f_x" not in free and "f_y" not in free
    if tied:
        columns |= {0, 1}
    found = Knowledge(shared, bool(angles), tuple(sorted(columns)), tied, known)
    _check_steep(camera, found)
    return found


def prior_shapes(known: Knowledge) -> list[torch.Size]:
    """The batch shapes of the priors' values."""
    shapes = []
    for one in known.priors:
        shapes.append(one.deviation.shape[:-1])
        if one.mean is not None:
            shapes.append(one.mean.shape[:-1])
    return shapes


def _known(names: PoseParameters, name: str, value: Any, tied_focal: bool, batch: Sequence[int]) -> Known:
    where = names.positions("priors", name)
    if name == "focal" and tied_focal:
        where = where[:1]
    pair = value if isinstance(value, tuple) else (None, value)
    if len(pair) != 2:
        raise ValueError(f"priors: want a deviation or (mean, deviation) for {name!r}, got {called(value)}")
    mean, deviation = (
        None if one is None and at == 0 else _numbers(name, one, len(where)) for at, one in enumerate(pair)
    )
    if deviation is not None:
        _check_no_covariance(name, deviation.detach(), batch)
    if deviation is None or not bool((deviation.detach() > 0).all()):
        raise ValueError(f"priors: want a positive standard deviation for {name!r}, got {called(pair[1])}")
    if mean is not None and name == "height" and not bool((mean.detach() > 0).all()):
        raise ValueError(f"priors: want a height above the ground, more than 0, got {called(pair[0])}")
    if mean is not None and name == "tilt" and not bool((mean.detach().abs() <= MOST_TILT).all()):
        want = f"a tilt in degrees below the horizon, from {-MOST_TILT:g} to {MOST_TILT:g}"
        raise ValueError(f"priors: want {want}, got {called(pair[0])}")
    if mean is not None:
        check_focal(name, mean, pair[0])
    return Known(name, tuple(where), mean, deviation)


def _numbers(name: str, value: Any, count: int) -> Tensor:
    """`(*B, count)` of a number, `(*B,)` for a single parameter, or `(*B, count)`."""
    if value is None or isinstance(value, bool | str):
        raise TypeError(f"priors: want numbers for {name!r}, got {called(value)}")
    tensor = ordinary(in_float64(check_tensor(f"priors[{name!r}]", value)))
    if not bool(tensor.detach().isfinite().all()):
        raise ValueError(f"priors: want finite numbers for {name!r}, got {called(value)}")
    if tensor.ndim == 0 or count == 1:
        return tensor.unsqueeze(-1).expand(*tensor.shape, count)
    if tensor.shape[-1] not in (1, count):
        raise ValueError(f"priors: want {name!r} of shape (*B, {count}), got {tuple(tensor.shape)}")
    return tensor.expand(*tensor.shape[:-1], count)


def _check_no_covariance(name: str, given: Tensor, batch: Sequence[int]) -> None:
    """Refuse a covariance `(n, n)` of n parameters, which has the shape of deviations of n cameras."""
    n = given.shape[-1]
    if n < 2 or given.shape != (n, n) or (tuple(batch[-1:]) == (n,) and bool((given > 0).all())):
        return
    if bool((given == given[0, 0]).all()):  # one deviation for all of n cameras
        return
    if bool((given == given.mT).all()) and bool((torch.linalg.eigvalsh(given) >= -1e-9 * given.abs().amax()).all()):
        raise ValueError(
            f"priors: want standard deviations for {name!r}, ({n},) or (*B, {n}), got what looks like a covariance "
            f"({n}, {n}): what errs together is told by an observation of your own, as help(dp.Observation) shows; if "
            f"it is the deviations of {n} cameras, give a camera of batch shape ({n},)"
        )


def _check_steep(camera: Camera, known: Knowledge) -> None:
    """Refuse priors on roll where a camera looks straight down: they would say nothing of how far it leans aside."""
    said = {one.name: one for one in known.priors}
    if not known.angles or "roll" not in said:
        return
    tilt = said["tilt"].mean if "tilt" in said else None
    steep = mounting_of(camera).tilt if tilt is None else tilt
    if bool((steep.detach().abs() > STEEPEST).any()):
        raise ValueError(
            "priors: want turn_x, turn_y and turn_z, degrees about the camera's own axes, for a camera that looks "
            "straight down: roll and heading turn it about the same axis there, so nothing tells how it leans aside"
        )
