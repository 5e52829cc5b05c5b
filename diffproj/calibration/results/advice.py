"""The verdict on a calibration that converged: good or weak, why, and what to photograph next, in plain words.

It looks at what a careful person would: how many views differ, how far the board was tilted, how much of the image its
corners covered, how surely the focal lengths are known, whether the corners scatter as a detector's do, and whether the
residuals leave something over. The limits are rules of thumb; error bars hold what each of them costs.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj.calibration.results.region import in_region
from diffproj.calibration.results.remark import OF_THE_CAMERA, Kind, Remarks
from diffproj.geometry.camera import Camera
from diffproj.geometry.grid import pixel_grid

FEW_VIEWS, ENOUGH_VIEWS = 5, 10
"""Views that differ below which a calibration is weak, and as many as are asked for then."""
LOW_TILT = 20.0
"""Largest tilt of the board against the image, in degrees, below which focal lengths lean on little."""
ONE_AXIS = 0.05
"""Spread of the boards' normals about their second axis below which the board was tilted about one only."""
SMALL_COVER = 0.4
"""Part of the image inside the corners' region below which most of the lens is guessed."""
BARE = 0.25
"""The same of each ninth of the image, below which it is named."""
UNSURE = 0.01
"""Deviation of a focal length or the principal point, relative to the focal length, from which on it is unsure."""
UNSURE_OF_LANDMARKS, FEW_SPARE = 0.02, 4
"""The same of a camera calibrated on landmarks; and degrees of freedom below which its residuals tell little."""
COARSE_PX = 0.5
"""Scatter of a corner's coordinate above that of a detector in sharp photographs, 0.05 to 0.3 px."""
ODD = 3.0
"""Times the median RMS of all views from which on a view is named."""
POSES_ONLY = "Poses only, the camera was given"
ACROSS, DOWN = ("left", "", "right"), ("top", "", "bottom")


@dataclass(frozen=True)
class Evidence:
    """What a verdict goes by, of one camera.

    Attributes:
        cameras: at the poses of the V views.
        used: which views have corners that were used `(V,)`.
        different: how many views differ, those alike counting as one.
        region: of the corners, as `covered_region` gives it `(64,)`.
        unsure: the largest deviation of a focal length or the principal point, relative to the focal length; `None`
            where it is not known.
        sigma: of a corner's coordinate in px.
        view_rms: `(V,)` in px.
        left_out: of which views too many corners were left out as outliers `(V,)`.
        names: of the views.
        remarks: what the residuals leave over.
    """

    cameras: Camera
    used: Bool[Tensor, " v"]
    different: float
    region: Float[Tensor, " directions"] | None
    unsure: float | None
    sigma: float
    view_rms: Float[Tensor, " v"]
    left_out: Bool[Tensor, " v"]
    names: tuple[str, ...]
    remarks: Remarks

    @property
    def kinds(self) -> set[Kind]:
        """What the remarks say."""
        return {remark.kind for remark in self.remarks}

    @property
    def other_model(self) -> bool:
        """Whether the residuals are those of another lens, or of a K with skew."""
        return not self.kinds.isdisjoint(OF_THE_CAMERA)


@dataclass(frozen=True)
class Judgement:
    """A verdict in its parts.

    Attributes:
        word: `Good`, `Weak` or `Not usable`; or `POSES_ONLY`.
        reasons: why, in a few words each.
        remedies: what to do next, the most useful first; for a good calibration, what would make it better still.
        bare: the ninths of the image that hardly a corner reached, such as `top left`.
        tilt: whether the board should be photographed tilted more, or about its other axis.
        views: how many more photographs it should have at least.
        note: what else is to be known.
    """

    word: str
    reasons: tuple[str, ...]
    remedies: tuple[str, ...] = ()
    bare: tuple[str, ...] = ()
    tilt: bool = False
    views: int = 0
    note: str = ""

    @property
    def good(self) -> bool:
        """Whether it is known well."""
        return self.word == "Good"

    def __str__(self) -> str:
        text = f"{self.word}: {'; '.join(self.reasons)}"
        if self.remedies:
            text += f". {'Better still' if self.good else 'Next'}: {'; '.join(self.remedies)}"
        return f"{text}. {self.note}".rstrip()


def judged(seen: Evidence) -> Judgement:
    """Good or weak, why, and what to photograph next."""
    normals = seen.cameras.R[seen.used][..., 2].detach()
    tilt = float(torch.rad2deg(normals[:, 2].abs().clamp(max=1).acos()).amax())
    covered = _covered(seen)
    faults, remedies = _faults(seen, tilt, covered), []
    one_axis = tilt >= LOW_TILT and seen.different >= 2 and _second_spread(normals) < ONE_AXIS
    more = ENOUGH_VIEWS - round(seen.different) if seen.different < FEW_VIEWS else 0
    if more:
        remedies.append(f"{more} more photographs, the board at other places, distances and tilts")
    tilted = tilt < LOW_TILT or (seen.unsure is not None and seen.unsure > UNSURE and not seen.other_model)
    if tilted:
        remedies.append("the board tilted by 20 to 50 degrees, about both axes")
    elif one_axis:
        remedies.append("the board tilted about its other axis too")
    bare = [] if covered is None else _bare(covered)
    if bare:
        remedies.append(f"the board in the {_listed(bare)} of the image, up to the edge")
    if Kind.FLEXING in seen.kinds:
        remedies.append("a board that does not bend, glued to glass or aluminium, at rest in each photograph")
    elif seen.sigma > COARSE_PX and not seen.other_model:
        remedies.append("sharper photographs: more light, a camera at rest, a flat print")
    odd = _odd(seen)
    if odd:
        remedies.append(f"another look at {_listed(odd)}, whose corners fit far worse than the others'")
    if seen.other_model:
        first = "first" if remedies else "no photograph yet, but"
        model = "lens model" if Kind.OTHER_LENS in seen.kinds else "skew"
        remedies.insert(0, f"{first} the {model} that the remark on the residuals names")
    if Kind.TWO_CAMERAS in seen.kinds:
        remedies.insert(
            0,
            "first another look at the views that the remark names, for one camera with one zoom must have taken all",
        )
    if Kind.TOLD_APART in seen.kinds:
        remedies.insert(0, "no other photograph yet, but those alone that one camera took with one zoom, turned alike")
    if Kind.TURNED in seen.kinds:
        remedies.insert(0, "no other photograph yet, but those that the remark names turned as the others are")
    if Kind.UNEVEN_PRINT in seen.kinds:
        remedies.insert(0, "no other photograph yet, but shape='free', or a board whose sides were measured both ways")
    if Kind.FOCUS in seen.kinds:
        remedies.insert(0, "the photographs once more with focus and zoom held")
    if Kind.STEADIED in seen.kinds:
        remedies.insert(0, "the photographs once more at rest and with image stabilisation switched off")
    if Kind.SPACING in seen.kinds:
        remedies.insert(0, "no other photograph yet, but the side and the distance of the tags measured")
    if Kind.WRONG_PRIOR in seen.kinds:
        remedies.insert(0, "first another look at the prior, or the value that was held, that the remark names")
    if Kind.BENT in seen.kinds:
        remedies.insert(0, "no other photograph yet, but shape='bow', or a board glued to something flat")
    word, reasons = ("Weak", faults) if faults else ("Good", _praise(seen, tilt, covered))
    return Judgement(word, tuple(reasons), tuple(remedies), tuple(bare), tilted or one_axis, more)


def of_landmarks(count: int, unsure: float | None, sigma: float, spare: float | None, remarks: Remarks) -> Judgement:
    """The same of a camera that was calibrated on so many landmarks.

    Args:
        count: how many landmarks were used.
        unsure: the largest deviation of focal length or principal point, relative to the focal length, where known.
        sigma: of a landmark's pixel coordinate in px.
        spare: degrees of freedom, where known.
        remarks: what the residuals leave over.
    """
    faults, remedies = [], []
    if unsure is not None and unsure > UNSURE_OF_LANDMARKS:
        known = f"only to {_percent(unsure)} %" if math.isfinite(unsure) else "not at all"
        faults.append(f"focal length and principal point are known {known} of the focal length")
        remedies.append("more landmarks, near and far, in all parts of the image")
    if spare is not None and spare < FEW_SPARE:
        faults.append(f"pixel coordinates outnumber unknowns by {spare:.0f} only, so they hardly test each other")
        remedies.append("more landmarks, near and far, in all parts of the image")
    faults += _reasons(remarks, *OF_THE_CAMERA)
    if apart := _reasons(remarks, Kind.TOLD_APART):
        faults += apart
        remedies.append("a calibration of this camera, lens and zoom, or photographs that it took alone")
    if other := _reasons(remarks, Kind.RIVAL):
        faults += other
        remedies.append("more landmarks, off the plane of the others, or a prior that tells the poses apart")
    if contradicted := _reasons(remarks, Kind.CONTRADICTION, Kind.WRONG_PRIOR):
        faults += contradicted
        remedies.append("a look at wrong landmarks, wrong priors and held values, or larger deviations for them")
    if not faults:
        known = [f"focal length and principal point are known to {100 * unsure:.1g} %"] if unsure else []
        return Judgement("Good", (f"{count} landmarks are met to {sigma:.2g} px in each coordinate", *known))
    return Judgement("Weak", tuple(faults), tuple(dict.fromkeys(remedies)))


def _percent(part: float) -> str:
    """A part in per cent, to its first digit, or to the per cent from ten on."""
    return f"{100 * part:.0f}" if part >= 0.095 else f"{100 * part:.1g}"


def _faults(seen: Evidence, tilt: float, covered: Tensor | None) -> list[str]:
    """What makes it weak."""
    faults = _reasons(seen.remarks, Kind.CONTRADICTION, Kind.WRONG_PRIOR)
    count = int(seen.used.sum())
    if seen.different < FEW_VIEWS:
        alike = f" of {count}" if round(seen.different) < count else ""
        number = f"only {round(seen.different)}{alike}"
        faults.append(f"{number} view{'s differ' if round(seen.different) > 1 else ' tells it'}")
    if tilt < LOW_TILT:
        faults.append(f"the board was tilted by {tilt:.0f} degrees at most")
    if seen.unsure is not None and seen.unsure > UNSURE:
        known = f"only to {_percent(seen.unsure)} %" if math.isfinite(seen.unsure) else "not at all"
        faults.append(f"focal lengths and principal point are known {known} of the focal length")
    if covered is not None and float(covered.nanmean()) < SMALL_COVER:
        faults.append(
            f"its corners cover {100 * float(covered.nanmean()):.0f} % of the image, the lens is a guess beyond"
        )
    if seen.sigma > COARSE_PX and not seen.other_model:
        faults.append(
            f"the corners scatter by {seen.sigma:.2g} px in each coordinate, in sharp photographs by 0.05 to 0.3"
        )
    return [
        *faults,
        *_reasons(
            seen.remarks,
            Kind.TOLD_APART,
            Kind.TURNED,
            Kind.TWO_CAMERAS,
            Kind.UNEVEN_PRINT,
            Kind.SPACING,
            Kind.FOCUS,
            Kind.STEADIED,
            Kind.BENT,
            Kind.FLEXING,
            Kind.RIVAL,
            *OF_THE_CAMERA,
        ),
    ]


def _reasons(remarks: Remarks, *kinds: Kind) -> list[str]:
    """The reasons that remarks of these kinds give, in their order."""
    return [remark.reason for kind in kinds for remark in remarks if remark.kind == kind]


def _praise(seen: Evidence, tilt: float, covered: Tensor | None) -> list[str]:
    where = "" if covered is None else f", cover {100 * float(covered.nanmean()):.0f} % of the image"
    praise = [f"{round(seen.different)} views differ{where} and are tilted by up to {tilt:.0f} degrees"]
    if seen.unsure:
        praise.append(f"focal lengths and principal point are known to {100 * seen.unsure:.1g} % of the focal length")
    return [*praise, f"corners scatter by {seen.sigma:.2g} px in each coordinate"]


def _covered(seen: Evidence) -> Tensor | None:
    """Which of 36 x 48 places of the image the corners surround, 1 or 0; NaN where the lens sees nothing."""
    size = seen.cameras.size
    if size is None or seen.region is None:
        return None
    grid = pixel_grid(36, 48, seen.region).to(seen.region).flatten(0, 1) + 0.5
    pixels = grid / grid.new_tensor([48.0, 36.0]) * grid.new_tensor(size) - 0.5
    _, has_ray = seen.cameras[0].detach().directions(pixels)
    inside = in_region(pixels, seen.region).to(pixels)
    return torch.where(has_ray, inside, torch.nan).reshape(36, 48)


def _bare(covered: Tensor) -> list[str]:
    """The ninths of the image that hardly a corner reached, in words."""
    parts = covered.unflatten(0, (3, 12)).unflatten(-1, (3, 16)).movedim(2, 1).flatten(2).nanmean(-1)
    return [
        " ".join(filter(None, (down, across))) or "middle"
        for row, down in zip(parts.tolist(), DOWN, strict=True)
        for share, across in zip(row, ACROSS, strict=True)
        if share < BARE
    ]


def _odd(seen: Evidence) -> list[str]:
    """Views whose corners fit far worse than the others', those that were left out among them."""
    usual = float(seen.view_rms.nanmedian())
    odd = (seen.view_rms > ODD * usual) & (usual > 0) | seen.left_out
    return [name for name, is_odd in zip(seen.names, odd.tolist(), strict=True) if is_odd]


def _second_spread(normals: Tensor) -> float:
    """Root mean square of the boards' normals along the axis of the image about which they differ least."""
    xy = (normals * normals[:, 2:].sign())[:, :2]
    xy = xy - xy.mean(0)
    return float(torch.linalg.eigvalsh(xy.mT @ xy / len(xy))[0].clamp(min=0).sqrt())


def _listed(names: list[str]) -> str:
    """`a`, `a and b`, `a, b and c`; of many the first four."""
    names = names if len(names) <= 4 else [*names[:4], f"{len(names) - 4} more"]
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last
