"""Whether the markers that a view shows are those that stand there on the board: their codes, compared with the image.

A marker that is read says which it is. One that is not, beside corners that were found, says so only here: a board with
another number of columns, or of the other pattern, has some markers in common with the one asked for, and all corners
look alike.
"""

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from diffproj.targets.april_grid import AprilGrid
from diffproj.targets.charuco import CharucoBoard
from diffproj.targets.dictionaries import dictionary_named, marker_modules

ALIKE = 0.5
"""Correlation with the grey values from which a code is there. Of 1800 markers that were, 500 of them in photographs,
none had less than 0.64, which were blurred; others have 0 on average, with a deviation of 0.26 for 16 modules."""

CONTRADICTED = 0.5
"""Markers with another code than they should have, relative to those with their own, from which none is believed."""

AROUND = 0.75
"""Distance from a marker's middle, in pitches, within which the four corners around it are."""

_WITHIN = np.stack(np.meshgrid([-0.25, 0.0, 0.25], [-0.25, 0.0, 0.25]), axis=-1).reshape(-1, 1, 2)
"""Places within a module at which the image is looked at."""


def contradicted(
    image: Shaped[np.ndarray, "h w"],
    board: AprilGrid | CharucoBoard,
    border: int,
    known: Float[np.ndarray, "n 2"],
) -> bool:
    """Whether too many of the markers amid corners that were found have not their own codes: it is another board.

    Args:
        image: `(H, W)`.
        board: the board.
        border: width of the markers' border in modules.
        known: its corners in px, NaN where not known.
    """
    bits = dictionary_named(board.dictionary).markerSize
    middles = np.indices((bits, bits)).reshape(2, -1).T[:, ::-1] + border + 0.5
    inside = (middles + _WITHIN) / (bits + 2 * border)
    last = np.array(image.shape[::-1]) - 1
    right = wrong = 0
    for number, quad in board.markers.items():
        distance = np.linalg.norm(board.corners - quad.mean(axis=0), axis=-1)
        around = np.argsort(distance)[:4]
        if distance[around].max() > AROUND * board.pitch or np.isnan(known[around]).any():
            continue
        on_print = quad[0] + inside[..., :1] * (quad[1] - quad[0]) + inside[..., 1:] * (quad[3] - quad[0])
        here, there = (part[around].astype(np.float32) for part in (board.corners, known))
        to_image = cv2.getPerspectiveTransform(here, there)
        pixels = cv2.perspectiveTransform(on_print.reshape(1, -1, 2), to_image)[0]
        u, v = np.rint(np.nan_to_num(pixels).clip(0, last)).astype(int).T
        light = image[v, u].reshape(len(_WITHIN), -1).mean(axis=0)
        dark = marker_modules(board.dictionary, number, border)[border:-border, border:-border].reshape(-1)
        if _correlation(-light, dark.astype(float)) > ALIKE:
            right += 1
        else:
            wrong += 1
    return wrong > CONTRADICTED * right


def _correlation(one: Float[np.ndarray, " n"], other: Float[np.ndarray, " n"]) -> float:
    one, other = one - one.mean(), other - other.mean()
    return float(one @ other / max(np.sqrt((one @ one) * (other @ other)), 1e-9))
