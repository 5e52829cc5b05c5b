"""Arguments that users get wrong, each refused by its name; and arrays and lists, which are taken for tensors."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import diffproj as dp

pytestmark = pytest.mark.plain  # checks of types at run time would answer first

D = torch.float64
BOARD, PLANE = dp.Chessboard(), dp.Plane.z(0.0)
VIEWS = dp.example_views("left")
CAMERA = dp.Camera(
    torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D),
    t=torch.tensor([0.0, 0, 500], dtype=D),
    size=(640, 480),
)
PIXELS = torch.tensor([[320.0, 240], [400, 300], [100, 50]], dtype=D)
IMAGE = torch.rand(1, 480, 640, dtype=D)


@pytest.fixture(scope="module")
def calibration() -> dp.Calibration:
    return dp.calibrate(VIEWS, BOARD)


def nested(tensor: torch.Tensor) -> torch.Tensor:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch's own: they are a prototype
        return torch.nested.nested_tensor([tensor, tensor])


Case = tuple[type[Exception], str, Callable[[dp.Calibration], Any]]

WRONG: list[Case] = [
    # What a plane, a camera, a calibration, views, a board and a loss are.
    (TypeError, r"plane: want a dp\.Plane, got tuple; dp\.Plane\(normal, offset\)", lambda _: dp.PlaneMap(CAMERA, (0, 0, 1))),
    (TypeError, "plane: want .* got 0.0", lambda _: dp.back_project(PIXELS, CAMERA, np.float64(0.0))),
    (TypeError, "plane: want .* got None", lambda _: dp.rectify(IMAGE, CAMERA, None, (0, 0, 9, 9), 1)),
    (TypeError, "plane: want .* got the class Plane", lambda _: dp.plane_axes(dp.Plane)),
    (TypeError, "plane: want .* got Camera", lambda k: dp.measure(PIXELS, k, CAMERA, view=0)),
    (TypeError, "camera: want .* got Calibration; give its .camera", lambda k: dp.back_project(PIXELS, k, PLANE)),
    (TypeError, "camera: want .* got Plane", lambda _: dp.back_project(PIXELS, PLANE, CAMERA)),
    (TypeError, "plane: want a dp.Plane, got Calibration", lambda k: dp.measure(PIXELS, PLANE, k)),
    (ValueError, "pixel_sigma: want the noise of the pixels in px", lambda _: dp.AccuracyMap.over_image(CAMERA)),
    (TypeError, "calibration: want a dp.Calibration, got Camera", lambda _: dp.CalibrationPrior(CAMERA)),
    (TypeError, "views: want dp.Views, got Tensor", lambda _: dp.cross_validate(VIEWS.pixels, BOARD)),
    (TypeError, "views: want dp.Views, got Chessboard", lambda _: dp.image_residuals(CAMERA, BOARD, VIEWS)),
    (TypeError, "fit: want dp.Views, got list", lambda _: dp.run_experiment([0, 1], VIEWS, BOARD)),
    (TypeError, "board: want a dp.Chessboard, .* got tuple", lambda _: dp.synthetic.board_texture((9, 6))),
    (TypeError, "target: want an instance, as dp.Chessboard", lambda _: dp.calibrate(VIEWS, dp.Chessboard)),
    (TypeError, "loss: want one such as .* got the class Huber", lambda _: dp.calibrate(VIEWS, BOARD, loss=dp.Huber)),
    (TypeError, "distortion: want a lens .* got the class BrownConrady", lambda _: dp.Camera(CAMERA.K, distortion=dp.BrownConrady)),
    (TypeError, "pinhole: want kornia's PinholeCamera, got Camera", lambda _: dp.Camera.from_kornia(CAMERA)),
    # Options.
    (TypeError, "draws: want a whole number of at least 2.* got 2.5", lambda _: dp.bootstrap(VIEWS, BOARD, draws=2.5)),
    (TypeError, "bow: want True or False, got 'x'", lambda _: dp.calibrate(VIEWS, BOARD, bow="x")),
    (TypeError, "throw: want True or False, got 'x'", lambda _: dp.locate(VIEWS, BOARD, CAMERA, throw="x")),
    (TypeError, "progress: want a function .* got 3", lambda _: dp.calibrate(VIEWS, BOARD, progress=3)),
    (TypeError, "weights: want .* got 'x'", lambda _: dp.calibrate(VIEWS, BOARD, weights="x")),
    (TypeError, "priors.*f_x.*: want .* got 'x'", lambda _: dp.calibrate(VIEWS, BOARD, priors={"f_x": ("x", 1.0)})),
    (TypeError, "fixed: want several names, got 3 among them", lambda _: dp.calibrate(VIEWS, BOARD, fixed=[3])),
    (TypeError, "max_iterations: want .* got 3.5", lambda _: dp.calibrate(VIEWS, BOARD, max_iterations=3.5)),
    (ValueError, "tolerance: want .* got -1.0", lambda _: dp.calibrate(VIEWS, BOARD, tolerance=-1)),
    (TypeError, "seed: want a whole number", lambda _: dp.bootstrap(VIEWS, BOARD, seed="a")),
    (ValueError, "pixel_sigma: want .* got 'x'", lambda k: dp.measure(PIXELS, k, PLANE, view=0, pixel_sigma="x")),
    (TypeError, "size: want .width, height. in whole px, got 5", lambda _: CAMERA.resized(5)),
    (TypeError, "size: want .width, height. in whole px, got 5", lambda _: dp.render(IMAGE, CAMERA, PLANE, (0, 0, 9, 9), size=5)),
    (ValueError, r"extent: want .* got \(0, 0, 9\)", lambda _: dp.rectify(IMAGE, CAMERA, PLANE, (0, 0, 9), 1)),
    (ValueError, r"extent: want .* got \(0, 0, 9\)", lambda k: dp.AccuracyMap.over_plane(k, (0, 0, 9), view=0)),
    (ValueError, "resolution: want .* got 1e-09, and 9e", lambda _: dp.rectify(IMAGE, CAMERA, PLANE, (0, 0, 9, 9), 1e-9)),
    (ValueError, "resolution: want .* got 0.0", lambda _: dp.rectify(IMAGE, CAMERA, PLANE, (0, 0, 9, 9), 0)),
    (ValueError, "resolution: want .* got nan", lambda _: dp.rectify(IMAGE, CAMERA, PLANE, (0, 0, 9, 9), np.nan)),
    (ValueError, "shape: want .rows, columns.* got 0", lambda k: dp.AccuracyMap.over_plane(k, (0, 0, 9, 9), view=0, shape=(0, 1))),
    (ValueError, "step: want .* got nan", lambda k: dp.AccuracyMap.over_image(k, view=0, step=np.nan)),
    (ValueError, "level: want a probability", lambda k: dp.measure(PIXELS, k, PLANE, view=0, pixel_sigma=0.5).interval(1.5)),
    (TypeError, "learn: want names of parts, got 3", lambda _: dp.PlaneProjector(CAMERA, PLANE, learn=3)),
    (ValueError, "scale: want .* got -2.0", lambda _: dp.LearnablePlane(PLANE, scale=-2.0)),
    # Views, points and functions of them.
    (TypeError, "view: want a number from -13 to 12, of the views, got list", lambda k: dp.measure(PIXELS, k, PLANE, view=[0, 3])),
    (TypeError, "view: want a number .* got Tensor", lambda k: dp.measure(PIXELS, k, PLANE, view=torch.tensor([0]))),
    (TypeError, "view: want a number .* got 1.5", lambda k: dp.measure(PIXELS, k, PLANE, view=1.5)),
    (TypeError, "view: want a number .* got True", lambda k: dp.measure(PIXELS, k, PLANE, view=True)),
    (ValueError, "view: want a number .* got 13", lambda k: dp.CalibrationPrior(k, view=13)),
    (ValueError, "view: want a number .* got 13", lambda k: k.covariance.view(13)),
    (ValueError, "corners: want the numbers .* of one polygon", lambda k: dp.measure(PIXELS, k, PLANE, view=0, pixel_sigma=0.5).area([[0, 1, 2]])),
    (ValueError, "corners: want at least 3, got 2", lambda k: dp.measure(PIXELS, k, PLANE, view=0, pixel_sigma=0.5).area([0, 1])),
    (IndexError, "pairs: want numbers of the 3 points", lambda k: dp.measure(PIXELS, k, PLANE, view=0, pixel_sigma=0.5).lengths([[0, 3]])),
    (
        ValueError,
        "function: want one that gives a number, .* got Tensor of shape",
        lambda k: dp.measure(PIXELS, k, PLANE, view=0, pixel_sigma=0.5).quantity(lambda p: p, [[0]]),
    ),
    (TypeError, "function: want a function", lambda k: dp.measure(PIXELS, k, PLANE, view=0, pixel_sigma=0.5).quantity(3, [[0]])),
    # Arrays and tensors.
    (TypeError, "pixels: want torch.float64 as camera has.*pixels.to", lambda _: dp.back_project(PIXELS.float(), CAMERA, PLANE)),
    (TypeError, "pixels: want .* lists of numbers of equal lengths", lambda _: dp.back_project([[1, 2], [3]], CAMERA, PLANE)),
    (TypeError, "pixels: want a dense tensor, got layout torch.sparse_coo; .to_dense", lambda _: dp.back_project(PIXELS.to_sparse(), CAMERA, PLANE)),
    (TypeError, "pixels: want a dense tensor, got a nested one", lambda _: dp.back_project(nested(PIXELS), CAMERA, PLANE)),
    (TypeError, "pixels: want a floating-point tensor, got torch.complex128; .real", lambda _: dp.back_project(PIXELS + 0j, CAMERA, PLANE)),
    (ValueError, "pixels: want an array without masked entries, got some", lambda _: dp.back_project(np.ma.masked_less(PIXELS.numpy(), 60), CAMERA, PLANE)),
    (ValueError, "visible: want an array without masked entries, got some", lambda _: dp.Views(VIEWS.pixels, np.ma.masked_equal(VIEWS.visible.numpy(), True))),
    (TypeError, "size: want .width, height. in whole px, got .True, True", lambda _: CAMERA.resized((True, True))),
    (TypeError, "image: want a tensor .* got ndarray of shape", lambda _: dp.rectify(IMAGE.numpy(), CAMERA, PLANE, (0, 0, 9, 9), 1)),
    (ValueError, "weights: want a shape that broadcasts to", lambda _: dp.PlaneLoss()(PIXELS.new_ones(3, 3), PIXELS.new_ones(3, 3), weights=PIXELS.new_ones(3, 1))),
    (ValueError, "phi|broadcast", lambda _: dp.rotation_from_euler(torch.zeros(2), torch.zeros(3), torch.zeros(2))),
    (TypeError, "distance: want .* got 'far'", lambda _: PLANE.parallel("far")),
    (ValueError, "distance: want finite", lambda _: PLANE.parallel(float("nan"))),
    # Nothing.
    (ValueError, "views: want at least one, got none", lambda _: dp.calibrate(VIEWS[:0], BOARD)),
    (ValueError, "test: want at least one view", lambda _: dp.run_experiment(VIEWS, VIEWS[:0], BOARD)),
    (ValueError, "views: want those of at least one camera", lambda _: dp.calibrate(dp.Views(torch.zeros(0, 3, 54, 2), size=(9, 9)), BOARD)),
    (ValueError, "views: want 54 corners", lambda _: dp.calibrate(dp.Views(torch.zeros(3, 0, 2), size=(9, 9)), BOARD)),
    (ValueError, "image: want at least one channel and one pixel", lambda _: dp.rectify(IMAGE[:, :0], CAMERA, PLANE, (0, 0, 9, 9), 1)),
    (
        ValueError,
        "distance: want poses from which the whole board is in view, got 0 of 2 views",
        lambda _: dp.synthetic.random_cameras(CAMERA, BOARD, 2, distance=(0.01, 0.02)),
    ),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "message", "call"), WRONG, ids=range(len(WRONG)))
def test_an_argument_is_refused_by_name(
    kind: type[Exception], message: str, call: Callable[[dp.Calibration], Any], calibration: dp.Calibration
) -> None:
    with pytest.raises(kind, match=message):
        call(calibration)


def test_a_map_without_places_in_the_image_is_not_drawn(calibration: dp.Calibration) -> None:
    nowhere = dp.AccuracyMap.over_plane(calibration, (1e5, 1e5, 2e5, 2e5), view=0, shape=(3, 4))
    with pytest.raises(ValueError, match="found: want a map .* got 0 of 3 x 4 in the image"):
        dp.figures.accuracy(nowhere)


ARRAYS: dict[str, Callable[[np.ndarray], Any]] = {
    "array": lambda x: x,
    "float32 array": lambda x: x.astype(np.float32),
    "integers": lambda x: x.astype(np.int32),
    "backwards": lambda x: x[::-1].copy()[::-1],
    "by columns": np.asfortranarray,
    "big endian": lambda x: x.astype(">f8"),
    "list": lambda x: x.tolist(),
    "list of arrays": list,
    "masked nowhere": np.ma.masked_invalid,
    "tuples": lambda x: tuple(map(tuple, x.tolist())),
}


@pytest.mark.parametrize("form", ARRAYS.values(), ids=ARRAYS.keys())
@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_arrays_take_the_kind_of_the_camera(form: Callable[[np.ndarray], Any], dtype: torch.dtype) -> None:
    camera, given = CAMERA.to(dtype), form(PIXELS.numpy())
    X, uv = torch.tensor([[10.0, 20, 0], [-30, 5, 10]], dtype=dtype), PIXELS.to(dtype)
    calls: list[tuple[Callable[[Any], Any], Any, Any]] = [
        (lambda p: dp.back_project(p, camera, PLANE)[0], given, uv),
        (lambda p: dp.explain(p, camera, PLANE), given, uv),
        (lambda p: dp.ground_resolution(p, camera, PLANE)[0], given, uv),
        (lambda p: camera.directions(p)[0], given, uv),
        (camera.in_image, given, uv),
        (lambda p: dp.PlaneProjector(camera, PLANE)(p)[0], given, uv),
        (lambda p: camera.project(p)[0], form(X.numpy()), X),
        (lambda x: dp.Plane.z(2.0).distance(x), X.double().numpy(), X.double()),
    ]
    for call, array, tensor in calls:
        assert torch.equal(call(array), call(tensor))
    per_point = dp.Plane.per_point([0.0, 0, 1], torch.arange(3.0, dtype=dtype))
    assert torch.equal(dp.back_project(given, camera, per_point)[0], dp.back_project(uv, camera, per_point)[0])


def test_a_tensor_that_is_kept_as_the_negative_of_another() -> None:
    negative = torch.complex(PIXELS, -PIXELS).conj().imag
    assert negative.is_neg()
    assert torch.equal(dp.back_project(negative, CAMERA, PLANE)[0], dp.back_project(PIXELS, CAMERA, PLANE)[0])
    K = torch.complex(CAMERA.K, -CAMERA.K).conj().imag
    assert torch.equal(dp.Camera(K).K, CAMERA.K)


def test_arrays_become_cameras_planes_and_views() -> None:
    K, t = CAMERA.K.numpy(), [0, 0, 500]
    assert dp.Camera(K, np.eye(3), t).dtype == D
    assert dp.Camera(K.astype(np.float32)).dtype == torch.float32
    assert dp.Camera(K.tolist(), t=torch.tensor([0.0, 0, 500])).dtype == torch.float32  # that of the tensor
    assert dp.Camera(K, distortion=dp.BrownConrady(torch.zeros(5))).dtype == torch.float32
    assert dp.Camera(np.array(K, order="F")[:, ::-1][:, ::-1]).K.tolist() == K.tolist()
    assert dp.BrownConrady([-0.1, 0.01, 0, 0, 0]).dtype == D
    assert dp.Plane(np.array([0, 0, 2]), np.array(4)).distance(np.zeros((1, 3))).tolist() == [-2.0]
    assert torch.equal(dp.Views(VIEWS.pixels.numpy()[::-1]).pixels, VIEWS.pixels.flip(0))
    assert dp.rotation_from_euler(0, 0.5, 0.0).dtype == D


def test_what_is_made_of_an_array_shares_no_memory_with_it() -> None:
    K = CAMERA.K.numpy().copy()
    camera, opencv = dp.Camera(K), dp.Camera.from_opencv(K)
    normal = np.array([0.0, 0, 1])
    plane = dp.Plane(normal)
    K[0, 0], normal[2] = 1.0, 5.0
    assert camera.K[0, 0] == opencv.K[0, 0] == 533
    assert plane.normal.tolist() == [0, 0, 1]


@pytest.mark.parametrize("size", [(12, 200), (200, 12), (1, 1), (1, 3000), (15, 15), (16, 17)])
def test_images_without_room_for_a_board_hold_none(size: tuple[int, int]) -> None:
    for image in (np.zeros(size, np.uint8), np.indices(size).sum(0).astype(np.uint8) % 2 * 255):
        with pytest.raises(dp.BoardNotFoundError):
            dp.detect(image, dp.Chessboard(3, 3))


def test_nothing_in_gives_nothing_out() -> None:
    none = torch.zeros(0, 2, dtype=D)
    points, valid = dp.back_project(none, CAMERA, PLANE)
    assert points.shape == (0, 3)
    assert valid.shape == (0,)
    batch = CAMERA.expand(0)
    assert dp.back_project(PIXELS, batch, PLANE)[0].shape == (0, 3, 3)
    assert dp.ground_resolution(none, CAMERA, PLANE)[0].shape == (0,)
    assert dp.measure(none, CAMERA, PLANE, pixel_sigma=1.0).points.shape == (0, 3)
    empty = dp.Views(torch.zeros(2, 0, 2))
    assert dp.Views(torch.zeros(0, 54, 2)).pixels.shape == (0, 54, 2)
    assert len(empty) == 2
    assert dp.PlaneLoss()(PIXELS.new_zeros(2, 3), PIXELS.new_zeros(2, 3)) == 0


def test_planes_of_numbers_are_stacked_with_planes_of_tensors() -> None:
    both = dp.Plane.stack([dp.Plane.z(1.0), dp.Plane(torch.tensor([0.0, 0, 1]), torch.tensor(2.0))])
    assert both.dtype == torch.float32
    assert both.offset.tolist() == [1, 2]


def test_many_sets_of_pixels_are_measured_from_one_located_view(calibration: dp.Calibration) -> None:
    located = dp.locate(VIEWS[:1], BOARD, calibration)
    far = torch.tensor([[5.0, 5.0], [630, 470]], dtype=D)  # where the lens is extrapolated
    one, two = (
        dp.measure(pixels, located, PLANE, view=0, pixel_sigma=0.5) for pixels in (far, torch.stack([far, far]))
    )
    torch.testing.assert_close(two.deviations, one.deviations.expand(2, 2, 3))
