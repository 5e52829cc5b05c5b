"""The paper's experiment with known truth: a web camera, its board, ten fitting views and the test views a to e."""

from dataclasses import dataclass

import torch

from diffproj.geometry.camera import Camera, check_lens
from diffproj.geometry.euler import rotation_from_euler
from diffproj.lens.protocol import Lens
from diffproj.targets.chessboard import Chessboard

TEST_VIEWS = ("a", "b", "c", "d", "e")
"""The paper's test views: from above at three distances, tilted by 45 degrees about x, and about y."""


# psi, phi, theta in degrees, then the board centre's position in the camera's frame: right, down, forward in mm.
_FIT_POSES = (
    (0, 0, 3, 0, 0, 380),
    (30, 0, 5, 20, -10, 400),
    (-30, 0, -5, -20, 10, 400),
    (0, 30, 10, 15, 10, 400),
    (0, -30, -10, -15, -10, 400),
    (25, 25, 20, 45, 30, 500),
    (-25, 25, -20, -45, 30, 500),
    (25, -25, 15, -45, -30, 500),
    (-25, -25, -15, 45, -30, 500),
    (35, 10, 90, 0, 0, 520),
)


_TEST_POSES = (
    (0, 0, 5, 0, 0, 400),
    (0, 0, 5, 0, 0, 600),
    (0, 0, 5, 0, 0, 800),
    (45, 0, 5, 0, 0, 500),
    (0, 45, 5, 0, 0, 500),
)


@dataclass(frozen=True, eq=False)
class PaperSetup:
    """The paper's experiment with known truth, in millimetres.

    Attributes:
        board: 9 x 6 inner corners, 25 mm squares, in the paper's frame (z towards the camera).
        fit: the camera at the ten fitting views, batch shape `(10,)`.
        test: the camera at the test views a to e, batch shape `(5,)`.
    """

    board: Chessboard
    fit: Camera
    test: Camera

    @property
    def cameras(self) -> Camera:
        """All fifteen views: the fitting views first."""
        return self.fit[0].at(torch.cat([self.fit.R, self.test.R]), torch.cat([self.fit.t, self.test.t]))

    @property
    def names(self) -> tuple[str, ...]:
        """The views' names: fit 1 to fit 10, then a to e."""
        return (*(f"fit {i + 1}" for i in range(len(_FIT_POSES))), *TEST_VIEWS)


def paper_setup(distortion: Lens | None = None) -> PaperSetup:
    """The paper's kind of set-up: a 640 x 480 web camera, ten fitting views and the test views a to e.

    Args:
        distortion: the camera's lens in float64; a pinhole if left out, as the paper assumes.

    Example:
        >>> paper_setup().test
        Camera(5 cameras, f 700.0, 702.0 px, c 322.0, 238.0 px, pinhole, 640 x 480 px, torch.float64)
    """
    if distortion is not None:
        check_lens(distortion)
    board = Chessboard(columns=9, rows=6, square=25.0, axes="paper")
    K = torch.tensor([[700.0, 0, 322], [0, 702, 238], [0, 0, 1]], dtype=torch.float64, device="cpu")
    camera = Camera(K, distortion=distortion, size=(640, 480))
    return PaperSetup(board, _at_poses(camera, board, _FIT_POSES), _at_poses(camera, board, _TEST_POSES))


def _at_poses(camera: Camera, board: Chessboard, poses: tuple[tuple[float, ...], ...]) -> Camera:
    """The camera at poses: the board's centre at a position in its frame, the board turned about it by Euler angles."""
    table = torch.tensor(poses, dtype=camera.dtype, device=camera.device)
    psi, phi, theta = table[:, :3].deg2rad().unbind(-1)
    # Straight from above the paper's x points down in the image, its y to the right and its z towards the camera.
    from_above = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]], dtype=camera.dtype, device=camera.device)
    R = from_above @ rotation_from_euler(psi, phi, theta)
    center = board.points.to(camera.dtype).mean(dim=0)
    return camera.at(R, table[:, 3:] - R @ center)
