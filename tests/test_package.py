"""What is handed out: one version, the bounds that are run, and commands that find what they need."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

import diffproj

ROOT = Path(__file__).parent.parent
CONFIGURATION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = CONFIGURATION["project"]
EXTRAS = PROJECT["optional-dependencies"]
SDIST = CONFIGURATION["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]


def requirements(*lists: list[str]) -> list[Requirement]:
    """The parsed requirements, without those on the package's own extras."""
    return [parsed for each in lists for text in each if (parsed := Requirement(text)).name != "diffproj"]


def pinned(name: str) -> dict[str, Version]:
    """The versions that a file of constraints names."""
    lines = (ROOT / ".ci" / name).read_text(encoding="utf-8").splitlines()
    return {line.partition("==")[0]: Version(line.partition("==")[2]) for line in lines if "==" in line}


def test_the_version_is_written_once() -> None:
    assert "version" in PROJECT["dynamic"]
    assert "version" not in PROJECT
    assert metadata.version("diffproj") == diffproj.__version__, "pip install -e . again"
    heading = re.search(
        r"^## (?:Unreleased: )?(\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert heading is not None
    assert heading[1] == diffproj.__version__


def test_every_requirement_has_a_tested_version() -> None:
    tested = pinned("constraints.txt")
    for requirement in requirements(PROJECT["dependencies"], *EXTRAS.values()):
        assert requirement.specifier.contains(tested[requirement.name]), requirement.name


def test_lower_bounds_are_those_of_the_oldest_run() -> None:
    """Of the formatter and the type checker it is the tested version: their judgement changes with each release."""
    run = pinned("oldest.txt") | {name: pinned("constraints.txt")[name] for name in ("mypy", "pyright", "ruff")}
    for requirement in requirements(PROJECT["dependencies"], EXTRAS["cli"], EXTRAS["notebooks"], EXTRAS["test"]):
        bounds = [Version(part.version) for part in requirement.specifier if part.operator == ">="]
        assert bounds == [run[requirement.name]], requirement.name


def test_what_the_readme_names_is_in_the_sdist() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    linked = re.findall(r"\]\(([^)#:]+)\)", readme)
    used = re.findall(r"(?<![\w/])(?:\.ci|\.readme|tests|diffproj)/[\w./]*\w", readme)
    for name in {*linked, *used}:
        assert (ROOT / name).exists(), name
        assert "/" + name.split("/")[0] in SDIST, name
    assert all((ROOT / name.removeprefix("/")).exists() for name in SDIST)
