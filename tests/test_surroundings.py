"""What surrounds a call changes nothing that it gives: other threads, PyTorch's defaults, warnings as errors."""

import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import diffproj as dp
from diffproj.targets import synthetic

D = torch.float64
THREADS = 8
Alone = Callable[[str], list[Any]]


class Shared:
    """What the calls below work on: the same objects for all of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.board, every = dp.Chessboard(), dp.example_views("left")
        self.views, self.others = every[:6], every[6:9]
        self.calibration = dp.calibrate(self.views, self.board, "brown4")
        self.camera = self.calibration.cameras[0]
        coefficients = torch.tensor([0.01, -0.02, 0.001, 0.0], dtype=D)
        self.fisheye = dp.Camera(self.camera.K, self.camera.R, self.camera.t, dp.KannalaBrandt(coefficients))
        self.pinhole = dp.Camera(self.camera.K, self.camera.R, self.camera.t, size=(640, 480))
        self.plane, self.slanted = dp.Plane.z(0.0), dp.Plane([0.1, 0.2, 1.0], 3.0)
        self.pixels = self.views.pixels[0, ::9].clone()
        self.points = self.board.points[::7].clone()
        self.image = torch.rand(1, 48, 64, dtype=D, generator=torch.Generator().manual_seed(0))
        self.photograph = synthetic.photograph(self.camera, self.board)
        self.file = folder / "calibration.json"
        dp.save_camera(self.file, self.calibration)
        self.projector = dp.PlaneProjector(self.camera, self.plane)
        self.learning = dp.PlaneProjector(self.camera, self.plane, learn=("focal", "distortion", "pose", "plane"))
        self.prior = dp.CalibrationPrior(self.calibration)


def measured(shared: Shared) -> list[Any]:
    found = dp.measure(
        shared.pixels,
        shared.calibration,
        shared.slanted,
        view=0,
        plane_covariance=1e-6 * torch.eye(4, dtype=D, device="cpu"),
    )
    middle = found.quantity(lambda p: p.mean(dim=0)[0], [[0, 1, 2]])
    numbers = [found.lengths(), found.angles(), found.area(), middle]
    intervals = [quantity.interval() for quantity in numbers]
    return [
        found.points,
        found.covariance,
        found.deviations,
        found.joint(),
        found.interval(),
        found.nonlinear,
        intervals,
        [(quantity.value, quantity.deviation) for quantity in numbers],
        found.summary(),
    ]


def maps(shared: Shared) -> list[Any]:
    found = [
        dp.AccuracyMap.over_image(shared.calibration, view=0, step=200),
        dp.AccuracyMap.over_plane(shared.calibration, (0, 0, 200, 125), view=0, shape=(3, 4)),
    ]
    return [(m.pixels, m.points, m.covered, m.resolution, m.deviation) for m in found]


def fitted(calibration: dp.Calibration) -> list[Any]:
    covariance = calibration.covariance
    return [
        calibration.cameras,
        calibration.rms,
        calibration.view_rms,
        calibration.status,
        covariance.full(),
        covariance.deviations,
        calibration.ambiguous,
        calibration.pixel_sigma,
        calibration.summary(),
    ]


def cameras(shared: Shared) -> list[Any]:
    found: list[Any] = []
    for camera in (shared.camera, shared.fisheye, shared.pinhole):
        found += [
            camera.project(shared.points),
            camera.rays(shared.pixels),
            camera.directions(shared.pixels),
            camera.center,
            camera.upright().K,
            camera.to_opencv()[:3],
            dp.Camera.from_opencv(*camera.to_opencv()[:1]).K,
            camera.to(torch.float32).K,
            camera.without_pose().R,
            dp.Camera.stack([camera, camera]).K,
        ]
    return [
        *found,
        shared.pinhole.resized((320, 240)).K,
        shared.pinhole.cropped(1.0, 2.0, 100, 90).K,
        shared.pinhole.in_image(shared.pixels),
        dp.Camera.from_kornia(shared.pinhole.to_kornia()).K,
        shared.camera.warped(shared.camera.K @ shared.camera.K.inverse()).K,
        dp.Camera.from_opencv(np.eye(3), rvec=[0.1, 0.2, 0.3]).R,
    ]


def lenses(shared: Shared) -> list[Any]:
    found = []
    for lens in (
        dp.BrownConrady(shared.camera.distortion.coefficients.clone()),
        dp.KannalaBrandt(shared.fisheye.distortion.coefficients.clone()),
    ):
        xy = lens.project_direction(shared.camera.directions(shared.pixels)[0])
        found += [lens.domain, xy, lens.unproject(xy[0]), lens.to(torch.float32).coefficients]
    return found


def planes(shared: Shared) -> list[Any]:
    plane = dp.Plane.from_points(shared.points + torch.tensor([0.0, 0, 7], dtype=D, device="cpu"))
    heights = dp.Plane.per_point([0.0, 0.0, 1.0], shared.pixels[:, 0])
    return [
        plane.normal,
        plane.offset,
        plane.rms(shared.points),
        plane.distance(shared.points),
        dp.plane_axes(plane),
        plane.tangents(),
        shared.slanted.parallel(0.1).offset,
        shared.slanted.distance(shared.points),
        heights.offset,
        dp.Plane.z(0.1).offset,
    ]


def gradients(shared: Shared) -> list[Any]:
    pixels, K = shared.pixels.clone().requires_grad_(), shared.camera.K.clone().requires_grad_()
    camera = dp.Camera(K, shared.camera.R, shared.camera.t, shared.camera.distortion)
    total = dp.measure(pixels, camera, shared.slanted, pixel_sigma=0.3).deviations.sum()
    total = total + dp.ground_resolution(pixels, camera, shared.plane)[0].sum() + camera.rays(pixels)[1].sum()
    return list(torch.autograd.grad(total, [pixels, K]))


def modules(shared: Shared) -> list[Any]:
    points, valid = shared.learning(shared.pixels)
    loss = dp.PlaneLoss(dp.Huber(0.1))(
        points, torch.zeros_like(points), valid, resolution=shared.learning.map().resolution(shared.pixels)[0]
    )
    slopes = torch.autograd.grad(loss, list(shared.learning.parameters()))
    fresh = dp.PlaneProjector(shared.camera, shared.plane, learn={"focal": True, "plane": True})
    return [
        shared.projector(shared.pixels),
        points,
        loss,
        slopes,
        shared.prior(shared.camera),
        fresh(shared.pixels),
        dp.LearnableCamera(shared.camera, "pose")().R,
        dp.LearnablePlane(shared.slanted)().normal,
        dp.CalibrationPrior(shared.calibration, view=0)(shared.camera),
    ]


def files(shared: Shared) -> list[Any]:
    path = shared.folder / f"{id(object())}-{np.random.default_rng().integers(10**12)}.json"
    dp.save_camera(path, shared.calibration)
    again, camera = dp.load_calibration(path), dp.load_camera(shared.file)
    path.unlink()
    return [again.cameras, again.covariance.full(), camera]


def pictures(shared: Shared) -> list[Any]:
    top = dp.rectify(
        shared.image,
        dp.Camera(shared.camera.K, shared.camera.R, shared.camera.t, size=(64, 48)),
        shared.plane,
        (0, 0, 200, 125),
        10.0,
    )
    return [
        top,
        dp.render(shared.image, shared.pinhole, shared.plane, (0, 0, 200, 125), size=(40, 30)),
        synthetic.photograph(shared.camera, shared.board),
        dp.detect(shared.photograph, shared.board).pixels,
        synthetic.random_cameras(shared.pinhole, shared.board, 3).t,
        synthetic.corner_views(shared.calibration.cameras, shared.board).pixels,
    ]


def rigs(shared: Shared) -> list[Any]:
    views = {name: dp.example_views(name)[:6] for name in ("left", "right")}
    priors = {"right.baseline": (83.2, 1.0), "left.focal": (533.0, 5.0)}
    found: list[Any] = []
    for rig in dp.calibrate_rig([views, {name: some[1:] for name, some in views.items()}], shared.board, priors=priors):
        assert isinstance(rig, dp.RigCalibration)
        points = rig.triangulate({name: some.pixels[1, ::9] for name, some in views.items()})
        found += [
            *rig.cameras.values(),
            rig.rms,
            rig.covariance.shared,
            rig.summary(),
            points.points,
            points.covariance,
        ]
    return found


def calibrations(shared: Shared) -> list[Any]:
    twice = dp.Views(shared.views.pixels.expand(2, -1, -1, -1), size=shared.views.size)
    return fitted(dp.calibrate(twice, shared.board, "brown4")[1])


def evidence(shared: Shared) -> list[Any]:
    mast = dp.Camera.mounted(6.0, 20.0, fov_deg=70.0, size=(640, 480))
    places = [[1.0, 12.0, 0.0], [-3.0, 15.0, 0.0], [4.0, 20.0, 1.0], [-2.0, 9.0, 0.5]]
    seen = mast.project(places)[0] + 0.3
    found = dp.adjust(
        mast, [dp.Seen(places, seen), dp.Horizon([[0.0, 10.0], [600.0, 12.0]], 3.0)], priors={"height": 0.05}
    )
    near = [dp.measure(seen[:2], one, shared.plane, pixel_sigma=1.0) for one in (found, mast)]
    fused = dp.fuse(near)
    return [found.camera, found.summary(), fused.points, fused.deviations, fused.summary(), fused.to_dict()]


def batches(shared: Shared) -> list[Any]:
    two = dp.stack([shared.camera, shared.calibration.cameras[1]])
    bank = dp.ProjectorBank([shared.camera, shared.pinhole], shared.plane)
    rig = dp.LearnableRig({"one": shared.camera, "two": shared.calibration.cameras[1]})
    return [
        two,
        *two,
        dp.collate([{"camera": shared.camera}, {"camera": two[1]}]),
        *(one(shared.pixels) for one in dp.PlaneMap(two, shared.slanted)),
        bank(shared.pixels.expand(2, -1, -1), camera=[1, 0]),
        rig(),
        dp.geotransform((0, 0, 200, 125), 0.5, (3.0, 4.0)),
    ]


CALLS: dict[str, Callable[[Shared], Any]] = {
    "calibrate": lambda s: fitted(dp.calibrate(s.views, s.board, "brown4")),
    "calibrate with a prior": lambda s: fitted(
        dp.calibrate(s.views, s.board, "brown4", priors={"f_x": (533.1, 1e-7), "distortion": (0.0, 0.1)})
    ),
    "calibrate robustly": lambda s: fitted(
        dp.calibrate(s.views, s.board, "none", loss=dp.Huber(0.3), objective="plane")
    ),
    "calibrate without outliers": lambda s: fitted(dp.calibrate(s.views, s.board, "brown4", reject_outliers=True)),
    "calibrate a fisheye": lambda s: fitted(dp.calibrate(s.views, s.board, "fisheye", tied_focal=True)),
    "choose a lens": lambda s: fitted(dp.calibrate(s.views, s.board, "auto")),
    "one of many calibrations": calibrations,
    "calibrate rigs, and triangulate": rigs,
    "refine": lambda s: fitted(
        dp.refine(s.views, s.board, s.calibration.cameras, weights=torch.tensor(2.5, dtype=D, device="cpu"))
    ),
    "locate": lambda s: dp.locate(s.others, s.board, s.calibration).cameras,
    "cross_validate": lambda s: dp.cross_validate(s.views, s.board, "brown4", folds=2).summary(),
    "bootstrap": lambda s: dp.bootstrap(s.views, s.board, "none", draws=2),
    "run_experiment": lambda s: dp.run_experiment(s.views, s.others, s.board, "brown4").rows,
    "back_project": lambda s: dp.back_project(s.pixels, s.camera, s.plane),
    "back_project behind a fisheye": lambda s: dp.back_project(s.pixels, s.fisheye, s.slanted),
    "explain": lambda s: dp.explain(s.pixels, s.camera, s.plane),
    "ground_resolution": lambda s: [
        dp.ground_resolution(s.pixels, c, s.slanted) for c in (s.camera, s.fisheye, s.pinhole)
    ],
    "measure": measured,
    "AccuracyMap": maps,
    "residuals": lambda s: [
        dp.image_residuals(s.calibration.cameras, s.views, s.board),
        dp.plane_residuals(s.calibration.cameras, s.views, s.board),
    ],
    "euler": lambda s: [dp.euler_from_rotation(s.camera.R), dp.rotation_from_euler(*s.points[1].unbind())],
    "paper": lambda s: [dp.paper_route(s.pixels, s.pinhole, s.plane), dp.paper_setup().cameras.t],
    "Camera": cameras,
    "lenses": lenses,
    "Plane": planes,
    "Views": lambda s: [
        s.views[1:3].pixels,
        s.views.hiding(np.arange(54) % 2 == 1).visible,
        dp.Views([[[1, 2], [3, 4]]]).pixels,
        dp.example_views("right").pixels,
    ],
    "losses": lambda s: [loss(0.1).value(s.points) for loss in (dp.Huber, dp.SoftL1, dp.Cauchy)],
    "gradients": gradients,
    "modules": modules,
    "evidence": evidence,
    "batches": batches,
    "files": files,
    "pictures": pictures,
}


def plain(found: Any) -> list[Any]:
    """Tensors and all else in a flat list."""
    if isinstance(found, dict):
        found = [*found.keys(), *found.values()]
    if isinstance(found, list | tuple):
        return [item for part in found for item in plain(part)]
    if isinstance(found, dp.Camera):
        return [tensor.detach() for tensor in found.tensors()]
    return [
        torch.from_numpy(found)
        if isinstance(found, np.ndarray)
        else found.detach()
        if isinstance(found, torch.Tensor)
        else found
    ]


def check_same(name: str, found: Any, wanted: list[Any]) -> None:
    found = plain(found)
    assert len(found) == len(wanted), name
    for number, (got, want) in enumerate(zip(found, wanted, strict=True)):
        if isinstance(want, torch.Tensor):
            assert (got.dtype, got.device, got.shape) == (want.dtype, want.device, want.shape), (name, number)
            assert torch.equal(got.nan_to_num(nan=7.0), want.nan_to_num(nan=7.0)), (name, number, got, want)
        else:
            assert got == want, (name, number)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Shared:
    return Shared(tmp_path_factory.mktemp("shared"))


@pytest.fixture(scope="module")
def alone(shared: Shared) -> Alone:
    """What one thread gets under PyTorch's own defaults."""
    return cache(lambda name: plain(CALLS[name](shared)))


@contextmanager
def defaults(dtype: torch.dtype, device: str) -> Iterator[None]:
    torch.set_default_dtype(dtype)
    try:
        with torch.device(device):
            yield
    finally:
        torch.set_default_dtype(torch.float32)


QUICK = [
    "calibrate with a prior",
    "calibrate rigs, and triangulate",
    "locate",
    "back_project",
    "explain",
    "ground_resolution",
    "measure",
    "residuals",
    "euler",
    "paper",
    "Camera",
    "lenses",
    "Plane",
    "Views",
    "losses",
    "gradients",
    "modules",
    "evidence",
    "batches",
    "files",
]


def under_other_defaults(shared: Shared, alone: Alone, names: Sequence[str], dtype: torch.dtype, device: str) -> None:
    for name in names:
        with defaults(dtype, device):
            found = plain(CALLS[name](shared))
        check_same(name, found, alone(name))


@pytest.mark.parametrize(("dtype", "device"), [(torch.float16, "meta"), (torch.float64, "cpu")])
def test_the_defaults_of_pytorch_change_nothing(shared: Shared, alone: Alone, dtype: torch.dtype, device: str) -> None:
    under_other_defaults(shared, alone, QUICK, dtype, device)


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "device"), [(torch.float16, "meta"), (torch.float64, "cpu")])
def test_the_defaults_of_pytorch_change_nothing_at_all(
    shared: Shared, alone: Alone, dtype: torch.dtype, device: str
) -> None:
    under_other_defaults(shared, alone, list(CALLS), dtype, device)


def in_threads(shared: Shared, wanted: dict[str, list[Any]], rounds: int) -> None:
    """Each thread starts at another of the calls, so that different ones meet, and in the end all are at the same."""
    names = list(wanted)

    def run(thread: int) -> None:
        for turn in range(rounds):
            name = names[(turn + 5 * thread) % len(names)]
            check_same(name, CALLS[name](shared), wanted[name])
        for name in ("ground_resolution", "gradients"):
            check_same(name, CALLS[name](shared), wanted[name])

    with often_switched(), ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(run, range(THREADS)))


def in_pairs(shared: Shared, slow: dict[str, list[Any]], quick: dict[str, list[Any]]) -> None:
    """Three pairs of threads make the slow calls, both of a pair the same one at the same moment; two more threads go
    round the quick calls, from two places, until the slow ones are made.
    """
    waiting = iter(slow)

    def same(name: str) -> None:
        check_same(name, CALLS[name](shared), (slow | quick)[name])

    def pairs() -> None:
        for name in waiting:
            twin = pool.submit(same, name)
            same(name)
            twin.result()

    def around(place: int) -> None:
        for name in islice(cycle(quick), place, None):
            if all(one.done() for one in slowly):
                break
            same(name)

    with often_switched(), ThreadPoolExecutor(THREADS) as pool:
        slowly = [pool.submit(pairs) for _ in range(THREADS // 2 - 1)]
        quickly = [pool.submit(around, place) for place in (0, len(quick) // 2)]
        for one in (*slowly, *quickly):
            one.result()


@contextmanager
def often_switched() -> Iterator[None]:
    """Threads take turns a hundred times as often as they do."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(before / 100)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@pytest.mark.slow
def test_threads_that_share_all_objects(shared: Shared, alone: Alone) -> None:
    in_threads(shared, {name: alone(name) for name in QUICK}, rounds=6)


@pytest.mark.slow
def test_threads_that_share_all_objects_in_every_call(shared: Shared, alone: Alone) -> None:
    quick = [name for name in QUICK if name != "measure"]
    slow = {name: alone(name) for name in CALLS if name not in quick}
    in_pairs(shared, slow, {name: alone(name) for name in quick})
