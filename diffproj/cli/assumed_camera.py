"""A camera of which there is no file: its field of view, what is assumed of the rest, and how far each may be off."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

from diffproj.calibration.problem.parametrisation import INTRINSICS
from diffproj.calibration.results.calibration import Calibration
from diffproj.calibration.results.remark import Kind, Remark, Remarks
from diffproj.cli.known_beforehand import FOCAL, FieldOfView, Known
from diffproj.cli.terminal import rounded
from diffproj.geometry.camera import Camera
from diffproj.targets.exif import Exif

MIDDLE = 0.02
"""Deviation of the principal point about the middle of the image, as a part of the longer side."""

BEND = 0.2
"""Deviation of k1 about 0: lenses of fixed cameras have down to -0.4, few have more than 0."""

LEAST, MOST = 0.01, 1 / 6
"""Limits of how far that moves the image's corners, as a part of their distance from the middle: no lens is free of it,
and one of twice the latter would fold there."""

FILM = math.hypot(36.0, 24.0)
"""Diagonal in mm of the film to which EXIF data refer a focal length."""

TOLD = 0.05
"""Relative deviation of a focal length that they tell: in whole mm, and of the width or of the diagonal."""

SENSORS = (4 / 3, 3 / 2)
"""Ratios of the sides of nearly all sensors; photographs of other ratios show a part of them."""

OTHER_SHAPE = 0.02
"""Logarithm of the ratio of two ratios of sides from which on one is a part of the other: some files tell the sensor's
sides, with some columns and rows more."""

SECOND = 0.5
"""How far k2 may move the corners, as a part of how far k1 may."""

APART = 3.3
"""Deviations from which on what the landmarks tell contradicts what was assumed: by chance one in a thousand does."""

WIDEST = 0.3
"""Relative deviation of a focal length from which on it is as good as unknown."""

TITLES = {
    "focal": ("focal length", " px"),
    "c_x": ("c_x", " px"),
    "c_y": ("c_y", " px"),
    "k1": ("k1", ""),
    "k2": ("k2", ""),
}
"""What is assumed, in words, and its unit."""


class Assumed(NamedTuple):
    """A camera without a file.

    Attributes:
        camera: what is most likely, without a pose.
        priors: how far that may be off, by name.
        source: what tells the focal length, in words.
    """

    camera: Camera
    priors: tuple[Known, ...]
    source: str

    def told(self) -> dict[str, Any]:
        """As a document has it."""
        told = {one.name: "{} ± {}".format(*rounded(one.value, one.deviation)) for one in self.priors}
        said = [f"{title} {told[name]}{unit}" for name, (title, unit) in TITLES.items() if name in told]
        text = f"No camera file: {self.source}. Assumed: square pixels, a lens of k1 and k2 alone"
        text += "; ".join(["", ", ".join(said)]) if said else ""
        return {"source": self.source, "priors": [one.name for one in self.priors], "text": f"{text}."}


def assumed_camera(
    view: FieldOfView, size: tuple[int, int], said: Sequence[Known], free: Sequence[str], exif: Exif
) -> Assumed:
    """The camera of a horizontal field of view, with square pixels and the principal point in the middle.

    The field of view is the angle between what the image shows at its left and right edges. Lenses that bend more show
    more than their focal length tells, and so what is unknown of k1 counts in the deviation of the focal length, too.

    Args:
        view: the field of view.
        size: of the photograph in px.
        said: what else is known, with deviations; it takes the place of what is assumed.
        free: names of what the landmarks alone are to tell.
        exif: what the file of the photograph tells.

    Raises:
        ValueError: the file does not tell it, or what was said does not go together.
    """
    if known := {one.name for one in said} & {*FOCAL}:
        raise ValueError(f"--prior: want no {min(known)!r} beside --fov, which tells the focal length")
    width, height = size
    if view.degrees is None:
        focal, relative = _focal_in_file(exif, size)
    else:
        focal, relative = width / 2 / math.tan(math.radians(view.degrees / 2)), 0.0
    # Half the width and half the diagonal, squared, as parts of the distance at which the sensor seems to be.
    edge = width / 2 / focal
    corner = (edge * math.hypot(width, height) / width) ** 2
    usual = Known("k1", 0.0, min(max(BEND, LEAST / corner), MOST / corner))
    lens = next((one for one in said if one.name == "k1"), usual)
    if 1 + 3 * lens.value * corner <= 0:
        raise ValueError(
            f"--prior: want a k1 above {-1 / (3 * corner):.2g} with this field of view, got {lens.value:g}, with which "
            "the image folds before its corners"
        )
    if view.degrees is not None:
        bent = 1 + lens.value * edge**2
        slope = (1 + 3 * lens.value * edge**2) * (1 + edge**2) / (2 * edge * bent)
        focal /= bent
        relative = math.hypot(slope * math.radians(view.deviation or 0.0), lens.deviation * edge**2 / bent)
    told = view.degrees is None or view.deviation is not None
    _check_known(view, told, relative, "focal" in free)
    middle = (width - 1) / 2, (height - 1) / 2
    priors = [Known("focal", focal, relative * focal)] if told else []
    priors += [Known(name, at, MIDDLE * max(size)) for name, at in zip(INTRINSICS[2:], middle, strict=True)]
    priors += [usual, Known("k2", 0.0, SECOND * lens.deviation / corner)]
    groups = {"principal_point": INTRINSICS[2:], "distortion": ("k1", "k2")}
    taken = {one.name for one in said} | {*free} - {"focal"}
    taken |= {name for group in taken for name in groups.get(group, ())}
    K = torch.tensor([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]], dtype=torch.float64)
    camera = Camera.from_opencv(K, [lens.value, 0.0, 0.0, 0.0], size=size)
    return Assumed(camera, tuple(one for one in priors if one.name not in taken), _source(view, exif, size))


def contradicted(assumed: Assumed, found: Calibration) -> Remarks:
    """What landmarks say against what was assumed, a remark each: they and it cannot both be right."""
    values = dict(zip(found.parameters.names, found.shared.tolist(), strict=True))
    spread = found.covariance.deviations
    remarks = []
    for one in assumed.priors:
        name = "f_x" if one.name == "focal" else one.name
        left = one.deviation**2 - min(float(spread[name]), one.deviation) ** 2
        far = abs(values[name] - one.value) / math.sqrt(left) if left > 0 else 0.0
        if far > APART:
            (title, unit), pair = TITLES[one.name], rounded(values[name], float(spread[name]))
            told = (
                f"{title} {' ± '.join(pair)}{unit} as the landmarks tell, {far:.2g} deviations from what is assumed: "
                "check --fov, that the photograph is whole, and the landmarks"
            )
            reason = f"the landmarks tell a {title} {far:.2g} deviations from what is assumed"
            remarks.append(Remark(told, Kind.WRONG_PRIOR, reason))
    return tuple(remarks)


def _check_known(view: FieldOfView, told: bool, relative: float, free: bool) -> None:
    """Check that something tells the focal length.

    Raises:
        ValueError: nothing does.
    """
    found = "--free focal, where six landmarks or more that are not on a plane tell the focal length"
    if not told and not free:
        raise ValueError(
            f"--fov: want how far it may be off behind it, such as {view}+-5, got {view}; or {found}, along with it"
        )
    if told and relative > WIDEST:
        raise ValueError(
            f"--fov: want what tells the focal length to {WIDEST:.0%}, got {relative:.0%} from {view} degrees and what "
            f"is unknown of the lens; or --fov {view.degrees:g} alone with {found}"
        )


def _focal_in_file(exif: Exif, size: tuple[int, int]) -> tuple[float, float]:
    """The focal length in px that the file of a photograph tells, and its relative deviation.

    It is told by the diagonal of the image area, as CIPA's guideline has it. EXIF does not say which area that is where
    a camera shows a part of its sensor, as one set to 16:9 does: some mean the photograph, others the sensor as ever.
    The focal length then lies in the middle between the two, and may be as far off as they are.

    Raises:
        ValueError: it tells none.
    """
    if exif.focal_35 is None or (exif.zoom is not None and exif.zoom > 1):
        why = "digital zoom" if exif.focal_35 is not None else "no focal length of 35 mm film"
        raise ValueError(f"--fov: want PHOTO with a focal length in its EXIF data, got {why}; say degrees, as 70+-5")
    if exif.size is not None and abs(math.log(_ratio(exif.size) / _ratio(size))) > OTHER_SHAPE:
        (width, height), (before, above) = size, exif.size
        raise ValueError(
            f"--fov: want PHOTO as a whole, whose EXIF data tell its focal length, got {width} x {height} px of what "
            f"they tell as {before} x {above}; say degrees from its left to its right edge, as 70+-5"
        )
    ratio = _ratio(size)
    whole = any(abs(math.log(ratio / own)) <= OTHER_SHAPE for own in SENSORS)
    larger = 1.0 if whole else max(_diagonals(own, ratio) for own in SENSORS)
    middle, apart = (larger + 1) / 2, (larger - 1) / 2
    return middle * exif.focal_35 / FILM * math.hypot(*size), math.hypot(TOLD, apart / middle)


def _diagonals(own: float, ratio: float) -> float:
    """The diagonal of a sensor over that of the largest part of it whose sides have another ratio."""
    width = min(own, ratio)  # both in heights of the sensor
    return math.hypot(own, 1) / math.hypot(width, width / ratio)


def _ratio(size: tuple[int, int]) -> float:
    """Of the longer side to the shorter one: programs turn photographs and leave their sides as they were told."""
    return max(size) / min(size)


def _source(view: FieldOfView, exif: Exif, size: tuple[int, int]) -> str:
    if view.degrees is None:
        return f"EXIF data tell the focal length, {exif.focal_35:g} mm of 35 mm film, if nobody cropped the photograph"
    return f"{view} degrees from the left to the right edge of {size[0]} px"
