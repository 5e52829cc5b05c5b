"""How objects show themselves: in one line of text, and as a small table where a notebook asks for HTML.

A class says what is worth a word (`_facts`), and what goes into the table, as columns of numbers and words
(`_columns`). Both are for people: `to_dict` and the attributes hold the numbers themselves.
"""

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from diffproj._core.numerics import has_values

ROWS = 20
"""Rows of a table that are shown."""
LARGE, HUGE = 1e4, 1e12
"""Between which six digits are too few for coordinates on a map, and three behind the point not more than there are."""


class Shown:
    """What shows itself in one line, and in a notebook with a table."""

    __slots__ = ()

    def _facts(self) -> list[str]:
        """What the line says, in a few words each."""
        raise NotImplementedError

    def _columns(self) -> Mapping[str, Sequence[Any]]:
        """The table's columns by their headings; none if there is no table."""
        return {}

    def _note(self) -> str:
        """A sentence below the table."""
        return ""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(filter(None, self._facts()))})"

    def _repr_html_(self) -> str:
        facts = html.escape(", ".join(filter(None, self._facts())))
        parts = [f"<p><b>{type(self).__name__}</b> {facts}</p>", _table(self._columns())]
        if note := self._note():
            parts.append(f"<p>{html.escape(note)}</p>")
        return f"<div>{''.join(parts)}</div>"


def _table(columns: Mapping[str, Sequence[Any]]) -> str:
    if not columns:
        return ""
    rows = list(zip(*columns.values(), strict=True))
    head = _row("th", columns)
    body = "".join(_row("td", map(_cell, row)) for row in rows[:ROWS])
    rest = f"<p>and {len(rows) - ROWS} more</p>" if len(rows) > ROWS else ""
    return f"<table><thead>{head}</thead><tbody>{body}</tbody></table>{rest}"


def _row(tag: str, cells: Iterable[str]) -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if math.isnan(value) else plain(value)
    return str(value)


def plain(value: float) -> str:
    """A number of which nothing else is known: to six digits, but to thousandths where it is large, as on a map."""
    if LARGE <= abs(value) < math.inf:
        return f"{value:.3f}".rstrip("0").rstrip(".") if abs(value) < HUGE else f"{value:.12g}"
    return f"{value:z.6g}"


def decimals(deviations: Iterable[float], least: int) -> int:
    """So many that the least of these deviations does not show as 0."""
    known = [deviation for deviation in deviations if 0 < deviation < math.inf]
    return max(least, -math.floor(math.log10(min(known)))) if known else least


def number(values: Tensor, form: str = ".1f") -> str:
    """A number for people: the one that all values are, or from the least to the largest; `?` if it cannot be read."""
    if values.numel() == 0 or not has_values(values):
        return "?"
    values = values.detach().to(torch.float64).flatten()
    low, high = (format(float(bound), form) for bound in (values.amin(), values.amax()))
    return low if low == high else f"{low} to {high}"


def counted(shape: Sequence[int], one: str) -> str:
    """`13 cameras` or `2 x 7 cameras` for a batch shape; nothing for a single one."""
    return f"{' x '.join(map(str, shape))} {one}s" if shape else ""


def listed(words: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def in_pixels(size: tuple[int, int] | None) -> str:
    """`640 x 480 px`; nothing where the size is not known."""
    return "" if size is None else f"{size[0]} x {size[1]} px"


def rounded(value: float, deviation: float) -> tuple[str, str]:
    """A value and its standard deviation, both to the second digit of the latter or its whole ones; 0 is not told."""
    if not (0 < deviation < math.inf):
        return _cell(value), "" if deviation == 0 else _cell(deviation)
    digits = max(0, 1 - math.floor(math.log10(deviation)))
    return f"{value:z.{digits}f}", f"{deviation:.{digits}f}"
