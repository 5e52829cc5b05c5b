"""The house: imports run downward only, and the package writes no word about the machine it was made on."""

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import diffproj

PACKAGE = Path(diffproj.__file__).parent
ROOT = Path(__file__).parent.parent


def test_imports_run_downward_only() -> None:
    """Between rooms and inside them, as `[tool.importlinter]` in pyproject.toml draws the house."""
    command = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    done = subprocess.run([sys.executable, "-c", command, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_folder_has_a_contract() -> None:
    """Whose layers then have to name every file: the contracts are exhaustive."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    assert all(contract["type"] == "layers" and contract["exhaustive"] for contract in contracts)
    folders = {".".join(("diffproj", *path.parent.relative_to(PACKAGE).parts)) for path in PACKAGE.rglob("*.py")}
    assert folders == {container for contract in contracts for container in contract["containers"]}


def room(path: Path) -> str:
    """The folder of the package in which a file lies; a file beside the folders is a room of its own."""
    return path.relative_to(PACKAGE).parts[0]


def private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name != "_"


def private_names(tree: ast.Module) -> tuple[set[str], dict[str, int]]:
    """The private names that a file makes, and those that it takes from elsewhere, each with its first line."""
    made, taken = set(), {}
    for node in ast.walk(tree):
        match node:
            case (
                ast.FunctionDef(name=name)
                | ast.AsyncFunctionDef(name=name)
                | ast.ClassDef(name=name)
                | ast.arg(arg=name)
            ):
                made.add(name)
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                made.add(name)
            case ast.Call(func=ast.Attribute(attr="__setattr__") | ast.Name(id="setattr"), args=[*_]):
                made |= {
                    part.value for part in node.args if isinstance(part, ast.Constant) and isinstance(part.value, str)
                }
            case ast.Attribute(attr=name) if private(name):
                taken.setdefault(name, node.lineno)
            case ast.ImportFrom(names=names):
                taken |= {alias.name: node.lineno for alias in names if private(alias.name)}
            case _:
                pass
    return {name for name in made if private(name)}, taken


def test_private_members_stay_in_their_room() -> None:
    """What a file uses under a name with an underscore is not made in another room alone.

    Private names of libraries are not meant here: nothing in the package makes them.
    """
    files = {path: private_names(ast.parse(path.read_text(encoding="utf-8"))) for path in sorted(PACKAGE.rglob("*.py"))}
    made: dict[str, set[str]] = {}
    for path, (names, _) in files.items():
        made.setdefault(room(path), set()).update(names)
    wrong = [
        f"{path.relative_to(PACKAGE)}:{line} uses {name} of {', '.join(sorted(owners))}"
        for path, (_, taken) in files.items()
        for name, line in taken.items()
        if name not in made[room(path)] and (owners := {other for other, names in made.items() if name in names})
    ]
    assert not wrong, "\n".join(wrong)


def test_no_file_is_longer_than_400_lines() -> None:
    lengths = {
        path.relative_to(PACKAGE): len(path.read_text(encoding="utf-8").splitlines()) for path in PACKAGE.rglob("*.py")
    }
    wrong = [f"{path} has {length} lines" for path, length in sorted(lengths.items()) if length > 400]
    assert not wrong, "\n".join(wrong)


def test_public_names_are_documented_and_sorted() -> None:
    assert diffproj.__all__ == sorted(diffproj.__all__)
    assert all(getattr(diffproj, name).__doc__ for name in diffproj.__all__)


def test_public_names_are_there_before_they_are_asked_for() -> None:
    command = "import diffproj; print(*(name for name in dir(diffproj) if not name.startswith('_')))"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True)
    assert done.stdout.split() == sorted([*diffproj.__all__, "figures", "synthetic"])
    assert done.stderr == ""


def test_importing_waits_for_nothing_before_a_public_name_is_asked_for() -> None:
    """And that loads neither the compiler nor matplotlib, each of which takes as long as PyTorch itself."""
    command = (
        "import sys, diffproj; print('torch' in sys.modules); diffproj.Camera\n"
        "print(*(name in sys.modules for name in ('torch', 'torch._dynamo', 'matplotlib')))"
    )
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("False\nTrue False False\n", "")
