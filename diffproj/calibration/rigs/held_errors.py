"""How what is held of a rig's cameras errs: as the calibrations say that it was taken from.

What is free follows an error of what is held. With S the normal matrix of the shared unknowns with the poses of the
target eliminated, F what is free and h what is held, whose covariance is C,

    d free = -S_FF^-1 S_Fh d held        covariance of all += A C A^T        A = [-S_FF^-1 S_Fh; 1]

The noise of both is taken to be independent.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
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


def held_errors(given: Any, parameters: RigParameters, positions: Sequence[int]) -> Tensor | None:
    """The covariance of what is held, among the shared unknowns `(few, few)`, with 0 for what is free or exact.

    `None` where all that is held counts as exact, as that of cameras without a covariance does.

    Args:
        given: the cameras known beforehand, checked: a rig, or cameras and calibrations by name.
        parameters: the shared unknowns.
        positions: of those that are held.

    Raises:
        ValueError: what is held is undetermined there: all that follows it would be told as if it were exact.
    """
    if not positions:
        return None
    if isinstance(given, RigCalibration):
        found = _of_a_rig(given, parameters) if given.has_covariance else None
    else:
        each = given.items() if isinstance(given, Mapping) else ()
        known = {name: one for name, one in each if isinstance(one, Calibration) and one.has_covariance}
        found = _of_cameras(known, parameters) if known else None
    if found is None:
        return None
    held = torch.zeros(len(found), dtype=torch.bool, device=found.device)
    held[list(positions)] = True
    found = torch.where(held & held.unsqueeze(-1), found, 0.0)
    unknown = [parameters.names[i] for i in positions if bool(found[i, i].isinf())]
    if unknown:
        raise ValueError(
            f"fixed: want what the calibration in cameras= determines, got {', '.join(unknown)}, whose deviation is "
            "infinite; leave it free, or give the camera alone, without its calibration, where it counts as exact"
        )
    return found if bool(found.any()) else None


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
    """Of a rig that was calibrated before, in whose frame another camera may have been the first.

    Infinite where it does not determine a number.
    """
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
        held: the covariance of what is held, of `held_errors`.
    """
    s = basis.shape[-2]
    held = torch.nn.functional.pad(held.to(basis), (0, s - len(held), 0, s - len(held)))
    S, *_ = reduced(H, None, None)
    T = basis.mT
    free, _ = inverse(T @ S @ basis, (T @ H.U @ basis).diagonal(dim1=-2, dim2=-1))
    A = torch.eye(s, dtype=S.dtype, device=S.device) - basis @ free @ T @ S
    more = A @ held @ A.mT
    unknown = found.undetermined.unsqueeze(-1) | found.undetermined.unsqueeze(-2)
    return replace(found, shared=torch.where(unknown, found.shared, found.shared + (more + more.mT) / 2))
