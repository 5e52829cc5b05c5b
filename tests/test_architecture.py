"""The house: imports run downward only, and the package writes no word about the machine it was made on."""

import ast
import subprocess
import sys
from pathlib import Path

import diffproj

PACKAGE = Path(diffproj.__file__).parent

LEVELS = (
    ("_core",),
    ("lens",),
    ("geometry",),
    ("targets",),
    ("calibration",),
    ("files", "measurement", "nn", "paper"),
    ("figures",),
    ("cli",),
    ("__main__",),
)
LEVEL = {module: level for level, modules in enumerate(LEVELS) for module in modules}


def imported_modules(path: Path) -> set[str]:
    """The package's own modules, or folders of modules, that a file imports."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join((*parts[: len(parts) - node.level], node.module or "")) if node.level else node.module or ""
            targets = [f"{base.rstrip('.')}.{alias.name}" for alias in node.names]
        else:
            continue
        names = [target.split(".") for target in targets]
        found |= {name[1] for name in names if name[0] == "diffproj" and len(name) > 1}
    return found


def test_every_module_has_a_level() -> None:
    modules = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")}
    assert modules - {"__init__"} == set(LEVEL)


def test_imports_run_downward_only() -> None:
    wrong = []
    for path in PACKAGE.rglob("*.py"):
        module = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if module == "__init__":
            continue
        sideways = [name for name in imported_modules(path) if name != module and LEVEL.get(name, -1) >= LEVEL[module]]
        wrong += [f"{path.relative_to(PACKAGE)} imports {name}" for name in sideways]
    assert not wrong


def test_public_names_are_documented_and_sorted() -> None:
    assert diffproj.__all__ == sorted(diffproj.__all__)
    assert all(getattr(diffproj, name).__doc__ for name in diffproj.__all__)


def test_import_loads_neither_the_compiler_nor_matplotlib() -> None:
    """Both take as long as PyTorch itself."""
    command = "import sys, diffproj; print(*(name in sys.modules for name in ('torch._dynamo', 'matplotlib')))"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True)
    assert (done.stdout.strip(), done.stderr) == ("False False", "")
