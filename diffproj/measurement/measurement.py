"""`Measurement`: points on a plane with their joint covariance, and what follows from them with error bars."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core import arguments
from diffproj._core.copying import Copied
from diffproj._core.shown import Shown, counted, decimals, listed, rounded
from diffproj.calibration.results.covariance import zero_where_infinite
from diffproj.calibration.results.region import in_region
from diffproj.geometry.back_projection import Reason, explain
from diffproj.measurement.each import at_each, checked_number
from diffproj.measurement.ellipses import Ellipses, plane_ellipses
from diffproj.measurement.folded import longest_first, norm_variance
from diffproj.measurement.intervals import Function, Interval, angle_interval, curved_interval, norm_interval
from diffproj.measurement.kinked import kinked_interval
from diffproj.measurement.propagation import Noise, Propagated, kink_variance, without_unknown
from diffproj.measurement.quantity import Bounds, Quantity, described
from diffproj.measurement.shapes import area_vector, coordinate, difference, length, turn, warn_of_crossings
from diffproj.measurement.sight import Sight
from diffproj.measurement.student import check_level

EXTRAPOLATED = (
    "Extrapolated: outside of the region that the calibration's corners covered. Only the lens model tells the lens "
    "there, and where it does not fit, the truth lies further off: calibrate with the board there too."
)
NONLINEAR = "Nonlinear: close to the horizon or to zero, where the deviation misleads; take the interval."
"""What the summary says of points and lengths that it marks so."""


@dataclass(frozen=True, eq=False, repr=False)
class Measurement(Copied, Shown):
    """Points measured on a plane, with their joint covariance.

    Attributes:
        points: `(*B, N, 3)` in world units; (0, 0, 0) where not valid.
        valid: `(*B, N)`, as `back_project` gives it. Where it is false, covariances, deviations and intervals are NaN.
        includes_intrinsics: whether the standard deviations include the uncertainty of focal lengths, principal point
            and lens. They do for a calibration with its covariance. For a camera alone, or a calibration from a file
            without a covariance, they hold the pixels' noise only; for a pose that `locate` found with a camera alone,
            the pixels' noise and the pose's uncertainty.
        doubts: what makes the pose that they were measured from doubtful, in words: that the calibration does not fit
            the photograph, as if it were another camera's, or that two poses fit it. Empty where nothing does.
    """

    points: Float[Tensor, "*batch n 3"]
    valid: Bool[Tensor, "*batch n"]
    includes_intrinsics: bool
    _noise: Noise = field(repr=False)
    _region: Tensor | None = field(default=None, repr=False)
    _lie = "on the plane"  # what points that are not valid do not
    doubts: str = ""

    @property
    def _sight(self) -> Sight:
        """Pixels, camera and plane; joined measurements, which have another, ask for none of them."""
        return cast(Sight, self._noise.sight)

    @property
    def degrees_of_freedom(self) -> Float[Tensor, "*batch"]:
        """How many residuals of the calibration tell the scale of the deviations `(*B,)`.

        Infinite where that is known, or where nothing is known of it. Intervals are wider where there are few.
        """
        return self._noise.degrees_of_freedom

    @property
    def covariance(self) -> Float[Tensor, "*batch n 3 3"]:
        """The covariance of each point `(*B, N, 3, 3)` in squared world units; infinite where it is not determined."""
        noise = self._noise
        C = noise.common @ zero_where_infinite(noise.sigma).unsqueeze(-3) @ noise.common.mT + noise.own @ noise.own.mT
        return torch.where(self.valid[..., None, None], without_unknown(C, noise.unknown(noise.common)), torch.nan)

    @property
    def deviations(self) -> Float[Tensor, "*batch n 3"]:
        """The standard deviations of each point's coordinates `(*B, N, 3)` in world units, to first order."""
        variance = self.covariance.diagonal(dim1=-2, dim2=-1)
        known = ~(variance <= 0)  # the root's slope at 0 is infinite; NaN stays
        return torch.where(known, torch.where(known, variance, 1.0).sqrt(), 0.0)

    def joint(self) -> Float[Tensor, "*batch all all"]:
        """The covariance of all coordinates together, `(*B, 3 N, 3 N)`, points in order; NaN where not valid."""
        noise = self._noise
        G = noise.common.flatten(-3, -2)
        own = noise.own @ noise.own.mT
        N = own.shape[-3]
        apart = torch.eye(N, dtype=own.dtype, device=own.device)[:, None, :, None]
        blocks = (own.unsqueeze(-2) * apart).flatten(-2).flatten(-3, -2)
        C = without_unknown(G @ zero_where_infinite(noise.sigma) @ G.mT + blocks, noise.unknown(G))
        valid = self.valid.repeat_interleave(3, dim=-1)
        return torch.where(valid.unsqueeze(-1) & valid.unsqueeze(-2), C, torch.nan)

    def interval(self, level: float = 0.95) -> tuple[Float[Tensor, "*batch n 3"], Float[Tensor, "*batch n 3"]]:
        """Lower and upper bounds of each coordinate `(*B, N, 3)`, as `Quantity.interval` gives them.

        Raises:
            ValueError: the level is not between 0 and 1.

        Example:
            >>> import diffproj as dp
            >>> floor = dp.Plane([0.0, 1.0, 0.0], 1.5)  # 1.5 m below a camera that looks to the horizon
            >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
            >>> pixels = torch.tensor([[320.0, 340.0], [320.0, 243.0]], dtype=torch.float64)
            >>> measured = dp.measure(pixels, dp.Camera(K), floor, pixel_sigma=1.0)
            >>> low, high = measured.interval()
            >>> for metres in zip(low[:, 2].tolist(), measured.points[:, 2].tolist(), high[:, 2].tolist()):
            ...     print("{:.1f} {:.1f} {:.1f}".format(*metres))
            7.4 7.5 7.6
            151.2 250.0 721.1
            >>> measured.nonlinear.tolist()
            [False, True]
        """
        bounds = [coordinate.interval(level) for coordinate in self._coordinates]
        low, high = (torch.stack(side, dim=-1) for side in zip(*bounds, strict=True))
        return low, high

    def ellipses(self, level: float = 0.95) -> Ellipses:
        """An ellipse on the plane around each point that holds the truth with that probability, to first order.

        It is larger where the noise was estimated from few residuals (Fisher's F).

        Raises:
            ValueError: the level is not between 0 and 1.

        Example:
            >>> import diffproj as dp
            >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
            >>> down = dp.Camera(K, t=torch.tensor([0.0, 0, 10], dtype=torch.float64))  # 10 m over the plane
            >>> pixel = torch.tensor([[320.0, 240.0]], dtype=torch.float64)
            >>> measured = dp.measure(pixel, down, dp.Plane.z(0.0), pixel_sigma=[[2.0, 1.0]])
            >>> measured.ellipses(0.95).half_axes  # 2.4477 deviations of 4 and 2 cm
            tensor([[0.0979, 0.0490]], dtype=torch.float64)
        """
        return plane_ellipses(self._noise, self.points, self.covariance, check_level(level))

    @cached_property
    def nonlinear(self) -> Bool[Tensor, "*batch n"]:
        """Where a point's deviations mislead, and `interval` is to be taken `(*B, N)`: see `Quantity.nonlinear`."""
        spread = torch.stack([coordinate.deviation for coordinate in self._coordinates], dim=-1)
        bent = torch.stack([coordinate.nonlinear for coordinate in self._coordinates], dim=-1)
        return (bent & (spread > 1e-9 * spread.amax(-1, keepdim=True))).any(-1)

    @cached_property
    def extrapolated(self) -> Bool[Tensor, "*batch n"] | None:
        """Which pixels lie outside the region that the corners of the calibration covered `(*B, N)`.

        Nothing tells the lens there but its model. The deviations hold what a lens of that model may do within the
        uncertainty of its coefficients, and are infinite where such a lens may end before the pixel; of another lens
        they know nothing. The region is the convex hull of all corners that were used, grown by half a square; for a
        calibration from `locate` that of the calibration it was given. `None` where the corners are not known: for a
        camera alone, and a pose that was located with one.
        """
        return None if self._region is None else ~in_region(self._sight.pixels, self._region)

    def quantity(self, function: Callable[[Tensor], Tensor], which: Sequence[Sequence[int]] | Tensor) -> Quantity:
        """Any number that depends on a few of the points, with its standard deviation.

        Args:
            function: takes k points `(k, 3)` to a number; written with PyTorch's functions, so that it has a gradient.
            which: the numbers of the k points of each of M quantities, `(M, k)`.

        Raises:
            TypeError: no function, or no whole numbers.
            ValueError: not of shape `(M, k)`, or the function gives something else than a number with a gradient, or is
                not written in PyTorch's functions alone.
            IndexError: there is no such point.

        Example:
            >>> import diffproj as dp
            >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
            >>> measured = dp.measure(calibration.views.pixels[0, :3], calibration, dp.Plane.z(0.0), view=0)
            >>> middle = measured.quantity(lambda p: p.mean(dim=0)[0], [[0, 1, 2]])
            >>> print(f"{middle.value[0]:.1f} mm")  # x of the centroid of three corners in a row
            25.0 mm
        """
        index = self._numbers("which", which)
        given = arguments.function("function", function, "a function of k points (k, 3)")
        chosen = self.points[..., index, :]  # (*B, M, k, 3)

        gradient, value = at_each(torch.func.grad_and_value(checked_number(given)))(chosen)
        gradient, value = gradient.reshape(chosen.shape), value.reshape(chosen.shape[:-2])
        spread = Propagated.of(self._noise, index, gradient.nan_to_num(0.0, 0.0, 0.0).unsqueeze(-3))
        with torch.no_grad():
            first = spread.covariance.squeeze(-1).squeeze(-1)
            kink = kink_variance(function, spread.steps(), chosen, first)
        return self._number(spread, function, value, kink, kinked_interval)

    def lengths(self, pairs: Sequence[Sequence[int]] | Tensor | None = None) -> Quantity:
        """Distances between points in world units: of successive points, or of `pairs (M, 2)`."""
        return self._norms(difference, self._successive(2) if pairs is None else self._numbers("pairs", pairs, 2))

    def angles(self, triples: Sequence[Sequence[int]] | Tensor | None = None) -> Quantity:
        """Angles at the second of three points in radians: of successive points, or of `triples (M, 3)`.

        Where an arm has no length the deviation is infinite, and where an arm may have none any angle is possible.
        """
        index = self._successive(3) if triples is None else self._numbers("triples", triples, 3)
        arms = [self._norms(difference, index[:, [1, end]]) for end in (0, 2)]
        undefined = (arms[0].value == 0) | (arms[1].value == 0)
        found = self._norms(turn, index, limit=torch.pi, undefined=undefined)
        return replace(found, _bounds=partial(angle_interval, arms, found))

    def area(self, corners: Sequence[int] | None = None) -> Quantity:
        """The area of the polygon with these corners in order (all points if left out), in squared world units.

        Parts of an outline that crosses itself cancel; a warning says so.
        """
        if corners is None:
            every = torch.arange(self.points.shape[-2], device=self.points.device).unsqueeze(0)
        else:
            want = "the numbers of the corners of one polygon, as [0, 1, 2]"
            index = arguments.whole_numbers("corners", corners, want)
            if index.ndim != 1:
                raise ValueError(f"corners: want {want}, got shape {tuple(index.shape)}")
            every = self._numbers("corners", index.unsqueeze(0))
        if every.shape[-1] < 3:
            raise ValueError(f"corners: want at least 3, got {every.shape[-1]}")
        places, spread = (part.detach()[..., every[0], :] for part in (self.points, self.deviations))
        warn_of_crossings(places, spread, self.valid[..., every[0]])
        return self._norms(area_vector, every)

    def summary(self) -> str:
        """Points and successive lengths with their standard deviations, as a text for people; for one camera.

        Raises:
            ValueError: there are many cameras.
        """
        if self.points.ndim > 2:
            raise ValueError(f"summary: want one camera, got batch shape {tuple(self.points.shape[:-2])}; see to_dict")
        valid, bent = self.valid.tolist(), self.nonlinear.tolist()
        beyond = [False] * len(valid) if self.extrapolated is None else self.extrapolated.tolist()
        spread, lines = self.deviations.tolist(), []
        digits = decimals(map(max, spread), 3)  # what no error moves, as a height on the ground, is known to rounding
        for n, (point, deviation) in enumerate(zip(self.points.tolist(), spread, strict=True)):
            texts = (f"{x:z10.{digits}f} ± {s:.{digits}f}" for x, s in zip(point, deviation, strict=True))
            notes = "  nonlinear" * bent[n] + "  extrapolated" * beyond[n]
            lines.append(f"point {n:<3} {'  '.join(texts) + notes if valid[n] else f'not {self._lie}'}")
        if len(lines) > 1:
            found = self.lengths()
            lines += [f"{n} to {n + 1:<4} {text}" for n, text in enumerate(described(found, self._lie))]
            bent = [*bent, *found.nonlinear.tolist()]
        lines += [EXTRAPOLATED] * any(out and there for out, there in zip(beyond, valid, strict=True))
        lines += [NONLINEAR] * any(bent)
        if self.doubts:
            lines.append(f"Doubtful: {self.doubts}.".replace("?.", "?"))
        if not self.includes_intrinsics:
            known = listed(self._held()) + " alone" * (len(self._held()) == 1)
            lines.append(f"The deviations hold the noise of the {known}: the camera came without a covariance.")
        return "\n".join(lines)

    def _held(self) -> tuple[str, ...]:
        """Whose noise and errors the deviations hold, beside those of the intrinsics."""
        sight = self._sight
        posed, others = sight.by_theta.shape[-1], self._noise.sigma.shape[-1] - sight.away.shape[-1]
        return ("pixels", *["the pose"][: min(1, posed)], *["the plane"][: min(1, others - posed)])

    def to_dict(self) -> dict[str, list[Any]]:
        """The points as columns of Python's own numbers, of many cameras with theirs: `pandas.DataFrame` takes it.

        `reason` is the name of a `Reason`; where a point is not `valid`, its numbers are NaN.

        Example:
            >>> import diffproj as dp
            >>> calibration = dp.calibrate(dp.example_views("left"), dp.Chessboard())
            >>> corners = calibration.views.pixels[0, :2]
            >>> found = dp.measure(corners, calibration, dp.Plane.z(0.0), view=0).to_dict()
            >>> found["point"], found["reason"], [round(x) for x in found["x"]]
            ([0, 1], ['VALID', 'VALID'], [0, 25])
        """
        sight, batch = self._sight, self.points.shape[:-2]
        reasons = explain(sight.pixels, sight.camera, sight.plane).expand(self.valid.shape)
        places = torch.where(self.valid.unsqueeze(-1), self.points, torch.nan)
        beyond = self.extrapolated
        columns: dict[str, Tensor] = {}
        if batch:
            cameras = torch.arange(batch.numel(), device="cpu").reshape(*batch, 1)
            columns["camera"] = cameras.expand(self.valid.shape)
        columns["point"] = torch.arange(self.valid.shape[-1], device="cpu").expand(self.valid.shape)
        columns |= dict(zip("uv", sight.pixels.unbind(-1), strict=True)) | {"valid": self.valid}
        columns |= dict(zip("xyz", places.unbind(-1), strict=True))
        columns |= {f"{axis}_deviation": part for axis, part in zip("xyz", self.deviations.unbind(-1), strict=True)}
        columns |= {"nonlinear": self.nonlinear} | ({} if beyond is None else {"extrapolated": beyond})
        found: dict[str, list[Any]] = {name: values.detach().flatten().tolist() for name, values in columns.items()}
        return found | {"reason": [Reason(code).name for code in reasons.flatten().tolist()]}

    def _facts(self) -> list[str]:
        count = self.valid.shape[-1]
        lost = int((~self.valid).sum())
        return [
            counted(self.valid.shape[:-1], "camera"),
            f"{count} point{'s' * (count != 1)}",
            f"{lost} not {self._lie}" if lost else "",
            "doubtful" if self.doubts else "",
        ]

    def _columns(self) -> dict[str, Sequence[Any]]:
        found = self.to_dict()
        shown: dict[str, Sequence[Any]] = {name: found[name] for name in ("camera", "point", "u", "v") if name in found}
        for axis in "xyz":
            pairs = [rounded(*pair) for pair in zip(found[axis], found[f"{axis}_deviation"], strict=True)]
            shown[axis], shown[f"\u00b1 {axis}"] = ([pair[side] for pair in pairs] for side in (0, 1))
        flags = [name for name in ("nonlinear", "extrapolated") if any(found.get(name, []))]
        flags += [] if all(found["valid"]) else ["reason"]
        return shown | {name: found[name] for name in flags}

    def _note(self) -> str:
        return self.doubts

    def _norms(
        self,
        function: Callable[[Tensor], tuple[Tensor, Tensor]],
        index: Tensor,
        limit: float = torch.inf,
        undefined: Tensor | None = None,
    ) -> Quantity:
        """Lengths of vectors that depend on the points, or what they lack to the limit: see `shapes`."""
        chosen = self.points[..., index, :]

        def twice(points: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
            found = function(points)
            return found[0], found

        J, (w, supplement) = at_each(torch.func.jacrev(twice, has_aux=True))(chosen)
        w, supplement = w.reshape(*chosen.shape[:-2], 3), supplement.reshape(chosen.shape[:-2])
        spread = Propagated.of(self._noise, index, J.reshape(*chosen.shape[:-2], 3, *chosen.shape[-2:]))
        C, r = spread.covariance, length(w)
        u = w / torch.where(r > 0, r, 1.0).unsqueeze(-1)
        along = (u * (C @ u.unsqueeze(-1)).squeeze(-1)).sum(-1)
        across = C.diagonal(dim1=-2, dim2=-1).sum(-1) - along
        rows = (spread.common * u.unsqueeze(-1)).sum(-2)
        rows = torch.where((r > 0).unsqueeze(-1), rows, spread.common.abs().sum(-2))
        lost = self._noise.unknown(rows.unsqueeze(-2)).squeeze(-1).squeeze(-1)
        lost = lost if undefined is None else lost | undefined
        bounds = partial(norm_interval, spread, function, w, supplement, lost, limit)
        freedom = spread.degrees_of_freedom(torch.where((r > 0).unsqueeze(-1), u, longest_first(C.detach())[1]))
        value = torch.where(supplement, limit - r, r) if limit < torch.inf else r
        return self._quantity(index, value, norm_variance(r, along, across), lost, freedom, bounds)

    def _number(
        self, spread: Propagated, function: Function, value: Tensor, kink: Tensor, interval: Interval
    ) -> Quantity:
        """A number with what its slopes make uncertain and, at a kink, what they do not tell."""
        variance = spread.covariance.squeeze(-1).squeeze(-1) + kink
        lacking = variance.detach().clamp(min=0).sqrt() - (variance.detach() - kink).clamp(min=0).sqrt()
        lost = self._noise.unknown(spread.common).squeeze(-1).squeeze(-1)
        freedom = spread.degrees_of_freedom(torch.ones_like(value).unsqueeze(-1))
        bounds = partial(interval, spread, function, value.detach(), lost, lacking)
        return self._quantity(spread.index, value, variance, lost, freedom, bounds)

    def _quantity(
        self, index: Tensor, value: Tensor, variance: Tensor, lost: Tensor, freedom: Tensor, bounds: Bounds
    ) -> Quantity:
        valid = self.valid[..., index].all(-1)
        # The root's slope at 0 is infinite: the length between a point and itself has deviation 0 and zero gradient.
        known = valid & (variance > 0)
        deviation = torch.where(known, torch.where(known, variance, 1.0).sqrt(), 0.0)
        deviation = torch.where(lost, torch.inf, deviation)
        nowhere = torch.full_like(value, torch.nan)
        return Quantity(torch.where(valid, value, nowhere), torch.where(valid, deviation, nowhere), freedom, bounds)

    @cached_property
    def _coordinates(self) -> list[Quantity]:
        index = torch.arange(self.points.shape[-2], device=self.points.device).unsqueeze(-1)
        found = []
        for axis in range(3):
            slope = torch.zeros_like(self.points)
            slope[..., axis] = 1.0
            spread = Propagated.of(self._noise, index, slope[..., None, None, :])
            value = self.points[..., axis]
            found.append(
                self._number(spread, partial(coordinate, axis), value, torch.zeros_like(value), curved_interval)
            )
        return found

    def _numbers(self, name: str, which: Sequence[Sequence[int]] | Tensor, k: int | None = None) -> Tensor:
        """The numbers of points `(M, k)`, from 0."""
        want = f"point numbers of shape (M, {'k' if k is None else k})"
        index = arguments.whole_numbers(name, which, want).to(self.points.device)
        N = self.points.shape[-2]
        if index.ndim != 2 or index.shape[-1] != (index.shape[-1] if k is None else k) or index.shape[-1] == 0:
            raise ValueError(f"{name}: want {want}, got shape {tuple(index.shape)}")
        if bool(((index < -N) | (index >= N)).any()):
            raise IndexError(f"{name}: want numbers of the {N} points, got {index.flatten().tolist()}")
        return index % max(1, N)

    def _successive(self, k: int) -> Tensor:
        N = self.points.shape[-2]
        if k > N:
            raise ValueError(f"points: want at least {k}, got {N}")
        first, following = (torch.arange(count, device=self.points.device) for count in (N - k + 1, k))
        return first.unsqueeze(-1) + following
