"""Calibration problems drawn at random, of the kinds in which a wrong minimum was once taken without a word."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

import diffproj as dp
from diffproj.calibration.results.border import border_with_rays
from diffproj.lens.models import MODELS

D = torch.float64
BOARD = dp.Chessboard()
TRIES = 20_000
"""Poses that are tried for each view."""


@dataclass(frozen=True)
class Problems:
    """Some problems of one kind: views `(count, V)` of true cameras `(count, V)`, and how to calibrate them."""

    views: dp.Views
    truth: dp.Camera
    model: str
    options: dict[str, Any]


class Draw:
    """Random numbers from a seed."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=self.generator, dtype=D)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, dtype=D)

    def one_of(self, *choices: Any) -> Any:
        return choices[int(torch.randint(len(choices), (), generator=self.generator))]


def camera_of(f_x: Tensor, f_y: Tensor, c: Tensor, lens: Any, size: tuple[int, int]) -> dp.Camera:
    K = torch.eye(3, dtype=D).repeat(len(f_x), 1, 1)
    K[:, 0, 0], K[:, 1, 1], K[:, :2, 2] = f_x, f_y, c
    return dp.Camera(K, distortion=lens, size=size)


def _photographed(
    draw: Draw,
    camera: dp.Camera,
    views: int,
    fill: tuple[float, float],
    tilt: tuple[float, float],
    noise: float,
    least: int = 12,
    missing: float = 0.0,
    fewest: int | None = None,
    facing: bool = False,
) -> tuple[dp.Views, dp.Camera]:
    """Boards that take up a part of the image's width, anywhere in the image, some of them cut off by its border.

    Args:
        draw: random numbers.
        camera: the true cameras `(count,)`.
        views: of each.
        fill: the board's diagonal over the image's width, seen head on.
        tilt: against the image, or against the line of sight where the boards face it, in degrees.
        noise: of the corners, in px.
        least: corners that are seen of each board.
        missing: the part of the corners that are hidden then.
        fewest: the fewest views that a camera keeps of them; all if left out.
        facing: whether the boards face the camera, as they do where it sees far to its sides.
    """
    points, (width, height) = BOARD.points.to(D), camera.size or (0, 0)
    count = len(camera.K)
    middle, diagonal = points.mean(0), float((points.amax(0) - points.amin(0)).norm())
    R, t = torch.zeros(count, views, 3, 3, dtype=D), torch.zeros(count, views, 3, dtype=D)
    wanting = torch.ones(count, views, dtype=torch.bool)
    many = camera[:, None]
    for _ in range(TRIES):
        where = wanting.nonzero()
        if len(where) == 0:
            break
        n = len(where)
        one = camera[where[:, 0]]
        pixel = draw.uniform(0, 1, n, 1, 2) * torch.tensor([width - 1.0, height - 1.0], dtype=D)
        ray, valid = one.directions(pixel)
        ray = torch.nn.functional.normalize(ray[:, 0], dim=-1)
        towards, lean = draw.uniform(0, 2 * math.pi, n), torch.deg2rad(draw.uniform(*tilt, n))
        leaning = torch.stack([towards.cos() * lean, towards.sin() * lean, torch.zeros_like(lean)], -1)
        roll = torch.nn.functional.pad(draw.uniform(-math.pi, math.pi, n, 1), (2, 0))
        turned = axis_angle_to_rotation_matrix(leaning) @ axis_angle_to_rotation_matrix(roll)
        if facing:
            x, y, z = ray.unbind(-1)
            zero = torch.zeros_like(x)
            turned = dp.rotation_from_euler(-torch.asin(y.clamp(-1, 1)), torch.atan2(x, z), zero) @ turned
        distance = diagonal * one.K[:, 0, 0] / (draw.uniform(*fill, n) * width)
        shift = ray * distance.unsqueeze(-1) - turned @ middle
        seen = one.at(turned, shift)
        pixels, visible = seen.project(points)
        inside = visible & seen.in_image(pixels)
        places = points @ turned.mT + shift.unsqueeze(-2)
        before = ((places * turned[..., 2].unsqueeze(-2)).sum(-1) > 0.02 * distance.unsqueeze(-1)).all(-1)
        in_front = (places[..., 2] > 0.02 * distance.unsqueeze(-1)).all(-1) | torch.full(
            (n,), isinstance(camera.distortion, dp.KannalaBrandt)
        )
        taken = valid[:, 0] & (inside.sum(-1) >= least) & before & in_front
        rows = where[taken]
        R[rows[:, 0], rows[:, 1]], t[rows[:, 0], rows[:, 1]] = turned[taken], shift[taken]
        wanting[rows[:, 0], rows[:, 1]] = False
    assert not bool(wanting.any()), f"no place for a board in {int(wanting.sum())} views; take another seed"
    truth = many.at(R, t)
    pixels, visible = truth.project(points)
    pixels = pixels + noise * draw.normal(*pixels.shape)
    visible = visible & truth.in_image(pixels) & (draw.uniform(0, 1, *visible.shape) >= missing)
    if fewest is not None:
        kept = torch.randint(fewest, views + 1, (count, 1), generator=draw.generator)
        visible = visible & (torch.arange(views) < kept).unsqueeze(-1)
    return dp.Views(pixels, visible, size=camera.size), truth


def _lens(draw: Draw, model: str, wide: Tensor) -> Tensor:
    """Coefficients of a Brown-Conrady lens `(count, n)`, weaker the wider `wide (count,)` the image is."""
    count, number = len(wide), MODELS[model].count
    s = (1 / wide.square()).clamp(max=1).unsqueeze(-1)

    def within(low: float, high: float, n: int = 1) -> Tensor:
        return draw.uniform(low, high, count, n)

    parts = [within(-0.3, 0.15) * s, within(-0.1, 0.1) * s**2, within(-0.002, 0.002, 2) * s]
    if number > 4:
        parts.append(within(-0.02, 0.02) * s**3)
    if number > 5:
        parts += [within(-0.1, 0.1) * s, within(-0.1, 0.1) * s**2, within(-0.1, 0.1) * s**3]
    if number > 8:
        parts.append(within(-0.005, 0.005, 4) * s)
    if number > 12:
        parts.append(within(-0.05, 0.05, 2) * s)
    return torch.cat(parts, -1)


def _legal(f_x: Tensor, f_y: Tensor, c: Tensor, lens: Any, kind: Any, size: tuple[int, int]) -> dp.Camera:
    """The camera, with its lens weakened until it reaches the whole image."""
    for _ in range(12):
        camera = camera_of(f_x, f_y, c, kind(lens), size)
        lost = border_with_rays(camera, size) < 1
        if not bool(lost.any()):
            return camera
        lens = torch.where(lost.unsqueeze(-1), lens * 0.6, lens)
    return camera_of(f_x, f_y, c, kind(torch.where(lost.unsqueeze(-1), 0.0, lens)), size)


def near_middle(draw: Draw, count: int, size: tuple[int, int], part: float = 0.05) -> Tensor:
    full = torch.tensor(size, dtype=D)
    return full / 2 - 0.5 + part * full * draw.uniform(-1, 1, count, 2)


def _usual(count: int, draw: Draw, **settings: Any) -> Problems:
    """640 x 480 px, a lens with barrel distortion, 15 views: the regimes in which views end in their other pose."""
    width = settings.pop("focal", 600 / 640)
    f = 640 * width * draw.uniform(0.8, 1.25, count)
    lens = torch.tensor([-0.25, 0.09, 0.0, 0.0], dtype=D).expand(count, 4) * draw.uniform(0.2, 1, count, 1)
    f_y = f * draw.uniform(0.98, 1.02, count)
    camera = _legal(f, f_y, near_middle(draw, count, (640, 480)), lens, dp.BrownConrady, (640, 480))
    return Problems(*_photographed(draw, camera, **({"views": 15, "noise": 0.3} | settings)), "brown4", {})


def _wrong_corners(count: int, draw: Draw, **options: Any) -> Problems:
    """Ten views in which 1 % or 5 % of the corners are off by up to 60 px."""
    f, size = 600 * draw.uniform(0.8, 1.3, count), (640, 480)
    lens = _lens(draw, "brown5", torch.ones(count, dtype=D))
    camera = _legal(f, f, near_middle(draw, count, size), lens, dp.BrownConrady, size)
    views, truth = _photographed(draw, camera, 10, (0.15, 0.7), (0, 55), 0.2, least=40)
    wrong = draw.uniform(0, 1, *views.visible.shape) < draw.one_of(0.01, 0.05)
    pixels = views.pixels + torch.where(wrong.unsqueeze(-1), draw.uniform(-60, 60, *views.pixels.shape), 0.0)
    return Problems(dp.Views(pixels, views.visible & truth.in_image(pixels), size=size), truth, "brown5", options)


def _telephoto(count: int, draw: Draw) -> Problems:
    size = (1224, 1024)
    f, c = draw.uniform(6000, 15000, count), torch.tensor([611.5, 511.5], dtype=D).expand(count, 2)
    camera = camera_of(f, f, c, dp.BrownConrady(torch.zeros(count, 5, dtype=D)), size)
    return Problems(*_photographed(draw, camera, 12, (0.3, 0.9), (10, 40), 0.2, least=54), "brown5", {})


def _wide(count: int, draw: Draw) -> Problems:
    size, model = (1280, 960), draw.one_of("none", "brown5")
    f = 640 / torch.tan(torch.deg2rad(draw.uniform(140, 165, count) / 2))
    lens = torch.zeros(count, 5, dtype=D)
    lens[:, 0] = 0.0 if model == "none" else draw.uniform(-0.002, 0.01, count)
    camera = _legal(f, f, near_middle(draw, count, size, 0.02), lens, dp.BrownConrady, size)
    return Problems(*_photographed(draw, camera, 8, (0.05, 0.3), (0, 50), 0.2, facing=True), model, {})


def _axis_outside(count: int, draw: Draw) -> Problems:
    """An image cut out of a larger one that does not show the optical axis."""
    size, model = (640, 480), draw.one_of("none", "brown5")
    far = draw.uniform(1, 3, count, 2) * torch.tensor(size, dtype=D)
    c = torch.where(draw.uniform(0, 1, count, 2) < 0.5, -far + torch.tensor(size, dtype=D), far)
    f = draw.uniform(600, 1600, count)
    lens = torch.zeros(count, 5, dtype=D)
    lens[:, 0] = 0.0 if model == "none" else draw.uniform(-0.03, 0.05, count)
    camera = _legal(f, f, c, lens, dp.BrownConrady, size)
    return Problems(*_photographed(draw, camera, 10, (0.15, 0.6), (0, 45), 0.2, facing=True), model, {})


def _random(count: int, draw: Draw, model: str) -> Problems:
    """Cameras of 15 to 165 degrees, images of any shape, some cut out of larger ones, some with pixels not square."""
    shape = math.exp(float(draw.uniform(math.log(0.4), math.log(4))))
    width = int(draw.uniform(500, 2000))
    size = (width, int(width / shape))
    longest = max(size)
    half = torch.deg2rad(draw.uniform(15, 165, count) / 2)
    fisheye = model == "fisheye"
    f = longest / 2 / (half if fisheye else torch.tan(half))
    aspect = (
        draw.uniform(0.97, 1.03, count)
        if draw.one_of(True, True, False)
        else draw.uniform(math.log(0.4), math.log(4), count).exp()
    )
    full = torch.tensor(size, dtype=D)
    crop = torch.where(draw.uniform(0, 1, count, 1) < 0.3, 0.3, 0.03) * draw.uniform(-1, 1, count, 2)
    c = full / 2 - 0.5 + crop * full
    # f is that of the axis on which the angle is largest.
    f_x, f_y = (f, f * aspect) if size[0] >= size[1] else (f / aspect, f)
    if fisheye:
        lens = draw.uniform(-0.05, 0.05, count, 4) * torch.tensor([1, 0.5, 0.2, 0.1], dtype=D)
        camera = _legal(f_x, f_y, c, lens, dp.KannalaBrandt, size)
    else:
        reach = torch.maximum(full[0] / f_x, full[1] / f_y) * 0.7
        camera = _legal(f_x, f_y, c, _lens(draw, model, reach.clamp(min=1)), dp.BrownConrady, size)
    facing = draw.one_of(True, False) or fisheye
    views = _photographed(draw, camera, 15, (0.15, 0.6), (0, 50), 0.2, least=14, fewest=8, facing=facing)
    return Problems(*views, model, {})


def _fisheye(count: int, draw: Draw) -> Problems:
    size = draw.one_of((640, 480), (1280, 960), (1000, 1000))
    f = max(size) / 2 / torch.deg2rad(draw.uniform(60, 200, count) / 2)
    lens = draw.uniform(-0.05, 0.05, count, 4) * torch.tensor([1, 0.5, 0.2, 0.1], dtype=D)
    f_y = f * draw.uniform(0.98, 1.02, count)
    camera = _legal(f, f_y, near_middle(draw, count, size), lens, dp.KannalaBrandt, size)
    return Problems(*_photographed(draw, camera, 12, (0.1, 0.5), (0, 55), 0.2, facing=True), "fisheye", {})


KINDS: dict[str, Callable[[int, Draw], Problems]] = {
    "near": lambda n, draw: _usual(n, draw, fill=(0.1, 0.8), tilt=(0, 60)),
    "far": lambda n, draw: _usual(n, draw, fill=(0.08, 0.2), tilt=(0, 60)),
    "long lens": lambda n, draw: _usual(n, draw, fill=(0.2, 0.8), tilt=(0, 50), focal=3.0),
    "few corners": lambda n, draw: _usual(n, draw, fill=(0.2, 0.8), tilt=(0, 50), least=54, missing=0.85),
    "wrong corners, Huber": lambda n, draw: _wrong_corners(n, draw, loss=dp.Huber(0.5)),
    "wrong corners, rejection": lambda n, draw: _wrong_corners(n, draw, reject_outliers=True),
    "telephoto": _telephoto,
    "wide": _wide,
    "axis outside": _axis_outside,
    **{
        f"any {model}": lambda n, draw, m=model: _random(n, draw, m)
        for model in ("brown5", "brown8", "brown12", "brown14")
    },
    "any fisheye": lambda n, draw: _random(n, draw, "fisheye"),
    "fisheye": _fisheye,
}
