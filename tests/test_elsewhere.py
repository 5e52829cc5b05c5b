"""Starts `elsewhere/calls.py` in a process of its own, for PyTorch keeps a device that it was told of."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from torch.utils import backend_registration


@pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="this PyTorch takes no device that is written in Python",
)
@pytest.mark.parametrize("which", ["not slow", pytest.param("slow", marks=pytest.mark.slow)])
def test_calls_on_another_device(which: str) -> None:
    root = Path(__file__).parent.parent
    calls = ["tests/elsewhere/calls.py", "-m", which, "-q", "-p", "no:cacheprovider", "--no-cov", "-o", "testpaths="]
    command = [sys.executable, "-m", "pytest", *calls]
    environment = os.environ | {"DIFFPROJ_SHAPE_CHECKS": "0"}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
