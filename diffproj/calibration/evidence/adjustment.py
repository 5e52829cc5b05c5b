"""`Adjustment`: a camera at its pose, found from evidence other than views of a target, and how sure it is."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffproj._core.copying import ordinary
from diffproj._core.shown import counted, decimals, number
from diffproj.calibration.evidence.observation import Observation
from diffproj.calibration.evidence.pose_parameters import MOUNTING, PLACE
from diffproj.calibration.evidence.problem import jacobian
from diffproj.calibration.evidence.rivals import Rivals
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import POSE
from diffproj.calibration.results.account import SENTENCES
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.indexed import numbers, some_of
from diffproj.calibration.results.remark import Kind, Remark, Remarks, text_of
from diffproj.geometry.cayley import turned
from diffproj.geometry.mounting import Mounting, mounting_from_rotation

CONTRADICTION = 1e-3
"""Probability below which residuals so large for their deviations are no chance."""

NOTHING = 1e-12
"""Deviation, relative to the value, that is rounding: of what was held."""
VERTICAL = 3.0
"""Deviations of the tilt within which an axis may be vertical."""
VERTICAL_WORDS = (
    "the axis may be vertical: beyond it, tilt folds back, and roll and heading are told half a turn further"
)
NEARLY = 100.0
"""Likelihood ratio below which another pose may be the true one."""
ANOTHER_POSE = "another pose explains the evidence nearly as well"
ANY_ANGLE = 180 / 3**0.5
"""Deviation of an angle in degrees of which nothing is known."""
ROUNDED = 1e-7
"""The same relative to the largest deviation of the pose, whose covariance it was computed from."""


@dataclass(frozen=True, eq=False, repr=False)
class Adjustment(Calibration):
    """A `Calibration` of one view without corners: what `adjust` found from other evidence, or from priors alone.

    `measure` takes it, with the covariance of pose and intrinsics; pixels need their own `pixel_sigma`. The deviations
    of observations and priors are taken at their word; `consistency` tells whether the residuals bear them out.

    Attributes:
        observations: what it was found from.
        parts: the residuals of each observation over their deviations `(*B, M, k)`.
        spare: how many more independent residuals and priors there are than unknowns.
        cost: half the sum of squares of residuals and priors over their deviations, under robust losses what these make
            of it.
        unknown: for each camera the names that nothing tells, `*B` flattened.
        rivals: the pose that explains the evidence second best; `None` where it was not looked for. Where the
            intrinsics were held, `alternatives` have it too, and covariance and measurements hold the doubt.
    """

    observations: tuple[Observation, ...] = ()
    parts: tuple[Tensor, ...] = ()
    spare: Int[Tensor, "*batch"] | None = None
    cost: Float[Tensor, "*batch"] | None = None
    unknown: tuple[tuple[str, ...], ...] = ()
    rivals: Rivals | None = None

    def _chosen(self, shape: torch.Size, index: Any) -> dict[str, Any]:
        """What it was found from is known of all: `observations` stay as they are."""
        return {
            "parts": tuple(some_of(part, shape, index, 2) for part in self.parts),
            "spare": some_of(self.spare, shape, index, 0),
            "cost": some_of(self.cost, shape, index, 0),
            "rivals": None if self.rivals is None else self.rivals.chosen(index),
            "unknown": tuple(self.unknown[i] for i in numbers(shape, index)) if self.unknown else (),
        }

    @property
    def mounting(self) -> Mounting:
        """Height, tilt, roll, heading and position of the camera, batch shape `*B`: see `Camera.mounting`."""
        return self.cameras[..., 0].mounting()

    @cached_property
    def mounting_covariance(self) -> Float[Tensor, "*batch 6 6"]:
        """The covariance of tilt, roll and heading in degrees and of x, y and height, `(*B, 6, 6)`.

        Where the camera looks straight down, roll and heading are not told apart: the heading has what both have. Where
        it may well look straight down, each of them may be any angle, and is told as 104 degrees off or more.
        """
        return mounting_covariance(self)

    @property
    def mounting_deviations(self) -> Mounting:
        """The standard deviations of height, tilt, roll, heading and position, batch shape `*B`; angles in degrees."""
        spread = self.mounting_covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
        tilt, roll, heading, x, y, height = spread.unbind(-1)
        return Mounting(height, tilt, roll, heading, torch.stack([x, y], dim=-1))

    @property
    def consistency(self) -> Float[Tensor, "*batch"]:
        """The root mean square of all residuals and priors over their deviations `(*B,)`, per spare one.

        About 1 where the deviations are right, above where they are too small or the evidence contradicts itself; NaN
        where nothing is spare.
        """
        if self.cost is None or self.spare is None:
            return torch.full_like(self.cameras.t[..., 0, 0], torch.nan)
        return torch.where(self.spare > 0, 2 * self.cost / self.spare, torch.nan).sqrt()

    @property
    def contradicted(self) -> tuple[str, ...]:
        """For each camera what residuals speak against its deviations, `*B` flattened; empty where none do."""
        return tuple(map(text_of, self.contradictions))

    @property
    def contradictions(self) -> tuple[Remarks, ...]:
        """The same with its kind."""
        if self.cost is None or self.spare is None:
            return ((),) * max(1, self.status.numel())
        half = self.spare.clamp(min=1).to(self.cost) / 2
        chance = torch.special.gammaincc(half, self.cost.detach().clamp(min=0))
        chance = torch.where(self.spare > 0, chance, 1.0).flatten()
        found: list[Remarks] = []
        for camera, (c, ratio) in enumerate(zip(chance.tolist(), self.consistency.flatten().tolist(), strict=True)):
            if not c < CONTRADICTION:
                found.append(())
                continue
            each = [
                (float(part.detach().reshape(-1, *part.shape[-2:])[camera].square().mean().sqrt()), type(one).__name__)
                for part, one in zip(self.parts, self.observations, strict=True)
                if part.numel()
            ]
            worst = f", most of all {max(each)[1]} ({max(each)[0]:.1f} times)" if len(each) > 1 else ""
            reason = f"the residuals are {ratio:.1f} times what the deviations say{worst}"
            sentence = f"{reason}: deviations are too small, or pieces of evidence contradict each other"
            found.append((Remark(sentence, Kind.CONTRADICTION, reason),))
        return tuple(found)

    @property
    def doubts(self) -> str:
        """What makes the pose doubtful, in words; empty where nothing does.

        Residuals that are larger than their deviations say; and another pose that explains the evidence nearly as well:
        see `rivals`.
        """
        if not self.views.batch_shape:
            return "; ".join(filter(None, [self.contradicted[0], self._rival]))
        many = [i for i, text in enumerate(self.contradicted) if text]
        said = (
            [f"the residuals of cameras {', '.join(map(str, many))} are larger than the deviations say"] if many else []
        )
        near = [] if self.rivals is None else (self._is_near(self.rivals)).flatten().nonzero().flatten().tolist()
        if near:
            said.append(f"another pose explains the evidence of cameras {', '.join(map(str, near))} nearly as well")
        return "; ".join(said)

    def _is_near(self, rivals: Rivals) -> Tensor:
        return (rivals.ratio < NEARLY) & (self.status == Status.CONVERGED)

    @property
    def _rival(self) -> str:
        """What is said of the other pose of one camera."""
        other = self.rivals
        if other is None or not bool(self._is_near(other)):
            return ""
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{ANOTHER_POSE}, {float(1 / other.ratio):.2g} times as likely: height "
            f"{float(other.height):.4g}{unit}, tilt {float(other.tilt):.1f}, roll {float(other.roll):.1f}, heading "
            f"{float(other.heading):.1f} degrees; a prior on one of these, or more evidence, as of landmarks off the "
            "plane of the others, tells them apart"
        )

    @property
    def rival_remarks(self) -> Remarks:
        """The other pose of one camera as a remark, where it may be the right one."""
        said = self._rival
        return (Remark(said, Kind.RIVAL, ANOTHER_POSE),) if said else ()

    @property
    def region(self) -> None:  # type: ignore[override]
        """Not known: no corners covered the image."""
        return

    @property
    def verdict(self) -> str:  # type: ignore[override]
        """Whether the pose is known, and why, in plain words; of many cameras how many are."""
        if self.views.batch_shape:
            return f"{int(self.converged.sum())} of {self.status.numel()} cameras converged."
        if self.status:
            return f"Not usable: {self._ends()[0]}."
        against = [self.doubts, *(one.reason for one in self.findings[0])]
        return f"Usable: {'; '.join(filter(None, against)) or 'nothing speaks against it'}."

    def summary(self) -> str:
        """One camera as a text for people: mounting and free intrinsics with deviations, the evidence, how it ended.

        Raises:
            ValueError: there are many cameras.
        """
        if self.views.batch_shape:
            raise ValueError(f"summary: want one camera, got batch shape {tuple(self.views.batch_shape)}; see message")
        values = {**dict(zip(self.parameters.names, self.shared.tolist(), strict=True)), **self._mounting_values()}
        spreads = self._spreads()
        far = max([abs(values["height"]), 1e-300, *(spreads[x] for x in PLACE if spreads[x] < torch.inf)])
        degree = far * math.radians(1)  # what a degree is at the camera's height
        unit_of = {name: degree if name in PLACE else 1.0 for name in MOUNTING}
        known = [spreads[name] / unit_of[name] for name in MOUNTING if spreads[name] < torch.inf]
        rounding = {name: ROUNDED * max(known, default=0.0) * size for name, size in unit_of.items()}
        unit = f" {self.unit}" if self.unit else ""
        lines = []
        for name, value in values.items():
            spread = spreads.get(name, 0.0)
            least = NOTHING * abs(value) if name in PLACE else NOTHING * max(1.0, abs(value))
            spread = spread if spread > least + rounding.get(name, 0.0) else 0.0
            if name in MOUNTING or spread:
                kind = " degrees" if name in MOUNTING[:3] else unit if name in MOUNTING else ""
                digits = decimals([spread], 4)
                shown = " (not known)" if spread == torch.inf else f" ± {spread:.{digits}f}" if spread else " (fixed)"
                lines.append(f"{name:<16}{value:z12.{digits}f}{shown}{kind}")
        if 90 - abs(values["tilt"]) < VERTICAL * spreads["tilt"] < torch.inf:
            lines.append(VERTICAL_WORDS)
        for one, part in zip(self.observations, self.parts, strict=True):
            rms = float(part.detach().square().mean().sqrt())
            lines.append(f"{type(one).__name__:<16}{part.shape[-2]:5d} seen, residuals {rms:.2f} deviations")
        return "\n".join([*lines, self._ends()[0], *filter(None, self.remarks), self.verdict])

    def to_dict(self) -> dict[str, Any]:
        """The numbers of the summary by name, as Python's own; of many cameras a list each, `*B` flattened."""
        many = bool(self.views.batch_shape)

        def plain(values: Tensor) -> Any:
            return values.detach().flatten().tolist() if many else values.detach().item()

        codes = [Status(code).name for code in self.status.flatten().tolist()]
        found: dict[str, Any] = {"status": codes if many else codes[0], "consistency": plain(self.consistency)}
        values, spread = self.mounting, self.mounting_deviations
        for name in ("height", "tilt", "roll", "heading"):
            found[name], found[f"{name}_deviation"] = plain(getattr(values, name)), plain(getattr(spread, name))
        for axis, name in enumerate(("x", "y")):
            found[name] = plain(values.position[..., axis])
            found[f"{name}_deviation"] = plain(spread.position[..., axis])
        for name, value in zip(self.parameters.names, self.shared.unbind(-1), strict=True):
            found[name] = plain(value)
            found[f"{name}_deviation"] = plain(self.covariance.deviations[name].expand(self.views.batch_shape))
        return found

    def _ends(self) -> list[str]:
        sentences = {
            **SENTENCES,
            Status.MAX_ITERATIONS: "was still falling when the iterations ended: raise max_iterations, or start closer",
            Status.DIVERGED: "no pose was found that sees what was observed: start closer, or look for mixed-up pixels",
            Status.DEGENERATE: "the evidence does not determine the camera",
        }
        codes = [Status(code) for code in self.status.flatten().tolist()]
        return [cause or sentences[code] for code, cause in zip(codes, self.causes or ("",) * len(codes), strict=True)]

    def _mounting_values(self) -> dict[str, float]:
        found = self.mounting
        x, y = found.position.tolist()
        return {
            "tilt": float(found.tilt),
            "roll": float(found.roll),
            "heading": float(found.heading),
            "x": x,
            "y": y,
            "height": float(found.height),
        }

    def _spreads(self) -> dict[str, float]:
        spread = self.mounting_covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt().tolist()
        own = {name: float(found) for name, found in self.covariance.deviations.items()}
        return {**dict(zip(MOUNTING, spread, strict=True)), **own}

    def _facts(self) -> list[str]:
        found = self.mounting
        names = {Status(code).name.lower() for code in self.status.flatten().tolist()}
        return [
            counted(self.views.batch_shape, "camera"),
            f"height {number(found.height, '.4g')}",
            f"tilt {number(found.tilt, '.2f')} degrees",
            f"{len(self.observations)} kinds of evidence",
            " or ".join(sorted(names)),
        ]

    def _columns(self) -> dict[str, Any]:
        found = self.to_dict()
        if self.views.batch_shape:
            return {name: found[name] for name in ("status", "height", "tilt", "roll", "heading")}
        names = [name.removesuffix("_deviation") for name in found if name.endswith("_deviation")]
        return {
            "parameter": names,
            "value": [found[name] for name in names],
            "standard deviation": [found[f"{name}_deviation"] for name in names],
        }

    def _note(self) -> str:
        return self.verdict


def mounting_covariance(calibration: Calibration, view: int = 0) -> Float[Tensor, "*batch 6 6"]:
    """The covariance of tilt, roll, heading in degrees, x, y and height in a view: see `Adjustment`."""
    with torch.inference_mode(False):
        camera = calibration.cameras[..., view]
        middle, pose = calibration.covariance.middle, calibration.covariance.about_middle.between(view, view)
        lost = pose.diagonal(dim1=-2, dim2=-1).isinf()
        pose = torch.where(lost.unsqueeze(-1) | lost.unsqueeze(-2), 0.0, pose)
        batch = pose.shape[:-2]
        R, t = ordinary(camera.R.detach().reshape(-1, 3, 3)), ordinary(camera.t.detach().reshape(-1, 3))
        m = torch.zeros_like(t) if middle is None else ordinary(middle).expand_as(t)
        t = t + (R @ m.unsqueeze(-1)).squeeze(-1)

        def mounted(step: Tensor) -> Tensor:
            again = turned(R, step[..., :3])
            center = m - (again.mT @ (t + step[..., 3:]).unsqueeze(-1)).squeeze(-1)
            return torch.cat([torch.stack(mounting_from_rotation(again), dim=-1), center], dim=-1)

        J = jacobian(mounted, t.new_zeros(len(t), POSE))[1].permute(1, 2, 0)
        C = _any_angle(J @ pose.reshape(-1, POSE, POSE) @ J.mT, mounting_from_rotation(R)[0]).reshape(
            *batch, POSE, POSE
        )
        return C + torch.diag_embed(torch.where(lost, torch.inf, 0.0).to(C))


def _any_angle(C: Tensor, tilt: Tensor) -> Tensor:
    """The covariance `(P, 6, 6)` where the vertical is among the likely directions of the axis.

    Roll and heading may be any angle there, which slopes do not tell; what they make together stays as well known.
    """
    spread = C.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    near = (tilt.abs() < 90) & (90 - tilt.abs() < VERTICAL * spread[:, 0])
    lost = near & (spread[:, 1:3].amin(-1) > ANY_ANGLE / (2 * VERTICAL))
    both = torch.zeros_like(C[:, 0])
    both[:, 1], both[:, 2] = 1.0, tilt.sign()
    return C + torch.where(lost, ANY_ANGLE**2, 0.0).to(C)[:, None, None] * both.unsqueeze(-1) * both.unsqueeze(-2)


def pose_covariance(names: tuple[str, ...], joint: Tensor, arm: Tensor, middle: Tensor, unknown: Tensor) -> Covariance:
    """The covariance of intrinsics and of the pose of one view, which turns about the middle.

    Args:
        names: of the s intrinsics.
        joint: of these and the pose `(*B, s + 6, s + 6)`, in which what is unknown is 0.
        arm: `R middle` `(*B, 3)`.
        middle: `(3,)`.
        unknown: which of the s parameters, and in the last place whether the pose, is not determined `(*B, s + 1)`.
    """
    s = len(names)
    shared = joint[..., :s, :s] + torch.diag_embed(torch.where(unknown[..., :s], torch.inf, 0.0).to(joint))
    mixed = joint[..., None, s:, :s]
    return Covariance(
        names,
        shared,
        unknown[..., :s],
        unknown[..., s:],
        torch.ones_like(joint[..., 0, 0]),
        torch.zeros_like(mixed),
        mixed,
        joint[..., None, s:, s:],
        middle,
        arm.unsqueeze(-2),
    )
