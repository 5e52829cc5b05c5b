"""`Remark`: a sentence on a calibration together with what it says, for the advice that depends on it."""

from collections.abc import Iterable
from enum import StrEnum
from typing import NamedTuple


class Kind(StrEnum):
    """What a remark says, as far as a verdict depends on it."""

    OTHER = "other"
    OTHER_LENS = "other lens"
    """The residuals are those of another lens."""
    NEEDLESS = "needless"
    """Some of the lens's terms stand for noise: the lens without them fits as well."""
    SKEW = "skew"
    """The residuals are those of a K with skew, which was held."""
    TWO_CAMERAS = "two cameras"
    """The views fall into two groups that want different cameras."""
    TOLD_APART = "told apart"
    """The files of photographs tell of several cameras, zooms or turns."""
    TURNED = "turned photographs"
    """Photographs of some views are turned by 180 degrees against the others'."""
    UNEVEN_PRINT = "uneven print"
    """The board was printed wider than high, or slanted."""
    SPACING = "spacing"
    """The tags of an AprilGrid do not stand as far apart as it says."""
    FOCUS = "focus"
    """The focal length differs from view to view."""
    STEADIED = "steadied"
    """The principal point differs from view to view, or seems to."""
    BENT = "bent board"
    """The board is bent."""
    FLEXING = "flexing board"
    """The corners of a view err together, another way in each view, as on a board that bends."""
    CONTRADICTION = "contradiction"
    """The residuals contradict the deviations that were given."""
    RIVAL = "rival"
    """Another pose, or another camera and pose, explain the evidence nearly as well."""
    BELOW = "below"
    """Landmarks on a level plane are seen from below, by a camera that is upside down if z is up."""
    LEFT_OUT = "left out"
    """Too many corners of some views were left out as outliers, or hardly counted."""
    PRIOR_WEIGHT = "prior weight"
    """The priors weigh against another noise of the corners than these have."""
    WRONG_PRIOR = "wrong prior"
    """The views contradict what was said beforehand of a parameter."""


class Remark(NamedTuple):
    """A remark on one camera.

    Attributes:
        sentence: what people read.
        kind: what it says.
        reason: the same in a few words, as a reason for a verdict; empty where a verdict does not depend on it.
    """

    sentence: str
    kind: Kind = Kind.OTHER
    reason: str = ""


OF_THE_CAMERA = (Kind.OTHER_LENS, Kind.SKEW)
"""Those that another model of the camera is a remedy for."""

Remarks = tuple[Remark, ...]
"""Those on one camera."""


def text_of(remarks: Iterable[Remark]) -> str:
    """All of them in one text; empty where there are none."""
    return "; ".join(remark.sentence for remark in remarks)
