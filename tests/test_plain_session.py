"""Starts the session of the tests marked `plain`, which run without shape checks; see conftest.py."""

import os
import subprocess
import sys
from pathlib import Path


def test_plain_session() -> None:
    root = Path(__file__).parent.parent
    command = [sys.executable, "-m", "pytest", "tests", "-q", "-p", "no:cacheprovider", "--no-cov"]
    environment = os.environ | {"DIFFPROJ_SHAPE_CHECKS": "0"}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
