"""Shared by all tests: shape checks at run time, reproducible draws, and the cameras that many tests look through.

Every annotation of the package is checked while the tests run (jaxtyping with beartype). The checks get in the way of
`torch.compile` and answer a wrong shape before the package's own message does; tests of those two kinds carry the
mark `plain` and run in a session of their own, without the checks, that `test_plain_session.py` starts.
"""

import os

SHAPE_CHECKS = os.environ.get("DIFFPROJ_SHAPE_CHECKS", "1") == "1"
if SHAPE_CHECKS:
    from tests import shape_checks

    shape_checks.install("diffproj")

import hypothesis
import pytest
import torch

import diffproj as dp

hypothesis.settings.register_profile("tests", deadline=None, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("tests")
torch.set_num_threads(1)  # two threads beside another busy process are ten times slower than one

D = torch.float64


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    def fits(item: pytest.Item) -> bool:
        plain = item.get_closest_marker("plain") is not None or "compiled" in item.path.parts
        return plain is not SHAPE_CHECKS

    config.hook.pytest_deselected(items=[item for item in items if not fits(item)])
    items[:] = [item for item in items if fits(item)]


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def K() -> torch.Tensor:
    """Intrinsics of a web camera of 640 x 480 pixels."""
    return torch.tensor([[533.0, 0, 342], [0, 534, 235], [0, 0, 1]], dtype=D)


@pytest.fixture
def camera(K: torch.Tensor) -> dp.Camera:
    """A pinhole that looks down on the plane z = 0 at a slant, from half a metre (in millimetres)."""
    angles = torch.tensor([2.7, 0.25, 0.4], dtype=D)
    return dp.Camera(K, dp.rotation_from_euler(*angles), torch.tensor([10.0, -20, 500], dtype=D), size=(640, 480))


@pytest.fixture
def lens() -> dp.BrownConrady:
    """A lens about as strong as that of the bundled photographs, one-to-one over the whole image."""
    return dp.BrownConrady(torch.tensor([-0.28, 0.07, 0.0013, 0.0001, 0.002], dtype=D))


@pytest.fixture
def lens_camera(camera: dp.Camera, lens: dp.BrownConrady) -> dp.Camera:
    """The same camera behind that lens."""
    return dp.Camera(camera.K, camera.R, camera.t, lens, camera.size)


@pytest.fixture
def pixels() -> torch.Tensor:
    """Two hundred pixels spread over the image."""
    return torch.rand(200, 2, dtype=D, generator=torch.Generator().manual_seed(1)) * torch.tensor([640.0, 480], dtype=D)
