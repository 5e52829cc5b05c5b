"""Pictures as SVG, in the colours of the page: axes with labels and units, and marks by classes of `figures.css`.

Numbers are in units of the picture's own, which is scaled to the room it gets; texts are escaped.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

from diffproj.report.document import asset

Points = Iterable[Sequence[float]] | np.ndarray
"""Places `(N, 2)`, as an array or one by one."""
STYLE = asset("figures.css")
WIDTH, HEIGHT = 420.0, 300.0
LEFT, RIGHT, TOP, BOTTOM = 50.0, 12.0, 10.0, 42.0
"""What axes leave for ticks and labels."""
DIGIT = 7.0
"""Width of a digit at an axis."""
BESIDE = 22.0
"""What the label of an upright axis and the gaps beside the names of its ticks take."""


@dataclass(frozen=True)
class Axes:
    """A field with two axes.

    Attributes:
        x_range, y_range: what the left and right, and the bottom and top end stand for.
        width, height: of the whole picture.
        left, right, top, bottom: margins around the field.
    """

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    width: float = WIDTH
    height: float = HEIGHT
    left: float = LEFT
    right: float = RIGHT
    top: float = TOP
    bottom: float = BOTTOM

    def x(self, value: Any) -> Any:
        """Where a value, or each of an array, lies across the picture."""
        low, high = self.x_range
        return self.left + (value - low) / (high - low) * (self.width - self.left - self.right)

    def y(self, value: Any) -> Any:
        """Where a value, or each of an array, lies down the picture."""
        low, high = self.y_range
        return self.height - self.bottom - (value - low) / (high - low) * (self.height - self.top - self.bottom)

    def at(self, points: Points) -> Float[np.ndarray, "n 2"]:
        """Where points lie `(N, 2)`."""
        x, y = _array(points).T
        return np.stack([self.x(x), self.y(y)], axis=-1)

    @property
    def field(self) -> tuple[float, float, float, float]:
        """Left, top, width and height of the field."""
        width, height = self.width - self.left - self.right, self.height - self.top - self.bottom
        return self.left, self.top, width, height

    def drawn(
        self,
        x_label: str,
        y_label: str,
        x_ticks: Sequence[float] | None = None,
        y_ticks: Sequence[float] | None = None,
        grid: bool = True,
    ) -> Markup:
        """The axes with rules, ticks and labels; no ticks for an empty list."""
        parts = []
        left, top, width, height = self.field
        x_ticks = ticks(*self.x_range) if x_ticks is None else x_ticks
        y_ticks = ticks(*self.y_range) if y_ticks is None else y_ticks
        names = tick_names(x_ticks)
        shown = self._named(x_ticks, names)
        for k, (value, name) in enumerate(zip(x_ticks, names, strict=True)):
            x = self.x(value)
            if k % shown == 0:
                parts.append(text(x, top + height + 15, name, "middle", "tick"))
            if grid:
                parts.append(line(x, top, x, top + height, "rule"))
        for value, name in zip(y_ticks, tick_names(y_ticks), strict=True):
            y = self.y(value)
            parts.append(text(left - 6, y + 3.5, name, "end", "tick"))
            if grid:
                parts.append(line(left, y, left + width, y, "rule"))
        parts.append(rectangle(left, top, width, height, "field"))
        parts.append(text(left + width / 2, top + height + 33, x_label, "middle", "label"))
        if y_label:
            y = top + height / 2
            parts.append(
                Markup(
                    '<text class="label" text-anchor="middle" transform="translate(12 {}) rotate(-90)">{}</text>'
                ).format(_n(y), y_label)
            )
        return Markup("").join(parts)

    def _named(self, values: Sequence[float], names: Sequence[str]) -> int:
        """Of how many ticks across one is named, so that no name runs into the next."""
        if len(values) < 2:
            return 1
        apart = abs(self.x(values[1]) - self.x(values[0]))
        return max(1, math.ceil(DIGIT * (max(map(len, names)) + 0.5) / apart))


def room_beside(y_range: tuple[float, float]) -> float:
    """The left margin that an axis of such values needs for the names of its ticks, `LEFT` where they are short.

    Example:
        >>> room_beside((0, 300)), room_beside((8303980, 8304060))
        (50.0, 71.0)
    """
    return max([LEFT, *(BESIDE + DIGIT * len(name) for name in tick_names(ticks(*y_range)))])


def image_axes(size: tuple[int, int]) -> Axes:
    """The axes of an image with its proportions, v down, in px."""
    width, height = size
    return Axes(
        (-0.5, width - 0.5),
        (height - 0.5, -0.5),
        height=TOP + BOTTOM + (WIDTH - LEFT - RIGHT) * min(2.0, height / width),
    )


def picture(width: float, height: float, label: str, *parts: Markup | str, kind: str = "") -> Markup:
    """A picture; the label says to those who do not see it what it shows."""
    return Markup('<svg class="picture {}" viewBox="0 0 {} {}" role="img" aria-label="{}">{}</svg>').format(
        kind, _n(width), _n(height), label, Markup("").join(parts)
    )


def figure(drawing: Markup, caption: str | Markup) -> Markup:
    """A picture with words below it."""
    return Markup("<figure>{}<figcaption>{}</figcaption></figure>").format(drawing, caption)


def line(x1: float, y1: float, x2: float, y2: float, kind: str) -> Markup:
    """A straight line."""
    return Markup('<path class="{}" d="M{} {}L{} {}"/>').format(kind, *map(_n, (x1, y1, x2, y2)))


def polyline(points: Points, kind: str, closed: bool = False) -> Markup:
    """A line through points; nothing without any."""
    places = "L".join(f"{x:g} {y:g}" for x, y in _short(points))
    return Markup('<path class="{}" d="M{}{}"/>').format(kind, places, "Z" * closed) if places else Markup()


def segments(starts: Points, ends: Points, kind: str, digits: int = 1) -> Markup:
    """Many short lines as one shape, from each start to its end."""
    both = np.concatenate([_array(starts), _array(ends)], axis=1)
    d = "".join(f"M{a:g} {b:g}L{c:g} {e:g}" for a, b, c, e in both.round(digits).tolist())
    return Markup('<path class="{}" d="{}"/>').format(kind, d) if d else Markup()


def crosses(points: Points, arm: float, kind: str, digits: int = 1) -> Markup:
    """Many crosses as one shape."""
    places = _array(points)
    one, other = np.array([arm, arm]), np.array([arm, -arm])
    starts, ends = np.concatenate([places - one, places - other]), np.concatenate([places + one, places + other])
    return segments(starts, ends, kind, digits)


def dots(points: Points, kind: str) -> Markup:
    """Many dots as one shape, of the width of its stroke."""
    d = "".join(f"M{x:g} {y:g}h0" for x, y in _short(points))
    return Markup('<path class="dots {}" d="{}"/>').format(kind, d) if d else Markup()


def rings(points: Points, radius: float, kind: str) -> Markup:
    """Many circles as one shape."""
    r = _n(radius, 2)
    turn = f"a{r} {r} 0 1 0 {_n(2 * radius, 2)} 0a{r} {r} 0 1 0 {_n(-2 * radius, 2)} 0"
    d = "".join(f"M{x:g} {y:g}{turn}" for x, y in _short(_array(points) - np.array([radius, 0.0])))
    return Markup('<path class="{}" d="{}"/>').format(kind, d) if d else Markup()


def rectangle(
    x: float, y: float, width: float, height: float, kind: str, words: str = "", opacity: float = 1
) -> Markup:
    """A rectangle, with words that show where a mouse rests on it."""
    title = Markup("<title>{}</title>").format(words) if words else ""
    faded = Markup(' fill-opacity="{}"').format(_n(opacity, 2)) if opacity < 1 else ""
    return Markup('<rect class="{}" x="{}" y="{}" width="{}" height="{}"{}>{}</rect>').format(
        kind, *map(_n, (x, y, max(0.0, width), max(0.0, height))), faded, title
    )


def text(x: float, y: float, words: str, anchor: str = "start", kind: str = "label") -> Markup:
    """Words at a place: their start, middle or end."""
    return Markup('<text class="{}" x="{}" y="{}" text-anchor="{}">{}</text>').format(kind, _n(x), _n(y), anchor, words)


def image(x: float, y: float, width: float, height: float, address: str, kind: str = "") -> Markup:
    """A picture of pixels, stretched to a rectangle."""
    return Markup(
        '<image class="{}" x="{}" y="{}" width="{}" height="{}" preserveAspectRatio="none" href="{}"/>'
    ).format(kind, *map(_n, (x, y, width, height)), address)


def clipped(name: str, axes: Axes, *parts: Markup) -> Markup:
    """What of the parts lies in the field of the axes; the name is the page's own."""
    return Markup('<clipPath id="{}">{}</clipPath><g clip-path="url(#{})">{}</g>').format(
        name, rectangle(*axes.field, ""), name, Markup("").join(parts)
    )


def key(*entries: tuple[str, str]) -> Markup:
    """What the marks of a picture stand for: pairs of a class and words."""
    items = (Markup('<li><span class="key {}"></span>{}</li>').format(kind, words) for kind, words in entries)
    return Markup('<ul class="keys">{}</ul>').format(Markup("").join(items))


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About so many round numbers from the lesser to the greater of two.

    Example:
        >>> ticks(0, 640), ticks(0.31, -0.2, 4)
        ([0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0], [-0.2, -0.1, 0.0, 0.1, 0.2, 0.3])
    """
    low, high = min(low, high), max(low, high)
    if not (math.isfinite(high - low) and high > low):
        return []
    rough = (high - low) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= 0.75 * rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{k * step:.12g}") for k in range(first, last + 1)]


def tick_names(values: Sequence[float]) -> list[str]:
    """Numbers at an axis, with a minus as typeset: all their digits, or with a power of ten where that is shorter.

    Example:
        >>> tick_names([8303980.0, 8304000.0]), tick_names([0.1, 1e7])
        (['8303980', '8304000'], ['0.1', '1e+07'])
    """
    found = []
    for value in values:
        whole, short = f"{value:.12g}", f"{value:.6g}"
        name = short if float(short) == value and len(short) < len(whole) else whole
        found.append(name.replace("-", "\N{MINUS SIGN}"))
    return found


def reach(values: Iterable[float], least: float = 1e-9) -> float:
    """The end of an axis from 0 for values: a little above the largest."""
    return max([least, *(1.06 * value for value in values if math.isfinite(value))])


def plain(value: float, digits: int = 2) -> str:
    """A number for people, to so many significant digits, without an exponent where it can be.

    Example:
        >>> plain(0.0123), plain(1234.5), plain(12.0, 3), plain(float("inf")), plain(3.1e-9)
        ('0.012', '1200', '12.0', 'not determined', '3.1e-09')
    """
    if not math.isfinite(value):
        return "not determined"
    if value == 0:
        return "0"
    power = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if -5 <= power <= 12:
        return f"{round(value, digits - 1 - power):.{max(0, digits - 1 - power)}f}"
    return f"{value:.{digits - 1}e}"


def _array(points: Points) -> Float[np.ndarray, "n 2"]:
    """Places as an array of doubles."""
    given = points if isinstance(points, np.ndarray) else list(points)
    return np.asarray(given, dtype=np.float64).reshape(-1, 2)


def _short(points: Points) -> list[list[float]]:
    """Places to a tenth of a unit."""
    return _array(points).round(1).tolist()


def _n(value: float, digits: int = 1) -> str:
    """A coordinate, as short as it can be."""
    number = f"{value:.{digits}f}"
    number = number.rstrip("0").rstrip(".") if "." in number else number
    return "0" if number == "-0" else number
