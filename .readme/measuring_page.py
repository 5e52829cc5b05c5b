"""Takes the README's pictures of the measuring page, with the Chromium that is there and one of OpenCV's photographs.

Debian's package opencv-doc has the photograph; `DIFFPROJ_PHOTOS` says where.
"""

import io
import os
import shutil
import tempfile
from pathlib import Path

from PIL import Image  # matplotlib brings it

import diffproj as dp

NAME, SIZE = "left01.jpg", (640, 480)
WINDOWS = {
    "measuring.png": (1240, 860, "light"),
    "measuring_dark.png": (1240, 860, "dark"),
    "measuring_narrow.png": (400, 860, "dark"),
}
COLOURS = 250


def pictures(calibration: dp.Calibration) -> dict[str, bytes]:
    """PNGs by their names; none where there is no browser, no Playwright or no photograph."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    photograph = Path(os.environ.get("DIFFPROJ_PHOTOS", "")) / NAME
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        browser = None
    if browser is None or not photograph.is_file():
        print("No pictures of the measuring page: they need Chromium, playwright and DIFFPROJ_PHOTOS.")
        return {}
    found = {}
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as tools:
        path = Path(folder, "measure.html")
        dp.write_measuring_page(path, photograph, calibration, view=NAME, unit="mm")
        chromium = tools.chromium.launch(executable_path=browser, args=["--no-sandbox", "--disable-gpu"])
        for name, (width, height, scheme) in WINDOWS.items():
            page = chromium.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            page.goto(path.as_uri())
            _measure(page, calibration.views.pixels[calibration.views.names.index(NAME)].tolist())
            page.wait_for_timeout(400)
            found[name] = _smaller(page.screenshot())
        chromium.close()
    return found


def _measure(page, corners: list[list[float]]) -> None:
    """A row of the board, then the area of four by two squares; the cursor stays on a corner."""
    for number in (45, 53):
        page.mouse.click(*_place(page, corners[number]))
    page.locator("[data-tool=area]").click()
    for number in (10, 14, 32, 28):
        page.mouse.click(*_place(page, corners[number]))
    page.locator("#m-finish").click()
    page.locator("#m-photo").evaluate("canvas => canvas.blur()")
    page.mouse.move(*_place(page, corners[35]))


def _place(page, pixel: list[float]) -> tuple[float, float]:
    box = page.locator("#m-photo").bounding_box()
    scale = min(box["width"] / SIZE[0], box["height"] / SIZE[1])
    u, v = ((at + 0.5 - side / 2) * scale for at, side in zip(pixel, SIZE, strict=True))
    return box["x"] + box["width"] / 2 + u, box["y"] + box["height"] / 2 + v


def _smaller(png: bytes) -> bytes:
    """The same picture with a palette, in a third of the bytes."""
    small = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(
        COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
    ).save(small, "PNG", optimize=True)
    return small.getvalue()
