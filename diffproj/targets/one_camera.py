"""Whether photographs are of one camera with one zoom, lie one way and are no mirror images, as far as files tell."""

import hashlib
from collections.abc import Sequence

from diffproj.targets.exif import MIRRORED, Exif, Told

SAME = 0.005
"""Relative difference up to which two numbers of EXIF data count as the same: they are rounded."""

KEPT = (
    ("camera", "different cameras", ""),
    ("serial", "cameras of different serial numbers", ""),
    ("lens", "different lenses", ""),
    ("focal", "different focal lengths", " mm"),
    ("zoom", "different digital zooms", "x"),
    ("focal_35", "different focal lengths (as of 35 mm film)", " mm"),
)
"""What stays as it is while one camera with one zoom photographs: in `Exif`, in words, its unit."""

TURN, FLIP = "turn", "flip"
"""In `Views.told`: how a photograph was turned, and whether its file holds a mirror image (1) or not (0)."""

ANOTHER = (
    ("camera", "another camera", ""),
    ("serial", "another camera, by its serial number,", ""),
    ("lens", "another lens", ""),
    ("focal", "another focal length", " mm"),
    ("zoom", "another digital zoom", "x"),
    ("focal_35", "another focal length (as of 35 mm film)", " mm"),
    (TURN, "another turn", ""),
    (FLIP, "another way of counting pixels, mirrored,", ""),
)
"""The same of a photograph, against those that its camera was calibrated on."""


def doubts(labels: Sequence[str], told: Sequence[Exif | None], upright: bool) -> list[str]:
    """What speaks against calibrating photographs as those of one camera, a warning each.

    Args:
        labels: names of the photographs.
        told: what their files tell; `None` where there is no file.
        upright: whether they were turned as their EXIF data ask.
    """
    files = [(label, one) for label, one in zip(labels, told, strict=True) if one is not None]
    found = [_several(files), _turned_apart(files) if upright else _mirrored(files)]
    many = [label for label, one in files if one.pictures > 1]
    if many:
        found.append(f"{named(many)}: want one picture a file, got several; the first was taken")
    return [text for text in found if text]


def told_of(exif: Exif | None, upright: bool) -> Told:
    """What a file tells of its photograph that all photographs of one calibration have in common, for `Views.told`.

    It goes into files of calibrations, which are handed on: of a serial number a digest is enough.
    """
    if exif is None:
        return ()
    if exif.serial:
        exif = exif._replace(serial=f"#{hashlib.blake2b(exif.serial.encode(), digest_size=4).hexdigest()}")
    kept = [(field, getattr(exif, field)) for field, _, _ in KEPT if getattr(exif, field)]
    if exif.orientation is None:  # it may have been turned before it was saved
        return tuple(kept)
    turn = (TURN, float(exif.orientation)) if upright else (FLIP, float(exif.orientation in MIRRORED))
    return (*kept, turn)


def against_one_camera(names: Sequence[str], told: Sequence[Told]) -> list[tuple[str, str]]:
    """What files tell against these views being of one camera that counts its pixels one way.

    Args:
        names: of the views.
        told: what their files tell, see `Views.told`; empty where nothing is known.

    Returns:
        A sentence each, and the same in a few words.
    """
    if not told:
        return []
    known = [dict(one) for one in told]
    found = []
    for field, what, unit in KEPT:
        each = _told_apart([(name, one[field]) for name, one in zip(names, known, strict=True) if field in one], unit)
        if each:
            reason = f"EXIF data tell of {what}"
            found.append((f"{reason}, {each}: calibrate them by themselves", reason))
            break
    for field, what in ((TURN, "of photographs that were turned apart"), (FLIP, "of mirror images among the others")):
        groups = _groups([(name, one[field]) for name, one in zip(names, known, strict=True) if field in one])
        if len(groups) > 1:
            fewest = min(groups.values(), key=len)
            reason = f"EXIF data tell {what}"
            found.append((f"{reason}, {named(fewest)}, which have another principal point: leave them out", reason))
    return found


def of_another_camera(before: Sequence[Told], names: Sequence[str], told: Sequence[Told]) -> str:
    """What files tell against views being of the camera of others, with its zoom and turn; empty where nothing.

    Args:
        before: what the files of the camera's own photographs tell, see `Views.told`.
        names: of the views.
        told: what their files tell.
    """
    kept, known = [dict(one) for one in before], [dict(one) for one in told]
    for field, what, unit in ANOTHER:
        own = list(dict.fromkeys(one[field] for one in kept if field in one))
        others = [
            (name, one[field])
            for name, one in zip(names, known, strict=False)
            if field in one and own and not any(_same(value, one[field]) for value in own)
        ]
        if not others:
            continue
        which = named([name for name, _ in others])
        text = f"{which}: EXIF data tell of {what} than those of the photographs that the camera was calibrated on"
        if field in (TURN, FLIP):
            return text
        here, there = (_in_words(list(dict.fromkeys(values)), unit) for values in ([v for _, v in others], own))
        return f"{text}: {here}, not {there}"
    return ""


def _in_words(values: Sequence[str | float], unit: str) -> str:
    """Some values, of many the first ones."""
    return named([value if isinstance(value, str) else f"{value:.4g}{unit}" for value in values])


def named(labels: Sequence[str]) -> str:
    """Names of some photographs, of many the first ones."""
    return ", ".join(labels[:3]) + (f" and {len(labels) - 3} more" if len(labels) > 3 else "")


def _mirrored(files: list[tuple[str, Exif]]) -> str:
    """Of photographs as recorded: whether they are mirror images of what is shown of them."""
    which = [label for label, one in files if one.orientation in MIRRORED]
    if not which:
        return ""
    holds, flips = (
        ("this file holds a mirror image", "it") if len(which) == 1 else ("these files hold mirror images", "them")
    )
    return (
        f"{named(which)}: {holds}, and viewers flip {flips} back, as EXIF data ask; pixels count as recorded, so "
        "lengths are right, but x and y are mirrored; to count pixels as viewers show them, give orientation='upright'"
    )


def _turned_apart(files: list[tuple[str, Exif]]) -> str:
    """Of photographs that are upright: whether they were turned alike, as far as their files tell."""
    turns: dict[int, list[str]] = {}
    for label, one in files:
        if one.orientation is not None:
            turns.setdefault(one.orientation, []).append(label)
    if len(turns) < 2:
        return ""
    fewest = min(turns.values(), key=len)
    return (
        f"{named(fewest)}: EXIF data turn these another way than the others, and a turned photograph has another "
        "principal point; give orientation='sensor'"
    )


def _several(files: list[tuple[str, Exif]]) -> str:
    """Whether the camera or its zoom changed between photographs."""
    for field, what, unit in KEPT:
        each = _told_apart([(label, getattr(one, field)) for label, one in files if getattr(one, field)], unit)
        if each:
            return (
                f"photographs: want those of one camera with one zoom, got {what} by their EXIF data: {each}; "
                "calibrate them by themselves"
            )
    return ""


def _told_apart(told: list[tuple[str, str | float]], unit: str) -> str:
    """Which photographs tell what of one thing; empty where all tell the same."""
    groups = _groups(told)
    if len(groups) < 2:
        return ""
    return " and ".join(
        f"{value if isinstance(value, str) else f'{value:.4g}'}{unit} in {named(labels)}"
        for value, labels in groups.items()
    )


def _groups(told: list[tuple[str, str | float]]) -> dict[str | float, list[str]]:
    """Names of photographs by what their files tell, the same for any order of these.

    Numbers are compared with their median: with the first one, groups would depend on which that is.
    """
    groups: dict[str | float, list[str]] = {}
    while told:
        values = [value for _, value in told]
        numbers = sorted(value for value in values if not isinstance(value, str))
        usual = numbers[(len(numbers) - 1) // 2] if numbers else values[0]
        groups[usual] = [label for label, value in told if _same(usual, value)]
        told = [(label, value) for label, value in told if not _same(usual, value)]
    return groups


def _same(kept: str | float, value: str | float) -> bool:
    if isinstance(kept, str) or isinstance(value, str):
        return kept == value
    return abs(kept - value) <= SAME * max(kept, value)
