"""Landmarks: what they take, and what they say of points that cannot be right."""

import numpy as np
import pytest
import torch

import diffproj as dp

SQUARE = [[0.0, 0.0], [1.8, 0.0], [1.8, 4.6], [0.0, 4.6]]
# Marks on a levelling staff that leans by 2 cm, in metres, as measured and as computed.
STAFF = np.array([[20, 30, 0], [20.004, 30.002, 0.5], [20.008, 30.005, 1], [20.013, 30.008, 1.5], [20.018, 30.01, 2]])
LEANING = np.array([20.0, 30.0, 0.0]) + np.outer(np.linspace(0, 2, 6), [0.004321, -0.0012347, 1])
FACADE = np.array([[-180.0, 50, 0], [180, 50, 0], [180, 50, 200], [-180, 50, 200]])  # 360 cm wide


def test_lists_arrays_and_tensors_are_taken_alike() -> None:
    """Two coordinates are points on z = 0; a tensor keeps its dtype and its graph."""
    arrays = [SQUARE, tuple(map(tuple, SQUARE)), np.array(SQUARE), torch.tensor(SQUARE, dtype=torch.float64)]
    for points in arrays:
        found = dp.Landmarks(points)
        assert found.points.tolist() == [[x, y, 0.0] for x, y in SQUARE]
        assert found.points.dtype == torch.float64
    given = torch.tensor(SQUARE, requires_grad=True)
    found = dp.Landmarks(given)
    assert found.points.dtype == torch.float32
    found.points.sum().backward()
    assert given.grad is not None
    assert len(found) == 4
    assert found.names == ("1", "2", "3", "4")


def test_sigma_is_a_number_deviations_or_covariances() -> None:
    """All become a covariance for each point."""
    each = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    assert dp.Landmarks(SQUARE).covariances is None
    one = dp.Landmarks(SQUARE, sigma=0.1).covariances
    assert one is not None
    torch.testing.assert_close(one, 0.01 * torch.eye(3, dtype=torch.float64).expand(4, 3, 3))
    along = each.unsqueeze(-1).expand(4, 3) * torch.tensor([1.0, 2, 3], dtype=torch.float64)
    for sigma, expected in ((each, each.unsqueeze(-1).expand(4, 3)), (along, along)):
        found = dp.Landmarks(SQUARE, sigma=sigma).covariances
        assert found is not None
        torch.testing.assert_close(found, torch.diag_embed(expected.square()))
        again = dp.Landmarks(SQUARE, sigma=found).covariances
        assert again is not None
        torch.testing.assert_close(again, found)


def test_the_line_is_short() -> None:
    """However many points there are."""
    many = dp.Landmarks(np.random.default_rng(0).uniform(0, 100, (5000, 3)), sigma=0.02)
    assert len(repr(many)) < 120
    assert "5000 points" in repr(many)
    assert "<table>" in many._repr_html_()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "want at least 1, got none"),
        (np.zeros((4, 4)), r"want shape \(N, 3\), or \(N, 2\) for points on z = 0, got \(4, 4\)"),
        ([[0, 0, np.nan]] + [[1.0, 2.0, 3.0]] * 3, "want finite coordinates, got \\[0.0, 0.0, nan\\] at 0"),
        (
            np.array(SQUARE, dtype=np.float32) + np.float32(642735),
            "want float64 so far from the origin, got float32, which holds 6.43e[+]05 only to 0.04",
        ),
        ([[54.1753, 12.0812], [54.1755, 12.0815], [54.1751, 12.0817], [54.1750, 12.0811]], "latitude and longitude"),
        ([[-17.0, 179.9995], [-17.0001, -179.9995], [-17.0002, 179.9999], [-17.0001, -179.9999]], "latitude"),
        ([[-79.382, 43.653, 80], [-79.381, 43.652, 95], [-79.380, 43.654, 90], [-79.3815, 43.655, 81]], "latitude"),
        (
            [[-79.3820, 43.65301, 80], [-79.3821, 43.65302, 81], [-79.382, 43.65304, 82.5], [-79.3822, 43.653, 84]],
            "lat",
        ),
        ([[180.0, -17, 0], [-179.9995, -17.0001, 2], [180.0, -17.0002, 0], [-179.9999, -17.0001, 0]], "latitude"),
    ],
)
def test_points_that_cannot_be(points: object, message: str) -> None:
    """One sentence says what is wrong."""
    with pytest.raises(ValueError, match=message):
        dp.Landmarks(points)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "points",
    [
        np.array(SQUARE) + np.array([642735, 8304292]),  # UTM
        np.array(SQUARE) * 0.01 + [0.4, 0.3],  # a marker of centimetres
        np.array(SQUARE) * 0.01 + [150.0, 300.0],
        np.array(SQUARE) + np.array([43.6, 79.4]),  # a hall
        np.column_stack([SQUARE, [1.0, 2, 3, 4]]) + np.array([3.78e6, 9.0e5, 5.04e6]),  # earth-centred
        STAFF,
        STAFF[:, [1, 0, 2]].astype(np.float32),
        LEANING,
        np.array([[20.0, 30.001, 0], [20.001, 30, 0.5], [20, 30.001, 1], [20.001, 30, 1.5]]),  # off by rounding
        np.array([[80.0, 30.001, 0], [80.001, 30, 1], [80, 30.001, 2], [80.001, 30, 3]], dtype=np.float32),
        FACADE,
        FACADE[:, [1, 0, 2]],
        np.array([[0.0, 50, 0], [360, 50, 0], [360, 50, 200], [0, 50, 200]]),
    ],
)
def test_lengths_are_not_taken_for_degrees(points: np.ndarray) -> None:
    """Nor refused for being far away."""
    assert dp.Landmarks(points).points.shape == (len(points), 3)
    pixels = torch.zeros(len(points), 2)
    assert len(dp.Seen(torch.as_tensor(points), pixels, pixel_sigma=1.0)) == len(points)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_than_four_are_landmarks_too(count: int) -> None:
    """For `adjust`; what needs more says so."""
    mast = dp.Landmarks([[12.5, 40.2, 0.0], [12.51, 40.2, 3.0], [12.5, 40.21, 6.0]][:count], sigma=0.1)
    assert len(mast) == count
    views = dp.Views(torch.arange(2.0 * count, dtype=torch.float64).reshape(1, count, 2))
    camera = dp.Camera.mounted(5.0, 10.0, focal=800.0, size=(1280, 720))
    for task in (dp.locate, dp.refine):
        with pytest.raises(ValueError, match=f"target: want at least 4 points.*, got {count}; dp.adjust takes fewer"):
            task(views, mast, camera)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=f"target: want at least 4 points.*, got {count}; dp.adjust takes fewer"):
        dp.calibrate(views, mast)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"names": ["a", "b", "c"]}, ValueError, "names: want one for each of the 4 points, got 3"),
        ({"names": ["a", "b", "c", "a"]}, ValueError, "names: want all different, got 'a' twice"),
        ({"sigma": -1.0}, ValueError, "sigma: want finite standard deviations of at least 0"),
        ({"sigma": [0.1, 0.2]}, ValueError, r"sigma: want a number, or shape \(4,\)"),
        ({"sigma": -np.eye(3) * np.ones((4, 1, 1))}, ValueError, "sigma: want symmetric covariances"),
    ],
)
def test_names_and_sigma_that_cannot_be(options: dict, error: type[Exception], message: str) -> None:
    """They are named."""
    with pytest.raises(error, match=message):
        dp.Landmarks(SQUARE, **options)
