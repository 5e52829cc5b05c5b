"""Poses that stand beside camera matrices: which of them place a camera, and which are not read, which is said.

Of two cameras `R` and `T`, or `rotation_matrix` and `translation_vector`, as `cv2.stereoCalibrate` calls them, lead
from the first to the second, where their names tell which that is. Of one camera, `R` and `t` are those that this
package writes, world to camera. What others mean their programs know: `rvec` and `tvec` of a board, `extrinsics` from
a lidar or to a vehicle, either way.
"""

import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from diffproj.files.numbers import matrix, rigid, square

Pose = tuple[np.ndarray, np.ndarray]

PAIRS = (("R", "T"), ("rotation_matrix", "translation_vector"))


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


TURNS = _words("r rot rotation rotationmatrix rotationvector rotmat rmat rmatrix rvec quaternion orientation")
SHIFTS = _words("t trans translation translationvector translationmatrix tvec tvector")
PLACES = _words("position pos location center centre origin")
WHOLE = _words("rt extrinsic extrinsics cameraextrinsic cameraextrinsics pose camerapose transform transformation")
"""Names in lower case, without what stands between words. A place is one of a pose only where a rotation is there too.
Of 4 x 4 and 3 x 4 numbers with a rotation any name will do."""

SEVERAL = re.compile(
    r"(?!.*(board|target|marker|pattern)).*(pose|extrinsic|transform|trajector|frames|c2w|w2c|cam(era)?to|tocam)"
)
"""Names of lists of poses; those of the board's views are a calibration's own."""

ENDINGS = re.compile(
    r"(?!.*(board|target|marker|pattern|rect)).*_"
    r"((?P<turn>rotation(_?matrix|_?vector)?|rvec|quaternion|(?<=_ext_|nsic_)r)"
    r"|(?P<shift>translation(_?vector)?|tvec|(?<=_ext_|nsic_)t))"
)
"""Names with another word before those of a rotation or a shift, as `extrinsicRotation` and `camera_ext_t`; in lower
case, with `_` before each word."""

QUATERNIONS = TURNS | _words("q quat")
ANGLES = _words("roll pitch yaw heading azimuth tilt pan omega phi kappa")
"""Names of single numbers of a pose; others have `x`, `w` or `01` behind a name of those above."""

SIDES = (
    *(("left", "right"), ("first", "second"), ("main", "aux"), ("master", "slave")),
    *(("camera", "projector"), ("cam", "proj")),
)
"""Words of two names that tell which camera is the first."""

LARGEST = 16
"""Numbers of a pose, at most."""

MOST_NAMES = 4
"""Keys in a remark."""

_INDEX = re.compile(r"(.*?)_?(\d_?\d|[wxyz\d])")
"""Where one number of several stands: `t_x`, `qw`, `r11`."""


def of(count: int, mapping: dict[str, Any], apart: bool = False) -> tuple[Pose | None, set[str]]:
    """The pose of the last of so many cameras, and the keys that it was read from.

    Args:
        count: of the cameras; of more than two no pose is read.
        mapping: where it may stand.
        apart: whether the cameras stand in mappings of their own, as for `of_pair`.

    Raises:
        ValueError: it is there in part, or is none.
    """
    if count == 2:
        return of_pair(mapping, apart)
    return of_one(mapping) if count == 1 else (None, set())


def of_pair(mapping: dict[str, Any], apart: bool = False) -> tuple[Pose | None, set[str]]:
    """The pose from the first of two cameras to the second, and the keys that it was read from.

    Args:
        mapping: where it may stand.
        apart: whether the cameras stand in mappings of their own. What is beside these may be anything, so that only
            3 x 3 and 3 numbers count, and a rotation alone is no half of a pose.

    Raises:
        ValueError: a rotation is there alone, a name is there twice, or the pose is none.
    """
    for names in PAIRS:
        keys = [[key for key in mapping if _named(key, name)] for name in names]
        if apart:
            shapes = (((3, 3), (9,)), ((3,), (3, 1), (1, 3)))
            keys = [[k for k in some if _shape(k, mapping[k]) in fit] for some, fit in zip(keys, shapes, strict=True)]
        for name, some in zip(names, keys, strict=True):
            if len(some) > 1:
                raise ValueError(f"want {name} once, got {', '.join(some)}")
        turns, shifts = keys
        if turns and not shifts and not apart:
            raise ValueError(f"want {' and '.join(names)} from the first camera to the second, got {turns[0]}")
        if not turns or not shifts:
            continue
        turn, shift = turns[0], shifts[0]
        R, t = square(turn, mapping[turn], 3, 3), matrix(shift, mapping[shift]).ravel()
        if t.size != 3:
            raise ValueError(f"{shift}: want 3 numbers, got {t.size}")
        return rigid(turn, np.column_stack([R, t])), {turn, shift}
    return None, set()


def of_one(mapping: dict[str, Any]) -> tuple[Pose | None, set[str]]:
    """The pose of the only camera, as this package writes it, and the keys that it was read from.

    Raises:
        ValueError: it is none.
    """
    if "R" not in mapping or "t" not in mapping:
        return None, set()
    return rigid("R", np.column_stack([square("R", mapping["R"], 3, 3), square("t", mapping["t"], 3, 1)])), {"R", "t"}


def in_order(names: Sequence[str]) -> Sequence[str] | None:
    """Two cameras, the first before the second; `None` where their names do not tell which that is, as rgb and depth.

    Args:
        names: of the cameras.
    """
    return next((pair for pair in (names, names[::-1]) if _is_before(*pair)), None)


def unread(mapping: dict[str, Any], read: set[str]) -> list[str]:
    """The keys of poses that nobody reads; empty where there is none, as where a rotation stands alone.

    Args:
        mapping: what to look through, and the mappings right in it.
        read: keys that were read, or that others look through.
    """
    rest = {key: value for key, value in mapping.items() if key not in read}
    found = list(_found(rest))
    return [key for key, _ in found] if _tell({kind for _, kind in found}) else []


def remark(names: Sequence[str]) -> str:
    """What is said of poses that are not read."""
    listed = ", ".join(names[:MOST_NAMES]) + " and more" * (len(names) > MOST_NAMES)
    return (
        f"{listed}: a pose that is not read, for it is not known from where to where it leads; "
        "camera.at(R, t), world to camera, places a camera"
    )


def _tell(kinds: set[str]) -> bool:
    """Whether these are of a pose: a rotation or a place alone may be anything."""
    return bool(kinds & {"shift", "pose"}) or kinds == {"turn", "place"}


def _found(mapping: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """The keys of a mapping that hold a part of a pose, with what `_kinds` calls it; also where numbers stand alone."""
    yield from ((key, kind) for key, value in mapping.items() for kind in _kinds(key, value))
    groups: dict[str, dict[str, str]] = {}
    for key, value in mapping.items():
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            continue
        if (plain := re.sub("[^a-z0-9]", "", key.lower())) in ANGLES:
            groups.setdefault("angles", {})[plain] = key
        elif parts := _INDEX.fullmatch(re.sub(r"[\s.\-]+", "_", key.strip()).lower()):
            groups.setdefault(_plain(parts[1]), {})[parts[2].replace("_", "")] = key
    for name, parts in groups.items():
        kind = _kind_of(name, {part: mapping[key] for part, key in parts.items()})
        if kind is not None:
            keys = list(parts.values())
            yield f"{keys[0]} to {keys[-1]}", kind


def _kind_of(name: str, parts: dict[str, Any]) -> str | None:
    """What numbers are, by their common name and what each has behind it."""
    axes, indices = "".join(sorted(parts)), [part for part in parts if part.isdigit()]
    if name == "angles":
        return "pose" if len(parts) > 1 and any(parts.values()) else None
    if axes == "wxyz":
        return "turn"
    if len(indices) in (12, 16) and len(indices) == len(parts):
        return "pose" if _is_rigid(np.array([float(parts[part]) for part in sorted(parts)])) else None
    if name in QUATERNIONS and (axes == "xyz" or len(indices) in (3, 4, 9)):
        return "turn"
    if axes == "xyz" or len(indices) == 3:
        return "shift" if name in SHIFTS else "place" if name in PLACES or (not name and axes == "xyz") else None
    return None


def _kinds(key: str, value: Any) -> Iterator[str]:
    """Whether a key holds a `"turn"`, a `"shift"`, a `"place"` or a whole `"pose"`."""
    plain = _plain(key)
    if isinstance(value, dict) and "data" not in value:
        inside = {kind for _, kind in _found(value)}
        if plain in TURNS | SHIFTS | PLACES:  # x, y, z by their names
            yield "turn" if plain in TURNS else "shift" if plain in SHIFTS else "place"
        elif _tell(inside):
            yield "pose"
        return
    if SEVERAL.match(plain) and isinstance(value, list | np.ndarray) and len(value):
        first = value[0]
        numbers = None if isinstance(first, dict) else _numbers(key, first)
        if _tell({kind for _, kind in _found(first)}) if isinstance(first, dict) else _is_rigid(numbers):
            yield "pose"
            return
    numbers = _numbers(key, value)
    if numbers is None:
        return
    if _is_rigid(numbers) or (plain in WHOLE and (numbers.size in (6, 7) or numbers.shape in ((12,), (16,)))):
        yield "pose"
    elif plain in TURNS and numbers.size in (3, 4, 9):
        yield "turn"
    elif (named := ENDINGS.fullmatch(_words_of(key))) and numbers.size in ((3, 4, 9) if named["turn"] else (3,)):
        yield "turn" if named["turn"] else "shift"
    elif plain in SHIFTS | PLACES and numbers.size == 3:
        yield "shift" if plain in SHIFTS else "place"


def _words_of(key: str) -> str:
    """A key in lower case, with `_` before each of its words, the first too: `_camera_ext_r`."""
    return "_" + re.sub("[^a-z0-9]+", "_", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", key).lower())


def _shape(key: str, value: Any) -> tuple[int, ...]:
    """The shape of the numbers that a key holds; of none, where it holds something else."""
    numbers = _numbers(key, value)
    return () if numbers is None else numbers.shape


def _numbers(key: str, value: Any) -> np.ndarray | None:
    content = value.get("data") if isinstance(value, dict) else value
    if not isinstance(content, list | np.ndarray) or len(content) > LARGEST:
        return None
    try:
        return matrix(key, value)
    except ValueError:
        return None


def _is_before(first: str, second: str) -> bool:
    """Whether the names of two cameras tell that the one is before the other: by a number, a letter or a side.

    In each word in which they differ; serial numbers tell nothing.
    """
    one, other = first.lower(), second.lower()
    if any(one.replace(*side) == other != one for side in SIDES):
        return True
    words = [re.findall(r"[a-z]+|\d+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()) for name in (first, second)]
    last = words[1][-1:]
    counted = bool(last) and last[0].isdigit() and len(last[0]) <= 2
    if words[0] == words[1][:-1] and counted:  # cam, cam2
        return True
    if words[0] == ["camera"] and words[1] == last and (counted or last in (["right"], ["second"])):  # K, K2
        return True
    apart = [pair for pair in zip(*words, strict=False) if pair[0] != pair[1]]
    return len(words[0]) == len(words[1]) and bool(apart) and all(_goes_before(*pair) for pair in apart)


def _goes_before(a: str, b: str) -> bool:
    """Whether of two words the one goes before the other."""
    if a.isdigit() and b.isdigit():
        return int(a) < int(b) and (max(len(a), len(b)) <= 2 or int(b) == int(a) + 1)
    return (a, b) in SIDES or (len(a) == len(b) == 1 and a < b)


def _is_rigid(numbers: np.ndarray | None) -> bool:
    """Whether these are 4 x 4 or 3 x 4 numbers, or one list of them, with a rotation."""
    if numbers is None or numbers.shape not in ((4, 4), (3, 4), (12,), (16,)):
        return False
    rows = numbers.reshape(-1, 4)
    last = len(rows) == 3 or rows[3].tolist() == [0, 0, 0, 1]
    return last and bool(np.abs(rows[:3, :3].T @ rows[:3, :3] - np.eye(3)).max() < 1e-2)


def _named(key: str, name: str) -> bool:
    """Whether a key is that name; of a long one in any case, and with anything between words."""
    return key == name or (len(name) > 1 and re.sub("[^a-z0-9]", "", key.lower()) == name.replace("_", ""))


def _plain(key: str) -> str:
    """A key in lower case, without what stands between words, and without a label of its camera."""
    words = re.sub(r"[\s.\-]+", "_", re.sub(r"(?<=[a-z])([LR])$", r"_\1", key.strip())).lower()
    return re.sub(r"^(left|right|cam\d*|camera\d*|stereo)_(?=.)|(?<=.)_?(\d+|_left|_right|_l|_r)$", "", words).replace(
        "_", ""
    )
