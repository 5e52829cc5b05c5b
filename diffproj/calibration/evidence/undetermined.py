"""What evidence does not tell of a camera, by name: directions of the parameters in which nothing holds them."""

from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj.calibration.evidence.pose_parameters import MOUNTING, PoseParameters
from diffproj.calibration.evidence.problem import jacobian
from diffproj.calibration.problem.parametrisation import INTRINSICS, POSE
from diffproj.geometry.mounting import mounting_from_rotation

LARGEST = 10.0
"""Deviation in natural units (a radian, the focal length, the distance of what was seen) from which on a direction is
not determined."""
ANYWHERE = 1e3
"""Natural units of x and y in which these are judged where no landmark was seen."""
TIGHT = 1e4
"""Deviations of a prior in which what it holds is judged: beyond them all else would be lost in rounding."""
ROUNDING = 1e-14
"""The same of an eigenvalue of the normal matrix, relative to the largest."""
PART = 0.05
"""Part of a direction, in natural units, from which on a name is said."""
SHOWN = {"x": "position", "y": "position", "f_x": "focal", "f_y": "focal"} | {
    "c_x": "principal_point",
    "c_y": "principal_point",
}


class Lacking(NamedTuple):
    """What nothing tells of a camera.

    Attributes:
        names: of parameters or groups.
        together: whether something is told of them, but not of each.
        each: of the parameters alone.
    """

    names: tuple[str, ...] = ()
    together: bool = False
    each: tuple[str, ...] = ()


def natural(values: Tensor, reach: Tensor) -> Tensor:
    """A natural unit of each parameter `(P, q)`; `reach (P,)` is the distance of what was seen."""
    scale = torch.ones_like(values)
    scale[:, : len(INTRINSICS)] = values[:, :2].abs().mean(-1, keepdim=True)
    scale[:, -POSE:-3] = 180 / torch.pi
    scale[:, -3:] = reach.unsqueeze(-1)
    return scale


def units(basis: Tensor, scale: Tensor) -> Tensor:
    """The natural unit of each unknown `(P, r)`, which moves parameters along a basis `(P, q, r)`."""
    return (basis * scale.unsqueeze(-1)).amax(-2)


def decisive(basis: Tensor, scale: Tensor, precision: Tensor, placed: Tensor) -> Tensor:
    """The unit of each unknown `(P, r)` in which a direction is judged to be known.

    That of `units`, but smaller for what a prior holds tightly, beside which all else would look unknown, and larger
    for x and y where no landmark was seen: however wide a prior on them is, it tells them, for all else is straight.

    Args:
        basis: `(P, q, r)`.
        scale: natural units `(P, q)`.
        precision: of the priors `(P, q)`, one over their variance.
        placed: whether landmarks were seen `(P,)`.
    """
    anywhere = torch.where(placed, 1.0, ANYWHERE).to(scale)
    wide = torch.cat([scale[:, :-3], scale[:, -3:-1] * anywhere.unsqueeze(-1), scale[:, -1:]], dim=-1)
    known = (basis.square() * precision.unsqueeze(-1)).sum(-2).sqrt()
    return units(basis, wide).minimum(torch.where(known > 0, TIGHT / torch.where(known > 0, known, 1.0), torch.inf))


def inverse(H: Tensor, scale: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The (pseudo-)inverse of normal matrices `(P, r, r)` whose unknowns have these units `(P, r)`.

    Returns:
        The inverse, which eigenvalues are lost `(P, r)`, and the eigenvectors in these units `(P, r, r)`.
    """
    sound = H.isfinite().all(-1).all(-1)
    scaled = torch.where(sound[:, None, None], H * scale.unsqueeze(-1) * scale.unsqueeze(-2), 0.0)
    values, vectors = torch.linalg.eigh(scaled)
    largest = values.amax(-1, keepdim=True) if values.shape[-1] else values
    lost = values <= torch.clamp(ROUNDING * largest, min=LARGEST**-2)
    kept = torch.where(lost, 0.0, torch.where(lost, 1.0, values).reciprocal())
    found = vectors @ torch.diag_embed(kept) @ vectors.mT
    return found * scale.unsqueeze(-1) * scale.unsqueeze(-2), lost, vectors


def undetermined(
    parameters: PoseParameters,
    values: Tensor,
    basis: Tensor,
    scale: Tensor,
    unit: Tensor,
    lost: Tensor,
    vectors: Tensor,
) -> tuple[Tensor, list[Lacking]]:
    """Which parameters nothing tells `(P, q)`, and their names for each camera.

    Args:
        parameters: their names.
        values: where the solver ended `(P, q)`.
        basis: `(P, q, r)`.
        scale: natural units `(P, q)`.
        unit: of the unknowns `(P, r)`.
        lost: which directions `(P, r)`.
        vectors: the directions, in these units `(P, r, r)`.
    """
    vectors = (unit / units(basis, scale)).unsqueeze(-1) * vectors
    vectors = vectors / vectors.norm(dim=-2, keepdim=True).clamp(min=1e-300)
    along = basis @ (units(basis, scale).unsqueeze(-1) * vectors) / scale.unsqueeze(-1)
    unknown = ((along * lost.unsqueeze(-2)).square().sum(-1) > PART**2).to(torch.bool)
    names = [Lacking()] * len(values)
    if not bool(lost.any()):
        return unknown, names
    if parameters.start is not None:
        J = jacobian(lambda turn: _angles(parameters, values, turn), torch.zeros_like(values[:, -POSE:-3]))[1]
        along = torch.cat([along[:, :-POSE], J.permute(1, 2, 0) @ along[:, -POSE:-3], along[:, -3:]], dim=1)
    shown = [*parameters.camera.names, *MOUNTING]
    said = (along * lost.unsqueeze(-2)).square().sum(-1) > PART**2
    for camera, (row, count) in enumerate(zip(said.tolist(), lost.sum(-1).tolist(), strict=True)):
        each = tuple(name for name, lacking in zip(shown, row, strict=True) if lacking)
        found = [SHOWN.get(name, name) for name in each]
        names[camera] = Lacking(tuple(dict.fromkeys(found)), count < len(found) - found.count("focal") // 2, each)
    return unknown, names


def described(lacking: Lacking, said: Collection[str] = ()) -> str:
    """What is lacking, and what to do, in words; `said` are names of parameters that have a prior."""
    names = lacking.names
    wide = [name for name in names if name in {SHOWN.get(each, each) for each in lacking.each if each in said}]
    first = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    pose = [name for name in names if name in (*MOUNTING, "position")]
    inside = [name for name in names if name not in pose]
    remedies = [f"fixed=({', '.join(map(repr, pose))}{',' * (len(pose) == 1)})"] if pose else []
    remedies += [f"leave {', '.join(inside)} out of free"] if inside else []
    remedies.append(f"priors={{{[*wide, *names][0]!r}: (value, deviation)}}")
    them = "it" if len(names) == 1 else "some of them" if lacking.together else "them"
    what = "the evidence does not tell them apart" if lacking.together else "no evidence"
    told = f", for the prior on {wide[0]} is too wide" if wide else ""
    return f"{first}: {what}{told}; fix {them} or give a {'narrower ' * bool(wide)}prior, as {' or '.join(remedies)}"


def _angles(parameters: PoseParameters, values: Tensor, turn: Tensor) -> Tensor:
    """Tilt, roll and heading after a turn in degrees."""
    moved = torch.cat([values[:, :-POSE], values[:, -POSE:-3] + turn, values[:, -3:]], dim=-1)
    return torch.stack(mounting_from_rotation(parameters.rotation(moved)), dim=-1)
