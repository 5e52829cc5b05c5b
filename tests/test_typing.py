"""A user's script passes mypy in its strict mode; Pyright's is among the checks of `test_style.py`."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_a_users_script_passes_mypy(tmp_path: Path) -> None:
    """Silent about what it imports: of an installed package, mypy takes the types and reports nothing."""
    pytest.importorskip("mypy", reason="mypy is not installed")
    checked = ("--strict", "--follow-imports=silent", f"--cache-dir={tmp_path}", "tests/typing/script.py")
    done = subprocess.run([sys.executable, "-m", "mypy", *checked], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
