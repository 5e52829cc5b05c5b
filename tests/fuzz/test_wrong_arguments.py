"""Whatever the public calls are given: the right answer, or an error that names the argument and says what it wants.

Every call is listed here with arguments that are right, small problems that take milliseconds. One or two of them are
spoilt by chance, and `conftest.py` looks at what comes of it.
"""

import decimal
import functools
import inspect
import math
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.nn.fixed_map import FixedMap

pytestmark = pytest.mark.plain  # checks of types at run time would answer first

D = torch.float64


class Call(NamedTuple):
    """A public function or method, and arguments that it takes.

    Attributes:
        function: what is called.
        given: its arguments by name.
        weight: how often it is tried, relative to others: less where it takes longer.
    """

    function: Callable[..., Any]
    given: dict[str, Any]
    weight: float = 10


class Things(NamedTuple):
    """What the calls are made with."""

    K: torch.Tensor
    camera: dp.Camera
    cameras: dp.Camera
    lens: dp.BrownConrady
    fisheye: dp.KannalaBrandt
    plane: dp.Plane
    planes: dp.Plane
    pixels: torch.Tensor
    points: torch.Tensor
    board: dp.Chessboard
    views: dp.Views
    calibration: dp.Calibration
    many: dp.Calibration
    located: dp.Calibration
    measured: dp.Measurement
    accuracy: dp.AccuracyMap
    experiment: dp.Experiment
    photograph: torch.Tensor
    pair: dict[str, dp.Views]
    rig: dp.RigCalibration
    triangulated: dp.Triangulation


@functools.cache
def things() -> Things:
    K = torch.tensor([[100.0, 0, 63.5], [0, 100, 47.5], [0, 0, 1]], dtype=D)
    lens = dp.BrownConrady(torch.tensor([-0.1, 0.01, 0.001, 0.0, 0.0], dtype=D))
    tilted = dp.rotation_from_euler(*torch.tensor([0.4, 0.1, 0.2], dtype=D))
    camera = dp.Camera(K, tilted, torch.tensor([-15.0, -10, 100], dtype=D), lens, size=(128, 96))
    board = dp.Chessboard(4, 3, 10.0)
    cameras = dp.synthetic.random_cameras(camera, board, 4)
    views = dp.synthetic.corner_views(cameras, board, noise_px=0.05)
    held = {"distortion": "none", "fixed": ("principal_point",), "priors": {"f_x": (100.0, 5.0)}}
    plain = camera.warped(torch.eye(3, dtype=D))
    calibration = dp.calibrate(views, board, **held)
    twice = dp.Views(torch.stack([views.pixels, views.pixels]), size=(128, 96))
    located = dp.locate(views, board, calibration)
    plane = dp.Plane.z(0.0)
    measured = dp.measure(views.pixels[0, :5], calibration, plane, view=0)
    accuracy = dp.AccuracyMap.over_image(calibration, view=0, step=40)
    beside = dp.Camera(
        K, dp.rotation_from_euler(0.05, 0.1, 0.02), torch.tensor([-20.0, 1, 2], dtype=D), lens, (128, 96)
    )
    second = beside.at(beside.R @ cameras.R, (beside.R @ cameras.t.unsqueeze(-1)).squeeze(-1) + beside.t)
    pair = {"one": views, "two": dp.synthetic.corner_views(second, board, noise_px=0.05, seed=1)}
    known = {"one": plain.without_pose(), "two": beside}
    rig = dp.calibrate_rig(pair, board, cameras=known, fixed=("intrinsics",), throw=False)
    return Things(
        K,
        plain,
        cameras,
        lens,
        dp.KannalaBrandt(torch.tensor([0.01, -0.002, 0.0, 0.0], dtype=D)),
        plane,
        dp.Plane(torch.tensor([[0.0, 0, 1], [0, 0.1, 1]], dtype=D), torch.tensor([0.0, 1], dtype=D)),
        torch.tensor([[60.0, 40], [70, 50], [20.5, 80]], dtype=D),
        torch.tensor([[0.0, 0, 0], [20, 0, 1], [0, 15, -2], [10, 10, 3]], dtype=D),
        board,
        views,
        calibration,
        dp.calibrate(twice, board, **held),
        located,
        measured,
        accuracy,
        dp.run_experiment(views[:3], views[3:], board, "none"),
        torch.tensor(np.kron(np.indices((6, 7)).sum(0) % 2, np.ones((12, 12))) * 200, dtype=torch.uint8),
        pair,
        rig,
        rig.triangulate({name: one.pixels[0] for name, one in pair.items()}, 0.1),
    )


def strangers(t: Things) -> list[Any]:
    """Things of any type."""
    numbers = [0, 1, -1, 5, 2.5, -0.5, 1e-12, 1e300, math.nan, math.inf, -math.inf, 10**30, True, False, 3j]
    arrays = [
        np.zeros(3),
        np.zeros((0, 2)),
        np.array("x"),
        np.array([1, "a"], dtype=object),
        np.float64(0.3),
        np.int64(2),
    ]
    tensors = [
        torch.zeros(0), torch.zeros(3), torch.zeros(2, 2), torch.zeros(0, 2, dtype=D), torch.tensor(1.5), torch.eye(3),
        torch.tensor(math.nan), torch.tensor([1, 2]), torch.tensor([True, False]), torch.zeros(3, 2, dtype=torch.complex64),
        torch.zeros(3, 2, dtype=torch.half), torch.zeros(3, 2, device="meta", dtype=D), torch.zeros(2, 3, 3, dtype=D),
    ]  # fmt: skip
    plain = [
        None,
        "",
        "x",
        "left",
        b"x",
        [],
        (),
        {},
        [1, 2],
        (1, 2, 3),
        [[1, 2], [3]],
        ["a"],
        [None],
        {"a": 1},
        {1, 2},
        range(3),
    ]
    odd = [
        object(),
        int,
        len,
        decimal.Decimal("0.5"),
        Path("no/such/folder"),
        slice(1),
        ...,
        iter([1, 2]),
        torch.float32,
        torch.int64,
    ]
    own = [
        t.camera, t.cameras, t.lens, t.fisheye, t.plane, t.planes, dp.Plane.per_point([0, 0, 1.0], torch.zeros(3, dtype=D)),
        t.board, t.views, t.views[:0], t.views[:1], t.calibration, t.many, t.located, t.measured, t.accuracy, t.experiment,
        t.calibration.covariance, t.measured.lengths(), dp.Huber(1.0), dp.Camera, dp.Camera(t.K), dp.PlaneMap(t.camera, t.plane),
        dp.Camera(t.K, size=(128, 96)).to_kornia(), dp.Camera(torch.eye(3)), dp.Chessboard(5, 4), dp.Status.CONVERGED,
    ]  # fmt: skip
    return [*numbers, *arrays, *tensors, *plain, *odd, *own]


@functools.cache
def calls() -> dict[str, Call]:
    """All of them by name."""
    t = things()
    return {**_geometry(t), **_lenses(t), **_targets(t), **_calibration(t), **_measurement(t), **_uses(t)}


def _geometry(t: Things) -> dict[str, Call]:
    p, x, c, n = t.pixels, t.points, t.camera, t.plane
    warp = torch.tensor([[0.0, -1, 95], [1, 0, 0], [0, 0, 1]], dtype=D)
    extent = (-5.0, -5.0, 35.0, 25.0)
    axes = dp.plane_axes(n)
    image = torch.rand(1, 96, 128, dtype=D)
    angle = torch.tensor([0.1, 0.2], dtype=D)
    onto = {"camera": c, "plane": n}
    return {
        "back_project": Call(dp.back_project, {"pixels": p, **onto}, 20),
        "explain": Call(dp.explain, {"pixels": p, **onto}),
        "ground_resolution": Call(dp.ground_resolution, {"pixels": p, **onto}, 5),
        "PlaneMap": Call(dp.PlaneMap, onto),
        "PlaneMap()": Call(dp.PlaneMap(c, n), {"pixels": p}),
        "PlaneMap.resolution": Call(dp.PlaneMap(c, n).resolution, {"pixels": p}),
        "PlaneMap.with_reach": Call(dp.PlaneMap(c, n).with_reach, {"pixels": p}),
        "PlaneMap.explain": Call(dp.PlaneMap(c, n).explain, {"pixels": p}),
        "paper_route": Call(
            dp.paper_route, {"pixels": p, "camera": dp.Camera(t.K), "plane": dp.Plane.z(9.0), "focal_length": 1.0}
        ),
        "plane_axes": Call(dp.plane_axes, {"plane": n}),
        "rectify": Call(
            dp.rectify, {"image": image, **onto, "extent": extent, "resolution": 2.0, "axes": axes, "north_up": True}, 5
        ),
        "geotransform": Call(dp.geotransform, {"extent": extent, "resolution": 2.0, "origin": (3.0, 4.0)}, 5),
        "metres_from_degrees": Call(dp.metres_from_degrees, {"degrees": [[40.4, -3.7]], "crs": "EPSG:32630"}, 2),
        "degrees_from_metres": Call(
            dp.degrees_from_metres, {"points": [[440291.5, 4474254.9]], "crs": "EPSG:32630"}, 2
        ),
        "render": Call(dp.render, {"texture": image, **onto, "extent": extent, "size": (64, 48), "axes": axes}, 5),
        "rotation_from_euler": Call(dp.rotation_from_euler, {"psi": angle, "phi": angle, "theta": angle}),
        "euler_from_rotation": Call(dp.euler_from_rotation, {"R": t.cameras.R}),
        "Camera": Call(dp.Camera, {"K": t.K, "R": c.R, "t": c.t, "distortion": t.lens, "size": (128, 96)}, 20),
        "Camera.from_opencv": Call(
            dp.Camera.from_opencv,
            {
                "K": t.K.numpy(),
                "dist": [0.1, 0, 0, 0],
                "rvec": np.zeros(3),
                "tvec": [0, 0, 9],
                "size": (128, 96),
                "fisheye": False,
            },
        ),
        "Camera.from_kornia": Call(dp.Camera.from_kornia, {"pinhole": dp.Camera(t.K, size=(128, 96)).to_kornia()}),
        "Camera.mounted": Call(
            dp.Camera.mounted,
            {
                "height": 2.0,
                "tilt_deg": angle * 100,
                "roll_deg": 1.0,
                "heading_deg": 30.0,
                "size": (128, 96),
                "focal": (100.0, 101.0),
                "principal_point": [64.0, 48.0],
                "position": [1.0, 2.0],
                "distortion": t.lens,
            },
        ),
        "Camera.mounted by millimetres": Call(
            dp.Camera.mounted, {"height": 2.0, "tilt_deg": 20.0, "size": (128, 96), "focal_mm": 5.0, "sensor_mm": 6.0}
        ),
        "Camera.mounted by degrees": Call(
            dp.Camera.mounted, {"height": 2.0, "tilt_deg": 20.0, "size": (128, 96), "fov_deg": 60.0}
        ),
        "Camera.from_matrix": Call(
            dp.Camera.from_matrix, {"projection": t.K @ t.camera.world_to_cam()[:3], "size": (128, 96)}
        ),
        "Camera.from_extrinsics": Call(
            dp.Camera.from_extrinsics,
            {
                "extrinsics": t.cameras.cam_to_world("opengl"),
                "K": t.K,
                "convention": "opengl",
                "to": "world",
                "distortion": t.lens,
                "size": (128, 96),
            },
        ),
        "Camera.world_to_cam": Call(c.world_to_cam, {"convention": "pytorch3d"}),
        "Camera.cam_to_world": Call(c.cam_to_world, {"convention": "opengl"}),
        "Camera.looking_at": Call(
            dp.Camera.looking_at,
            {
                "position": [0.0, -4, 3],
                "target": [0.0, 0, 0],
                "up": [0.0, 0, 1],
                "size": (128, 96),
                "focal": (100.0, 101.0),
                "principal_point": [64.0, 48.0],
                "distortion": t.lens,
            },
        ),
        "stack": Call(dp.stack, {"items": [c, c], "dim": 0}),
        "collate": Call(dp.collate, {"samples": [{"camera": c, "n": 1}, {"camera": c, "n": 2}]}),
        "PlaneMap.miss": Call(dp.PlaneMap(c, t.plane).miss, {"pixels": p}),
        "PlaneMap.homography": Call(
            dp.PlaneMap(dp.Camera(t.K, c.R, c.t), dp.Plane.z(0.0)).homography, {"axes": dp.plane_axes(dp.Plane.z(0.0))}
        ),
        "Camera.at": Call(c.at, {"R": t.cameras.R, "t": t.cameras.t}),
        "Camera.shifted": Call(c.shifted, {"offset": torch.ones(3, dtype=D)}),
        "Camera.resized": Call(c.resized, {"size": (64, 48), "stretched": False}),
        "Camera.cropped": Call(c.cropped, {"left": 3, "top": 4.5, "width": 60, "height": 40}),
        "Camera.warped": Call(c.warped, {"matrix": warp, "size": (96, 128)}),
        "Camera.in_image": Call(c.in_image, {"pixels": p}),
        "Camera.project": Call(c.project, {"points": x}),
        "Camera.directions": Call(c.directions, {"pixels": p}),
        "Camera.rays": Call(c.rays, {"pixels": p}),
        "Camera[]": Call(t.cameras.__getitem__, {"index": 2}),
        "Camera.to": Call(lambda dtype: c.to(dtype), {"dtype": torch.float32}),
        "Camera.expand": Call(
            lambda batch_shape: c.expand(*(batch_shape if isinstance(batch_shape, tuple) else (batch_shape,))),
            {"batch_shape": (2, 3)},
        ),
        "Camera.stack": Call(dp.Camera.stack, {"items": [c, c], "dim": 0}),
        "Plane": Call(dp.Plane, {"normal": [0.0, 0.1, 1], "offset": 2.0}, 20),
        "Plane.z": Call(dp.Plane.z, {"offset": 1.0}),
        "Plane.per_point": Call(dp.Plane.per_point, {"normal": [0.0, 0, 1], "offset": torch.tensor([1.0, 2], dtype=D)}),
        "Plane.from_points": Call(dp.Plane.from_points, {"points": x}),
        "Plane.parallel": Call(t.planes.parallel, {"distance": 2.0}),
        "Plane.distance": Call(n.distance, {"points": x}),
        "Plane.rms": Call(n.rms, {"points": x}),
        "Plane.like": Call(n.like, {"tensor": p}),
        "Plane[]": Call(t.planes.__getitem__, {"index": slice(1)}),
        "Plane.stack": Call(dp.Plane.stack, {"items": [t.planes, n], "dim": 1}),
    }


def _lenses(t: Things) -> dict[str, Call]:
    xy = torch.tensor([[0.1, 0.2], [0.3, -0.4]], dtype=D)
    towards = torch.tensor([[0.1, 0.2, 1.0], [0.5, 0.5, 2]], dtype=D)
    return {
        "BrownConrady": Call(dp.BrownConrady, {"coefficients": t.lens.coefficients}),
        "KannalaBrandt": Call(dp.KannalaBrandt, {"coefficients": t.fisheye.coefficients}),
        "BrownConrady.distort": Call(t.lens.distort, {"xy": xy}),
        "BrownConrady.undistort": Call(t.lens.undistort, {"xy_distorted": xy}),
        "BrownConrady.project_direction": Call(t.lens.project_direction, {"direction": towards}),
        "BrownConrady.unproject": Call(t.lens.unproject, {"xy_distorted": xy}),
        "KannalaBrandt.project_direction": Call(t.fisheye.project_direction, {"direction": towards}),
        "KannalaBrandt.unproject": Call(t.fisheye.unproject, {"xy_distorted": xy}),
        "register_lens": Call(lambda kind: dp.register_lens(kind, ("factor",)), {"kind": dp.Lens}),
        **{f"{kind.__name__}": Call(kind, {"scale": 0.5}) for kind in (dp.Huber, dp.Cauchy, dp.SoftL1)},
        "Huber.value": Call(dp.Huber(1.0).value, {"squared": xy.abs()}),
        "Cauchy.weight": Call(dp.Cauchy(1.0).weight, {"squared": xy.abs()}),
    }


def _targets(t: Things) -> dict[str, Call]:
    v, b = t.views, t.board
    return {
        "AprilGrid": Call(dp.AprilGrid, {"columns": 3, "rows": 2, "tag": 10.0, "spacing": 0.3}),
        "CharucoBoard": Call(
            dp.CharucoBoard,
            {"columns": 4, "rows": 3, "square": 10.0, "marker": 7.0, "dictionary": "4X4_50", "legacy": True},
        ),
        "CircleGrid": Call(
            dp.CircleGrid, {"columns": 4, "rows": 3, "spacing": 10.0, "diameter": 5.0, "asymmetric": "rows"}
        ),
        "Chessboard": Call(dp.Chessboard, {"columns": 4, "rows": 3, "square": 10.0, "axes": "paper"}),
        "Landmarks": Call(
            dp.Landmarks, {"points": b.points, "names": [str(n) for n in range(len(b))], "sigma": 0.1}, 3
        ),
        "Views": Call(
            dp.Views, {"pixels": v.pixels, "visible": v.visible, "names": ["a", "b", "c", "d"], "size": (128, 96)}, 20
        ),
        "Views[]": Call(v.__getitem__, {"index": [0, 2]}),
        "Views.hiding": Call(v.hiding, {"mask": torch.arange(12) == 3}),
        "Views.stack": Call(dp.Views.stack, {"items": [v, v], "dim": 0}),
        "detect": Call(
            dp.detect, {"photographs": t.photograph, "target": dp.Chessboard(6, 5), "progress": print_nothing}, 3
        ),
        "example_views": Call(dp.example_views, {"side": "left"}, 1),
        "image_residuals": Call(dp.image_residuals, {"camera": t.cameras, "views": v, "target": b}),
        "plane_residuals": Call(dp.plane_residuals, {"camera": t.cameras, "views": v, "target": b}),
        "synthetic.board_texture": Call(dp.synthetic.board_texture, {"board": b, "texels": 2}),
        "synthetic.photograph": Call(
            dp.synthetic.photograph,
            {"camera": t.cameras[0], "board": b, "blur_px": 0.5, "noise": 0.01, "vignetting": 0.3, "seed": 1},
            2,
        ),
        "synthetic.corner_views": Call(
            dp.synthetic.corner_views, {"camera": t.cameras, "board": b, "noise_px": 0.1, "seed": 2}
        ),
        "synthetic.random_cameras": Call(
            dp.synthetic.random_cameras,
            {"camera": t.camera, "board": b, "views": 2, "tilt": 0.3, "distance": (2.0, 3.0), "seed": 3},
            3,
        ),
        "paper_setup": Call(dp.paper_setup, {"distortion": t.lens}, 3),
    }


def _calibration(t: Things) -> dict[str, Call]:
    on = {"views": t.views, "target": t.board}
    options = {
        "weights": torch.ones(4, 12, dtype=D),
        "loss": dp.Huber(1.0),
        "max_iterations": 30,
        "tolerance": 1e-9,
        "progress": print_nothing,
        "throw": False,
    }
    more = {
        "objective": "image",
        "shape": "flat",
        "bow": False,
        "skew": False,
        "fixed": ("principal_point",),
        "tied_focal": False,
        "priors": {"f_x": (100.0, 5.0)},
        "reject_outliers": 5.0,
    }
    held = {"fixed": ("principal_point",), "max_iterations": 20, "throw": False}
    rough = dp.Camera(t.K, size=(128, 96))
    k = t.calibration
    return {
        "calibrate": Call(dp.calibrate, {**on, "distortion": "none", **options, **more}, 6),
        "refine": Call(dp.refine, {**on, "camera": rough, "differentiable": True, **options, **more}, 6),
        "locate": Call(dp.locate, {**on, "camera": k, **options, "reject_outliers": 5.0, "same_target": True}, 4),
        "locate landmarks": Call(
            dp.locate,
            {
                "views": t.views,
                "target": dp.Landmarks(t.board.points),
                "camera": rough,
                "pixel_sigma": 0.2,
                "throw": False,
            },
            4,
        ),
        "calibrate_rig": Call(
            dp.calibrate_rig,
            {
                "views_by_camera": t.pair,
                "target": t.board,
                "distortion": "none",
                "moments": {"one": [1, 2, 3, 4], "two": [1, 2, 3, 4]},
                "cameras": t.rig,
                **options,
                "weights": {"one": 1.0, "two": torch.ones(12, dtype=D)},
                "fixed": ("intrinsics",),
                "reject_outliers": 5.0,
            },
            3,
        ),
        "cross_validate_rig": Call(
            dp.cross_validate_rig,
            {
                "views_by_camera": t.pair,
                "target": t.board,
                "distortion": "none",
                "folds": 2,
                "moments": None,
                "cameras": t.rig,
                "fixed": ("intrinsics",),
                "throw": False,
            },
            0.2,
        ),
        "RigCalibration.baseline": Call(t.rig.baseline, {"one": "one", "other": "two"}),
        "RigCalibration.place_covariance": Call(t.rig.place_covariance, {"name": "two"}),
        "RigCalibration.parameters_of": Call(t.rig.parameters_of, {"name": "two"}),
        "RigCalibration.triangulate": Call(
            t.rig.triangulate,
            {
                "pixels_by_camera": {name: one.pixels[0] for name, one in t.pair.items()},
                "pixel_sigma": {"one": 0.1, "two": 0.2},
            },
        ),
        "Calibration[]": Call(t.many.__getitem__, {"index": 1}),
        "RigCalibration[]": Call(t.rig.__getitem__, {"name": "one"}),
        "Triangulation.between": Call(t.triangulated.between, {"i": 0, "j": 1}),
        "Triangulation.length": Call(t.triangulated.length, {"i": 0, "j": 1}),
        "cross_validate": Call(dp.cross_validate, {**on, "distortion": "none", "folds": 2, **held}, 1),
        "bootstrap": Call(dp.bootstrap, {**on, "distortion": "none", "draws": 3, "seed": 0, "fixed": held["fixed"]}, 1),
        "Covariance.between": Call(k.covariance.between, {"view": 0, "other": 1}),
        "Covariance.cross": Call(k.covariance.cross, {"view": 0}),
        "Covariance.view": Call(k.covariance.view, {"view": 1}),
        "Covariance.following": Call(k.covariance.following, {"known": k.covariance}),
        **_evidence(),
        "run_experiment": Call(
            dp.run_experiment,
            {
                "fit": t.views[:3],
                "test": t.views[3:],
                "board": t.board,
                "distortion": "none",
                "strict": False,
                "shape": "flat",
            },
            1,
        ),
    }


def _evidence() -> dict[str, Call]:
    mast = dp.Camera.mounted(5.0, 20.0, focal=100.0, size=(128, 96))
    points = torch.tensor([[-2.0, 10, 0], [2, 12, 0], [0, 15, 1], [4, 20, 0]], dtype=D)
    pixels = mast.project(points)[0]
    ground = {"pixel_sigma": 0.5, "loss": dp.Huber(2.0)}
    pieces = [dp.Seen(points, pixels), dp.Horizon([[10.0, 11.0], [100.0, 11.0]], 2.0)]
    return {
        "adjust": Call(
            dp.adjust,
            {
                "camera": mast,
                "observations": pieces,
                "priors": {"tilt": (20.0, 1.0), "focal": 5.0},
                "fixed": ("height",),
                "free": ("focal",),
                "tied_focal": True,
                "differentiable": True,
                "max_iterations": 20,
                "throw": False,
            },
            3,
        ),
        "Seen": Call(dp.Seen, {"landmarks": points, "pixels": pixels, "sigma": 0.1, **ground}),
        "Horizon": Call(dp.Horizon, {"pixels": pixels, "dip_deg": 0.1, **ground}),
        "Heights": Call(
            dp.Heights,
            {"feet": pixels, "tops": pixels - 5, "height": 1.7, "deviation": torch.ones(4, dtype=D), **ground},
        ),
        "Lengths": Call(
            dp.Lengths,
            {
                "starts": pixels,
                "ends": pixels + 5,
                "length": 1.7,
                "deviation": 0.1,
                "plane": dp.Plane.z(0.0),
                **ground,
            },
        ),
        "VanishingPoints": Call(dp.VanishingPoints, {"directions": points, "pixels": pixels, **ground}),
        "VanishingPoints of lines": Call(
            dp.VanishingPoints, {"directions": ["x", "y"], "segments": pixels.reshape(2, 2, 2), **ground}
        ),
        "Coplanar": Call(dp.Coplanar, {"places": points[:, :2], "pixels": pixels, "level": 1.0, **ground}),
        **{
            f"{type(one).__name__}.residuals": Call(one.residuals, {"camera": mast})
            for one in (
                *pieces,
                dp.Heights(pixels, pixels - 5, 1.7, 0.1),
                dp.Lengths(pixels, pixels + 5, 1.7, 0.1),
                dp.VanishingPoints(["x", "y"], pixels=pixels[:2]),
                dp.Coplanar(points[:, :2], pixels),
            )
        },
    }


def _measurement(t: Things) -> dict[str, Call]:
    m, k = t.measured, t.calibration
    on = {"plane": t.plane, "view": 0, "pixel_sigma": 0.1}
    covariance = torch.diag(torch.tensor([1e-6, 1e-6, 1e-6, 1e-2], dtype=D))
    wide = {"calibration": k, **on}
    return {
        "measure": Call(
            dp.measure, {"pixels": t.views.pixels[0, :4], "calibration": k, **on, "plane_covariance": covariance}, 12
        ),
        "measure camera": Call(
            dp.measure, {"pixels": t.pixels, "calibration": t.camera, "plane": t.plane, "pixel_sigma": 0.1}
        ),
        "measure located": Call(dp.measure, {"pixels": t.pixels, "calibration": t.located, **on}, 3),
        "fuse": Call(dp.fuse, {"measurements": [m, m]}, 3),
        "Measurement.interval": Call(m.interval, {"level": 0.9}, 2),
        "Measurement.ellipses": Call(m.ellipses, {"level": 0.9}, 2),
        "Ellipses.outline": Call(m.ellipses().outline, {"count": 8}),
        "Measurement.quantity": Call(m.quantity, {"function": lambda p: p.square().sum(), "which": [[0, 1], [1, 2]]}),
        "Measurement.lengths": Call(m.lengths, {"pairs": [[0, 1]]}),
        "Measurement.angles": Call(m.angles, {"triples": [[0, 1, 2]]}),
        "Measurement.area": Call(m.area, {"corners": [0, 1, 2]}),
        "Quantity.interval": Call(m.lengths().interval, {"level": 0.9}, 3),
        "AccuracyMap.over_image": Call(dp.AccuracyMap.over_image, {**wide, "step": 60.0}, 4),
        "AccuracyMap.over_plane": Call(
            dp.AccuracyMap.over_plane, {**wide, "extent": (0, 0, 30, 20), "shape": (2, 3)}, 4
        ),
        "figures.accuracy": Call(dp.figures.accuracy, {"found": t.accuracy, "unit": "mm"}, 0.1),
        "figures.corners": Call(dp.figures.corners, {"calibration": k}, 0.1),
        "figures.target_shape": Call(
            dp.figures.target_shape, {"calibration": dp.calibrate(t.views, t.board, "none", shape="bow")}, 0.1
        ),
        "figures.fig7": Call(dp.figures.fig7, {"experiment": t.experiment, "magnification": 2.0}, 0.1),
    }


def _uses(t: Things) -> dict[str, Call]:
    c, n, p = t.camera, t.plane, t.pixels
    folder = Path(tempfile.mkdtemp())
    path = folder / "camera.json"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dp.save_camera(path, t.calibration)
    projector = dp.PlaneProjector(c, n)
    prior = dp.CalibrationPrior(t.calibration, view=0)
    world = torch.rand(3, 3, dtype=D)
    return {
        "PlaneProjector": Call(
            dp.PlaneProjector, {"camera": c, "plane": n, "learn": ("focal", "plane"), "tied_intrinsics": None}
        ),
        "PlaneProjector()": Call(projector, {"pixels": p, "warp": torch.eye(3, dtype=D), "plane": n}),
        "PlaneProjector() of a bank": Call(
            dp.PlaneProjector(t.cameras, n), {"pixels": p.expand(2, *p.shape), "camera": [0, 3]}
        ),
        "ProjectorBank": Call(
            dp.ProjectorBank, {"cameras": [c, dp.Camera(t.K, c.R, c.t)], "plane": n, "learn": ("focal",)}
        ),
        "ProjectorBank()": Call(
            dp.ProjectorBank([c, c], n),
            {"pixels": p.expand(2, *p.shape), "camera": [0, 1], "warp": torch.eye(3, dtype=D), "plane": n},
        ),
        "ProjectorBank.miss": Call(
            dp.ProjectorBank([c, c], n).miss,
            {"pixels": p.expand(2, *p.shape), "camera": [0, 1], "warp": torch.eye(3, dtype=D), "plane": n},
        ),
        "PlaneProjector.miss": Call(projector.miss, {"pixels": p, "warp": torch.eye(3, dtype=D), "plane": n}),
        "PlaneProjector() learned": Call(dp.PlaneProjector(c, n, learn="focal"), {"pixels": p}),
        "FixedMap": Call(FixedMap, {"camera": c, "plane": n}),
        "LearnableCamera": Call(
            dp.LearnableCamera,
            {"camera": t.cameras, "learn": {"focal": True, "pose": [True, False, True, True]}, "tied_intrinsics": True},
        ),
        "LearnableRig": Call(
            dp.LearnableRig,
            {
                "rig": {"one": c, "two": c},
                "learn": ("focal", "two.pose", "moments"),
                "moments": [t.cameras.R, t.cameras.t],
            },
        ),
        "LearnableRig[]": Call(dp.LearnableRig({"one": c, "two": c}).__getitem__, {"name": "one"}),
        "LearnablePlane": Call(dp.LearnablePlane, {"plane": t.planes, "scale": 2.0, "learn": [True, False]}),
        "PlaneLoss": Call(dp.PlaneLoss, {"loss": dp.Huber(1.0), "pull": 2.0}),
        "PlaneLoss()": Call(
            dp.PlaneLoss(dp.Huber(1.0)),
            {
                "points": world,
                "target": world + 1,
                "valid": torch.tensor([True, False, True]),
                "weights": torch.ones(3, dtype=D),
                "resolution": torch.ones(3, dtype=D),
            },
            20,
        ),
        "PlaneLoss.counted": Call(
            dp.PlaneLoss(pull=1.0).counted,
            {
                "points": world,
                "target": world + 1,
                "valid": torch.tensor([True, False, True]),
                "miss": torch.ones(3, dtype=D),
            },
        ),
        "CalibrationPrior": Call(dp.CalibrationPrior, {"calibration": t.calibration, "view": 1}),
        "CalibrationPrior()": Call(prior, {"camera": t.calibration.cameras[0]}),
        "draw_target": Call(
            dp.draw_target,
            {"target": t.board, "path": folder / "board.svg", "paper": "A5", "dpi": 60, "unit": "mm"},
            3,
        ),
        "write_measuring_page": Call(
            dp.write_measuring_page,
            {
                "path": folder / "page.html",
                "photograph": torch.zeros(96, 128, dtype=torch.uint8),
                "calibration": t.camera,
                "plane": t.plane,
                "pixel_sigma": 0.5,
                "unit": "mm",
                "orientation": "sensor",
            },
            2,
        ),
        "write_measuring_page of a view": Call(
            dp.write_measuring_page,
            {
                "path": folder / "page.html",
                "photograph": np.zeros((96, 128, 3), dtype=np.uint8),
                "calibration": t.calibration,
                "view": 0,
            },
            2,
        ),
        "write_report": Call(
            dp.write_report,
            {
                "path": folder / "report.html",
                "calibration": t.calibration,
                "photographs": torch.zeros(len(t.views), 1, 96, 128, dtype=torch.uint8),
                "folds": 4,
                "target": t.board,
                "orientation": "sensor",
                "title": "A camera",
                "camera_file": "camera.json",
            },
            0.1,
        ),
        "save_camera": Call(dp.save_camera, {"path": folder / "saved.json", "camera": c, "format": "json"}, 3),
        "load": Call(dp.load, {"path": path, "camera": None}, 3),
        "load_camera": Call(dp.load_camera, {"path": path, "format": "json"}, 3),
        "load_calibration": Call(dp.load_calibration, {"path": path, "camera": None}, 3),
    }


def print_nothing(*_: object) -> None:
    """A function for progress."""


# ------------------------------------------------------------------------------------------------------- the tests

OTHER = {
    "Lens",  # protocols, and what they ask of users' own classes
    "Loss",
    "Observation",
    "LensComparison",  # results that are made inside
    "Baseline",
    "RigCalibration",
    "RigCrossValidation",
    "Triangulation",
    "Adjustment",
    "Calibration",
    "Covariance",
    "CrossValidation",
    "Experiment",
    "AccuracyMap",
    "FusedMeasurement",
    "Measurement",
    "Mounting",
    "PaperSetup",
    "Quantity",
    "Reason",
    "Status",
    "Ellipses",
    "Positions",
}
"""Classes that users do not build by hand."""


def test_the_list_is_whole() -> None:
    """No public function, class or method with an argument is missing."""
    wanted = set()
    for name in dp.__all__:
        thing = getattr(dp, name)
        if not inspect.isclass(thing):
            wanted.add(name)
        elif not issubclass(thing, BaseException | dict) and not inspect.isabstract(thing):
            wanted |= {name} - OTHER
            wanted |= {f"{name}.{method}" for method in vars(thing) if _has_arguments(thing, method)}
    for module in (dp.synthetic, dp.figures):
        wanted |= {f"{module.__name__.rsplit('.', 1)[1]}.{name}" for name in vars(module) if _is_own(module, name)}
    listed = {name.split()[0].replace("()", ".forward") for name in calls()}
    listed |= {name.removesuffix(".forward") for name in listed}
    assert sorted(wanted - listed - NOT_CALLED) == []


NOT_CALLED = {
    "Camera.unchecked",  # which look at nothing, for parts that were looked at
    "Plane.unchecked",
    "Views.unchecked",
    "PlaneMap.unchecked",
    "PlaneMap.quietly",  # as the constructor
    "Camera.warped_by",
    "BrownConrady.undistort_apart",  # as undistort
    "torchvision_warp",  # which needs torchvision, and has a test of its own
    "Covariance.from_fields",  # of files
    "RigCalibration.from_fields",
    "SoftL1.value",  # as Huber's and Cauchy's
    "SoftL1.weight",
    "Cauchy.value",
    "Huber.weight",
    "figures.content",  # for the command line, which looked at what is drawn
    "figures.landmarks",
    "figures.measured",
    "Lens.distort",
    "Lens.undistort",
    "Lens.project_direction",
    "Lens.unproject",
    "Lens.to",
    "Lens.expand",
    "Observation.residuals",
    "Loss.value",
    "Loss.weight",
    *(
        f"{lens}.{method}"
        for lens in ("BrownConrady", "KannalaBrandt")
        for method in ("turned", "by_direction", "by_coefficients")
    ),
    "Plane.to",  # as Camera's
    "figures.png",
}


def _has_arguments(kind: type, method: str) -> bool:
    function = inspect.getattr_static(kind, method)
    function = getattr(function, "__func__", function)
    if method.startswith("_") or not inspect.isfunction(function):
        return False
    return len(inspect.signature(function).parameters) > 1


def _is_own(module: Any, name: str) -> bool:
    thing = getattr(module, name)
    return inspect.isfunction(thing) and thing.__module__ == module.__name__ and not name.startswith("_")


def test_calls_are_right_as_they_are_listed(hostile: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, call in calls().items():
            if name != "register_lens":
                assert call.function(**call.given) is not NotImplemented, name


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """For what is written by a name that stands for a path."""
    monkeypatch.chdir(tmp_path)


def test_wrong_arguments(hostile: Any) -> None:
    each = hostile(calls(), strangers(things()))
    assert [fault for number in range(2000) if (fault := each.attempt(0, number))] == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 11))
def test_many_wrong_arguments(hostile: Any, seed: int) -> None:
    each = hostile(calls(), strangers(things()))
    assert [fault for number in range(10_000) if (fault := each.attempt(seed, number))] == []
