"""A prior that the views contradict is told by its name, and a right one is not."""

import pytest
import torch

import diffproj as dp

VIEWS, BOARD = dp.example_views("left"), dp.Chessboard()


@pytest.fixture(scope="module")
def alone():
    return dp.calibrate(VIEWS, BOARD)


@pytest.mark.parametrize(
    "priors",
    [
        {"focal": (600.0, 1.0)},
        {"c_x": (319.5, 0.5)},
        {"k1": (0.0, 0.001)},
        {"focal": (600.0, 1.0), "c_x": (342.0, 1.0)},
    ],
    ids=lambda priors: " and ".join(priors),
)
def test_a_wrong_prior_is_named_and_not_another_lens(priors, alone):
    """Beside a right one, too. The views of the bundled camera tell a focal length of 536 and c_x 342.4."""
    found = dp.calibrate(VIEWS, BOARD, priors=priors)
    name = next(iter(priors))
    wanted = ("f_x", "f_y") if name == "focal" else (name,)
    assert any(f"the views contradict the prior on {one}: they tell" in found.remarks[0] for one in wanted)
    assert "another lens" not in found.remarks[0]
    assert str(found.verdict).startswith("Weak: the views contradict the prior on")
    assert "Next: first another look at the prior" in str(found.verdict)
    told = float(found.remarks[0].partition("they tell ")[2].split()[0])
    meant = dict(zip(alone.parameters.names, alone.shared.tolist(), strict=True))
    assert any(abs(told - meant[one]) < 0.1 * abs(meant[one]) for one in wanted)


def test_what_the_views_tell_is_near_the_calibration_without_the_prior(alone):
    """To first order: of a prior that is 2 % off, to a tenth of that."""
    f_x = float(alone.camera.K[0, 0])
    found = dp.calibrate(VIEWS, BOARD, priors={"focal": (1.02 * f_x, 0.5)}, tied_focal=True)
    told = float(found.remarks[0].partition("they tell ")[2].split()[0])
    assert told == pytest.approx(f_x, rel=0.002)


def test_right_priors_are_left_alone(alone):
    """Drawn about the values of all views, for subsets of the real ones; 117 simulated cameras had none, either."""
    generator = torch.Generator().manual_seed(1)
    values = dict(zip(alone.parameters.names, alone.shared, strict=True))
    for count in (3, 5, 8):
        priors = {}
        for name, sigma in (("f_x", 1.5), ("c_x", 2.0), ("c_y", 2.0), ("k1", 0.01)):
            off = sigma * torch.randn((), generator=generator, dtype=torch.float64)
            priors[name] = (values[name] + off, sigma)
        found = dp.calibrate(VIEWS[:count], BOARD, priors=priors, throw=False)
        assert "contradict" not in found.remarks[0]


@pytest.mark.parametrize(
    "options",
    [{"shape": "bow"}, {"pixel_sigma": 0.15}, {"loss": dp.Huber(0.3)}, {"reject_outliers": True}],
    ids=lambda options: next(iter(options)),
)
def test_it_is_told_whatever_else_is_asked_for(options, alone):
    focal = torch.stack([alone.camera.K[0, 0], alone.camera.K[1, 1]])
    right = dp.calibrate(VIEWS, BOARD, priors={"focal": (focal, 2.0)}, throw=False, **options)
    assert "contradict the prior" not in " ".join(right.remarks)
    wrong = dp.calibrate(VIEWS, BOARD, priors={"focal": (600.0, 1.0)}, throw=False, **options)
    assert "the views contradict the prior on f_" in wrong.remarks[0]


def test_free_points_and_the_plane_objective_are_not_asked():
    """Nothing is said of them, and nothing fails."""
    for options in ({"shape": "free"}, {"objective": "plane"}):
        found = dp.calibrate(VIEWS, BOARD, priors={"focal": (536.0, 3.0)}, throw=False, **options)
        assert "contradict" not in found.remarks[0]


def test_a_prior_that_the_views_say_nothing_of_is_not_contradicted():
    """One view with the principal point held by a prior: nothing tells that it is elsewhere."""
    found = dp.calibrate(
        VIEWS[:1], BOARD, "none", priors={"c_x": (300.0, 1.0), "c_y": (220.0, 1.0)}, tied_focal=True, throw=False
    )
    assert "contradict" not in found.remarks[0]
