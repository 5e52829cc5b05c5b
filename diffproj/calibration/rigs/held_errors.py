"""How what is held of a rig's cameras errs: as the calibrations say that it was taken from.

What is free follows an error of what is held. With S the normal matrix of the shared unknowns with the poses of the
target eliminated, F what is free and h what is held, whose covariance is C,

    d free = -S_FF^-1 S_Fh d held        covariance of all += A C A^T        A = [-S_FF^-1 S_Fh; 1]

The noise of both is taken to be independent.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffproj.calibration.least_squares.eliminated import inverse, reduced
from diffproj.calibration.least_squares.normal_equations import Equations
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.covariance import Covariance, zero_where_infinite
from diffproj.calibration.rigs.options import place_in_rig
from diffproj.calibration.rigs.parameters import POSE_NAMES, RigParameters
from diffproj.calibration.rigs.result import RigCalibration
from diffproj.geometry.cayley import cross_matrix


@dataclass(frozen=True, eq=False)
class HeldErrors:
    """How what is held errs.

    Attributes:
        known: a rig, or calibrations by the names of their cameras, with their covariances.
        parameters: the shared unknowns.
        positions: of those that are held.
    """

    known: RigCalibration | dict[str, Calibration]
    parameters: RigParameters
    positions: tuple[int, ...]

    @cached_property
    def covariance(self) -> Tensor:
        """Of the shared unknowns `(few, few)`: 0 for what is free or exact, infinite where nothing is known."""
        given, parameters = self.known, self.parameters
        found = _of_cameras(given, parameters) if isinstance(given, dict) else _of_a_rig(given, parameters)
        held = torch.zeros(len(found), dtype=torch.bool, device=found.device)
        held[list(self.positions)] = True
        return torch.where(held & held.unsqueeze(-1), found, 0.0)


def held_errors(given: Any, parameters: RigParameters, positions: Sequence[int]) -> HeldErrors | None:
    """How what is held errs; `None` where it counts as exact, as that of cameras without a covariance does.

    Args:
        given: the cameras known beforehand, checked: a rig, or cameras and calibrations by name.
        parameters: the shared unknowns.
        positions: of those that are held.

    Raises:
        ValueError: what is held is undetermined there: all that follows it would be told as if it were exact.
    """
    if isinstance(given, RigCalibration):
        known = given if given.has_covariance else {}
    else:
        each = given.items() if isinstance(given, Mapping) else ()
        known = {name: one for name, one in each if isinstance(one, Calibration) and one.has_covariance}
    held = {parameters.names[i].rpartition(".")[0] for i in positions}
    if not held & set(known):
        return None
    errors = HeldErrors(known, parameters, tuple(positions))
    unknown = [parameters.names[i] for i in positions if bool(errors.covariance[i, i].isinf())]
    if unknown:
        raise ValueError(
            f"fixed: want what the calibration in cameras= determines, got {', '.join(unknown)}, whose deviation is "
            "infinite; leave it free, or give the camera alone, without its calibration, where it counts as exact"
        )
    return errors


def _of_cameras(calibrations: Mapping[str, Calibration], parameters: RigParameters) -> Tensor:
    """Of calibrations of one camera each, which err independently."""
    found = torch.zeros(parameters.few, parameters.few, dtype=torch.float64)
    for c, name in enumerate(parameters.cameras):
        if name in calibrations:
            known = calibrations[name].covariance_of_kept_poses
            own = parameters.intrinsics(c)
            found = found.to(known.shared.device)
            rows = [known.names.index(each) for each in parameters.kinds[c].names if each in known.names]
            at = [own.start + i for i, each in enumerate(parameters.kinds[c].names) if each in known.names]
            found[torch.tensor(at).unsqueeze(-1), torch.tensor(at)] = known.shared.detach().to(found)[rows][:, rows]
    return found


def _of_a_rig(rig: RigCalibration, parameters: RigParameters) -> Tensor:
    """Of a rig that was calibrated before, in whose frame another camera may have been the first."""
    known = rig.covariance
    J = known.shared.new_zeros(parameters.few, len(known.names))
    first = parameters.cameras[0]
    for c, name in enumerate(parameters.cameras):
        if name not in rig.cameras:
            continue
        own = parameters.intrinsics(c)
        for i, each in enumerate(parameters.kinds[c].names):
            if f"{name}.{each}" in known.names:
                J[own.start + i, known.names.index(f"{name}.{each}")] = 1.0
        if c and first in rig.cameras:
            # R' = R_c R_1^T and t' = t_c - R' t_1, with omega' = omega_c - R' omega_1 and R' t_1 turned by it.
            R, _ = place_in_rig(rig.cameras[first], rig.cameras[name])
            arm = (R @ rig.cameras[first].t.detach().to(R).unsqueeze(-1)).squeeze(-1)
            own_turn = torch.eye(POSE, dtype=R.dtype, device=R.device)
            own_turn[3:, :3] = cross_matrix(arm)
            pose = parameters.pose(c)
            for camera, slope in ((name, own_turn), (first, -own_turn @ torch.block_diag(R, R))):
                if camera != rig.names[0]:
                    J[pose, [known.names.index(f"{camera}.{each}") for each in POSE_NAMES]] = slope
    unknown = (J.abs() @ known.undetermined.to(J)) > 0
    found = J @ zero_where_infinite(known.shared) @ J.mT
    return found + torch.diag(torch.where(unknown, torch.inf, 0.0).to(J))


def following(found: Covariance, H: Equations, basis: Tensor, held: Tensor) -> Covariance:
    """The covariance of the shared unknowns with the errors of what is held, which all else follows.

    Args:
        found: without them, of one rig with its batch axis.
        H: the curvature at the minimum, with all shared unknowns.
        basis: of the free directions `(1, s, q)`.
        held: the covariance of `HeldErrors`.
    """
    s = basis.shape[-2]
    held = torch.nn.functional.pad(held.to(basis), (0, s - len(held), 0, s - len(held)))
    S, *_ = reduced(H, None, None)
    T = basis.mT
    free, _ = inverse(T @ S @ basis, (T @ H.U @ basis).diagonal(dim1=-2, dim2=-1))
    A = torch.eye(s, dtype=S.dtype, device=S.device) - basis @ free @ T @ S
    more = A @ zero_where_infinite(held) @ A.mT
    unknown = found.undetermined | held.diagonal().isinf()
    shared = zero_where_infinite(found.shared) + (more + more.mT) / 2
    shared = torch.where(unknown.unsqueeze(-1) | unknown.unsqueeze(-2), 0.0, shared)
    shared = shared + torch.diag_embed(torch.where(unknown, torch.inf, 0.0).to(shared))
    return replace(found, shared=shared, undetermined=unknown)
