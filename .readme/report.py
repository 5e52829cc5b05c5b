"""The README's picture of a report's first screen, as a headless Chromium shows it."""

import io
import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image  # matplotlib brings it

import diffproj as dp

WIDTH, HEIGHT = 1180, 1480
SCALE = 0.6
COLOURS = 120
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def screenshot(calibration: dp.Calibration) -> bytes | None:
    """The top of the report as a PNG; `None` where there is no browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        page, picture = Path(folder, "report.html"), Path(folder, "report.png")
        dp.write_report(page, calibration)
        options = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--hide-scrollbars",
        ]
        shot = [f"--screenshot={picture}", f"--window-size={WIDTH},{HEIGHT}", page.as_uri()]
        subprocess.run([browser, *options, *shot], check=True, capture_output=True)  # noqa: S603
        image = Image.open(picture).convert("RGB")
    small = image.resize((round(SCALE * WIDTH), round(SCALE * HEIGHT)), Image.Resampling.LANCZOS)
    written = io.BytesIO()
    small.quantize(COLOURS).save(written, "PNG", optimize=True)
    return written.getvalue()
