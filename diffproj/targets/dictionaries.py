"""The dictionaries of square markers that OpenCV has: their names, and the markers' black and white modules."""

import functools

import cv2
import numpy as np
from jaxtyping import Bool

from diffproj._core.arguments import called


def _names() -> dict[str, int]:
    names = {name.removeprefix("DICT_"): getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name[:5] == "DICT_"}
    # OpenCV spells some names twice, in both cases.
    return {name: number for name, number in sorted(names.items()) if name == name.upper() or name.upper() not in names}


def dictionary_name(dictionary: str) -> str:
    """The name of a dictionary as this package writes it, without OpenCV's `DICT_`.

    Raises:
        TypeError: it is no string.
        ValueError: OpenCV has no such dictionary.

    Example:
        >>> dictionary_name("DICT_4X4_1000"), dictionary_name("apriltag_36h11")
        ('4X4_1000', 'APRILTAG_36H11')
    """
    if not isinstance(dictionary, str):
        raise TypeError(f"dictionary: want the name of one of OpenCV's, such as '4X4_1000', got {called(dictionary)}")
    name = dictionary.upper().removeprefix("DICT_")
    if name not in _names():
        raise ValueError(f"dictionary: want one of {', '.join(_names())}, got {dictionary!r}")
    return name


def dictionary_named(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a name that `dictionary_name` gave."""
    return cv2.aruco.getPredefinedDictionary(_names()[name])


def marker_count(name: str) -> int:
    """How many markers a dictionary has."""
    return len(dictionary_named(name).bytesList)


@functools.lru_cache(maxsize=4096)
def marker_modules(name: str, number: int, border: int) -> Bool[np.ndarray, "side side"]:
    """Which modules of a marker are black, its border of so many modules included."""
    dictionary = dictionary_named(name)
    side = dictionary.markerSize + 2 * border
    return dictionary.generateImageMarker(number, side, borderBits=border) < 128
