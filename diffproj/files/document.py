"""A file in hand: its bytes, its text and the tree of what the text says, each worked out once, when asked for."""

import os
import stat
from functools import cached_property
from pathlib import Path
from typing import Any

from diffproj.files.trees import json_lines, json_tree, xml_tree, yaml_tree

MOST_BYTES = 2**31
"""No camera file is larger; a film that was taken for one is."""

OF_OTHERS = (
    (b"\x80\x02", "a pickle"),
    (b"\x80\x03", "a pickle"),
    (b"\x80\x04", "a pickle"),
    (b"\x80\x05", "a pickle"),
    (b"(dp", "a pickle"),
    (b"\x89PNG", "a photograph"),
    (b"\xff\xd8\xff", "a photograph"),
    (b"%PDF", "a PDF"),
    (b"\x1f\x8b", "a file compressed by gzip"),
)
REMEDIES = {
    "a pickle": "; it is never opened, for it may run any program: save K and the coefficients by numpy.savez",
    "a file compressed by gzip": "; unpack it first",
}


class Document:
    """A file's content, and what it is called.

    Attributes:
        path: where it came from; readers look for a file beside it where the format says so.
        data: its bytes.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self.data = path, data

    @classmethod
    def read(cls, path: Path) -> "Document":
        """Read a file.

        Raises:
            OSError: there is none, or it cannot be read.
            ValueError: it is something that cannot be read to its end, or no file of a camera at the first glance.
        """
        if "\0" in str(path):
            raise ValueError(f"{str(path)!r}: want the path of a file, got one with a NUL character")
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise ValueError(f"{path}: want a file, got a folder; name the file in it that holds the camera")
        if not stat.S_ISREG(status.st_mode):
            raise ValueError(f"{path}: want a file, got a pipe or a device")
        if status.st_size > MOST_BYTES:
            raise ValueError(f"{path}: want a camera file, got {status.st_size / 2**30:.0f} GiB")
        data = path.read_bytes()
        if not data.strip():
            raise ValueError(f"{path}: want a camera file, got an empty one")
        for start, kind in OF_OTHERS:
            if data.startswith(start):
                raise ValueError(f"{path}: want a camera file, got {kind}{REMEDIES.get(kind, '')}")
        return cls(path, data)

    def beside(self, name: str) -> "Document | None":
        """The file of that name in the same folder, where there is one."""
        neighbour = self.path.with_name(name)
        return Document.read(neighbour) if os.path.lexists(neighbour) else None

    @cached_property
    def text(self) -> str | None:
        """The text, with line feeds as line ends and no byte order mark; `None` where the file is binary."""
        utf16 = self.data[:2] in (b"\xff\xfe", b"\xfe\xff")
        text = self.data.decode("utf-16" if utf16 else "utf-8-sig", errors="replace")
        return None if "\0" in text else text.replace("\r\n", "\n")

    @property
    def tree(self) -> Any:
        """What JSON, YAML or XML says, in Python's own types; of JSON lines, a list of them; see `trees`.

        Raises:
            ValueError: it is none of the three.
        """
        tree, problem = self._parsed
        if problem:
            raise ValueError(problem)
        return tree

    @property
    def mapping(self) -> dict[str, Any]:
        """The tree where it is a mapping; empty where it is a list, or no tree at all."""
        tree, _ = self._parsed
        return tree if isinstance(tree, dict) else {}

    @cached_property
    def _parsed(self) -> tuple[Any, str]:
        """The tree, or why there is none: found out once, though every format asks."""
        if self.text is None:
            return None, "want JSON, YAML or XML, got a binary file"
        start = self.text.lstrip()[:1]
        if self.path.suffix.lower() == ".jsonl":
            return json_lines(self.text), ""
        parsers = [xml_tree] if start == "<" else [json_tree] if self.path.suffix.lower() == ".json" else [yaml_tree]
        if start in ("{", "[") and parsers == [yaml_tree]:
            parsers = [json_tree, yaml_tree]  # YAML has lists and mappings in brackets too
        problem = ""
        for parser in parsers:
            try:
                return parser(self.text), ""
            except ValueError as error:
                problem = str(error)
        return None, problem
