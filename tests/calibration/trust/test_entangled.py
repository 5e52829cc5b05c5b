"""What a lens of many parameters does not tell from the principal point is said, and the error bars hold it."""

from typing import Any

import pytest
import torch

import diffproj as dp
from diffproj import synthetic
from diffproj.calibration.fitting.options import calibration_options
from diffproj.calibration.one_lens import fitted
from diffproj.calibration.trust import entangled

BOARD = dp.Chessboard()
HARDLY = "these views hardly tell"


def off(found: dp.Calibration, simple: dp.Calibration) -> float:
    """How far f and c are from those of a simple lens, in deviations."""
    variance = found.covariance.shared.diagonal(dim1=-2, dim2=-1)[..., :4]
    variance = variance + simple.covariance.shared.diagonal(dim1=-2, dim2=-1)[..., :4]
    return float(((found.shared[..., :4] - simple.shared[..., :4]).abs() / variance.sqrt()).amax())


def test_a_prism_that_moves_the_principal_point() -> None:
    """Without the thin prism c_x is 327 px; with it 280, and its own deviation is 16."""
    views = dp.example_views("right")
    found, simple = dp.calibrate(views, BOARD, "brown12"), dp.calibrate(views, BOARD)
    assert f"{HARDLY} s1, s2, s3, s4 from c_x: without them it is 327." in found.message
    assert "the error bars hold both" in found.summary()
    assert off(found, simple) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("options", [{}, {"skew": True}, {"fixed": ("k4", "k5", "k6")}], ids=["all", "skew", "short"])
def test_a_tilt_that_moves_the_principal_point(side: Any, options: dict[str, Any]) -> None:
    """With tilt and skew the principal point of the left camera was 95 and 112 px off, and said 13 and 12."""
    views = dp.example_views(side)
    found = dp.calibrate(views, BOARD, "brown14", **options)
    assert HARDLY in found.message
    assert off(found, dp.calibrate(views, BOARD)) < 2


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"skew": True}])
def test_of_few_real_views_too(options: dict[str, Any]) -> None:
    """Of 20 subsets of 5 views, f or c of 1 to 9 was beyond 3 deviations without a word, the worst at 15."""
    draw = torch.Generator().manual_seed(5)
    views = dp.example_views("left")
    subsets = torch.stack([torch.randperm(13, generator=draw)[:5] for _ in range(6)])
    several = dp.Views(views.pixels[subsets], views.visible[subsets], size=views.size)
    simple = dp.calibrate(views, BOARD)
    assert off(dp.calibrate(several, BOARD, "brown12", **options), simple) < 3


@pytest.mark.parametrize("lens", ["brown5", "fisheye"])
def test_skew_alone_is_told(lens: Any) -> None:
    found = dp.calibrate(dp.example_views("left"), BOARD, lens, skew=True)
    assert HARDLY not in found.message
    assert off(found, dp.calibrate(dp.example_views("left"), BOARD, lens)) < 1


@pytest.mark.parametrize("poorer", [False, True], ids=["simplest", "poorer"])
def test_of_what_may_be_held_the_first_that_tells(poorer: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without s2 and s4 the camera is the same, without all four another one.

    Where the simplest camera is sought that corners hardly tell from this one, it is the first, and nothing is in doubt;
    where the lens is doubted, whichever moves the principal point.
    """
    some, every = ("s2", "s4"), ("s1", "s2", "s3", "s4")
    for choices in ([some, every], [every, some]):
        monkeypatch.setattr(entangled, "_together", lambda _, choices=choices: [] if poorer else choices)
        monkeypatch.setattr(entangled, "_poorer_lenses", lambda _, choices=choices: choices if poorer else [])
        monkeypatch.setattr(entangled, "_adrift", lambda found: torch.ones_like(found.pixel_sigma(), dtype=torch.bool))
        found = dp.calibrate(dp.example_views("right"), BOARD, "brown12")
        assert (f"{HARDLY} s1, s2, s3, s4 from c_x" in found.message) == (poorer or choices[0] == every)


def test_what_is_held_or_known_is_not_in_doubt() -> None:
    prism = ("s1", "s2", "s3", "s4")
    views = dp.example_views("right")
    assert HARDLY not in dp.calibrate(views, BOARD, "brown12", fixed=prism).message
    known = dict.fromkeys(prism, 1e-4)
    assert HARDLY not in dp.calibrate(views, BOARD, "brown12", priors=known, weights=torch.tensor(30.0)).message


@pytest.mark.slow
def test_the_later_terms_of_a_fisheye_that_sees_little_of_the_field() -> None:
    """Through a long lens they stood for noise, and moved the principal point by up to 7 deviations."""
    K = torch.tensor([[3400.0, 0, 316], [0, 3400, 236], [0, 0, 1]], dtype=torch.float64)
    lens = dp.KannalaBrandt(torch.zeros(4, dtype=torch.float64))
    camera = dp.Camera(K, distortion=lens, size=(640, 480))
    seen = []
    for seed in range(8):
        cameras = synthetic.random_cameras(camera, BOARD, 12, distance=(10, 30), seed=seed)
        seen.append(synthetic.corner_views(cameras, BOARD, noise_px=0.2, seed=seed))
    pixels, visible = (torch.stack([getattr(views, part) for views in seen]) for part in ("pixels", "visible"))
    views = dp.Views(pixels, visible, size=(640, 480))
    found = dp.calibrate(views, BOARD, "fisheye", throw=False)
    simple = dp.calibrate(views, BOARD, "fisheye", throw=False, fixed=("k2", "k3", "k4"))
    assert bool((found.converged & simple.converged).all()), found.message
    assert any(HARDLY in text and "k2, k3, k4 from c_" in text for text in found.remarks)
    assert off(found, simple) < 3


def test_each_family_of_terms_is_doubted_by_itself() -> None:
    """A lens that is decentred may need no more than k1, and one of many radial terms may not be decentred."""
    _, found = fitted(dp.example_views("left"), BOARD, "brown5", calibration_options("calibrate", {}))
    lenses = entangled._poorer_lenses(found)
    assert lenses[0] == ("k1", "k2", "p1", "p2", "k3")  # first no lens at all
    shifts = {"p1", "p2"}
    left = [{"k1", "k2", "k3", "p1", "p2"} - set(held) for held in lenses]
    assert {"k1"} | shifts in left
    assert {"k1", "k2", "k3"} in left


def test_a_long_lens_that_bends_nothing() -> None:
    """Terms that stood for noise moved the principal point by up to 11 deviations, a fifth by more than 3."""
    cameras, seen = [], []
    lens = dp.BrownConrady(torch.tensor([0.1, -0.5, 0, 0, 0], dtype=torch.float64))
    for seed in range(12):
        focal = 8000.0 * 1.15**seed
        K = torch.tensor([[focal, 0, 640], [0, focal, 480], [0, 0, 1]], dtype=torch.float64)
        camera = dp.Camera(K, distortion=lens, size=(1280, 960))
        near = 1.3 * focal / 1280
        posed = synthetic.random_cameras(camera, BOARD, 6, distance=(near, 2 * near), seed=seed)
        cameras.append(camera)
        seen.append(synthetic.corner_views(posed, BOARD, noise_px=0.15, seed=seed))
    pixels, visible = (torch.stack([getattr(views, part) for views in seen]) for part in ("pixels", "visible"))
    found = dp.calibrate(dp.Views(pixels, visible, size=(1280, 960)), BOARD, throw=False)
    names = ("f_x", "f_y", "c_x", "c_y")
    deviations = torch.stack([found.covariance.deviations[name] for name in names], dim=-1)
    truth = torch.stack([torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) for K in (one.K for one in cameras)])
    error = ((found.shared[:, :4] - truth) / deviations)[found.converged]
    assert len(error) > 8
    assert float(error.square().mean().sqrt()) < 1.3
    assert float(error.abs().amax()) < 4
    assert sum(HARDLY in text for text in found.remarks) > 4


def test_a_long_fisheye_whose_terms_pin_the_principal_point() -> None:
    """Without its terms c_y is the same, but known to 45 px; with them it was 3.7 of 21 px off, without a word."""
    K = torch.tensor([[3000.0, 0, 310], [0, 3000, 250], [0, 0, 1]], dtype=torch.float64)
    lens = dp.KannalaBrandt(torch.tensor([0.05, 0, 0, 0], dtype=torch.float64))
    camera = dp.Camera(K, distortion=lens, size=(640, 480))
    cameras = synthetic.random_cameras(camera, BOARD, 8, distance=(7.03125, 17.578125), seed=0)
    views = synthetic.corner_views(cameras, BOARD, noise_px=0.2, seed=0)
    found, simple = dp.calibrate(views, BOARD, "fisheye"), dp.calibrate(views, BOARD, "fisheye", fixed=["distortion"])
    assert f"{HARDLY} k1, k2, k3, k4 from c_y: without them it is known to 4" in found.message
    assert "px, not 2" in found.message
    assert "the error bars hold that" in found.message
    names, truth = ("f_x", "f_y", "c_x", "c_y"), (3000, 3000, 310, 250)
    for i, (name, true) in enumerate(zip(names, truth, strict=True)):
        deviation = float(found.covariance.deviations[name])
        assert deviation > 0.98 * float(simple.covariance.deviations[name])
        assert abs(float(found.shared[i]) - true) < 2.5 * deviation
    eigenvalues = torch.linalg.eigvalsh(found.covariance.shared[:4, :4] - simple.covariance.shared[:4, :4])
    assert float(eigenvalues.min()) > -1e-3  # it holds the other in every direction
