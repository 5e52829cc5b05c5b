"""A rig's board that is bent, and one of which it is known how well it was printed: minimum, covariance, files."""

import pytest
import torch
from torch import Tensor

import diffproj as dp
from diffproj.calibration.problem.bow import bowed
from diffproj.calibration.problem.shape import similarities
from diffproj.geometry.cayley import turned
from diffproj.targets.views import Views

D = torch.float64
BOARD = dp.Chessboard(4, 3, 30.0)
T = torch.tensor([-40.0, 3, 5], dtype=D)
BUNDLED = {name: dp.example_views(name) for name in ("left", "right")}
BOW = torch.tensor([1.5, -0.8], dtype=D)


def scene(points: Tensor, moments: int = 8, noise: float = 0.1, seed: int = 0) -> dict[str, Views]:
    """Two cameras without a lens that see these points at so many moments; `b` misses the first, `a` the last."""
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[[500.0, 0, 320], [0, 510, 240], [0, 0, 1]], [[380, 0, 310], [0, 370, 250], [0, 0, 1]]], dtype=D)
    poses = dp.synthetic.random_cameras(dp.Camera(K[0], size=(640, 480)), BOARD, moments, distance=(1.2, 1.8), seed=3)
    R = dp.rotation_from_euler(*torch.tensor([0.0, 0.1, 0.05], dtype=D))
    other = dp.Camera(K[1], R @ poses.R, (R @ poses.t.unsqueeze(-1)).squeeze(-1) + T)
    views = {}
    for name, camera, seen in (("a", poses, range(moments - 1)), ("b", other, range(1, moments))):
        pixels = camera.project(points)[0] + noise * torch.randn(moments, 12, 2, generator=generator, dtype=D)
        views[name] = Views(pixels[list(seen)], names=[str(i) for i in seen], size=(640, 480))
    return views


def bent() -> Tensor:
    return bowed(BOARD.points.to(D), BOW)


def printed(deviation: float, seed: int) -> Tensor:
    draw = torch.Generator().manual_seed(100 + seed)
    return BOARD.points.to(D) + deviation * torch.randn(12, 3, generator=draw, dtype=D)


class Slow:
    """All residuals of a rig as one vector, counted from what was found; the last of them are the shape's own."""

    def __init__(self, rig: dp.RigCalibration, views: dict[str, Views], root: Tensor) -> None:
        """With `root (k, shape)`: rows whose squares are added to the cost, of displacements of the points."""
        self.rig, self.views, self.root = rig, views, root
        self.moments = {name: torch.tensor([int(view) for view in one.names]) for name, one in views.items()}
        self.count = 2 if rig.shape == "bow" else 36
        self.own = len(root)

    @property
    def found(self) -> Tensor:
        one = self.rig["a"]
        shape = one.bow if one.bow is not None else one.displacements.flatten()  # type: ignore[union-attr]
        intrinsics = torch.cat([self.rig[name].shared[:4] for name in self.views])
        return torch.cat([intrinsics, torch.zeros(6 + 6 * len(self.rig.moments), dtype=D), shape])

    def __call__(self, x: Tensor) -> Tensor:
        K, place, poses = x[:8].unflatten(0, (2, 4)), x[8:14], x[14 : len(x) - self.count].unflatten(0, (-1, 6))
        shape, nominal, errors = x[len(x) - self.count :], BOARD.points.to(D), []
        points = bowed(nominal, shape) if self.rig.shape == "bow" else nominal + shape.unflatten(0, (12, 3))
        X = points @ turned(self.rig.R_target, poses[:, :3]).mT + (self.rig.t_target + poses[:, 3:]).unsqueeze(1)
        for c, name in enumerate(self.views):
            camera = self.rig.cameras[name]
            R, t = (turned(camera.R, place[:3]), camera.t + place[3:]) if c else (camera.R, camera.t)
            seen = X[self.moments[name]] @ R.mT + t
            errors.append((seen[..., :2] / seen[..., 2:] * K[c, :2] + K[c, 2:] - self.views[name].pixels).flatten())
        return torch.cat([*errors, self.root @ shape])

    def minimum(self) -> Tensor:
        """Where Gauss and Newton end, from a start that is a little off."""
        at = self.found.clone()
        at[:14] += torch.tensor([2.0, -1, 1, 0, 1, 1, 0, -2, 0.001, 0, 0, 0.1, 0, 0.1], dtype=D)
        at[-self.count :] = 0.0
        for _ in range(12):
            at = at - torch.linalg.lstsq(torch.func.jacrev(self)(at), self(at).unsqueeze(-1)).solution.squeeze(-1)
        return at


def frame() -> Tensor:
    return 1e3 * similarities(BOARD.points.to(D), torch.zeros(1, 12, dtype=torch.bool))[0].mT


def check_covariance(rig: dp.RigCalibration, slow: Slow, of_prior: Tensor) -> None:
    """Against the sandwich of dense matrices; `of_prior`: the covariance of the scores of a prior."""
    J = torch.func.jacrev(slow)(slow.found)
    rows = J[: len(J) - slow.own]
    inverse = torch.linalg.inv(J.mT @ J)
    halves = [2 * 12 * len(one) for one in slow.views.values()]
    sigma = [float(rig[name].pixel_sigma) for name in slow.views]  # type: ignore[arg-type]
    noise = torch.cat([torch.full((n,), s**2, dtype=D) for n, s in zip(halves, sigma, strict=True)])
    whole = inverse @ (rig.covariance.dispersion * (rows.mT * noise) @ rows + of_prior) @ inverse
    order = [*range(4), *range(4, 14), *range(len(slow.found) - slow.count, len(slow.found))]
    assert torch.allclose(whole[order][:, order], rig.covariance.shared, rtol=1e-4, atol=1e-9)
    for name in rig.names:
        own = rig[name]
        assert own.covariance.names[: len(own.parameters.names)] == own.parameters.names
        assert torch.equal(own.points, rig.points)
        assert torch.allclose(own.points_deviation, rig.points_deviation)


def test_a_bow_has_the_minimum_and_the_covariance_of_the_slow_obvious_way() -> None:
    views = scene(bent())
    rig = dp.calibrate_rig(views, BOARD, "none", shape="bow")
    slow = Slow(rig, views, torch.zeros(0, 2, dtype=D))
    at = slow.minimum()
    assert (at[:8] - slow.found[:8]).abs().max() < 1e-4
    assert (at[-2:] - slow.found[-2:]).abs().max() < 1e-6
    cost = float(slow(at).square().sum())
    assert float(slow(slow.found).square().sum()) == pytest.approx(cost, rel=1e-12)
    assert (slow.found[-2:] - BOW).abs().max() < 0.15
    freedom = sum(float(rig[name].degrees_of_freedom) for name in views)  # type: ignore[arg-type]
    assert freedom == pytest.approx(2 * 12 * 14 - len(slow.found))
    check_covariance(rig, slow, torch.zeros(64, 64, dtype=D))
    assert rig.covariance.names[-2:] == ("bow_x", "bow_y")
    z = rig.points_deviation[:, 2]
    shape = bowed(BOARD.points.to(D), torch.eye(2, dtype=D))[..., 2]
    assert torch.allclose(z.square(), (shape * (rig.covariance.shared[-2:, -2:] @ shape)).sum(0))
    assert "bow along x, y: 1.5" in rig.summary()
    assert "bow_x" not in rig.summary()


def test_exact_corners_give_the_bow_that_there_is() -> None:
    rig = dp.calibrate_rig(scene(bent(), noise=0.0), BOARD, "none", shape="bow")
    assert rig.rms < 1e-8
    assert (rig.points - bent()).abs().max() < 1e-6
    assert (rig.cameras["b"].t - T).abs().max() < 1e-5


def test_cameras_of_unlike_lenses_share_one_bow() -> None:
    views = scene(bent())
    alike = dp.calibrate_rig(views, BOARD, "none", shape="bow")
    held = {"fixed": ("b.distortion",), "shape": "bow"}
    unlike = dp.calibrate_rig(views, BOARD, {"a": "none", "b": "brown4"}, **held)
    assert unlike["a"].bow is not None
    assert torch.allclose(unlike["a"].bow, alike["a"].bow, atol=1e-6)
    assert torch.equal(unlike["b"].bow, unlike["a"].bow)
    assert torch.allclose(unlike.covariance.shared[-2:, -2:], alike.covariance.shared[-2:, -2:], rtol=1e-4)


@pytest.mark.parametrize("weight", [None, 100.0])
def test_a_prior_has_the_minimum_and_the_covariance_of_the_slow_obvious_way(weight: float | None) -> None:
    """With weights it weighs against these, without against the noise that the residuals tell."""
    views = scene(printed(0.2, 0), noise=0.3)
    options = {} if weight is None else {"weights": weight}
    rig = dp.calibrate_rig(views, BOARD, "none", shape="free", priors={"points": 0.2}, **options)
    squares = sum(float(one.residuals.square().sum()) for one in rig.calibrations.values())
    freedom = sum(float(one.degrees_of_freedom) for one in rig.calibrations.values())  # type: ignore[arg-type]
    variance = squares / freedom if weight is None else 1 / weight
    slow = Slow(rig, views, torch.cat([frame(), variance**0.5 / 0.2 * torch.eye(36, dtype=D)]))
    at = slow.minimum()
    assert (at[:8] - slow.found[:8]).abs().max() < 1e-3
    assert (at[-36:] - slow.found[-36:]).abs().max() < 1e-4
    # What the prior tells of a coordinate takes no freedom: the trace of its part of the normal matrix.
    J = torch.func.jacrev(slow)(slow.found)
    inverse = torch.linalg.inv(J.mT @ J)
    told = float((inverse @ (J[-43:].mT @ J[-43:])).trace())
    assert freedom == pytest.approx(2 * 12 * 14 - len(slow.found) + told, rel=1e-6)
    check_covariance(rig, slow, variance * J[-36:].mT @ J[-36:])


def test_a_firm_prior_gives_the_flat_board_and_a_loose_one_free_points() -> None:
    views = scene(printed(0.3, 1))
    flat, free = (dp.calibrate_rig(views, BOARD, "none", shape=shape) for shape in ("flat", "free"))
    firm, loose = (
        dp.calibrate_rig(views, BOARD, "none", shape="free", priors={"points": deviation}) for deviation in (1e-6, 1e4)
    )
    for found, other in ((firm, flat), (loose, free)):
        assert found.rms == pytest.approx(other.rms, rel=1e-6)
        for name in ("a", "b"):
            assert torch.allclose(found.cameras[name].K, other.cameras[name].K, rtol=1e-6)
            assert float(found[name].degrees_of_freedom) == pytest.approx(float(other[name].degrees_of_freedom), 1e-4)  # type: ignore[arg-type]
        assert torch.allclose(found.place_covariance("b"), other.place_covariance("b"), rtol=0.02)
    # In the plane the print may be good, and out of it the paper loose.
    plane = dp.calibrate_rig(views, BOARD, "none", shape="free", priors={"points_x": 1e-6, "points_y": 1e-6})
    moves = plane.points - BOARD.points
    assert moves[:, :2].abs().max() < 1e-6 < 0.1 < moves[:, 2].abs().max()
    each = torch.full((12, 3), 0.3, dtype=D)
    one = dp.calibrate_rig(views, BOARD, "none", shape="free", priors={"points": each})
    assert torch.allclose(
        one.points, dp.calibrate_rig(views, BOARD, "none", shape="free", priors={"points": 0.3}).points
    )


def test_a_prior_makes_few_views_enough() -> None:
    views = {name: one[:2] for name, one in scene(printed(0.1, 2)).items()}
    known = dp.calibrate_rig(scene(printed(0.1, 2)), BOARD, "none")
    options = {"cameras": known, "fixed": ("intrinsics",), "shape": "free"}
    with pytest.raises(dp.CalibrationError, match=r"or say how well the target was printed, such as priors=\{'points'"):
        dp.calibrate_rig(views, BOARD, "none", **options)
    rig = dp.calibrate_rig(views, BOARD, "none", priors={"points": 0.1}, **options)
    assert bool((rig.points_deviation < 0.1001).all())
    assert bool((rig.points_deviation > 0).all())


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["bow", "free"])
def test_errors_scatter_as_the_covariance_says(shape: str) -> None:
    """Squared errors over variances, 60 rigs, of a bow: .92, .98, 1.04; of points with a prior: 1.01, 1.00, 1.02."""
    squares: dict[str, list[Tensor]] = {"focal": [], "place": [], "shape": []}
    for seed in range(30):
        truth = bent() if shape == "bow" else printed(0.2, seed)
        prior = {} if shape == "bow" else {"priors": {"points": 0.2}}
        rig = dp.calibrate_rig(scene(truth, seed=seed), BOARD, "none", shape=shape, **prior)
        size, there = 1.0, truth
        if shape == "free":  # the printed board in the frame, and at the size, that the target's points have
            a, b = (points - points.mean(0) for points in (BOARD.points.to(D), truth))
            U, S, Vh = torch.linalg.svd(a.mT @ b)
            size = float(S.sum() / a.square().sum())
            there = b @ (U @ Vh).mT / size + BOARD.points.to(D).mean(0)
        told = rig.points_deviation > 1e-9
        squares["shape"].append(((rig.points - there)[told] / rig.points_deviation[told]).square())
        spread = rig.covariance.deviations
        off = torch.stack([rig[name].camera.K[0, 0] for name in ("a", "b")]) - torch.tensor([500.0, 380], dtype=D)
        squares["focal"].append((off / torch.stack([spread[f"{name}.f_x"] for name in ("a", "b")])).square())
        squares["place"].append((rig.cameras["b"].t - T / size).square() / rig.place_covariance("b").diagonal()[3:])
    for name, found in squares.items():
        assert 0.6 < torch.cat(found).mean() < 1.3, name


def test_the_bundled_pair() -> None:
    """The bow that both cameras see; flat: .1732 px."""
    rig = dp.calibrate_rig(BUNDLED, dp.Chessboard(), shape="bow")
    assert rig.rms == pytest.approx(0.1640, abs=2e-4)
    assert rig["left"].bow is not None
    assert torch.allclose(rig["left"].bow, torch.tensor([0.040, -0.171], dtype=D), atol=0.01)
    assert rig.baseline("left", "right").length == pytest.approx(83.15, abs=0.05)
    known = dp.calibrate_rig(BUNDLED, dp.Chessboard(), shape="free", priors={"points": 0.1})
    assert known.rms == pytest.approx(0.0917, abs=2e-3)
    located = dp.locate(BUNDLED["left"][10:], dp.Chessboard(), rig["left"])
    assert located.shape == "bow"


@pytest.mark.slow
def test_held_out_moments_of_the_bundled_pair() -> None:
    """Flat: .1853 px and .1283 mm; free points without a prior: .1087 px and .0723 mm."""
    bow = dp.cross_validate_rig(BUNDLED, dp.Chessboard(), shape="bow")
    assert bow.held_out_px.square().mean().sqrt() < 0.180
    assert bow.fits[0].shape == "bow"
    known = dp.cross_validate_rig(BUNDLED, dp.Chessboard(), shape="free", priors={"points": 0.1})
    assert known.held_out_px.square().mean().sqrt() < 0.112
    assert known.held_out_world.square().mean().sqrt() < 0.075


@pytest.mark.parametrize("options", [{"shape": "bow"}, {"shape": "free", "priors": {"points": 0.1}}])
def test_a_file_keeps_the_shape(tmp_path, options) -> None:
    rig = dp.calibrate_rig(BUNDLED, dp.Chessboard(), **options)
    dp.save_camera(tmp_path / "rig.json", rig)
    again = dp.load(tmp_path / "rig.json")
    assert isinstance(again, dp.RigCalibration)
    assert again.shape == options["shape"]
    assert torch.equal(again.points, rig.points)
    assert torch.equal(again.points_deviation, rig.points_deviation)
    assert again.summary() == rig.summary()


def test_it_says_what_it_does_not_take() -> None:
    views = scene(bent())
    with pytest.raises(ValueError, match="priors: want 'points' with shape='free' only, got shape='bow'"):
        dp.calibrate_rig(views, BOARD, "none", shape="bow", priors={"points": 0.1})
    with pytest.raises(ValueError, match=r"priors: want 'points', .* got 'k3'"):
        dp.calibrate_rig(views, BOARD, "none", shape="free", priors={"k3": 0.1})
    with pytest.raises(ValueError, match="priors: want a positive standard deviation for 'points', got 0"):
        dp.calibrate_rig(views, BOARD, "none", shape="free", priors={"points": 0})
    solid = dp.Landmarks(torch.cat([BOARD.points, BOARD.points[:1] + 20.0]))
    more = {name: Views(torch.cat([one.pixels, one.pixels[:, :1]], 1), size=one.size) for name, one in views.items()}
    with pytest.raises(ValueError, match="shape: want 'flat' for points that are not all on z = 0, got 'bow'"):
        dp.calibrate_rig(more, solid, "none", shape="bow")
