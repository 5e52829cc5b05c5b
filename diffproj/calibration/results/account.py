"""`Account`: what a `Calibration` tells people of itself: a summary, a verdict, a line, a table, plain numbers."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffproj._core.shown import Shown, counted, number, rounded
from diffproj.calibration.least_squares.solver import Status
from diffproj.calibration.problem.parametrisation import BOW, SKEW, Parametrisation
from diffproj.calibration.problem.shape import AXES
from diffproj.calibration.results import advice
from diffproj.calibration.results import ambiguity as ambiguities
from diffproj.calibration.results.ambiguity import SURE
from diffproj.calibration.results.border import border_with_rays
from diffproj.calibration.results.covariance import Covariance
from diffproj.calibration.results.distinct import alike, described
from diffproj.calibration.results.left_out import mostly_left_out
from diffproj.calibration.results.remark import Kind, Remarks, text_of
from diffproj.geometry.camera import Camera
from diffproj.targets.views import Views

OF_MANY = {
    Kind.CONTRADICTION: "the residuals of cameras {} are larger than pixel_sigma says",
    Kind.TOLD_APART: "EXIF data speak against the photographs of cameras {} being of the camera that was given",
}
EXACT_PX = 1e-9
"""Residuals up to which corners are met exactly, but for rounding."""
REMARK = "something speaks against the poses of cameras {}"
"""What a remark of a kind says against poses, and any other one, of some of many cameras."""

SENTENCES = {
    Status.CONVERGED: "converged: no step lowers the error any more",
    Status.MAX_ITERATIONS: "was still falling when the iterations ended: raise max_iterations, or look for mixed-up "
    "corners",
    Status.DIVERGED: "found no step that lowers the error: look for mixed-up corners, or start closer",
    Status.DEGENERATE: "the views do not determine the camera",
}


def told_of(calibration: "Account") -> list[str]:
    """The remarks on the one camera of a calibration, and what makes it doubtful, a sentence each."""
    doubts = "" if calibration.status else calibration.doubts
    remarks = [remark.sentence for remark in calibration.findings[0] if remark.sentence not in doubts]
    return [*remarks, *([doubts] if doubts else [])]


class Account(Shown):
    """The part of `Calibration` that is in words."""

    if TYPE_CHECKING:  # what `Calibration` has
        camera: Camera
        cameras: Camera
        views: Views
        used: Tensor
        rejected: Tensor
        status: Tensor
        bow: Tensor | None
        displacements: Tensor | None
        nominal: Tensor
        causes: tuple[str, ...]
        pixel_sigma: Tensor | None
        degrees_of_freedom: Tensor | None
        shares: Tensor | None
        lens_region: Tensor | None
        landmarks: tuple[str, ...] | None

        @property
        def counting(self) -> Tensor:
            """See `Calibration`."""
            ...

        @property
        def left_out(self) -> Tensor:
            """See `Calibration`."""
            ...

        @property
        def residuals(self) -> Tensor:
            """See `Calibration`."""
            ...

        @property
        def parameters(self) -> Parametrisation:
            """See `Calibration`."""
            ...

        @property
        def shared(self) -> Tensor:
            """See `Calibration`."""
            ...

        @property
        def points_deviation(self) -> Tensor:
            """See `Calibration`."""
            ...

        @property
        def rms(self) -> Tensor:
            """See `Calibration`."""
            ...

        @property
        def view_rms(self) -> Tensor:
            """See `Calibration`."""
            ...

        @cached_property
        def findings(self) -> tuple[Remarks, ...]:
            """See `Calibration`."""
            ...

        @property
        def doubts(self) -> str:
            """See `Calibration`."""
            ...

        @property
        def ambiguous(self) -> Tensor:
            """See `Calibration`."""
            ...

        @property
        def has_covariance(self) -> bool:
            """See `Calibration`."""
            ...

        @property
        def knows_intrinsics(self) -> bool:
            """See `Calibration`."""
            ...

        @cached_property
        def covariance(self) -> Covariance:
            """See `Calibration`."""
            ...

        @cached_property
        def covariance_of_kept_poses(self) -> Covariance:
            """See `Calibration`."""
            ...

        @property
        def has_alternatives(self) -> bool:
            """See `Calibration`."""
            ...

        @property
        def likelihood_ratio(self) -> Tensor:
            """See `Calibration`."""
            ...

        @cached_property
        def region(self) -> Tensor | None:
            """See `Calibration`."""
            ...

    @property
    def contradiction(self) -> str:
        """Where poses alone were found, what speaks against them, in words; empty where nothing does.

        It is what residuals say against the `pixel_sigma`, and files against the camera that was given.
        """
        if not (self.lens_region is not None or (self.has_covariance and not self.knows_intrinsics)):
            return ""
        said = [[one for one in remarks if one.kind not in (Kind.BELOW, Kind.LEFT_OUT)] for remarks in self.findings]
        if not self.views.batch_shape:
            return text_of(said[0])
        cameras: dict[str, list[str]] = {}
        for camera, remarks in enumerate(said):
            for what in dict.fromkeys(OF_MANY.get(one.kind, REMARK) for one in remarks):
                cameras.setdefault(what, []).append(str(camera))
        found = "; ".join(what.format(", ".join(which)) for what, which in cameras.items())
        return f"{found}: see remarks" if found else ""

    @property
    def ambiguity(self) -> str:
        """Which views are ambiguous, in words; empty where none is, or where other poses are not known."""
        return ambiguities.described(self.ambiguous, self.views.names) if self.has_alternatives else ""

    @cached_property
    def verdict(self) -> str:
        """Whether one camera is known well, why, and what to photograph next, in plain words.

        `Good: ...`, `Weak: ...` or `Not usable: ...`; for what `locate` found, how its poses compare with the
        calibration behind them.

        Raises:
            ValueError: there are many cameras.
        """
        return str(self.judgement).replace("?.", "?")

    @cached_property
    def judgement(self) -> advice.Judgement:
        """The verdict in its parts: the word, the reasons, what to photograph next.

        Raises:
            ValueError: there are many cameras.
        """
        if self.views.batch_shape:
            raise ValueError(f"verdict: want one camera, got batch shape {tuple(self.views.batch_shape)}; index it")
        if self.status:
            return advice.Judgement("Not usable", (self._ends()[0],))
        if self.lens_region is not None or (self.has_covariance and not self.knows_intrinsics):
            points = "corners" if self.landmarks is None else "landmarks"
            met = f"to {self._scatter:.2g} px in each coordinate" if self._scatter > EXACT_PX else "exactly"
            met = f"nothing speaks against them, and {points} are met {met}"
            return advice.Judgement(advice.POSES_ONLY, (self.doubts or met,))
        used = self.used.any(-1)
        unsure = None
        if self.has_covariance:
            spread = self.covariance_of_kept_poses.shared.diagonal()[:4].sqrt()
            unsure = float(spread.amax() / self.shared[0])
        if self.landmarks is not None:
            spare = None if self.degrees_of_freedom is None else float(self.degrees_of_freedom)
            return advice.of_landmarks(int(self.used.any(0).sum()), unsure, self._scatter, spare, self.findings[0])
        found = advice.judged(
            advice.Evidence(
                self.cameras,
                used,
                float((used if self.shares is None else self.shares * used).sum()),
                self.region,
                unsure,
                self._scatter,
                self.view_rms,
                mostly_left_out(self.counting, self.left_out),
                self.views.names,
                self.findings[0],
            )
        )
        if self.displacements is None:
            return found
        off = float(self.displacements.square().sum(-1).mean().sqrt())
        return replace(
            found, note=f"As printed, the target's points lie {off:.2g} world units (RMS) off their nominal places."
        )

    @property
    def _scatter(self) -> float:
        """The standard deviation of a corner's coordinate of one camera in px, as the residuals show it."""
        said = self.degrees_of_freedom is not None and bool(self.degrees_of_freedom.isinf())
        return float(self.rms) / math.sqrt(2) if self.pixel_sigma is None or said else float(self.pixel_sigma)

    def summary(self) -> str:
        """One camera as a text for people: parameters with deviations, RMS of each view, how it ended, the verdict.

        Raises:
            ValueError: there are many cameras.
        """
        if self.views.batch_shape:
            raise ValueError(f"summary: want one camera, got batch shape {tuple(self.views.batch_shape)}; index it")
        deviations = self.covariance.deviations if self.has_covariance else {}
        values = dict(zip(self.parameters.names, self.shared.tolist(), strict=True))

        def line(title: str, names: tuple[str, ...], form: str, unit: str) -> str:
            texts = (f"{values[name]:{form}}{_spread(deviations.get(name), form)}" for name in names)
            return f"{title:<16}{'  '.join(texts)}{unit}"

        lines = [
            line("focal lengths", ("f_x", "f_y"), "10.3f", " px"),
            line("principal point", ("c_x", "c_y"), "10.3f", " px"),
            *(line(f"lens {name}", (name,), "10.5f", "") for name in self.parameters.coefficient_names),
        ]
        if self.parameters.skew:
            lines.append(line("skew", (SKEW,), "10.3f", " px"))
        if self.bow is not None:
            lines.append(line("bow along x, y", BOW, "10.4f", " world units"))
        if self.displacements is not None:
            lines.append(self._shape())
        lines.append(f"{'RMS':<16}{self.rms.item():10.4f} px over {int(self.used.sum())} corners")
        width = max(map(len, self.views.names), default=0)
        seen, used = self.views.visible.sum(-1).tolist(), self.used.sum(-1).tolist()
        odds = self.likelihood_ratio.tolist() if self.has_alternatives else [torch.inf] * len(used)
        for view, (name, rms) in enumerate(zip(self.views.names, self.view_rms.tolist(), strict=True)):
            out = self.rejected[view].nonzero().flatten().tolist()
            remark = f"  without corners {', '.join(map(str, out))}" if out and used[view] else ""
            if odds[view] < SURE:
                remark += f"  another pose is {odds[view]:.2g} times less likely"
            text = f"{rms:.4f} px{remark}" if used[view] else f"left out: {seen[view] - len(out)} corners, 4 are needed"
            lines.append(f"  {name:<{width}}  {text}")
        if self.landmarks is not None and len(self.views) == 1:
            errors = zip(self.landmarks, self.residuals[0].tolist(), self.used[0].tolist(), strict=True)
            lines += [f"    landmark {name}: {u:+.2f}, {v:+.2f} px" for name, (u, v), counts in errors if counts]
        if self.shares is not None:
            same = alike(self.nominal, self.views.pixels.unsqueeze(0), self.used.unsqueeze(0))[0]
            lines.append(described(same, self.views.names))
        if self.camera.size is not None and (share := float(border_with_rays(self.camera, self.camera.size))) < 1:
            lines.append(
                f"{'image':<16}{100 * (1 - share):.0f} % of its border lies beyond the fold of the lens: no rays"
            )
        return "\n".join([*lines, self._ends()[0], *told_of(self), self.verdict])

    def _shape(self) -> str:
        """How far a target of free points is off its nominal places."""
        moves = torch.zeros_like(self.nominal) if self.displacements is None else self.displacements
        spread = self.points_deviation if self.has_covariance else torch.full_like(moves, torch.nan)
        told = spread.isfinite().all(-1) if self.has_covariance else torch.ones_like(moves[..., 0]) > 0
        off = moves[told].square().mean(0).sqrt().tolist()
        texts = [f"{value:10.4f}" for value in off]
        if self.has_covariance:
            sure = spread[told].square().mean(0).sqrt().tolist()
            texts = [f"{text} ± {value:.4f}" for text, value in zip(texts, sure, strict=True)]
        held = "" if bool(told.all()) else f"; {int((~told).sum())} points are not told by the views"
        return f"{'points off by':<16}{'  '.join(texts)} world units in x, y, z (RMS){held}"

    def _ends(self) -> list[str]:
        """How each camera ended, in a sentence."""
        codes = [Status(code) for code in self.status.flatten().tolist()]
        return [cause or SENTENCES[code] for code, cause in zip(codes, self.causes or ("",) * len(codes), strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """The numbers of the summary by name, as Python's own; of many cameras a list each, `*B` flattened.

        `pandas.DataFrame([calibration.to_dict()])` makes a row of them, and `pandas.DataFrame(many.to_dict())` a table.

        Example:
            >>> import diffproj as dp
            >>> found = dp.calibrate(dp.example_views("left"), dp.Chessboard()).to_dict()
            >>> found["status"], found["views"], round(found["f_x"]), round(found["f_x_deviation"], 1)
            ('CONVERGED', 13, 534, 0.9)
        """
        many = bool(self.views.batch_shape)

        def plain(values: Tensor) -> Any:
            return values.detach().flatten().tolist() if many else values.detach().item()

        codes = [Status(code).name for code in self.status.flatten().tolist()]
        found: dict[str, Any] = {"status": codes if many else codes[0]}
        found["views"], found["corners"] = plain(self.used.any(-1).sum(-1)), plain(self.used.sum((-2, -1)))
        found["rms"] = plain(self.rms)
        if self.pixel_sigma is not None:
            found["pixel_sigma"] = plain(self.pixel_sigma)
        deviations = self.covariance.deviations if self.has_covariance else {}
        for name, values in zip(self.parameters.few_names, self.shared.unbind(-1), strict=False):
            found[name] = plain(values)
            if name in deviations:
                found[f"{name}_deviation"] = plain(deviations[name].expand(self.views.batch_shape))
        if self.displacements is not None:
            off = self.displacements.square().mean(-2).sqrt()
            found |= {f"points_{axis}_rms": plain(off[..., i]) for i, axis in enumerate(AXES)}
        return found

    def _facts(self) -> list[str]:
        lens = "pinhole" if self.camera.distortion is None else type(self.camera.distortion).__name__
        focal = self.camera.K.diagonal(dim1=-2, dim2=-1)
        names = {Status(code).name.lower() for code in self.status.flatten().tolist()}
        return [
            counted(self.views.batch_shape, "camera"),
            f"{len(self.views)} views of {self.views.pixels.shape[-2]} corners",
            f"f {number(focal[..., 0])}, {number(focal[..., 1])} px",
            lens,
            *([] if self.displacements is None else ["free points"]),
            f"RMS {number(self.rms, '.4f')} px",
            " or ".join(sorted(names)),
        ]

    def _columns(self) -> dict[str, Sequence[Any]]:
        if self.views.batch_shape:
            found = self.to_dict()
            return {name: found[name] for name in ("status", "rms", "f_x", "f_y", "c_x", "c_y")}
        found = self.to_dict()
        names = self.parameters.few_names
        pairs = [rounded(found[name], found.get(f"{name}_deviation", math.nan)) for name in names]
        values, deviations = zip(*pairs, strict=True)
        return {"parameter": names, "value": values, "standard deviation": deviations}

    def _note(self) -> str:
        return "" if self.views.batch_shape else self.verdict


def _spread(deviation: Tensor | None, form: str) -> str:
    if deviation is None or not float(deviation) > 0:
        return ""
    return " (not determined)" if bool(deviation.isinf()) else f" ± {float(deviation):.{form.split('.')[1]}}"
