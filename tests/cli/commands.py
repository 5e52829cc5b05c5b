"""Commands as tests call them."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from diffproj import cli

Run = Callable[..., tuple[int, str, str]]


def runner(*command: str) -> Run:
    """What runs a command with more arguments, and gives its exit code, its output and its errors."""

    def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
        try:
            code = cli.main([*command, *map(str, arguments)])
        except SystemExit as error:
            code = int(error.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return run


def parser(*command: str) -> Callable[..., dict[str, Any]]:
    """What runs a command with more arguments, and gives its JSON document, in which all numbers are finite."""
    run = runner(*command)

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    def parsed(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
        code, out, err = run(capsys, *arguments, "--json")
        assert (code, err) == (0, "")
        return json.loads(out, parse_constant=refuse)

    return parsed
