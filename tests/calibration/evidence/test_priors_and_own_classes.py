"""Priors that are tight, wide or go together, observations of one's own, and starts that are far off."""

import pytest
import torch

import diffproj as dp
from diffproj.geometry.cayley import turn_between, turned

D = torch.float64
SIZE = (1280, 960)
TRUE = dp.Camera.mounted(6.0, 20.0, 1.5, 1.0, position=[2.0, -1.0], focal=900.0, size=SIZE)
POINTS = torch.tensor([[0.0, 12, 0], [6, 20, 0], [-3, 25, 0], [8, 30, 0]], dtype=D)
LANDMARKS = dp.Seen(POINTS, TRUE.project(POINTS)[0], pixel_sigma=2.0)


def spreads(found: dp.Adjustment) -> torch.Tensor:
    """Deviations of tilt, roll, heading, x, y and height `(6,)`."""
    return found.mounting_covariance.diagonal().clamp(min=0).sqrt()


class Place:
    """Where the camera stands, off by errors that go together."""

    def __init__(self, place: list[float], covariance: list[list[float]]) -> None:
        self.place = torch.tensor(place, dtype=D)
        self.whiten = torch.linalg.inv(torch.linalg.cholesky(torch.tensor(covariance, dtype=D)))

    def residuals(self, camera: dp.Camera) -> torch.Tensor:
        return (self.whiten @ (camera.center - self.place).unsqueeze(-1)).mT


@pytest.mark.parametrize("start", [(90.0, 60.0), (180.0, 89.0), (270.0, 60.0), (270.0, 89.0)])
def test_deviations_do_not_depend_on_where_adjust_began(start: tuple[float, float]) -> None:
    """From half a turn away they were infinite, and from further than some 110 degrees up to 2 % too large."""
    near = dp.adjust(TRUE, LANDMARKS)
    heading, tilt = start
    far = dp.Camera.mounted(50.0, tilt, 90.0, heading, position=[100.0, 100.0], focal=900.0, size=SIZE)
    found = dp.adjust(far, LANDMARKS)
    torch.testing.assert_close(spreads(found), spreads(near), rtol=1e-6, atol=0)
    torch.testing.assert_close(found.cameras.R, near.cameras.R, rtol=0, atol=1e-7)


@pytest.mark.parametrize("heading", [6.0, 41.0])
def test_what_is_known_of_a_turn_is_about_where_the_camera_began(heading: float) -> None:
    """Not about a direction that a search tried: from 6 degrees off the heading was .12 +- .05 where it is 1."""
    start = dp.Camera.mounted(6.0, 20.0, 1.5, heading, position=[2.0, -1.0], focal=900.0, size=SIZE)
    for known in ({"priors": {"turn_y": 1e-3}}, {"fixed": ("turn_y",)}):
        found = dp.adjust(start, LANDMARKS, **known)  # type: ignore[arg-type]
        about_y = turn_between(start.R, found.cameras.R[0]).rad2deg()[1]
        assert float(about_y) == pytest.approx(0, abs=1e-3)
        assert "residuals are" in found.doubts


@pytest.mark.filterwarnings("ignore")  # remarks on few landmarks
def test_turns_that_are_known_are_kept_from_far_off() -> None:
    """The camera turned 60 degrees about its own x and 20 about z, and not about y."""
    start = dp.Camera.unchecked(
        TRUE.K, turned(TRUE.R, torch.tensor([-60.0, 0, -20], dtype=D).deg2rad()), TRUE.t, None, SIZE
    )
    assert float(turn_between(start.R, TRUE.R)[1]) == pytest.approx(0, abs=1e-12)
    points = torch.cat([POINTS, torch.tensor([[5.0, 15, 1]], dtype=D)])
    pixels = TRUE.project(points)[0]
    views, landmarks = dp.Views(pixels[None], size=SIZE), dp.Landmarks(points)
    for known in ({"priors": {"turn_y": 1e-3}}, {"fixed": ("turn_y",)}):
        found = dp.adjust(start, dp.Seen(points, pixels), **known)  # type: ignore[arg-type]
        torch.testing.assert_close(found.cameras.R[0], TRUE.R, rtol=0, atol=1e-6)
        located = dp.locate(views, landmarks, start, pixel_sigma=1.0, **known)  # type: ignore[arg-type]
        torch.testing.assert_close(located.cameras.R[0], TRUE.R, rtol=0, atol=1e-6)
    with pytest.raises(dp.CalibrationError):  # held at a turn that was not that; it was found as if nothing were held
        dp.locate(views, landmarks, start, pixel_sigma=1.0, fixed=("turn",))


@pytest.mark.parametrize(("name", "value"), [("height", 6.0), ("tilt", 20.0), ("focal", 900.0)])
def test_a_tight_prior_is_as_good_as_what_is_held(name: str, value: float) -> None:
    """Beside one of 1e-8 all else was said to have no evidence."""
    angles = {"roll": 1e6, "heading": 1e6}  # so that angles are what is found in each
    fixed = dp.adjust(TRUE, LANDMARKS, priors=angles, fixed=(name,) * (name != "focal"))
    want = spreads(fixed)
    kept = want > 1e-6
    for deviation in (1e-6, 1e-8, 1e-10):
        found = dp.adjust(TRUE, LANDMARKS, priors={name: (value, deviation), **angles})
        torch.testing.assert_close(spreads(found)[kept], want[kept], rtol=1e-3, atol=0)


def test_a_wide_prior_on_the_place_counts() -> None:
    """A place known to 20 m is known, however low the camera stands; it was said to have no evidence."""
    low = dp.Camera.mounted(1.5, 20.0, focal=900.0, size=SIZE)
    angles = {"tilt": 1.0, "roll": 1.0, "heading": 5.0}
    found = dp.adjust(low, priors={**angles, "height": 0.1, "position": 200.0})
    assert spreads(found).tolist() == pytest.approx([1, 1, 5, 200, 200, 0.1])
    gps = Place([3.0, 4.0, 1.5], [[400.0, 100, 0], [100, 400, 0], [0, 0, 0.01]])
    found = dp.adjust(low, [gps], priors=angles)
    assert spreads(found).tolist() == pytest.approx([1, 1, 5, 20, 20, 0.1])
    assert float(found.mounting_covariance[3, 4]) == pytest.approx(100)
    assert found.mounting.position.tolist() == pytest.approx([3, 4], abs=1e-3)
    with pytest.raises(dp.CalibrationError, match="position"):
        dp.adjust(low, priors={**angles, "height": 0.1})


PEOPLE = torch.tensor([[-3.0, 14, 0], [2, 20, 0], [5, 30, 0], [-6, 26, 0], [0, 12, 0]], dtype=D)


@pytest.mark.parametrize("prior", [{"position": 5.0}, {"heading": 40.0}], ids=["place", "heading"])
def test_a_wide_prior_does_not_hide_the_curve(prior: dict[str, float]) -> None:
    """People's heights say nothing of place and heading: the focal length is as sure with these held as known roughly."""
    camera = dp.Camera.mounted(5.0, 15.0, 1.0, focal=900.0, size=SIZE)
    feet, tops = (camera.project(PEOPLE + torch.tensor([0.0, 0, up], dtype=D))[0] for up in (0.0, 1.75))
    noise = 3 * torch.randn(2, *feet.shape, generator=torch.Generator().manual_seed(3), dtype=D)
    people = dp.Heights(feet + noise[0], tops + noise[1], 1.75, 0.08, pixel_sigma=3.0)
    held = dp.adjust(camera, people, free=["focal"], fixed=("position", "heading"), priors={"tilt": 4.0})
    (name,) = prior
    other = "heading" if name == "position" else "position"
    found = dp.adjust(camera, people, free=["focal"], fixed=(other,), priors={"tilt": 4.0, **prior})
    want = float(held.covariance.deviations["f_x"])
    assert float(found.covariance.deviations["f_x"]) == pytest.approx(want, rel=1e-4)


def test_errors_that_go_together_count_as_such() -> None:
    """The covariance is the inverse of landmarks' and place's normal matrices together."""
    covariance = [[0.25, 0.15, 0.05], [0.15, 0.16, 0.03], [0.05, 0.03, 0.09]]
    alone = dp.adjust(TRUE, LANDMARKS).mounting_covariance
    found = dp.adjust(TRUE, [LANDMARKS, Place([2.0, -1.0, 6.0], covariance)]).mounting_covariance
    more = torch.zeros(6, 6, dtype=D)
    more[3:, 3:] = torch.linalg.inv(torch.tensor(covariance, dtype=D))
    torch.testing.assert_close(found, torch.linalg.inv(torch.linalg.inv(alone) + more), rtol=1e-4, atol=1e-8)


def test_an_observation_without_a_gradient_is_refused() -> None:
    """It would be counted as evidence and tell nothing."""

    class Cut(Place):
        def residuals(self, camera: dp.Camera) -> torch.Tensor:
            return super().residuals(camera).detach()

    class Nothing:
        def residuals(self, camera: dp.Camera) -> torch.Tensor:
            return torch.zeros(*camera.batch_shape, 2, 1, dtype=D)

    class Within:
        def __init__(self, branch: bool) -> None:
            self.branch = branch

        def residuals(self, camera: dp.Camera) -> torch.Tensor:
            off = (camera.center[..., 2:] - 9.0).unsqueeze(-1)
            if self.branch:
                return torch.full_like(off.detach(), 0.5) if bool((off < -1).all()) else off
            return torch.where(off < -1, 0.5, off)

    with pytest.raises(ValueError, match=r"Cut.residuals: want numbers that follow from the camera"):
        dp.adjust(TRUE, [LANDMARKS, Cut([2.0, -1.0, 6.1], torch.eye(3).tolist())])
    with pytest.raises(
        ValueError, match=r"Within.residuals: want .*, torch.where in the place of if, and 0 where there"
    ):
        dp.adjust(TRUE, [LANDMARKS, Within(branch=True)])
    assert bool(dp.adjust(TRUE, [LANDMARKS, Within(branch=False)]).converged)
    assert bool(dp.adjust(TRUE, [LANDMARKS, Nothing()]).converged)
    with torch.no_grad():
        assert bool(dp.adjust(TRUE, [LANDMARKS, Place([2.0, -1.0, 6.1], torch.eye(3).tolist())]).converged)


def test_a_covariance_is_no_prior() -> None:
    """One of two numbers was taken for the deviations of two cameras."""
    covariance = [[0.10, 0.05], [0.05, 0.10]]
    with pytest.raises(ValueError, match="covariance"):
        dp.adjust(TRUE, LANDMARKS, priors={"position": ([2.0, -1.0], covariance)})
    with pytest.raises(ValueError, match="covariance"):
        dp.adjust(TRUE, LANDMARKS, priors={"position": [[0.1, -0.05], [-0.05, 0.1]]})
    with pytest.raises(ValueError, match="covariance"):  # what errs together entirely
        dp.adjust(TRUE, LANDMARKS, priors={"position": [[0.49, 0.07], [0.07, 0.01]]})
    two = dp.adjust(TRUE.expand(2), LANDMARKS, priors={"position": covariance})
    assert two.mounting.height.shape == (2,)


@pytest.mark.parametrize("deviation", [0.3, 0.87, 1.74])
def test_one_deviation_for_as_many_cameras_is_no_covariance(deviation: float) -> None:
    """It was refused as one, or not, as its eigenvalues of 0 were rounded."""
    several = dp.Seen(LANDMARKS.points, LANDMARKS.pixels.expand(3, -1, 2))
    found = dp.adjust(TRUE, several, priors={"turn": torch.full((3, 3), deviation, dtype=D)})
    assert found.mounting.height.shape == (3,)


def test_the_level_of_a_shore_is_no_spare_residual() -> None:
    """Eight residuals less the level and three angles; `consistency` was told as if the level were known."""
    shore = torch.tensor([[-20.0, 60, 1.5], [0, 55, 1.5], [25, 70, 1.5], [10, 90, 1.5]], dtype=D)
    camera = dp.Camera.mounted(12.0, 12.0, 1.0, 5.0, focal=900.0, size=SIZE)
    seen = dp.Coplanar(shore[:, :2], camera.project(shore)[0] + 0.3, pixel_sigma=1.0)
    found = dp.adjust(camera, seen, fixed=("position", "height"))
    assert int(found.spare) == 4


def test_landmarks_in_degrees_are_refused() -> None:
    """As they are in `Landmarks`; heights up one mast are none."""
    places = [
        [40.4168, -3.7038, 650.0],
        [40.4169, -3.7037, 651.0],
        [40.4170, -3.7036, 650.0],
        [40.4169, -3.7034, 650.0],
    ]
    with pytest.raises(ValueError, match="landmarks: want metres .*latitude and longitude.*dp.metres_from_degrees"):
        dp.Seen(places, torch.zeros(4, 2))
    assert len(dp.Seen([[12.0, 30.0, up] for up in (0.0, 1.0, 2.0, 3.0)], torch.zeros(4, 2))) == 4
