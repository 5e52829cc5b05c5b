"""Whether the cameras of a rig contradict what was said of them, and of their places, beforehand.

With the poses eliminated, what is minimised is nearly a bowl about its lowest place. There the priors are off by e,
in their deviations, with the Jacobian J, and V = J H^-1 J^T is the part of their variance that is left. Without them
the corners tell (I - V)^-1 e, with the covariance V (I - V)^-1 of their noise; the priors have that of I besides.
"""

import torch

from diffproj.calibration.least_squares.eliminated import reduced
from diffproj.calibration.rigs.fit import RigFit
from diffproj.calibration.rigs.knowledge import CENTER, ROTATION, RigKnowledge
from diffproj.calibration.rigs.uncertainty import CameraNoise, pooled_variance
from diffproj.calibration.trust.prior_contradiction import DEVIATIONS, LEAST, NEARLY_NONE


def contradicted_priors(found: RigFit, noise: CameraNoise, dispersion: float) -> list[str]:
    """A remark on the prior that the corners contradict most, if they do contradict one.

    Args:
        found: the fit.
        noise: of its cameras.
        dispersion: how much more the moments contradict each other than independent corners would.
    """
    known = found.problem.known
    if known is None:
        return []
    with torch.no_grad():
        off, rows = (part[0] for part in known.rows(found.shared, *found.problem.places(found.shared)))
        S, basis = reduced(found.equations, found.basis, None)[0][0], found.basis
        rows = rows if basis is None else rows @ basis[0]
        scale = S.diagonal().clamp(min=1e-300).rsqrt()
        scaled = rows * scale
        left = scaled @ torch.linalg.pinv(S * scale * scale.unsqueeze(-1), hermitian=True) @ scaled.mT
        values, axes = torch.linalg.eigh((left + left.mT) / 2)
        told_part = (1 - values).clamp(NEARLY_NONE, 1)  # of each direction, how much the corners tell
        root = known.variance[0].sqrt().clamp(min=torch.finfo(off.dtype).tiny)
        along = axes.mT @ (off / root)
        gap = axes @ (along / told_part)
        untold = (1 - told_part) / told_part
        squares = float(pooled_variance(noise) * noise.freedom.clamp(min=0).sum())
        # Moments that a wrong prior bends scatter more, and contradict each other: without it they would less.
        saved = min(float(root.square() * (along.square() * untold).sum()) / max(squares, 1e-300), 1 - LEAST)
        worse = max(1.0, dispersion * (1 - saved)) * float(pooled_variance(noise) / root.square()) * (1 - saved)
        spread = worse * (axes.square() @ untold)
        far = (gap.abs() / (1 + spread).sqrt()).nan_to_num(0.0)
    if not len(far) or float(far.amax()) <= DEVIATIONS:
        return []
    return [
        _said(found, known, int(far.argmax()), gap.tolist(), spread.clamp(min=0).sqrt().tolist(), float(far.amax()))
    ]


def _said(
    found: RigFit, known: RigKnowledge, worst: int, gaps: list[float], deviations: list[float], far: float
) -> str:
    """The remark; `gaps` and `deviations` are those of what the corners tell, in deviations of the priors."""
    entries = [
        (found.parameters.names[at], "", mean, sure, "is it of this camera, its zoom and this lens model?")
        for at, mean, sure in zip(
            known.positions.tolist(), known.mean[0].tolist(), known.deviation[0].tolist(), strict=True
        )
    ]
    for place in known.places:
        name = f"{found.parameters.cameras[place.camera]}.{place.what}"
        sure = place.deviation[0]
        mean, parts, ask = place.mean[0], [""], "is it from the first camera, in the target's unit?"
        if place.what == ROTATION:
            mean, parts, sure = torch.zeros_like(sure), [f" about {axis}" for axis in "xyz"], sure.rad2deg()
            ask = "is it from the first camera's frame to its own, in degrees?"
        elif place.what == CENTER:
            parts = [f" along {axis}" for axis in "xyz"]
        entries += [(name, *one, ask) for one in zip(parts, mean.tolist(), sure.tolist(), strict=True)]
    name, part, mean, sure, ask = entries[worst]
    told, spread = gaps[worst] * sure, deviations[worst] * sure
    what = (
        f"they tell {told:.3g} ± {spread:.2g} degrees{part} off it, and it is sure to {sure:.2g}"
        if name.endswith(f".{ROTATION}")
        else f"they tell {mean + told:.6g} ± {spread:.2g}{part}, and it says {mean:.6g} ± {sure:.2g}"
    )
    return f"the views contradict the prior on {name}: {what}, {far:.0f} deviations off: {ask}"
