"""Several cameras' measurements of the same points on one plane, joined by their covariances.

With y_c the points that camera c measured, as coordinates along the plane, and C_c their joint covariance, the best
estimate and its covariance are

    y = C sum_c C_c^-1 y_c        C^-1 = sum_c C_c^-1

where a camera that did not see a point adds nothing about it, and what it knows of the others still counts. All are
linearised at the estimate (`relinearised.py`): each at its own point they would be biased near the horizon. The errors
of different cameras are taken to be independent, as they are where each was calibrated and located by itself. Several
photographs of one calibrated camera share the errors of its intrinsics, frames of one that stands still those of its
pose, the cameras of a rig those of all that was calibrated with it, and cameras that were found by the same landmarks
those that these came with (`shared_errors.py`), in ways that are not known here: each of n counts by an nth of its
information, which no correlation makes too much (covariance intersection, Julier and Uhlmann 1997). So does a
measurement that is given twice. Of a rig's own moments, and of points in space, `RigCalibration.triangulate` knows the
joint covariance, and is surer. So is one measurement of the mean of a point's pixels in many frames of a camera that
stands still: the mean of n clicks is off by a click's deviation over the root of n, which is its `pixel_sigma`.

Whether the cameras agree is tested: each camera against the estimate of all others, by the chi-square of the difference
(by F's distribution where deviations were estimated from few residuals), linearised where the others say that the
points are. The camera that disagrees most is named, then tested is the rest; of two that share points with each other
alone, both are. Where cameras disagree, nothing tells by itself which one is right: all stay in, and the covariance
grows by chi-square over its degrees of freedom (Birge 1932), of all points or of those that a camera which disagrees
saw, whichever is more, until its owner mends or leaves one out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.arguments import called
from diffproj._core.numerics import broadcast_batches
from diffproj._core.shown import listed
from diffproj._core.warn import warn_caller
from diffproj.calibration.results.mismatch import CameraDisagreementWarning
from diffproj.geometry.plane import Plane
from diffproj.measurement.agreement import Sources, chances, disagreeing, growth, inverse, joined, without
from diffproj.measurement.measurement import Measurement
from diffproj.measurement.propagation import Noise
from diffproj.measurement.quantity import BENT
from diffproj.measurement.relinearised import bent, relinearised
from diffproj.measurement.shared_errors import sharing
from diffproj.measurement.sight import Sight, Straight
from diffproj.measurement.student import normal_reach

MOST_POINTS = 3000
"""Whose joint covariance is inverted for each camera."""
MOST_STEPS, STANDS = 10, 1e-4
"""Steps of linearising anew, and the deviations by which a further one may move the estimate."""


@dataclass(frozen=True, eq=False, repr=False)
class FusedMeasurement(Measurement):
    """Points that several cameras measured; with lengths, areas and intervals as those of one camera have them.

    Attributes:
        names: of the C cameras.
        seen: which camera measured which point `(*B, C, N)`.
        chance: how likely a camera differs from the estimate of all others as much as it does, by chance, `(*B, C)`;
            1 where no other saw its points.
        disagrees: which cameras differ by more than chance `(*B, C)`.
        scale: by what the deviations were multiplied, as the cameras disagree, `(*B,)`; 1 where they agree.
    """

    names: tuple[str, ...] = ()
    seen: Bool[Tensor, "*batch c n"] | None = None
    chance: Float[Tensor, "*batch c"] | None = None
    disagrees: Bool[Tensor, "*batch c"] | None = None
    scale: Float[Tensor, "*batch"] | None = None
    _hold: tuple[str, ...] = ()
    _bent: Bool[Tensor, "*batch n"] | None = None
    _beyond: Bool[Tensor, "*batch n"] | None = None

    _lie = "measured"

    @cached_property
    def nonlinear(self) -> Bool[Tensor, "*batch n"]:
        """Where deviations mislead `(*B, N)`, and `interval`, which is straight here, is not quite symmetric in truth.

        Even together the cameras are not sure enough of such a point for the curve from pixels to the plane to be
        straight: see `Quantity.nonlinear`.
        """
        return torch.zeros_like(self.valid) if self._bent is None else self._bent

    @cached_property
    def extrapolated(self) -> Bool[Tensor, "*batch n"] | None:
        """Which points no camera saw within the region that its calibration's corners covered `(*B, N)`."""
        return self._beyond

    def to_dict(self) -> dict[str, list[Any]]:
        """The points as columns of Python's own numbers; `cameras` counts those that measured a point."""
        counts = torch.zeros_like(self.valid, dtype=torch.long) if self.seen is None else self.seen.sum(-2)
        places = torch.where(self.valid.unsqueeze(-1), self.points, torch.nan)
        columns = {"point": torch.arange(self.valid.shape[-1], device="cpu").expand(self.valid.shape)}
        columns |= {"valid": self.valid, "cameras": counts} | dict(zip("xyz", places.unbind(-1), strict=True))
        columns |= {f"{axis}_deviation": part for axis, part in zip("xyz", self.deviations.unbind(-1), strict=True)}
        found = {name: values.detach().flatten().tolist() for name, values in columns.items()}
        reasons = ["VALID" if valid else "NOT_MEASURED" for valid in found["valid"]]
        flags = {"nonlinear": self.nonlinear.flatten().tolist()}
        if self.extrapolated is not None:
            flags["extrapolated"] = self.extrapolated.flatten().tolist()
        return found | flags | {"reason": reasons}

    def _held(self) -> tuple[str, ...]:
        return self._hold

    def _facts(self) -> list[str]:
        return [f"{len(self.names)} cameras", *super()._facts()]


def fuse(measurements: Sequence[Measurement] | Mapping[str, Measurement]) -> FusedMeasurement:
    """Join what several cameras measured of the same points on one plane.

    Args:
        measurements: of each camera, of the same N points in the same order and on the same plane, as `measure` gives
            them; a mapping names the cameras, which are "camera 0", "camera 1", ... otherwise. A point that a camera
            does not see has NaN pixels there.

    Returns:
        The joined points in float64, with their covariance; see `FusedMeasurement`. Where cameras disagree, `doubts`
        and a `CameraDisagreementWarning` name them, and deviations are as much larger as it takes to explain it.

    Raises:
        TypeError: something else than measurements.
        ValueError: less than two of them, different points or planes, points without any uncertainty, or an uncertain
            plane, whose error all cameras would share.

    Example:
        >>> import diffproj as dp
        >>> K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
        >>> table, dot = dp.Plane.z(0.0), torch.tensor([[2.0, 3.0, 0.0]], dtype=torch.float64)
        >>> near, far = (dp.Camera(K, t=torch.tensor([0.0, 0, depth], dtype=torch.float64)) for depth in (50, 100))
        >>> seen = {
        ...     name: dp.measure(camera.project(dot)[0], camera, table, pixel_sigma=0.5)
        ...     for name, camera in (("near", near), ("far", far))
        ... }
        >>> fused = fuse(seen)
        >>> for found in (*seen.values(), fused):
        ...     print("{:.3f}".format(found.deviations[0, 0]))
        0.050
        0.100
        0.045
    """
    names, found = _checked(measurements)
    batch = broadcast_batches(**{f"m{i}": one.points.shape[:-2] for i, one in enumerate(found)})
    plane = found[0]._sight.plane
    N = found[0].points.shape[-2]
    T = (plane.tangents() if plane.is_per_point else plane.tangents().unsqueeze(-3)).to(torch.float64)
    T = T.expand(*batch, N, 3, 2)
    seen = torch.stack([_seen(one).expand(*batch, N) for one in found], dim=-2)  # (*B, C, N)
    shares = sharing(found, batch).to(torch.float64)
    best, moving = _settled(names, found, seen, T, shares)
    y, covariance = best.y, best.estimate[1]
    freedom = torch.stack([one.degrees_of_freedom.expand(batch) for one in found], dim=-1)

    def sources_at(one: _Joined) -> Sources:
        both = seen.repeat_interleave(2, dim=-1)
        estimated = without(_covariances([_told(each) for each in one.found], T, shares), both)
        return Sources(one.y, one.C, one.information, both, estimated, freedom)

    def seen_by(some: Tensor) -> Sources:
        theirs = _joined(names, found, seen & some.unsqueeze(-1), T, shares)
        at = torch.where(theirs.there.unsqueeze(-1), theirs.placed, best.placed).detach()
        return sources_at(_joined(names, [relinearised(one, at) for one in found], seen, T, shares))

    sources = sources_at(best)
    chance = chances(sources)
    disagrees = disagreeing(sources, seen_by, chance)
    scale = growth(sources, disagrees).sqrt()
    common = scale[..., None, None, None] * T @ torch.linalg.cholesky(covariance).unflatten(-2, (N, 2))
    there, placed = best.there, best.placed
    common = torch.where(there[..., None, None], common, 0.0)
    unit = torch.eye(2 * N, dtype=y.dtype, device=y.device).expand(*batch, 2 * N, 2 * N)
    noise = Noise(
        Straight(placed.detach(), there, common, plane),
        common,
        unit,
        common[..., :2] * 0,
        freedom.amin(-1),
        pixels_too=False,
    )
    doubts = _doubts(names, disagrees)
    if doubts:
        warn_caller(doubts, CameraDisagreementWarning)
    told = "; ".join(dict.fromkeys([doubts, *(one.doubts for one in found)])).strip("; ")
    includes = all(one.includes_intrinsics for one in found)
    each = {"names": names, "seen": seen, "chance": chance.exp(), "disagrees": disagrees, "scale": scale}
    fused = FusedMeasurement(placed, there, includes, noise, None, told, **each)
    curved = _curved(found, fused) | (moving.unsqueeze(-1) & there)
    return replace(fused, _hold=_hold(names, found), _bent=curved, _beyond=_extrapolated(found, seen))


def _settled(
    names: Sequence[str], found: Sequence[Measurement], seen: Tensor, T: Tensor, shares: Tensor
) -> tuple["_Joined", Tensor]:
    """Measurements joined and linearised at their estimate, each element of the batch until it stands still.

    Returns:
        That, and which elements still move `(*B,)`.
    """
    best = _joined(names, found, seen, T, shares)
    at, moving = best.placed.detach(), torch.ones(T.shape[:-3], dtype=torch.bool, device=T.device)
    for _ in range(MOST_STEPS):
        best = _joined(names, [relinearised(one, at) for one in found], seen, T, shares)
        moving = moving & (best.deviations_from(at) > STANDS)
        if not bool(moving.any()):
            break
        at = torch.where(moving[..., None, None], best.placed.detach(), at)
    return best, moving


class _Joined(NamedTuple):
    """The best estimate of measurements as they are linearised.

    Attributes:
        found: these.
        y: what each measured, along the plane from near the points `(*B, C, 2 N)`.
        C: the covariances, as much larger as others share them `(*B, C, 2 N, 2 N)`.
        information: their inverses.
        estimate: the estimate of y, its covariance, and which coordinates anybody knows.
        placed: the estimate in the world `(*B, N, 3)`; 0 where nobody saw the point.
        there: which points somebody saw `(*B, N)`.
        T: the plane's directions `(*B, N, 3, 2)`.
    """

    found: Sequence[Measurement]
    y: Tensor
    C: Tensor
    information: Tensor
    estimate: tuple[Tensor, Tensor, Tensor]
    placed: Tensor
    there: Tensor
    T: Tensor

    def deviations_from(self, at: Tensor) -> Tensor:
        """How many deviations the furthest point is from there `(*B,)`."""
        step = torch.einsum("...nij,...ni->...nj", self.T, self.placed.detach() - at).flatten(-2)
        spread = self.estimate[1].detach().diagonal(dim1=-2, dim2=-1).sqrt()
        off = torch.where(self.estimate[2], step.abs() / spread, 0.0)
        return torch.nn.functional.pad(off, (1, 0)).amax(-1)  # 0 of no points


def _joined(names: Sequence[str], found: Sequence[Measurement], seen: Tensor, T: Tensor, shares: Tensor) -> _Joined:
    """Join them; `shares (*B, C)` is how many share each one's errors."""
    *batch, N, _, _ = T.shape
    points = torch.stack([one.points.expand(*batch, N, 3) for one in found], dim=-3)
    origin = _mean(points, seen)  # near the points, so that their coordinates are small
    y = torch.einsum("...nij,...cni->...cnj", T, points - origin.unsqueeze(-3)).flatten(-2)
    both = seen.repeat_interleave(2, dim=-1)
    y = torch.where(both, y, 0.0)
    C = without(_covariances(found, T, shares), both)
    information, sound = inverse(C)
    if not bool(sound.all()):
        who = next(name for name, bad in zip(names, _of_any(~sound), strict=True) if bad)
        raise ValueError(
            f"measurements: want points with an uncertainty of their own, got {who} without; give pixel_sigma above 0"
        )
    information = torch.where(both.unsqueeze(-1) & both.unsqueeze(-2), information, 0.0)
    estimate = joined(information, y)
    there = estimate[2].unflatten(-1, (N, 2)).all(-1)
    placed = origin + (T @ estimate[0].unflatten(-1, (N, 2)).unsqueeze(-1)).squeeze(-1)
    return _Joined(found, y, C, information, estimate, torch.where(there.unsqueeze(-1), placed, 0.0), there, T)


def _checked(
    measurements: Sequence[Measurement] | Mapping[str, Measurement],
) -> tuple[tuple[str, ...], list[Measurement]]:
    """Names and measurements, known to fit together."""
    want = "what dp.measure gives for each camera, in a list or by name"
    if isinstance(measurements, Mapping):
        names, found = tuple(map(str, measurements)), list(measurements.values())
    elif isinstance(measurements, Sequence) and not isinstance(measurements, str):
        names, found = tuple(f"camera {i}" for i in range(len(measurements))), list(measurements)
    else:
        raise TypeError(f"measurements: want {want}, got {called(measurements)}")
    for name, one in zip(names, found, strict=True):
        if not isinstance(one, Measurement):
            raise TypeError(f"measurements: want {want}, got {called(one)} for {name}")
        if not isinstance(one._noise.sight, Sight):
            raise TypeError(f"measurements: want {want}, got fused ones for {name}; fuse all cameras at once")
    if len(found) < 2:
        raise ValueError(f"measurements: want those of two cameras or more, got {len(found)}")
    first = found[0]
    if first.points.shape[-2] > MOST_POINTS:
        raise ValueError(f"measurements: want at most {MOST_POINTS} points at once, got {first.points.shape[-2]}")
    for name, one in zip(names[1:], found[1:], strict=True):
        if one.points.shape[-2] != first.points.shape[-2]:
            raise ValueError(
                f"measurements: want the same points of each camera, got {first.points.shape[-2]} of {names[0]} and "
                f"{one.points.shape[-2]} of {name}; give NaN as the pixels of points that a camera does not see"
            )
        if one.points.device != first.points.device:
            raise ValueError(f"measurements: want one device, got {first.points.device} and {one.points.device}")
        if not _same(first._sight.plane, one._sight.plane):
            raise ValueError(
                f"measurements: want one plane, in one world frame, got different ones of {names[0]} and {name}; "
                "locate both cameras by the same landmarks"
            )
    for name, one in zip(names, found, strict=True):
        n = one._sight.plane.unit_normal
        n = (n if n.ndim > 1 and n.shape[-2:-1] == one.points.shape[-2:-1] else n.unsqueeze(-2)).expand(
            one.points.shape
        )
        across = (n.unsqueeze(-2) @ one.covariance.nan_to_num(0.0, 0.0) @ n.unsqueeze(-1)).abs()
        size = one.covariance.nan_to_num(0.0, 0.0).diagonal(dim1=-2, dim2=-1).sum(-1)
        if bool((across.squeeze(-1).squeeze(-1) > 1e-6 * size).any()):
            raise ValueError(
                f"measurements: want an exact plane, got an uncertain one, or a doubtful pose, of {name}, whose "
                "error the cameras would share; measure without plane_covariance"
            )
    return names, found


def _same(a: Plane, b: Plane) -> bool:
    """Whether two planes are one, up to rounding."""
    try:
        (n, d), (m, e) = a.to(torch.float64).normalised(), b.to(torch.float64).normalised()
        side = (n * m).sum(-1).sign()  # the normal of one may point to the other side
        close = torch.isclose(n, side.unsqueeze(-1) * m, rtol=0, atol=1e-9)
        return bool(close.all()) and bool(torch.isclose(d, side * e, rtol=1e-9, atol=1e-9).all())
    except RuntimeError:  # of shapes that do not meet
        return False


def _seen(one: Measurement) -> Tensor:
    """Which points a camera tells something about: valid ones of finite variance."""
    return one.valid & one.covariance.isfinite().all(-1).all(-1)


def _curved(found: Sequence[Measurement], fused: FusedMeasurement) -> Tensor:
    """Of which points `(*B, N)` the 95 % interval is not straight for a camera that saw them."""
    C = fused.covariance.detach().nan_to_num(0.0)
    values, vectors = torch.linalg.eigh(C)
    axes = normal_reach(0.95) * vectors * values.clamp(min=0).sqrt().unsqueeze(-2)
    steps, at = torch.cat([axes, -axes], dim=-1), fused.points.detach()
    return torch.stack([bent(one, at, steps, BENT).expand(fused.valid.shape) for one in found]).any(0)


def _extrapolated(found: Sequence[Measurement], seen: Tensor) -> Tensor | None:
    """Which points `(*B, N)` were extrapolated by all that saw them; `None` where that is known of none of these."""
    known = [one.extrapolated for one in found]
    if all(one is None for one in known):
        return None
    inside = [
        torch.ones_like(here) if one is None else here & ~one for one, here in zip(known, seen.unbind(-2), strict=True)
    ]
    return seen.any(-2) & ~torch.stack(inside).any(0)


def _hold(names: Sequence[str], found: Sequence[Measurement]) -> tuple[str, ...]:
    """Whose noise and errors the joined deviations hold, in words."""
    posed = [name for name, one in zip(names, found, strict=True) if "the pose" in one._held()]
    return ("pixels",) if not posed else ("pixels", "the pose" + f" of {listed(posed)}" * (len(posed) < len(names)))


def _mean(points: Tensor, seen: Tensor) -> Tensor:
    """About where each point is `(*B, N, 3)`, of those that saw it."""
    kept = torch.where(seen.unsqueeze(-1), points.detach(), 0.0)
    return kept.sum(-3) / seen.sum(-2).clamp(min=1).unsqueeze(-1)


def _covariances(found: Sequence[Measurement], T: Tensor, shares: Tensor) -> Tensor:
    """Of coordinates along the plane `(*B, C, 2 N, 2 N)`, each as much larger as others share it."""
    shape = *T.shape[:-3], 3 * T.shape[-3], 3 * T.shape[-3]
    return shares[..., None, None] * torch.stack([_along(one.joint().expand(shape), T) for one in found], dim=-3)


def _told(one: Measurement) -> Measurement:
    """The measurement with those errors alone whose scale the calibration's residuals tell."""
    noise = one._noise
    return one if noise.pixels_too else replace(one, _noise=replace(noise, own=0 * noise.own))


def _along(joint: Tensor, T: Tensor) -> Tensor:
    """The covariance `(*B, 2 N, 2 N)` of coordinates along the plane, of that in the world `(*B, 3 N, 3 N)`."""
    N = T.shape[-3]
    blocks = joint.unflatten(-1, (N, 3)).unflatten(-3, (N, 3))  # (*B, N, 3, N, 3)
    return torch.einsum("...nia,...nimj,...mjb->...namb", T, blocks, T).flatten(-2).flatten(-3, -2)


def _of_any(mask: Tensor) -> list[bool]:
    """Which cameras `(C,)` the mask `(*B, C)` marks anywhere in the batch."""
    return mask.reshape(-1, mask.shape[-1]).any(0).tolist()


def _doubts(names: Sequence[str], disagrees: Tensor) -> str:
    """Which cameras disagree, in words; empty where all agree."""
    who = [name for name, bad in zip(names, _of_any(disagrees), strict=True) if bad]
    if not who:
        return ""
    if len(who) == len(names):
        return f"{listed(who)} disagree by more than their deviations explain: was one moved, or is its pose wrong?"
    verb = "disagrees" if len(who) == 1 else "disagree"
    return f"{listed(who)} {verb} with the other cameras by more than the deviations explain: moved, or a wrong pose?"
