"""Warnings point at the line that called into the package."""

import re
import warnings
from pathlib import Path

import pytest

import diffproj
from diffproj._core.warn import warn_caller


@pytest.mark.plain  # the checks of types put frames of their own between
@pytest.mark.parametrize("depth", [0, 1, 2, 5])
def test_however_deep_it_arises(depth: int) -> None:
    inside: dict[str, object] = {"__name__": "diffproj.room.part", "warn_caller": warn_caller}
    exec("def call(n):\n    return call(n - 1) if n else warn_caller('too hot')", inside)  # noqa: S102
    call = inside["call"]
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        call(depth)  # type: ignore[operator]
    assert [(str(warning.message), warning.filename) for warning in seen] == [("too hot", __file__)]
    # A package of a name that only begins like this one's is the caller's own.
    outside: dict[str, object] = {"__name__": "diffprojector.part", "call": call}
    exec(compile("def use(n):\n    call(n)", "theirs.py", "exec"), outside)  # noqa: S102
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        outside["use"](depth)  # type: ignore[operator]
    assert [warning.filename for warning in seen] == ["theirs.py"]


def test_nothing_warns_at_a_line_of_the_package() -> None:
    room = Path(diffproj.__file__).parent
    direct = [path.name for path in room.rglob("*.py") if re.search(r"\bwarnings\.warn\(", path.read_text())]
    assert direct == ["warn.py"]
