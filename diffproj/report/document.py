"""One self-contained HTML file out of parts, in the reader's choice of light or dark, that keeps off the network.

What a part says is escaped where it is written, by Jinja2 with autoescape on (`templates`); the document escapes titles
itself. A policy in its head names each style and script by its hash: whatever else should have come into the page does
not run, and nothing is fetched from anywhere.
"""

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

HERE = Path(__file__).parent
ANCHOR = re.compile(r"[a-z][a-z0-9-]*\Z")
TITLE_LENGTH = 300
"""Characters of a title that a page shows."""


class Part(NamedTuple):
    """One part of a document.

    Attributes:
        title: its heading, plain text.
        anchor: its name in links, of small letters, digits and `-`.
        html: its content, escaped where it was made; the headings inside are `h3` and below.
        style: rules of CSS that only it needs.
        script: JavaScript that only it needs; it runs when the whole page is there.
    """

    title: str
    anchor: str
    html: str
    style: str = ""
    script: str = ""


def document(title: str, parts: Sequence[Part], lead: str = "") -> str:
    """One HTML file that holds the parts, in their order, and needs nothing else.

    Its colours are custom properties of CSS that parts use: `--ink` on `--paper`, `--faint` for what stands back,
    `--line` for rules and axes, `--panel` behind figures, `--accent` for what is meant, `--good`, `--doubt` and `--bad`
    for judgements. They follow the reader's choice of light or dark, and are light on paper.

    Args:
        title: of the page, plain text.
        parts: at least one, their anchors all different.
        lead: what stands below the title, as HTML.

    Raises:
        ValueError: no parts, anchors that are alike or no words, or an end of a script or style inside one.

    Example:
        >>> page = document("A <b> camera", [Part("Verdict", "verdict", "<p>Good.</p>")])
        >>> "A &lt;b&gt; camera" in page, "default-src 'none'" in page
        (True, True)
    """
    anchors = [part.anchor for part in parts]
    if not parts or len(set(anchors)) < len(anchors) or not all(map(ANCHOR.match, anchors)):
        raise ValueError(f"parts: want at least one, with anchors that differ, of letters, digits and -, got {anchors}")
    styles = [text for text in (asset("document.css"), *dict.fromkeys(part.style for part in parts)) if text.strip()]
    scripts = [text for text in dict.fromkeys(part.script for part in parts) if text.strip()]
    for tag, texts in (("style", styles), ("script", scripts)):
        for text in texts:
            if f"</{tag}" in text.lower() or "<!--" in text:
                raise ValueError(f"{tag}: want text without </{tag} and <!--, got some; write the < as an escape")
    page = render(
        "document.html",
        title=shortened(title),
        lead=Markup(lead),  # noqa: S704  # made by a template
        parts=[part._replace(title=shortened(part.title), html=Markup(part.html)) for part in parts],  # noqa: S704
        styles=[Markup(text) for text in styles],  # noqa: S704
        scripts=[Markup(text) for text in scripts],  # noqa: S704
        policy=Markup(_policy(styles, scripts)),  # noqa: S704
    )
    return page.encode("utf-8", "replace").decode()  # names of files may hold what is no text


def render(template: str, **values: Any) -> Markup:
    """The text of a template of this folder with the values, all of them escaped but `Markup`."""
    return Markup(templates().get_template(template).render(**values))  # noqa: S704  # autoescaped


@cache
def templates() -> Environment:
    """The templates of this folder: values are escaped, and one that is missing is an error."""
    return Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )


@cache
def asset(name: str) -> str:
    """The text of a file of this folder."""
    return (HERE / name).read_text(encoding="utf-8")


def json_block(name: str, value: Any) -> Markup:
    r"""Data for a script, as `<script type="application/json" id="NAME">`; no text inside can end the element.

    Numbers are finite or null.

    Example:
        >>> print(json_block("data", {"name": "</script>"}))
        <script type="application/json" id="data">{"name":"\u003c/script\u003e"}</script>
    """
    if not ANCHOR.match(name):
        raise ValueError(f"name: want letters, digits and -, got {name!r}")
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))  # ASCII: line separators are escaped, too
    for letter in "<>&":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup('<script type="application/json" id="{}">{}</script>').format(name, Markup(text))  # noqa: S704


def data_uri(content: bytes, kind: str = "image/png") -> str:
    """A picture's bytes as an address that needs no file."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def shortened(text: str, length: int = TITLE_LENGTH) -> str:
    """A text of at most so many characters, on one line, its middle left out where it is longer.

    Example:
        >>> shortened("a photograph with a long name.jpg", 17)
        'a photog…name.jpg'
    """
    text = " ".join(text.split())
    return text if len(text) <= length else f"{text[: (length - 1) // 2]}…{text[len(text) - length // 2 :]}"


def _policy(styles: Sequence[str], scripts: Sequence[str]) -> str:
    """What the page may do: show its own styles, scripts and pictures, and nothing else."""
    allowed = {"style-src": styles, "script-src": scripts}
    rules = [" ".join([name, *(map(_hashed, texts) if texts else ["'none'"])]) for name, texts in allowed.items()]
    return "; ".join(["default-src 'none'", "img-src data: blob:", *rules, "base-uri 'none'", "form-action 'none'"])


def _hashed(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
