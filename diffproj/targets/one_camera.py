"""Whether photographs are of one camera with one zoom, lie one way and are no mirror images, as far as files tell."""

from collections.abc import Sequence

from diffproj.targets.exif import MIRRORED, Exif

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
    """Of photographs that are upright: whether they were turned alike."""
    turns: dict[int, list[str]] = {}
    for label, one in files:
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
        groups = _groups([(label, getattr(one, field)) for label, one in files if getattr(one, field)])
        if len(groups) > 1:
            each = [
                f"{value if isinstance(value, str) else f'{value:.4g}'}{unit} in {named(labels)}"
                for value, labels in groups.items()
            ]
            return (
                f"photographs: want those of one camera with one zoom, got {what} by their EXIF data: "
                f"{' and '.join(each)}; calibrate them by themselves"
            )
    return ""


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
