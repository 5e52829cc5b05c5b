"""What is known of a rig's cameras beforehand: the minimum, its covariance, and what is refused."""

import math
import re
from typing import Any

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj.calibration.rigs.knowledge import BASELINE, CENTER, ROTATION, KnownPlace
from diffproj.geometry.cayley import turn_between, turned
from tests.calibration.rigs.rig_scenes import Scene, off_truth, rotation, scene

D = torch.float64


@pytest.fixture(scope="module")
def pair() -> Scene:
    return scene(2, 6, missing=0.0, seed=7)


def true_vector(camera: dp.Camera) -> Tensor:
    """The rotation vector of a camera's pose in degrees."""
    w, V = torch.linalg.eig(camera.R)
    axis = torch.nn.functional.normalize(V[:, (w - 1).abs().argmin()].real, dim=0)
    turn = dp.Camera(torch.eye(3, dtype=D), camera.R).R
    sine = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return torch.rad2deg(torch.atan2(sine @ axis, (turn.trace() - 1) / 2)) * axis


def test_omega_between_rotations_is_what_one_is_turned_by() -> None:
    R, omega = rotation(torch.tensor([0.3, -0.5, 1.0], dtype=D)), torch.tensor([0.4, 0.2, -1.1], dtype=D)
    assert torch.allclose(turn_between(R, turned(R, omega)), omega, rtol=1e-12)


@pytest.mark.parametrize("what", [ROTATION, CENTER, BASELINE])
def test_derivatives_of_places_are_those_of_differences(what: str) -> None:
    """Far from the mean, and turned far from where the solver began."""
    base, mean = rotation(torch.tensor([0.2, -0.1, 0.3], dtype=D)), torch.tensor([1.0, 2.0, -3.0], dtype=D)
    known = {ROTATION: rotation(torch.tensor([0.1, 0.5, -0.2], dtype=D)), CENTER: mean, BASELINE: mean[:1]}[what]
    deviation = torch.tensor([0.1, 0.2, 0.3], dtype=D)[: len(mean[:1]) if what == BASELINE else 3]
    place = KnownPlace(1, what, 0, known, deviation)
    at = torch.tensor([0.3, -0.4, 0.2, 5.0, -6.0, 7.0], dtype=D)

    def off(pose: Tensor) -> Tensor:
        return place.rows(turned(base, pose[:3]), pose[3:], pose[:3])[0]

    _, slope = place.rows(turned(base, at[:3]), at[3:], at[:3])
    assert torch.allclose(slope, torch.autograd.functional.jacobian(off, at), rtol=1e-9, atol=1e-12)


def told(cameras: dict[str, dp.Camera], what: str) -> Tensor:
    """What a prior of that name is on."""
    owner, _, own = what.rpartition(".")
    if own in (BASELINE, CENTER, ROTATION):
        camera = cameras[owner]
        return {BASELINE: camera.center.norm(), CENTER: camera.center, ROTATION: true_vector(camera)}[own]
    values = []
    for name, camera in cameras.items():
        if owner in ("", name):
            lens = camera.distortion.coefficients  # type: ignore[union-attr]
            values.append({"focal": camera.K[[0, 1], [0, 1]], "principal_point": camera.K[:2, 2], "k1": lens[:1]}[own])
    return torch.cat(values)


@pytest.mark.parametrize(
    ("what", "off", "close", "weights"),
    [
        ("cam1.baseline", 2.0, 1e-3, None),
        ("cam1.center", 2.0, 1e-3, 25.0),
        ("cam1.rotation", 0.1, 1e-5, None),
        ("cam0.focal", 3.0, 1e-3, 25.0),
        ("cam1.principal_point", 3.0, 1e-3, None),
        ("cam0.k1", 0.005, 1e-7, None),
    ],
)
def test_a_sure_prior_is_what_comes_out_and_an_unsure_one_nothing(
    pair: Scene, what: str, off: float, close: float, weights: float | None
) -> None:
    mean = told(pair.cameras, what) + off
    sure = dp.calibrate_rig(pair.views, pair.board, weights=weights, priors={what: (mean, close)})
    assert torch.allclose(told(sure.cameras, what), mean, rtol=0, atol=0.02 * off)
    free = dp.calibrate_rig(pair.views, pair.board, weights=weights)
    unsure = dp.calibrate_rig(pair.views, pair.board, weights=weights, priors={what: (mean, 1e6)})
    assert torch.allclose(unsure.cameras["cam1"].t, free.cameras["cam1"].t, rtol=0, atol=2e-3)  # mm
    spread = free.covariance.shared.diagonal().sqrt()
    assert (
        float(((unsure.covariance.shared - free.covariance.shared) / spread / spread.unsqueeze(-1)).abs().amax()) < 1e-4
    )
    one, other = (float(rig["cam1"].degrees_of_freedom) for rig in (free, unsure))  # type: ignore[arg-type]
    assert one == pytest.approx(other, abs=1e-6)


def test_a_prior_so_sure_is_as_good_as_held(pair: Scene) -> None:
    """The camera's lens and its place held, and known to a hair about the same values: the same rig, the same covariance."""
    known, start = pair.cameras, {"cam1.distortion": 1e-9, "cam1.center": 1e-6, "cam1.rotation": 1e-8}
    held = dp.calibrate_rig(pair.views, pair.board, cameras=known, fixed=("cam1.distortion", "cam1.pose"))
    sure = dp.calibrate_rig(pair.views, pair.board, cameras=known, priors=start)
    assert torch.allclose(sure.cameras["cam0"].K, held.cameras["cam0"].K, rtol=1e-6)
    for name in sure.names:
        one, other = (rig[name].covariance.deviations for rig in (sure, held))
        assert float(one["f_x"]) == pytest.approx(float(other["f_x"]), rel=1e-4)
        freedom = [float(rig[name].degrees_of_freedom) for rig in (sure, held)]  # type: ignore[arg-type]
        assert freedom[0] == pytest.approx(freedom[1], abs=0.01)


def test_what_is_said_of_one_camera_counts_before_what_is_said_of_all(pair: Scene) -> None:
    priors = {"cam1.k1": (-0.18, 1e-6), "k1": (-0.21, 1e-6)}
    rig = dp.calibrate_rig(pair.views, pair.board, priors=priors, throw=False)
    for name, k1 in (("cam0", -0.21), ("cam1", -0.18)):
        lens = rig.cameras[name].distortion
        found = float(lens.coefficients[0])  # type: ignore[union-attr]
        assert found == pytest.approx(k1, abs=1e-4)


@pytest.mark.parametrize("options", [{"shape": "bow"}, {"shape": "free", "priors": {"points": 0.1}}])
def test_it_goes_along_with_a_shape(pair: Scene, options: dict[str, Any]) -> None:
    mean = pair.cameras["cam1"].center.norm()
    priors = options.get("priors", {}) | {"cam1.baseline": (mean, 0.01)}
    rig = dp.calibrate_rig(pair.views, pair.board, **options | {"priors": priors})
    length, deviation = rig.baseline("cam0", "cam1")
    assert length == pytest.approx(float(mean), abs=0.02)
    assert deviation == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize(
    ("what", "off", "deviation", "shape", "says"),
    [
        ("cam1.baseline", 30.0, 0.1, "flat", r"cam1\.baseline: they tell (\S+) ± (\S+), and it says"),
        ("cam1.center", 30.0, 0.1, "flat", r"cam1\.center: they tell \S+ ± \S+ along [xyz], and it says"),
        ("cam1.rotation", 3.0, 0.01, "flat", r"cam1\.rotation: they tell \S+ ± \S+ degrees about [xyz] off it, and"),
        ("cam0.focal", 50.0, 0.1, "bow", r"cam0\.f_[xy]: they tell \S+ ± \S+, and it says"),
    ],
)
def test_a_prior_that_the_views_contradict_is_named(
    pair: Scene, what: str, off: float, deviation: float, shape: Any, says: str
) -> None:
    """It bends the rig towards it, whose deviations do not tell: a remark says what the views tell by themselves."""
    mean = told(pair.cameras, what)
    wrong, right = (
        dp.calibrate_rig(pair.views, pair.board, shape=shape, priors={what: (mean + shift, deviation)})
        for shift in (off, 0.0)
    )
    said = [remark for remark in wrong.remarks if remark.startswith("the views contradict the prior on ")]
    assert len(said) == 1, wrong.remarks
    match = re.search(says, said[0])
    assert match is not None, said
    assert not any("contradict" in remark for remark in right.remarks)
    if match.groups():
        length, spread = dp.calibrate_rig(pair.views, pair.board, shape=shape).baseline("cam0", "cam1")
        assert float(match[1]) == pytest.approx(length, abs=spread)  # found 0.75 of that
        assert float(match[2]) == pytest.approx(spread, rel=0.5)  # found 4.5 and 3.2


def test_where_there_is_no_rig_the_priors_are_asked_for(pair: Scene) -> None:
    """One number for all of a centre is easily said in the place of a distance."""
    length = float(pair.cameras["cam1"].center.norm())
    with pytest.raises(dp.CalibrationError, match="no rig explains .*: are the priors right, do the moments fit"):
        dp.calibrate_rig(pair.views, pair.board, priors={"cam1.center": (-5 * length, 0.01)})


def known(true: Scene, seed: int) -> dict[str, Any]:
    """What is measured beforehand of a pair, with errors as large as is said: a little of each kind."""
    draw = torch.Generator().manual_seed(seed)

    def off(deviation: float, count: int) -> Tensor:
        return deviation * torch.randn(count, generator=draw, dtype=D)

    left, right = true.cameras["cam0"], true.cameras["cam1"]
    turn = true_vector(dp.Camera(right.K, turned(right.R, off(math.radians(0.02), 3))))
    return {
        "cam0.focal": (left.K[[0, 1], [0, 1]] + off(1.0, 2), 1.0),
        "cam1.principal_point": (right.K[:2, 2] + off(1.0, 2), 1.0),
        "cam1.baseline": (right.center.norm() + off(0.3, 1), 0.3),
        "cam1.rotation": (turn, 0.02),
    }


@pytest.mark.slow
@pytest.mark.parametrize("weights", [None, 25.0])
def test_errors_are_what_the_covariance_says(weights: float | None) -> None:
    """Measured over 50 rigs of six moments, a kind of prior alone or all together: squares over variance 0.83 to 1.2."""
    squares: dict[str, list[float]] = {"place": [], "baseline": [], "f_x": [], "c_x": []}
    for seed in range(40):
        true = scene(2, 6, missing=0.0, seed=1000 + seed)
        rig = dp.calibrate_rig(true.views, true.board, weights=weights, priors=known(true, seed))
        assert not any("contradict the prior" in remark for remark in rig.remarks)
        off, C = off_truth(rig, true, "cam1"), rig.place_covariance("cam1")
        squares["place"].append(float(off @ torch.linalg.solve(C, off)) / 6)
        length, deviation = rig.baseline("cam0", "cam1")
        squares["baseline"].append(((length - float(true.cameras["cam1"].center.norm())) / deviation) ** 2)
        for name in rig.names:
            spread, apart = rig[name].covariance.deviations, rig.cameras[name].K - true.cameras[name].K
            squares["f_x"].append(float(apart[0, 0] / spread["f_x"]) ** 2)
            squares["c_x"].append(float(apart[0, 2] / spread["c_x"]) ** 2)
    for what, limit in {"place": 0.25, "baseline": 0.5, "f_x": 0.4, "c_x": 0.4}.items():
        assert sum(squares[what]) / len(squares[what]) == pytest.approx(1, abs=limit), what


@pytest.mark.parametrize(
    ("priors", "options", "message"),
    [
        ({"k9": 1.0}, {}, r"priors: want 'points', or names from rotation, center, baseline, .* got 'k9'"),
        ({"cam0.baseline": (1.0, 1.0)}, {}, "got 'cam0.baseline'; the first camera's place is the rig's frame"),
        ({"cam1.baseline": 1.0}, {}, r"want \(mean, deviation\) for 'cam1.baseline', or cameras= with it"),
        ({"cam1.baseline": (-3.0, 1.0)}, {}, "want a distance from the first camera, more than 0"),
        ({"cam1.center": ((1.0, 2.0), 1.0)}, {}, r"want 'cam1.center' to broadcast to \(3,\), got \(2,\)"),
        ({"cam1.center": (1.0, math.nan)}, {}, "want finite numbers for 'cam1.center', got nan"),
        ({"cam1.rotation": (0.0, 0.0)}, {}, "want a positive standard deviation for 'cam1.rotation', got 0.0"),
        ({"cam1.focal": 1.0}, {}, r"want \(mean, deviation\) with a finite mean for 'cam1.focal'"),
        ({"cam1.k1": -1.0}, {}, "want a positive standard deviation for 'cam1.k1', got -1.0"),
        ({"k1": 0.1}, {"fixed": ("cam1.k1",)}, "fixed: want what has no prior, got 'cam1.k1', also in priors"),
        ({"cam1.baseline": (1.0, 1.0)}, {"fixed": ("rig",)}, "fixed: want what has no prior, got 'cam1.omega_x'"),
    ],
)
def test_what_cannot_be_is_refused(pair: Scene, priors: dict[str, Any], options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dp.calibrate_rig(pair.views, pair.board, priors=priors, **options)


def test_a_camera_whose_name_begins_as_anothers_has_its_own_priors_and_fixed_parameters(pair: Scene) -> None:
    """As `front` and `front.wide`: a dot in a name is no end of it."""
    names = dict(zip(pair.views, ("front", "front.wide"), strict=True))
    views = {names[name]: one for name, one in pair.views.items()}
    cameras = {names[name]: one for name, one in pair.cameras.items()}
    mean = float(pair.cameras["cam1"].center.norm()) + 1.0
    rig = dp.calibrate_rig(views, pair.board, priors={"front.wide.baseline": (mean, 1e-3)})
    assert rig.baseline("front", "front.wide").length == pytest.approx(mean, abs=0.01)
    held = dp.calibrate_rig(views, pair.board, cameras=cameras, fixed=("front.wide.k3",))
    parts = [held.cameras[name].distortion.coefficients for name in cameras]  # type: ignore[union-attr]
    true = [one.distortion.coefficients for one in cameras.values()]  # type: ignore[union-attr]
    assert [float(one[4]) == float(other[4]) for one, other in zip(parts, true, strict=True)] == [False, True]


def test_how_a_prior_weighs_against_a_camera_alone_is_not_said_of_the_rig() -> None:
    """There it weighs against the noise that the corners have, as it should; and there is no `pixel_sigma`."""
    true = scene(3, 16, missing=0.2, seed=5)
    rig = dp.calibrate_rig(true.views, true.board, priors={"focal": (1000.0, 20.0)})
    assert not any("weigh against" in remark or "pixel_sigma" in remark for remark in rig.remarks)
