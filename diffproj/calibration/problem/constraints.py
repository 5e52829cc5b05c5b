"""The shared parameters by name: which are fixed, tied or known beforehand.

Names are those of the summary (`f_x f_y c_x c_y k1 k2 p1 p2 k3 ... bow_x bow_y`) or of groups: `focal`,
`principal_point`, `distortion`, `bow`, and for free points `points`, `points_x`, `points_y` and `points_z`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from diffproj._core.arguments import called, tensor_of
from diffproj.calibration.least_squares.solver import Prior
from diffproj.calibration.problem.parametrisation import Parametrisation

Priors = Mapping[str, Any]
"""By name or group: a standard deviation about the starting value, or a tuple `(mean, standard deviation)`; numbers or
tensors that broadcast to `(*B, size of the group)`."""


def free_basis(shared: Tensor, parameters: Parametrisation, fixed: Sequence[str], tied_focal: bool) -> Tensor | None:
    """The directions `(P, s, q)` in which the shared parameters may move; `None` where all may.

    Args:
        shared: the start `(P, s)`.
        parameters: which they are.
        fixed: names or groups that keep their starting values.
        tied_focal: `f_x : f_y` keeps the start's ratio.

    Raises:
        ValueError: an unknown name, or one focal length fixed while they are tied.
    """
    held = {position for name in fixed for position in parameters.positions("fixed", name)}
    if tied_focal and len(held & {0, 1}) == 1:
        raise ValueError("fixed: want both focal lengths or none while tied_focal=True, got one of them")
    tied = tied_focal and not held & {0, 1}
    if not held and not tied:
        return None
    identity = torch.eye(parameters.size, dtype=shared.dtype, device=shared.device)
    columns = [i for i in range(parameters.size) if i not in held and not (tied and i == 1)]
    basis = identity[:, columns].expand(len(shared), -1, -1).clone()
    if tied:
        basis[:, 1, 0] = shared[:, 1] / shared[:, 0]
    return basis


def ratio_only(own: Tensor, basis: Tensor) -> Tensor:
    """Zero, shaped as the basis, with the first derivative of one of tied focal lengths by those of `own (P, s)`.

    f_x is the first direction of the basis, and f_y follows it.
    """
    ratio = own[:, 1] / own[:, 0]
    place = torch.zeros_like(basis[:1])
    place[0, 1, 0] = 1.0
    return place * (ratio - ratio.detach())[:, None, None]


def held_at(reference: Tensor, shared: Tensor, parameters: Parametrisation, fixed: Sequence[str]) -> Tensor:
    """The start `(P, s)` with fixed parameters at the values that they keep.

    Raises:
        ValueError: nothing is known of what is to be fixed.
    """
    held = sorted({position for name in fixed for position in parameters.positions("fixed", name)})
    if not held:
        return shared
    if bool(reference[:, held].isnan().any()):
        raise ValueError("fixed: want what is known beforehand; a focal length is for refine, whose camera has one")
    return shared.index_copy(1, torch.tensor(held, device=shared.device), reference[:, held])


def make_prior(
    priors: Priors | None, shared: Tensor, parameters: Parametrisation, batch: Sequence[int], tied_focal: bool
) -> Prior | None:
    """The prior on the shared parameters; gradients flow to tensors among its values, and to those it is about.

    Focal lengths that are tied are one number: a prior on `focal` then is one measurement, of `f_x`.

    Raises:
        ValueError: an unknown name, a shape that does not fit, or a deviation that is not positive.
    """
    if not priors:
        return None
    told = [name for name, value in priors.items() if not isinstance(value, tuple)]
    about = sorted({position for name in told for position in parameters.positions("priors", name)})
    mean = shared.detach()
    if about:
        mean = mean.index_copy(1, torch.tensor(about, device=shared.device), shared[:, about])
    precision = torch.zeros_like(mean)
    for name, value in priors.items():
        where = parameters.positions("priors", name)
        pair = value if isinstance(value, tuple) else (None, value)
        if len(pair) != 2:
            raise ValueError(f"priors: want a deviation or (mean, deviation) for {name!r}, got {called(value)}")
        if pair[0] is not None:
            mean = _written(mean, where, pair[0], name, batch)
        deviation = _written(torch.ones_like(mean), where, pair[1], name, batch)
        if not bool((deviation > 0).all()):
            raise ValueError(f"priors: want a positive standard deviation for {name!r}, got {pair[1]}")
        if not bool(mean.detach()[:, where].isfinite().all()):
            raise ValueError(f"priors: want (mean, deviation) with a finite mean for {name!r}, got {value!r}")
        if pair[0] is not None:
            check_focal(name, mean[:, where], pair[0])
        chosen = torch.zeros_like(mean)
        chosen[:, where[:1] if name == "focal" and tied_focal else where] = 1.0
        precision = precision * (1 - chosen) + chosen / deviation.square()
    return Prior(torch.where(precision > 0, mean, 0.0), torch.diag_embed(precision))


def check_focal(name: str, mean: Tensor, said: Any) -> None:
    """Check what is said of a focal length.

    Raises:
        ValueError: it is none.
    """
    if name in ("focal", "f_x", "f_y") and not bool((mean.detach() > 0).all()):
        raise ValueError(f"priors: want a focal length in px, more than 0, for {name!r}, got {called(said)}")


def of_points(name: str) -> tuple[int, ...]:
    """The axes of the free points' displacements that a group stands for; none if it is one of other parameters."""
    return {"points": (0, 1, 2), "points_x": (0,), "points_y": (1,), "points_z": (2,)}.get(name, ())


def of_camera(priors: Priors | None) -> Priors | None:
    """The priors but for those of free points."""
    return priors and {name: value for name, value in priors.items() if not of_points(name)}


def printing_precision(priors: Priors | None, batch: Sequence[int], points: Tensor) -> Tensor | None:
    """The precision `(P, N, 3, 3)` of free points' displacements, in world units; `None` where nothing is known.

    It carries gradients to deviations that are tensors.

    Raises:
        ValueError: a shape that does not fit, or a deviation that is not positive.
    """
    precision, known = points.new_zeros(*batch, *points.shape), False
    for name, value in (priors or {}).items():
        axes = list(of_points(name))
        if not axes:
            continue
        if isinstance(value, tuple):
            raise ValueError(  # noqa: TRY004
                f"priors: want a standard deviation about the target's own points for {name!r}, got a tuple; where "
                "they are known better, give them as the target"
            )
        deviation = tensor_of(f"priors[{name!r}]", value)
        if deviation.is_complex() or deviation.is_meta:
            raise TypeError(f"priors: want real numbers for {name!r}, got {deviation.dtype} on {deviation.device}")
        if not bool((deviation > 0).all()):
            raise ValueError(f"priors: want a positive standard deviation for {name!r}, got {value}")
        want = (*batch, len(points), len(axes)) if len(axes) > 1 else (*batch, len(points))
        try:
            deviation = deviation.to(points).expand(want)
        except RuntimeError:
            got = tuple(deviation.shape)
            raise ValueError(f"priors: want {name!r} to broadcast to {want}, got {got}") from None
        own = deviation.unsqueeze(-1) if len(axes) == 1 else deviation
        precision[..., axes] = own.square().reciprocal()
        known = True
    return torch.diag_embed(precision.reshape(-1, *points.shape)) if known else None


def _written(into: Tensor, where: list[int], value: Any, name: str, batch: Sequence[int]) -> Tensor:
    """A copy with `value`, which broadcasts to `(*B, len(where))`, at some columns."""
    tensor = tensor_of(f"priors[{name!r}]", value)
    if tensor.is_complex() or tensor.is_meta:
        raise TypeError(f"priors: want real numbers for {name!r}, got {tensor.dtype} on {tensor.device}")
    try:
        tensor = tensor.to(into).expand(*batch, len(where)).reshape(-1, len(where))
    except RuntimeError:
        want = (*batch, len(where))
        raise ValueError(f"priors: want {name!r} to broadcast to {want}, got {tuple(tensor.shape)}") from None
    return into.index_copy(1, torch.tensor(where, device=into.device), tensor)
