"""The measuring page in headless Chromium, opened from disk, without a network."""

import csv
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

import diffproj as dp

D = torch.float64
SIZE = 640, 480
SIGMA = 0.5
HOSTILE = "\"'><script>alert(1)</script><img src=x onerror=alert(2)> ${x} \u202e\u0000 \U0001f4d0" + "n" * 300
Page = Any
"""Of Playwright, which need not be there."""


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(dp.example_views("left"), dp.Chessboard())


@pytest.fixture(scope="module")
def photograph(calibration: dp.Calibration) -> torch.Tensor:
    return dp.synthetic.photograph(calibration.cameras[0], dp.Chessboard(), seed=0)


@pytest.fixture(scope="module")
def file(calibration: dp.Calibration, photograph: torch.Tensor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "measure.html"
    dp.write_measuring_page(path, photograph, calibration, view=0, unit="mm")
    return path


@pytest.fixture
def opened(chromium: Any) -> Iterator[Callable[..., Page]]:
    """Open a page from disk; the test fails where it says anything on the console, or asks the network for anything."""
    said: list[str] = []
    asked: list[str] = []
    contexts = []

    def open_page(path: Path, width: int = 1280, height: int = 900, **options: Any) -> Page:
        context = chromium.new_context(viewport={"width": width, "height": height}, offline=True, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("dialog", lambda dialog: (said.append(f"dialog {dialog.message}"), dialog.dismiss()))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_function(
            "document.getElementById('m-cursor').textContent && document.getElementById('m-plane').length"
        )
        page.wait_for_timeout(100)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not said
    assert not [url for url in asked if not url.startswith(("file:", "data:"))]


def place(page: Page, u: float, v: float) -> tuple[float, float]:
    """Where a pixel of the photograph is on the screen, while all of it is shown."""
    box = page.locator("#m-photo").bounding_box()
    scale = min(box["width"] / SIZE[0], box["height"] / SIZE[1])
    left, top = ((box[side] - size * scale) / 2 for side, size in zip(("width", "height"), SIZE, strict=True))
    return box["x"] + left + (u + 0.5) * scale, box["y"] + top + (v + 0.5) * scale


def click(page: Page, *pixels: tuple[float, float]) -> None:
    for pixel in pixels:
        page.mouse.click(*place(page, *pixel))


def quantities(page: Page) -> dict[str, list[float]]:
    """What the table holds, to all digits: value, deviation, and the 95 % interval."""
    read = "cells => cells.map(({ dataset: d }) => [d.what, ['value', 'deviation', 'low', 'high'].map((name) => Number(d[name]))])"
    return dict(page.locator("#m-measures .m-quantity").evaluate_all(read))


def points(page: Page) -> torch.Tensor:
    read = (
        "rows => rows.map((row) => [...row.querySelectorAll('input[type=number]')].map((input) => Number(input.value)))"
    )
    return torch.tensor(page.locator("#m-points tbody tr").evaluate_all(read), dtype=D)


def clipped(page: Page) -> str:
    return page.evaluate("navigator.clipboard.readText()")


def taken(page: Page) -> dict[str, Any]:
    """What is copied as JSON."""
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.locator("#m-copy-json").click()
    page.locator("#m-copied", has_text="Copied as JSON").wait_for()
    return json.loads(clipped(page))


def agrees(found: list[float], quantity: dp.Quantity, factor: float = 1.0) -> None:
    wanted = torch.stack([quantity.value, quantity.deviation, *quantity.interval()], dim=-1)[0] * factor
    torch.testing.assert_close(torch.tensor(found, dtype=D), wanted, rtol=1e-6, atol=1e-6)


def test_a_squares_side_is_measured_by_two_clicks(
    file: Path, calibration: dp.Calibration, opened: Callable[..., Page]
) -> None:
    """The third of the three clicks that it may take would be that on the tool, which is there at the start."""
    page = opened(file)
    corners = calibration.views.pixels[0, [0, 1]]
    click(page, *[tuple(corner) for corner in corners.tolist()])
    value = page.locator("#m-value").inner_text()
    assert value.endswith(" mm")
    assert " ± " in value
    assert float(value.split(" ")[0]) == pytest.approx(25.0, abs=1.0)
    assert page.locator("#m-interval").inner_text().startswith("95 %: ")
    clicked = torch.tensor([p["pixel"] for p in pixels_of(taken(page))], dtype=D)
    measured = dp.measure(clicked, calibration, dp.Plane.z(0.0), view=0, pixel_sigma=SIGMA)
    agrees(quantities(page)["length"], measured.lengths())


def pixels_of(document: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        point | {"pixel": [point["u"], point["v"]]} for measure in document["measures"] for point in measure["points"]
    ]


@pytest.mark.slow
def test_clicks_give_the_librarys_numbers(file: Path, calibration: dp.Calibration, opened: Callable[..., Page]) -> None:
    """Lengths, areas with perimeters, angles and points; on the board, over it, and with another noise."""
    page = opened(file)
    click(page, (244, 94), (512, 110))
    page.locator("[data-tool=area]").click()
    click(page, (240, 100), (500, 130), (470, 300), (230, 310))
    page.locator("#m-finish").click()
    page.locator("[data-tool=angle]").click()
    click(page, (120, 90), (320, 240), (560, 400))
    page.locator("[data-tool=point]").click()
    click(page, (600, 40))
    for height, sigma in ((0.0, 0.5), (12.0, 0.5), (-30.0, 0.2)):
        page.locator("#m-height").fill(str(height))
        page.locator("#m-sigma").fill(str(sigma))
        page.locator("#m-sigma").press("Enter")
        document = taken(page)
        towards = -1.0  # the board's z points away from the camera
        assert document["plane"]["offset"] == towards * height
        rows = pixels_of(document)
        clicked = torch.tensor([row["pixel"] for row in rows], dtype=D)
        measured = dp.measure(clicked, calibration, dp.Plane.z(towards * height), view=0, pixel_sigma=sigma)
        found = torch.tensor([[row[axis] for axis in "xyz"] for row in rows], dtype=D)
        torch.testing.assert_close(found, measured.points, rtol=1e-6, atol=1e-6)
        deviations = torch.tensor([[row[f"{axis}_deviation"] for axis in "xyz"] for row in rows], dtype=D)
        torch.testing.assert_close(deviations, measured.deviations, rtol=1e-6, atol=1e-6)
        assert [row["extrapolated"] for row in rows] == measured.extrapolated.tolist()
        seen = quantities(page)
        agrees(seen["length"], measured.lengths([[0, 1]]))
        agrees(seen["area"], measured.area([2, 3, 4, 5]))
        agrees(seen["angle"], measured.angles([[6, 7, 8]]), 180 / torch.pi)
        way = measured.quantity(lambda p: (p.roll(-1, 0) - p).norm(dim=-1).sum(), [[2, 3, 4, 5]])
        agrees(seen["perimeter"], way)


@pytest.mark.slow
def test_a_hand_can_do_everything_with_keys_alone(file: Path, opened: Callable[..., Page]) -> None:
    page = opened(file)
    page.locator("#m-photo").focus()
    middle = page.evaluate("(document.activeElement.id)")
    assert middle == "m-photo"
    keys = page.keyboard
    keys.press("ArrowRight")
    keys.press("Enter")
    for key in ("Shift+ArrowRight", "Shift+ArrowDown", "ArrowLeft", "Alt+ArrowUp"):
        keys.press(key)
    keys.press("Enter")
    first, second = points(page)
    torch.testing.assert_close(second - first, torch.tensor([19.0, 19.9], dtype=D))
    assert " mm" in page.locator("#m-value").inner_text()
    keys.press("n")
    keys.press("ArrowRight")
    keys.press("Alt+ArrowDown")
    torch.testing.assert_close(points(page)[0] - first, torch.tensor([0.1, 0.01], dtype=D))
    keys.press("Control+z")
    keys.press("Control+z")
    torch.testing.assert_close(points(page)[0], first)
    keys.press("Control+y")
    torch.testing.assert_close(points(page)[0] - first, torch.tensor([0.1, 0.0], dtype=D))
    keys.press("Escape")
    keys.press("a")
    for key in ("Shift+ArrowUp", "Shift+ArrowLeft", "Shift+ArrowDown"):
        keys.press(key)
        keys.press("Enter")
    keys.press("f")
    assert set(quantities(page)) == {"length", "area", "perimeter"}
    keys.press("b")
    keys.press("Delete")
    assert set(quantities(page)) == {"length"}
    assert page.locator("#m-spoken").inner_text()
    for _ in range(40):  # the way with the tabulator goes past all controls, each of which shows its focus
        keys.press("Tab")
        outlined = page.evaluate(
            "document.activeElement === document.body || getComputedStyle(document.activeElement).outlineStyle !== 'none'"
        )
        assert outlined


@pytest.mark.slow
@pytest.mark.parametrize("width", [320, 768, 1280, 2560])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_every_screen(file: Path, width: int, scheme: str, opened: Callable[..., Page]) -> None:
    page = opened(file, width, 800, color_scheme=scheme)
    click(page, (244, 94), (512, 110))
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert " ± " in page.locator("#m-value").inner_text()
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, paper[4:-1].split(","))) < 3 * 100) is (scheme == "dark")
    box = page.locator("#m-photo").bounding_box()
    assert box["width"] >= 0.5 * width
    assert box["height"] <= 0.8 * 800


@pytest.mark.slow
def test_where_scripts_do_not_run_it_says_so(file: Path, chromium: Any) -> None:
    for runs in (False, True):
        context = chromium.new_context(java_script_enabled=runs, offline=True)
        page = context.new_page()
        page.goto(file.as_uri())
        assert ("Measuring takes JavaScript, which does not run here" in page.locator("body").inner_text()) != runs
        context.close()


def test_points_are_dragged_zoomed_named_and_deleted(file: Path, opened: Callable[..., Page]) -> None:
    page = opened(file)
    click(page, (244, 94), (512, 110))
    before = points(page)
    start, end = place(page, *before[1].tolist()), place(page, 400, 200)
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=4)
    page.mouse.up()
    torch.testing.assert_close(points(page)[1], torch.tensor([400.0, 200.0], dtype=D), atol=0.1, rtol=0)
    torch.testing.assert_close(points(page)[0], before[0])
    page.mouse.move(*place(page, 300, 300))
    page.mouse.wheel(0, -300)
    page.mouse.down()
    page.mouse.move(place(page, 300, 300)[0] + 60, place(page, 300, 300)[1] + 30)
    page.mouse.up()
    assert len(points(page)) == 2  # the drag put none
    page.locator("#m-fit").click()
    name = page.get_by_label("Name of Length 1")
    name.fill(HOSTILE[:280])
    name.press("Enter")
    assert page.locator("#m-what").inner_text().startswith("\"'><script>")
    page.get_by_label("Delete point B").click()
    assert page.locator("#m-points tbody tr").count() == 0
    page.locator("#m-undo").click()
    assert len(points(page)) == 2
    field = page.get_by_label("u of A")
    field.fill("250.25")
    field.press("Enter")
    assert points(page)[0, 0] == 250.25


@pytest.mark.slow
def test_hostile_names_are_text(
    calibration: dp.Calibration, photograph: torch.Tensor, tmp_path: Path, opened: Callable[..., Page]
) -> None:
    """In the page, and in the table for spreadsheets, which would run a formula."""
    from diffproj.report.document import document
    from diffproj.report.measuring import measuring_part

    part = measuring_part(photograph, calibration, view=0, unit="<b>", name=HOSTILE)
    (tmp_path / "hostile.html").write_text(document(part.title, [part]), encoding="utf-8")
    page = opened(tmp_path / "hostile.html")
    click(page, (244, 94), (512, 110))
    assert page.locator("h1").inner_text().startswith("Measure in \"'><script>alert(1)</script>")
    assert page.locator("#measuring script, #measuring b, #measuring [onerror]").count() == 0
    assert page.locator("#m-value").inner_text().endswith("<b>")
    name = page.get_by_label("Name of point A")
    name.fill('=HYPERLINK("x")')
    name.press("Enter")
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.locator("#m-copy-csv").click()
    page.locator("#m-copied", has_text="Copied as CSV").wait_for()
    rows = list(csv.DictReader(io.StringIO(clipped(page))))
    assert [row["row"] for row in rows] == ["length", '\'=HYPERLINK("x")', "B"]
    assert float(rows[0]["value"]) == quantities(page)["length"][0]
    policy = page.locator("meta[http-equiv='Content-Security-Policy']").get_attribute("content")
    assert policy.startswith("default-src 'none'")
    assert "unsafe-inline" not in policy


@pytest.mark.slow
def test_beyond_the_horizon_and_the_lens_it_says_so(
    photograph: torch.Tensor, tmp_path: Path, opened: Callable[..., Page]
) -> None:
    """A camera that looks to the horizon, through a lens that ends inside of its picture."""
    lens = dp.BrownConrady(torch.tensor([-0.5, 0.0, 0.0, 0.0], dtype=D))
    K = torch.tensor([[330.0, 0, 320], [0, 330, 240], [0, 0, 1]], dtype=D)
    camera, floor = dp.Camera(K, distortion=lens, size=SIZE), dp.Plane([0.0, 1.0, 0.0], 1.5)
    dp.write_measuring_page(tmp_path / "road.html", photograph, camera, floor, unit="m")
    page = opened(tmp_path / "road.html")
    for pixel, text in (((320, 100), "beyond the horizon"), ((630, 470), "outside the lens"), ((320, 330), "z 5.")):
        page.mouse.move(*place(page, *pixel))
        assert text in page.locator("#m-cursor").inner_text()
    click(page, (320, 330), (320, 100))
    assert "beyond the horizon" in page.locator("#m-note").inner_text()
    assert page.locator("#m-value").inner_text() == "\u2013"
    assert "the camera came without its uncertainty" in page.locator("#m-facts").inner_text()
    option = page.locator("#m-plane option").all_inner_texts()
    assert option == ["the given plane, y = 1.5", "the plane, z = 0"]
    page.locator("#m-plane").select_option("1")
    page.mouse.move(*place(page, 320, 331))
    assert "the camera itself lies in the plane" in page.locator("#m-cursor").inner_text()
    assert page.locator("#m-plan-text").inner_text() == "The camera sees nothing of this plane."


@pytest.mark.slow
def test_large_photographs_are_reduced_but_not_their_coordinates(
    calibration: dp.Calibration, photograph: torch.Tensor, tmp_path: Path, opened: Callable[..., Page]
) -> None:
    large = torch.nn.functional.interpolate(photograph.to(torch.float32)[None, None] / 255, scale_factor=5)[0, 0]
    camera = calibration.cameras[0]
    K = camera.K.clone()
    K[:2, :2] *= 5
    K[:2, 2] = 5 * K[:2, 2] + 2
    scaled = dp.Camera(K, camera.R, camera.t, camera.distortion, (3200, 2400))
    path = tmp_path / "large.html"
    dp.write_measuring_page(path, large, scaled, unit="mm")
    page = opened(path)
    assert "It is shown from 2400 \u00d7 1800 px" in page.locator("#m-facts").inner_text()
    click(page, (244, 94), (512, 110))
    expected = torch.tensor([[244.0, 94], [512, 110]], dtype=D) * 5 + 2
    torch.testing.assert_close(points(page), expected, atol=2.0, rtol=0)
    assert path.stat().st_size < 5_000_000


@pytest.mark.slow
def test_fingers_put_points_and_pinch(file: Path, opened: Callable[..., Page]) -> None:
    page = opened(file, 390, 800, has_touch=True)
    for pixel in ((244, 94), (512, 110)):
        page.touchscreen.tap(*place(page, *pixel))
    assert " ± " in page.locator("#m-value").inner_text()
    before = page.evaluate("document.getElementById('m-photo').toDataURL().length")
    x, y = place(page, 320, 240)
    tools = page.context.new_cdp_session(page)

    def touch(kind: str, *apart: float) -> None:
        spots = [{"x": x + side, "y": y, "id": n} for n, side in enumerate(apart)]
        tools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": spots})

    touch("touchStart", -20)
    touch("touchStart", -20, 20)
    touch("touchMove", -60, 60)
    touch("touchEnd")
    page.wait_for_timeout(100)
    assert page.evaluate("document.getElementById('m-photo').toDataURL().length") != before
    assert len(points(page)) == 2


def test_a_reports_tables_fit_on_a_telephone(calibration: dp.Calibration, chromium: Any, tmp_path: Path) -> None:
    """How well one measures, the table that most look for, was cut off on the right where no unit was known."""
    path = tmp_path / "report.html"
    dp.write_report(path, calibration, folds=3)
    page = chromium.new_page(viewport={"width": 390, "height": 844}, offline=True)
    page.goto(path.as_uri())
    tables = page.locator(".scroll:visible").evaluate_all("all => all.map((one) => [one.scrollWidth, one.clientWidth])")
    page.close()
    assert len(tables) >= 3
    assert all(needed <= there for needed, there in tables)
