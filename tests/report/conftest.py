"""What the tests of pages share: the page's own mathematics in a JavaScript engine, and a headless Chromium."""

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import diffproj

PAGE = Path(diffproj.__file__).parent / "report" / "measuring_page"
MATHEMATICS = ("lens.js", "camera.js", "statistics.js", "errors.js")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""Debian's, or another that is there; nothing is downloaded."""
OPTIONS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--force-color-profile=srgb")


@pytest.fixture(scope="session")
def javascript() -> Callable[[str, Any], Any]:
    """Run an expression over `given` with the page's mathematics, in Node; infinity and NaN come as text."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("no Node: Debian's package is nodejs")
    library = "\n".join((PAGE / name).read_text(encoding="utf-8") for name in MATHEMATICS)

    def run(expression: str, given: Any) -> Any:
        script = f"""{library}
const given = JSON.parse(require("fs").readFileSync(0, "utf8"));
const plain = (_, x) => (typeof x === "number" && !Number.isFinite(x) ? String(x) : x);
process.stdout.write(JSON.stringify({expression}, plain));"""
        done = subprocess.run([node, "-e", script], input=json.dumps(given), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A browser that stays open for the session."""
    if CHROMIUM is None:
        pytest.skip("no Chromium: Debian's package is chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install diffproj[web-test]")
    with playwright.sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=list(OPTIONS))
        yield browser
        browser.close()
