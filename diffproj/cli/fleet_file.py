"""The file of a fleet: one line of JSON a camera, appended whole as cameras are done, and picked up where it ends.

Of several lines of one camera the last counts.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diffproj._core.atomic import write_whole
from diffproj.calibration.results.calibration import Calibration
from diffproj.cli.fleet_folder import Searched
from diffproj.files import own_json
from diffproj.files.trees import json_lines

BEGINNING = '{"name": '
"""How each line starts."""
DONE = "camera"
"""The key that only lines of cameras have, and not those of failures."""
STATE = "files"
"""The key of what tells whether a camera's photographs are those of its line, see `state_of`."""


def done_before(
    path: Path, asked: Mapping[str, Any], states: Mapping[str, str]
) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """The lines of cameras that are done, by name; of others the file keeps those that are done with other photographs.

    These stay till they are done anew. Failures are taken out of it, and what was not written whole.

    Args:
        path: the file, which need not exist.
        asked: the options, which have to be those of its lines.
        states: of the photographs of each camera now, by name, see `state_of`; empty where they are not known.

    Returns:
        The lines, and the names of cameras that were done with other photographs than are there now.

    Raises:
        ValueError: it is no file of a fleet, or one with other options.
        OSError: it cannot be read, or be written.
    """
    if not path.exists():
        return {}, []
    text = path.read_text(encoding="utf-8")
    remedy = "choose another file, or remove it"
    try:
        lines = json_lines(text)
        if text and not text.startswith(BEGINNING):
            raise ValueError("no line of a fleet")  # noqa: TRY301
        found = {line["name"]: line for line in lines}
        other = next((line["asked"] for line in lines if line["asked"] != json.loads(json.dumps(asked))), None)
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"--output: want a file of a fleet, got {path}, which is another; {remedy}") from None
    if other is not None:
        differ = next(key for key in (*asked, *other) if json.dumps(asked.get(key)) != json.dumps(other.get(key)))
        raise ValueError(
            f"--output: {path} holds cameras with {differ} {other.get(differ)}, not {asked.get(differ)}; {remedy}"
        )
    done = {name: line for name, line in found.items() if DONE in line}
    if len(done) < len(lines) or not text.endswith("\n"):
        _write(path, done)
    changed = [name for name, line in done.items() if states.get(name) and line.get(STATE) != states[name]]
    return {name: line for name, line in done.items() if name not in changed}, changed


def leave_out_replaced(path: Path) -> None:
    """Take out the lines of cameras that have a later one.

    Raises:
        OSError: the file cannot be read, or be written.
    """
    _write(path, {line["name"]: line for line in json_lines(path.read_text(encoding="utf-8"))})


def _write(path: Path, lines: Mapping[str, dict[str, Any]]) -> None:
    write_whole(path, "".join(json.dumps(line) + "\n" for line in lines.values()))


def line_of(
    name: str, asked: Mapping[str, Any], state: str, searched: Searched, found: Calibration | str, seconds: float
) -> dict[str, Any]:
    """What is said of a camera; of one that failed, why.

    Verdict and remarks are in the library's words, as it reads the line; notes and failures speak of options.
    """
    line: dict[str, Any] = {
        "name": name,
        "asked": dict(asked),
        "photographs": searched.photographs,
        STATE: state,
        "seconds": {"search": round(searched.seconds, 4), "calibration": round(seconds, 4)},
        "notes": list(searched.notes),
    }
    if isinstance(found, str):
        return line | {"error": found}
    more = {"verdict": found.verdict, "remarks": found.remarks[0], "summary": found.to_dict()}
    return own_json.plain_fields(found, **line, **more)


def append(path: Path, lines: list[dict[str, Any]]) -> None:
    """Put lines at the end of the file; they are on the disk when this returns.

    Raises:
        OSError: the file cannot be written.
    """
    with path.open("ab") as file:
        file.write("".join(json.dumps(line, allow_nan=False) + "\n" for line in lines).encode())
        file.flush()
        os.fsync(file.fileno())
