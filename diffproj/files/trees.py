"""JSON, YAML and XML as one kind of tree: `dict`, `list`, `str`, `int`, `float`, `bool` and `None`.

What OpenCV makes of the three is understood: `%YAML:1.0`, the tag `!!opencv-matrix` and the attribute `type_id`, both
of which become the key `type_id`, and lists of numbers as the text of an XML element. OpenCV's own `FileStorage` is
not used: it reads past its memory where a matrix lacks a line, and lets the first of two equal keys win, or the last.

A number in quotes is a string. Two equal keys, references, entities and deep nesting are refused.
"""

import json
import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Any
from xml.etree import ElementTree

import yaml

METASHAPE = "document"
"""The root of its files, where an element of one tag may follow another."""

DEEPEST = 40
"""Levels of nesting that a camera file may have; those of the wild have ten."""

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?(0|[1-9]\d{0,18})")
_WORDS: dict[str, Any] = {"": None, "~": None, "null": None, "true": True, "false": False}
_NOT_FINITE = {"nan": float("nan"), "inf": float("inf"), "-inf": float("-inf"), "+inf": float("inf")}


def json_tree(text: str) -> Any:
    """The tree of a JSON text.

    Raises:
        ValueError: it is not JSON, is nested too deeply, or has a key twice.
    """
    try:
        tree = json.loads(text, object_pairs_hook=_without_doubles)
    except RecursionError:
        raise ValueError(f"want at most {DEEPEST} levels of nesting, got more") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"want JSON, got something else ({error})") from None
    check_depth(tree)
    return tree


def json_lines(text: str) -> list[Any]:
    """The trees of JSON texts, one a line; the last is left out where it was not written to its end.

    Raises:
        ValueError: a line is not JSON.
    """
    *whole, rest = text.split("\n")
    trees = [json_tree(line) for line in whole if line.strip()]
    if rest.strip():
        with suppress(ValueError):
            trees.append(json_tree(rest))
    return trees


def yaml_tree(text: str) -> Any:
    """The tree of a YAML text, also of the dialect that OpenCV writes.

    Raises:
        ValueError: it is not YAML, is nested too deeply, refers to itself, or has a key twice.
    """
    if re.match(r"\s*%YAML:", text):  # OpenCV's dialect, which takes `PointSize:2` and `data:[0]` for keys and values
        text = re.sub(r"\A(\s*)%YAML:[\d.]+[ \t]*(#.*)?$", r"\1", text, flags=re.MULTILINE)
        text = re.sub(r"^(\s*[A-Za-z][\w.]*):(?=[-+.\d\[])", r"\1: ", text, flags=re.MULTILINE)
    events = yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    try:
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                tree = _yaml_node(next(events), events, 0)
                _check_alike(tree, events)
                return tree
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark is not None else ""
        raise ValueError(f"want YAML, got something else ({getattr(error, 'problem', None) or error}{where})") from None
    raise ValueError("want YAML, got nothing")


def xml_tree(text: str) -> Any:
    """The tree of an XML text; of its root, the content alone, but for its name under the key `"<root>"`.

    Raises:
        ValueError: it is not XML, declares entities or a document type, or has an element twice that is no document of
            Metashape, where sensors, cameras and others stand one after the other.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("want XML without a document type, got one, as no camera file that is known here has")
    try:
        root = ElementTree.fromstring(text.strip())  # noqa: S314  # no entities, as checked above
    except ElementTree.ParseError as error:
        raise ValueError(f"want XML, got something else ({error})") from None
    tree = _xml_node(root, 0, lists=root.tag == METASHAPE)
    return {"<root>": root.tag} | tree if isinstance(tree, dict) else {"<root>": root.tag}


def check_depth(tree: Any, depth: int = 0) -> None:
    """Refuse a tree that is nested deeper than any camera file is.

    Raises:
        ValueError: it is.
    """
    if depth > DEEPEST:
        raise ValueError(f"want at most {DEEPEST} levels of nesting, got more")
    for item in tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ():
        if isinstance(item, dict | list):
            check_depth(item, depth + 1)


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A mapping of pairs; that of OpenCV's FileStorage keeps the first of two equal keys, Python's the last."""
    mapping: dict[str, Any] = {}
    for key, value in pairs:
        if key in mapping:
            raise ValueError(f"{key}: want the key once, got it twice")
        mapping[key] = value
    return mapping


def _yaml_node(event: Any, events: Iterator[Any], depth: int) -> Any:
    if depth > DEEPEST:
        raise ValueError(f"want at most {DEEPEST} levels of nesting, got more")
    if isinstance(event, yaml.AliasEvent):
        raise ValueError(f"*{event.anchor}: want the value itself, got a reference to it; write it out")
    if isinstance(event, yaml.ScalarEvent):
        plain = event.implicit[0] and not event.style
        return _yaml_scalar(event.value) if plain else event.value
    if isinstance(event, yaml.SequenceStartEvent):
        items = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            items.append(_yaml_node(event, events, depth + 1))
        return items
    tag, pairs = event.tag, []
    while not isinstance(event := next(events), yaml.MappingEndEvent):
        key = event.value if isinstance(event, yaml.ScalarEvent) else str(_yaml_node(event, events, depth + 1))
        pairs.append((key, _yaml_node(next(events), events, depth + 1)))
    if tag and tag.rpartition(":")[2] != "map":
        pairs.append(("type_id", tag.rpartition(":")[2]))
    return _without_doubles(pairs)


def _check_alike(tree: Any, events: Iterator[Any]) -> None:
    """Refuse documents behind the first that say something else: another camera would be dropped.

    The messages of one camera, as `rostopic echo` prints them, differ in their headers alone; one that was cut off, or
    is of another kind, is not looked at.
    """
    with suppress(yaml.YAMLError):
        for event in events:
            other = _yaml_node(next(events), events, 0) if isinstance(event, yaml.DocumentStartEvent) else None
            if isinstance(tree, dict) and isinstance(other, dict):
                differ = [key for key in other if key != "header" and key in tree and str(other[key]) != str(tree[key])]
                if differ:
                    raise ValueError(f"{differ[0]}: want one document, got another behind '---'; split the file there")


def _yaml_scalar(text: str) -> Any:
    number = _number(text)
    if number is not None:
        return number
    lower = text.lower()
    if lower in _WORDS:
        return _WORDS[lower]
    return _NOT_FINITE.get(lower.replace(".", "", 1), text) if "." in lower else text


def _number(text: str) -> float | int | None:
    """A number in decimal notation; `None` where it is none, or, as 010, may be meant in another."""
    if _WHOLE.fullmatch(text):
        return int(text)
    return float(text) if _NUMBER.fullmatch(text) and not re.match(r"[-+]?0\d", text) else None


def _xml_node(element: ElementTree.Element, depth: int, lists: bool) -> Any:
    """What an element holds; with `lists`, several of one tag are a list of them."""
    if depth > DEEPEST:
        raise ValueError(f"want at most {DEEPEST} levels of nesting, got more")
    children = [(child.tag, _xml_node(child, depth + 1, lists)) for child in element]
    attributes = list(element.attrib.items())
    if not children:
        content = _xml_text(element.text or "")
        return content if not attributes else _without_doubles([*attributes, ("<text>", content)])
    if not attributes and all(tag == "_" for tag, _ in children):
        return [item for _, item in children]
    many: dict[str, list[Any]] = {}
    for tag, item in children:
        many.setdefault(tag, []).append(item)
    for tag, items in many.items():
        if len(items) > 1 and not lists:
            raise ValueError(f"{tag}: want the element once, got it {len(items)} times")
    return _without_doubles(
        [*attributes, *((tag, items if len(items) > 1 else items[0]) for tag, items in many.items())]
    )


def _xml_text(text: str) -> Any:
    text = text.strip()
    if len(text) > 1 and text[0] == text[-1] == '"':
        return text[1:-1]
    numbers = [_NOT_FINITE.get(word.lower().replace(".", "", 1), _number(word)) for word in text.split()]
    if not numbers or any(number is None for number in numbers):
        return text or None
    return numbers[0] if len(numbers) == 1 else numbers
