"""Cameras from surveyed landmarks, against published cases and random scenes.

The cases, with their sources: a forum's question (Stack Overflow 44104633); the demonstration of CIRN's UAS toolbox, a
drone over a beach; ImGRAFT's example of the glacier Engabreen; the examples of pyorc, two rivers. The figures were
computed twice, by OpenCV or SciPy and here.
"""

import warnings

import numpy as np
import pytest
import torch
from torch import Tensor

import diffproj as dp


def T(values: object) -> Tensor:
    """In float64."""
    return torch.as_tensor(np.asarray(values, dtype=np.float64))


def camera_of(fx: float, fy: float, cx: float, cy: float, size: tuple[int, int], lens: object = None) -> dp.Camera:
    distortion = None if lens is None else dp.BrownConrady(T(lens))
    return dp.Camera(T([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), distortion=distortion, size=size)


def seen(pixels: object, size: tuple[int, int]) -> dp.Views:
    return dp.Views(T(pixels).unsqueeze(0), size=size)


BEACH = camera_of(2298.59, 2310.87, 1957.13, 1088.21, (3840, 2160), [-0.14185, 0.11168, 0, 0.002314, 0])
BEACH_POINTS = np.array(
    [
        (902062.638, 274683.639, 7.432),
        (901957.888, 274645.217, 7.435),
        (901887.879, 274619.829, 7.423),
        (901811.634, 274643.425, 7.156),
        (901790.934, 274691.320, 6.585),
    ]
)
BEACH_PIXELS = [
    (2521.9588508, 483.68938913),
    (2968.64083887, 734.49451693),
    (3546.11012936, 1064.62991583),
    (3770.57121219, 1802.68876725),
    (2707.49279597, 2059.49402435),
]


def test_a_parking_lot_with_a_known_lens() -> None:
    """Four points on z = 0."""
    lens = [0.1128663679798094, -1.487790079922432, 0, 0, 2.300571896761067]
    camera = camera_of(517.0036881709533, 517.0036881709533, 320, 212, (640, 424), lens)
    ground = dp.Landmarks([(0, 0), (1.775, 0), (1.775, 4.62), (0, 4.62)])
    located = dp.locate(seen([(275, 204), (331, 204), (331, 308), (257, 308)], (640, 424)), ground, camera)
    measured = dp.measure([[331.0, 308], [300, 260]], located, dp.Plane.z(0.0), pixel_sigma="detector")
    expected = T([[1.77687211, 4.61771556], [0.93847, 2.79502]])
    torch.testing.assert_close(measured.points[:, :2], expected, atol=1e-5, rtol=0)
    deviations = T([[0.0070, 0.0096], [0.0065, 0.0103]])
    torch.testing.assert_close(measured.deviations[:, :2], deviations, atol=6e-5, rtol=0)
    assert measured.degrees_of_freedom == 2


def test_a_drone_over_a_beach() -> None:
    """Five points in space, State Plane metres; published (901727.734, 274710.522, 79.087)."""
    located = dp.locate(seen(BEACH_PIXELS, (3840, 2160)), dp.Landmarks(BEACH_POINTS), BEACH)
    position = located.positions
    torch.testing.assert_close(position.points[0], T([901727.737, 274710.524, 79.083]), atol=0.002, rtol=0)
    torch.testing.assert_close(position.deviations[0], T([0.1035, 0.1285, 0.2015]), atol=0, rtol=0.005)
    measured = dp.measure([[2000.0, 1000]], located, dp.Plane.z(0.0), pixel_sigma="detector")
    torch.testing.assert_close(measured.points[0, :2], T([901894.543, 274734.140]), atol=0.001, rtol=0)
    torch.testing.assert_close(measured.deviations[0, :2], T([0.391, 0.161]), atol=0, rtol=0.005)


@pytest.mark.parametrize("offset", [(0, 0, 0), (1e6, -3e6, 0), (3.78e6, 9.0e5, 5.04e6)])
@pytest.mark.parametrize("turned", [False, True])
def test_the_world_frame_does_not_matter(offset: tuple[float, float, float], turned: bool) -> None:
    """Far origins and turned axes give the same camera, the same residuals and the same deviations."""
    here = dp.locate(seen(BEACH_PIXELS, (3840, 2160)), dp.Landmarks(BEACH_POINTS), BEACH)
    turn = dp.rotation_from_euler(T(0.3), T(-0.8), T(2.0)) if turned else torch.eye(3, dtype=torch.float64)
    origin = BEACH_POINTS.mean(0)
    moved = (T(BEACH_POINTS - origin) @ turn.mT).numpy() + offset
    there = dp.locate(seen(BEACH_PIXELS, (3840, 2160)), dp.Landmarks(moved), BEACH)
    center = turn @ (here.cameras.center[0] - T(origin)) + T(offset)
    torch.testing.assert_close(there.cameras.center[0], center, atol=1e-5, rtol=0)
    torch.testing.assert_close(there.residuals, here.residuals, atol=1e-6, rtol=0)
    spread = turn @ here.positions.covariance[0] @ turn.mT
    torch.testing.assert_close(there.positions.covariance[0], spread, atol=1e-6, rtol=1e-4)


GLACIER = """562,662,596.4,1960,1494; 629,649,581.6,1741,1567; 620,161,898.2,588,373; 1238,1055,586.4,825,2216;
405,999,530.9,3414,1820; 359.2,1092.5,519.2,3851,1889; 1286.2,1088.5,584.8,681,2346; 529.2,433.5,812.1,1435,662;
1545.2,1447.5,688.5,845,2520; 707.2,1233.5,453.8,3779,2579; 712.2,9.5,915.8,42,321; 1567.2,1419.5,701.9,113,2230;
579.2,962.5,515.9,2910,1963; 463.2,719.5,619.1,2373,1396; 915.2,744.5,575.2,1126,1766; 1052.2,1174.5,491,2400,2783;
871.2,1162.5,484.7,2988,2539; 924.2,992.5,568.2,2019,1968; 497.2,1177.5,456.5,3945,2304; 632.2,1285.5,432,4191,2654;
587.2,876.5,542.6,2582,1810; 982.2,471.5,668.3,100,1253; 847.2,218.5,699.9,29,1061; 1565.2,1453.5,694.3,572,2511;
795.2,472.5,632.1,766,1364; 430.2,896.5,563.8,3011,1658; 1525.2,1464.5,691,1399,2458; 637.2,378.5,781.8,1011,764"""


@pytest.mark.parametrize("known_roughly", [True, False])
def test_a_glacier(known_roughly: bool) -> None:
    """28 points over 480 m of relief tell focal lengths, k1 and the pose, from EXIF's focal length or from nothing."""
    rows = T([[float(x) for x in row.split(",")] for row in GLACIER.replace("\n", "").split(";")])
    landmarks = dp.Landmarks(rows[:, :3] + T([445000, 7395000, 0]))
    views = seen(rows[:, 3:] - 1, (4290, 2856))
    fixed = ("principal_point", "k2", "p1", "p2")
    if known_roughly:
        rough = camera_of(5850, 5828.57, (4290 - 1) / 2, (2856 - 1) / 2, (4290, 2856), [0.0, 0, 0, 0])
        found = dp.refine(views, landmarks, rough, fixed=fixed)
    else:
        found = dp.calibrate(views, landmarks, "brown4", fixed=fixed)
    numbers = found.to_dict()
    for name, value, deviation in (("f_x", 6007.99, 4.92), ("f_y", 6013.24, 6.26), ("k1", -0.1142, 0.0057)):
        assert numbers[name] == pytest.approx(value, abs=1e-4 if name == "k1" else 0.02)
        assert numbers[f"{name}_deviation"] == pytest.approx(deviation, rel=0.005)
    assert numbers["rms"] == pytest.approx(2.4703, abs=1e-4)
    published = T([446722, 7396671, 770])
    torch.testing.assert_close(found.cameras.center[0] - published, T([-0.68, -0.46, -0.03]), atol=0.01, rtol=0)
    assert found.verdict.startswith("Good: 28 landmarks")
    assert "board" not in found.summary()


def test_a_river_of_unknown_focal_length() -> None:
    """Six points in space tell one focal length and k1."""
    pixels = [(1779, 774), (436, 372), (385, 147), (922, 186), (1041, 139), (1785, 337)]
    points = [
        (111.36369, 157.71636, 138.92348),
        (102.85935, 152.98001, 138.526),
        (100.16404, 153.16391, 139.68308),
        (99.97028, 158.91532, 138.45433),
        (98.38713, 161.31339, 138.51091),
        (106.66182, 165.641, 138.5616),
    ]
    landmarks = dp.Landmarks(np.array(points) + np.array([192000, 313000, 0]))
    fixed = ("principal_point", "k2", "p1", "p2")
    found = dp.calibrate(seen(pixels, (1920, 1080)), landmarks, "brown4", tied_focal=True, fixed=fixed).to_dict()
    assert found["f_x"] == pytest.approx(1556.5, abs=0.1)
    assert found["f_x_deviation"] == pytest.approx(46.7, abs=0.1)
    assert found["k1"] == pytest.approx(-0.335, abs=0.001)
    assert found["rms"] == pytest.approx(4.196, abs=0.001)


RIVER_PIXELS = [(1421, 1001), (1251, 460), (421, 432), (470, 607)]
RIVER = dp.Landmarks(
    [
        (642735.8076, 8304292.119),
        (642737.5823, 8304295.593),
        (642732.7864, 8304298.425),
        (642732.6705, 8304296.858),
    ]
)
RIVER_CAMERA = camera_of(1552.16064453125, 1552.16064453125, 960, 540, (1920, 1080))


def test_a_river_in_utm() -> None:
    """Four points on z = 0, millions of metres from the origin."""
    located = dp.locate(seen(RIVER_PIXELS, (1920, 1080)), RIVER, RIVER_CAMERA)
    measured = dp.measure([[800.0, 600]], located, dp.Plane.z(0.0), pixel_sigma="detector")
    torch.testing.assert_close(measured.points[0, :2], T([642734.3465, 8304295.9526]), atol=1e-4, rtol=0)
    torch.testing.assert_close(measured.deviations[0, :2], T([0.0798, 0.0973]), atol=3e-4, rtol=0)
    torch.testing.assert_close(located.cameras.center[0], T([642731.645, 8304290.35, 7.036]), atol=0.005, rtol=0)


def test_a_focal_length_known_to_a_tenth_is_told() -> None:
    """A plane in one view tells it to 11 %; points near it are put back all the same."""
    views = seen(RIVER_PIXELS, (1920, 1080))
    found = dp.refine(views, RIVER, RIVER_CAMERA, tied_focal=True, fixed=("principal_point",))
    assert found.to_dict()["f_x"] == pytest.approx(1422.7, abs=0.2)
    assert found.to_dict()["f_x_deviation"] == pytest.approx(159.2, abs=0.3)
    assert "known only to 11 %" in found.message
    assert 'priors={"focal"' in found.message
    measured = dp.measure([[800.0, 600]], found, dp.Plane.z(0.0), pixel_sigma="detector")
    assert measured.deviations[0, :2].amax() < 0.14
    known = dp.refine(
        views,
        RIVER,
        RIVER_CAMERA,
        tied_focal=True,
        fixed=("principal_point",),
        pixel_sigma=3.0,
        priors={"focal": (1550.0, 50.0)},
    )
    assert known.to_dict()["f_x"] == pytest.approx(1475.6, abs=0.2)
    assert known.to_dict()["f_x_deviation"] < 50
    assert "times what pixel_sigma says" in known.message


@pytest.mark.parametrize(
    ("center", "known", "value", "deviation"),
    [
        ((959.5, 539.5), {}, 1423.90, 159.42),
        ((960.0, 540.0), {}, 1422.72, 159.17),
        # Tied focal lengths are one number, which is known once; said of each of them, it is known twice.
        ((959.5, 539.5), {"priors": {"focal": (1550.0, 50.0)}}, 1476.31, 32.76),
        ((959.5, 539.5), {"priors": {"f_x": (1550.0, 50.0)}}, 1476.31, 32.76),
        ((959.5, 539.5), {"priors": {"f_x": (1550.0, 50.0), "f_y": (1550.0, 50.0)}}, 1499.55, 27.79),
    ],
)
def test_a_river_on_one_plane_is_what_scipy_finds(
    center: tuple[float, float], known: dict[str, object], value: float, deviation: float
) -> None:
    """Focal length and pose by `scipy.optimize.least_squares` from the same pixels, and its Jacobian's covariance."""
    noise = {"pixel_sigma": 3.0} if known else {}
    camera = camera_of(1550, 1550, *center, (1920, 1080))
    held = {"tied_focal": True, "fixed": ("principal_point",)}
    found = dp.refine(seen(RIVER_PIXELS, (1920, 1080)), RIVER, camera, **held, **noise, **known).to_dict()  # type: ignore
    assert found["f_x"] == pytest.approx(value, abs=0.01)
    assert found["f_x_deviation"] == pytest.approx(deviation, abs=0.02)


# ----------------------------------------------------------------------------------------------------- random scenes

K = T([[1000.0, 0, 639.5], [0, 1000, 479.5], [0, 0, 1]])


def around(
    count: int, generator: torch.Generator, near: float = 1.5, far: float = 6.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations, translations and centres of cameras that look at the origin from anywhere."""
    direction = torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=-1)
    center = direction * (near + (far - near) * torch.rand(count, 1, dtype=torch.float64, generator=generator))
    z = torch.nn.functional.normalize(
        -direction + 0.1 * torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=-1
    )
    up = torch.randn(count, 3, dtype=torch.float64, generator=generator)
    x = torch.nn.functional.normalize(torch.linalg.cross(up, z), dim=-1)
    R = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
    return R, -(R @ center.unsqueeze(-1)).squeeze(-1), center


@pytest.mark.parametrize("depth", [0.0, 1e-3, 0.05, 0.3, 1.0])
@pytest.mark.parametrize("facade", [False, True])
def test_scenes_from_flat_to_cube(depth: float, facade: bool) -> None:
    """The right pose in all but a few of 60 views from all sides; where it is another, the view is called ambiguous.

    Measured over 14,400 views of 4 to 30 points: none ended above the minimum next to the truth.
    """
    generator = torch.Generator().manual_seed(round(1000 * depth) + facade)
    points = torch.rand(6, 3, dtype=torch.float64, generator=generator) - 0.5
    points[:, 2] *= depth
    points = points[:, [2, 0, 1]] if facade else points
    R, t, _center = around(60, generator)
    pixels, _ = dp.Camera(K.expand(60, 3, 3), R, t).project(points)
    pixels = pixels + 0.3 * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    pixels[::3, 5] = torch.nan  # some views miss a point
    offset = T([642735, 8304292, 0.0 if depth == 0 and not facade else 31.0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.AmbiguousPoseWarning)
        found = dp.locate(dp.Views(pixels, ~pixels.isnan().any(-1)), dp.Landmarks(points + offset), dp.Camera(K))
    cosine = ((found.cameras.R * R).sum((-2, -1)) - 1) / 2
    wrong = cosine < np.cos(np.radians(15))
    assert int((wrong & ~found.ambiguous).sum()) == 0
    assert int(wrong.sum()) <= 3


def test_many_frames_are_what_each_is() -> None:
    """40 frames of a moving drone in one call."""
    generator = torch.Generator().manual_seed(4)
    points = torch.rand(9, 3, dtype=torch.float64, generator=generator) - 0.5
    R, t, center = around(40, generator)
    pixels, _ = dp.Camera(K.expand(40, 3, 3), R, t).project(points)
    pixels = pixels + 0.2 * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    together = dp.locate(dp.Views(pixels), dp.Landmarks(points), dp.Camera(K), pixel_sigma=0.2)
    assert together.positions.points.shape == (40, 3)
    standard = torch.linalg.solve(together.positions.covariance, together.positions.points - center)
    assert 2.2 < ((together.positions.points - center) * standard).sum(-1).mean() < 3.8  # chi-squared of three
    for view in (0, 17, 39):
        alone = dp.locate(dp.Views(pixels[[view]]), dp.Landmarks(points), dp.Camera(K), pixel_sigma=0.2)
        torch.testing.assert_close(alone.cameras.center[0], together.cameras.center[view], atol=1e-9, rtol=0)


def test_an_unknown_focal_length_in_many_scenes() -> None:
    """Eight points in space, one view each: the right minimum, and deviations that hold."""
    generator = torch.Generator().manual_seed(9)
    points = torch.rand(10, 3, dtype=torch.float64, generator=generator) - 0.5
    R, t, _ = around(24, generator, 1.2, 2.5)
    pixels, _ = dp.Camera(K.expand(24, 3, 3), R, t).project(points)
    pixels = pixels + 0.5 * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    inside = ((pixels > 0) & (pixels < T([1280, 960]))).all(-1).all(-1)
    views = dp.Views(pixels[inside].unsqueeze(1), size=(1280, 960))
    found = dp.calibrate(views, dp.Landmarks(points), "none", tied_focal=True, fixed=("principal_point",))
    off = (found.camera.K[:, 0, 0] - 1000) / found.covariance.deviations["f_x"]
    assert off.abs().amax() < 4.5
    assert 0.6 < off.square().mean() < 1.8


# ------------------------------------------------------------------------------------------------------------- noise


def test_known_noise_gives_its_covariance() -> None:
    """`sigma^2 (J^T J)^-1`, whatever the residuals are; infinitely many degrees of freedom."""
    views, landmarks = seen(BEACH_PIXELS, (3840, 2160)), dp.Landmarks(BEACH_POINTS)
    estimated = dp.locate(views, landmarks, BEACH)
    known = dp.locate(views, landmarks, BEACH, pixel_sigma=2.0)
    assert known.pixel_sigma == pytest.approx(2.0)
    assert known.degrees_of_freedom == torch.inf
    assert estimated.degrees_of_freedom == 4
    torch.testing.assert_close(known.cameras.center, estimated.cameras.center, atol=1e-5, rtol=0)
    scale = (2.0 / estimated.pixel_sigma) ** 2
    torch.testing.assert_close(known.positions.covariance, scale * estimated.positions.covariance, rtol=1e-5, atol=0)
    each = dp.locate(views, landmarks, BEACH, pixel_sigma=T([2.0, 2, 2, 2, 50]))
    assert each.residuals[0, 4].norm() > known.residuals[0, 4].norm()  # it counts little


def test_noise_that_is_known_is_kept_in_a_file(tmp_path: object) -> None:
    """Infinite degrees of freedom, the landmarks' names, and the summary."""
    known = dp.locate(
        seen(BEACH_PIXELS, (3840, 2160)), dp.Landmarks(BEACH_POINTS, names=list("abcde")), BEACH, pixel_sigma=2.0
    )
    again = dp.Calibration.from_fields(known.to_fields(), known.camera)
    assert again.degrees_of_freedom == torch.inf
    assert again.landmarks == ("a", "b", "c", "d", "e")
    assert again.summary() == known.summary()
    assert "landmark e:" in known.summary()


@pytest.mark.slow
def test_uncertain_landmarks_are_carried() -> None:
    """Errors of the pose are as large as its covariance says, where landmarks are off by centimetres to decimetres.

    Measured over 200 trials: squares over the covariance have a mean of 2.9 where 3 are expected.
    """
    generator = torch.Generator().manual_seed(4)
    points = T([[0, 0, 0], [4, 0, 0.5], [4, 4, 0], [0, 4, 1], [2, 6, 0], [6, 2, 0.3], [3, 8, 0.2], [8, 8, 1]])
    sigma = T([0.01, 0.02, 0.05, 0.01, 0.05, 0.02, 0.01, 0.03])
    z = torch.nn.functional.normalize(T([0, 10, -5]), dim=0)
    x = T([1.0, 0, 0])
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    center = T([2.0, -8, 5])
    camera = dp.Camera(K, R, -R @ center)
    pixels, _ = camera.project(points)
    squares = []
    for _ in range(60):
        shaken = pixels + torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
        surveyed = points + sigma.unsqueeze(-1) * torch.randn(points.shape, dtype=torch.float64, generator=generator)
        landmarks = dp.Landmarks(surveyed, sigma=sigma)
        found = dp.locate(dp.Views(shaken.unsqueeze(0)), landmarks, camera, pixel_sigma=1.0).positions
        off = found.points[0] - center
        squares.append(float(off @ torch.linalg.solve(found.covariance[0], off)))
    assert 2.2 < np.mean(squares) < 3.9


def test_uncertain_landmarks_widen_the_pose() -> None:
    """By their own part."""
    views, exact = seen(BEACH_PIXELS, (3840, 2160)), dp.Landmarks(BEACH_POINTS)
    here = dp.locate(views, exact, BEACH, pixel_sigma=1.0).positions.deviations
    nearly = dp.locate(views, dp.Landmarks(BEACH_POINTS, sigma=1e-6), BEACH, pixel_sigma=1.0).positions.deviations
    torch.testing.assert_close(nearly, here, rtol=1e-5, atol=0)
    rough = dp.locate(views, dp.Landmarks(BEACH_POINTS, sigma=0.5), BEACH, pixel_sigma=1.0).positions.deviations
    assert (rough > 2 * here).all()


# ---------------------------------------------------------------------------------------------------------- mistakes


def in_space(seed: int = 2) -> tuple[Tensor, dp.Views, dp.Camera]:
    """Eight points in space, a view of them, and its camera."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(8, 3, dtype=torch.float64, generator=generator) * 10
    R, t, _ = around(1, generator, 25.0, 30.0)
    camera = dp.Camera(K, R[0], t[0] - R[0] @ T([5, 5, 5]), size=(1280, 960))
    pixels, _ = camera.project(points)
    return points, dp.Views(pixels.unsqueeze(0), size=(1280, 960)), camera


@pytest.mark.parametrize("how", ["locate", "calibrate"])
@pytest.mark.parametrize(
    "mirror", [lambda p: p[:, [1, 0, 2]], lambda p: p * T([1, -1, 1]), lambda p: p * T([1, 1, -1])]
)
def test_left_handed_coordinates_are_named(how: str, mirror: object) -> None:
    """Exchanged axes or one that points the other way: the mirror image fits, and the message says so."""
    points, views, camera = in_space()
    landmarks = dp.Landmarks(mirror(points))  # pyright: ignore[reportCallIssue]
    if how == "locate":
        found = dp.locate(views, landmarks, camera, throw=False)
    else:
        held = {"tied_focal": True, "fixed": ("principal_point",)}
        found = dp.calibrate(views, landmarks, "none", throw=False, **held)
    assert "left-handed; exchange x and y" in found.message


def test_other_mistakes_are_named() -> None:
    """Points in another order, on a line, too few in a view, another number."""
    points, views, camera = in_space()
    with pytest.raises(dp.CalibrationError, match="do not match the landmarks: are pixels and landmarks in the same"):
        dp.locate(views, dp.Landmarks(points[[1, 0, 5, 3, 7, 2, 6, 4]]), camera)
    line = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1) * T([1, 2, 3]) + T([1e6, 2e6, 50])
    with pytest.raises(ValueError, match="do not lie on one line"):
        dp.locate(views, dp.Landmarks(line), camera)
    with pytest.raises(dp.CalibrationError, match="no view shows at least 4 corners"):
        dp.locate(views.hiding(torch.arange(8) > 2), dp.Landmarks(points), camera)
    with pytest.raises(ValueError, match="want 7 corners in each as the target has, got 8; a pixel for each"):
        dp.locate(views, dp.Landmarks(points[:7]), camera)
    with pytest.raises(dp.CalibrationError, match=r"more landmarks.*fixed=\(\"principal_point\".*priors=\{\"focal\""):
        dp.calibrate(views.hiding(torch.arange(8) > 5), dp.Landmarks(points))
    with pytest.raises(ValueError, match="objective: want 'image' for points that are not all on z = 0"):
        dp.refine(views, dp.Landmarks(points), camera, objective="plane")
    with pytest.raises(ValueError, match="want .* for points that are not all on z = 0"):
        dp.refine(views, dp.Landmarks(points), camera, shape="bow")
    with pytest.raises(ValueError, match="pixel_sigma, weights: want one of the two"):
        dp.locate(views, dp.Landmarks(points), camera, pixel_sigma=1.0, weights=1.0)
    with pytest.raises(ValueError, match=r"pixel_sigma: want standard deviations in px from .*, got -2 at \(0, 3\)"):
        dp.locate(views, dp.Landmarks(points), camera, pixel_sigma=T([1, 1, 1, -2, 1, 1, 1, 1]))
    with pytest.raises(ValueError, match="plane_residuals|points on z = 0"):
        dp.plane_residuals(camera[None], views, dp.Landmarks(points))


def test_a_wrong_landmark_is_rejected() -> None:
    """`locate` takes reject_outliers too; the pose is that without it."""
    points, views, camera = in_space()
    pixels = views.pixels.clone()
    pixels[0, 3] += T([60, -25])
    wrong = dp.Views(pixels, size=(1280, 960))
    found = dp.locate(wrong, dp.Landmarks(points), camera, reject_outliers=True)
    assert found.rejected[0].nonzero().flatten().tolist() == [3]
    torch.testing.assert_close(found.cameras.center[0], camera.center, atol=1e-6, rtol=0)


def test_gradients_through_a_refined_landmark_camera() -> None:
    """Against differences: by a pixel, and by a landmark."""
    points, views, camera = in_space()
    pixels = (views.pixels + 0.3 * torch.sin(torch.arange(16.0, dtype=torch.float64)).reshape(1, 8, 2)).requires_grad_()
    given = points.clone().requires_grad_()

    def focal(pixels: Tensor, points: Tensor, differentiable: bool = False) -> Tensor:
        options = {"tied_focal": True, "fixed": ("principal_point",), "differentiable": differentiable}
        found = dp.refine(dp.Views(pixels, size=(1280, 960)), dp.Landmarks(points), camera, **options)
        return found.camera.K[0, 0]

    by_pixel, by_point = torch.autograd.grad(focal(pixels, given, True), (pixels, given))
    for step, slope in ((T([1e-4, 0]), by_pixel[0, 2, 0]),):
        ahead, behind = pixels.detach().clone(), pixels.detach().clone()
        ahead[0, 2] += step
        behind[0, 2] -= step
        assert slope == pytest.approx(float(focal(ahead, points) - focal(behind, points)) / 2e-4, rel=1e-4)
    ahead, behind = points.clone(), points.clone()
    ahead[4, 1] += 1e-5
    behind[4, 1] -= 1e-5
    slope = float(focal(pixels.detach(), ahead) - focal(pixels.detach(), behind)) / 2e-5
    assert by_point[4, 1] == pytest.approx(slope, rel=1e-4)


def test_scatter_is_no_fault_of_landmarks_but_of_corners() -> None:
    """Landmarks are clicked to a few pixels; corners of a board that scatter so are blurred, or wrong."""
    board = dp.Chessboard()
    views = dp.example_views("left")[:6]
    generator = torch.Generator().manual_seed(0)
    rough = dp.Views(
        views.pixels + 3 * torch.randn(views.pixels.shape, generator=generator, dtype=T(0).dtype), size=views.size
    )
    remarks = [dp.calibrate(rough, target, "brown4").remarks[0] for target in (board, dp.Landmarks(board.points))]
    assert ["in sharp photographs by 0.1 to 0.3" in remark for remark in remarks] == [True, False]


def test_cross_validation_of_landmarks_in_space() -> None:
    """Held-out errors are distances from the rays."""
    generator = torch.Generator().manual_seed(11)
    points = torch.rand(20, 3, dtype=torch.float64, generator=generator) - 0.5
    R, t, _ = around(6, generator, 1.5, 2.5)
    pixels, _ = dp.Camera(K.expand(6, 3, 3), R, t).project(points)
    pixels = pixels + 0.2 * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
    views = dp.Views(
        pixels.clamp(min=0).minimum(T([1279, 959])),
        (pixels > 0).all(-1) & (pixels < T([1279, 959])).all(-1),
        size=(1280, 960),
    )
    found = dp.cross_validate(views, dp.Landmarks(points), "none", folds=3)
    assert found.held_out_px.amax() < 0.6
    assert found.held_out_world.amax() < 0.003


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 5, 6, 8, 12])
def test_coverage(count: int) -> None:
    """95 % intervals and ellipses of points on the ground hold 95 % of 600 trials, noise 1 px.

    Measured for 4, 5, 6, 8 and 12 landmarks: intervals .948 .952 .947 .948 .947, ellipses .957 .954 .950 .947 .949.
    """
    generator = torch.Generator().manual_seed(count)
    ground = torch.tensor(
        [[0, 0], [4, 0], [4, 4], [0, 4], [2, 2], [1, 3], [3, 1], [2, 0.5], [0.5, 2], [3.5, 2.5], [1, 1], [3, 3]]
    )
    points = torch.nn.functional.pad(ground[:count].to(torch.float64), (0, 1))
    z = torch.nn.functional.normalize(T([0, 10, -5]), dim=0)
    x = T([1.0, 0, 0])
    R = torch.stack([x, torch.linalg.cross(z, x), z])
    camera = dp.Camera(K, R, -R @ T([2.0, -8, 5]), size=(1280, 960))
    probe = T([[1.0, 1, 0], [3, 2, 0], [2, 4, 0]])
    pixels, clicks = (camera.project(place)[0].expand(600, -1, 2) for place in (points, probe))
    pixels, clicks = (p + torch.randn(p.shape, dtype=torch.float64, generator=generator) for p in (pixels, clicks))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dp.AmbiguousPoseWarning)
        found = dp.locate(dp.Views(pixels.unsqueeze(1), size=(1280, 960)), dp.Landmarks(points), camera)
    measured = dp.measure(clicks, found, dp.Plane.z(0.0), pixel_sigma="detector")
    low, high = measured.interval(0.95)
    inside = ((low <= probe) & (probe <= high))[..., :2].to(torch.float64).mean()
    assert 0.93 < inside < 0.97
    ellipses = measured.ellipses(0.95)
    along = ((measured.points - probe).unsqueeze(-2) * ellipses.directions).sum(-1) / ellipses.half_axes
    assert 0.93 < (along.square().sum(-1) < 1).to(torch.float64).mean() < 0.97
