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
    ("zoom", "different digital zooms", " times"),
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


def mirrored(which: str) -> str:
    """What is said of photographs that are mirror images of what is shown of them."""
    return (
        f"{which}: EXIF data ask programs to show it mirrored, and pixels count as recorded: if what they show is not "
        "the mirror image (writing reads well), lengths are right, but x and y are those of a mirrored world: give "
        "orientation='upright'"
    )


def named(labels: Sequence[str]) -> str:
    """Names of some photographs, of many the first ones."""
    return ", ".join(labels[:3]) + (f" and {len(labels) - 3} more" if len(labels) > 3 else "")


def _mirrored(files: list[tuple[str, Exif]]) -> str:
    which = [label for label, one in files if one.orientation in MIRRORED]
    return mirrored(named(which)) if which else ""


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
        groups: dict[str | float, list[str]] = {}
        for label, one in files:
            value = getattr(one, field)
            if value:
                groups.setdefault(next((kept for kept in groups if _same(kept, value)), value), []).append(label)
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


def _same(kept: str | float, value: str | float) -> bool:
    if isinstance(kept, str) or isinstance(value, str):
        return kept == value
    return abs(kept - value) <= SAME * max(kept, value)
