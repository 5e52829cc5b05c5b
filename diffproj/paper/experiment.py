"""The paper's experiment: calibrate, put each corner of a test view back on the board, compare with the truth.

Siswantoro et al. (2013), section 3: some views fit the intrinsics, each test view has its own extrinsics, each of its
corners is back-projected on z = 0, and Table 1 gives mean and standard deviation of

    E_x = |x - x_app|,  E_y = |y - y_app|,  E_z = |z - z_app|    (Eq. 15-17).
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.arguments import flag
from diffproj._core.shown import Shown
from diffproj.calibration.calibrate import calibrate
from diffproj.calibration.locate import locate
from diffproj.calibration.problem.shape_names import Shape
from diffproj.calibration.results.calibration import Calibration
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.plane import Plane
from diffproj.lens.models import LensModel
from diffproj.targets.chessboard import Chessboard, as_board
from diffproj.targets.views import Views, as_views


@dataclass(frozen=True)
class Row:
    """One line of Table 1: errors over the corners of a view, in world units.

    Attributes:
        view: the view's name.
        corners: how many corners were measured.
        mean: means of E_x, E_y, E_z.
        deviation: their sample standard deviations (divided by the number of corners less one).
    """

    view: str
    corners: int
    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]


@dataclass(frozen=True, eq=False, repr=False)
class Experiment(Shown):
    """The outcome of the experiment.

    Attributes:
        fit: the calibration of the fitting views.
        test: the test views with their poses, intrinsics held; its covariance holds what the fit leaves open of them.
        board: the board.
        approximated: corners of the test views put back on the board `(V, N, 3)`, in world units.
        measured: which corners count `(V, N)`: seen, back-projected, and under `strict` not used for the pose.
    """

    fit: Calibration
    test: Calibration
    board: Chessboard
    approximated: Float[Tensor, "v n 3"]
    measured: Bool[Tensor, "v n"]

    @property
    def exact(self) -> Float[Tensor, "n 3"]:
        """The corners' known places `(N, 3)`: the board's own, or where the fitting views show that it has them."""
        return self.fit.points

    @property
    def errors(self) -> Float[Tensor, "v n 3"]:
        """`E_x, E_y, E_z` of each corner `(V, N, 3)` in world units; NaN where a corner does not count."""
        return torch.where(self.measured.unsqueeze(-1), (self.exact - self.approximated).abs(), torch.nan)

    @property
    def rows(self) -> list[Row]:
        """Table 1: a row for each test view, then one over all their corners."""
        views = zip(self.test.views.names, self.errors, self.measured, strict=True)
        rows = [_row(name, errors[measured]) for name, errors, measured in views]
        return [*rows, _row("all", self.errors[self.measured])]

    def to_dict(self) -> dict[str, list[Any]]:
        """Table 1 as columns of Python's own numbers: `pandas.DataFrame` takes it."""
        rows = self.rows
        columns: dict[str, list[Any]] = {"view": [row.view for row in rows], "corners": [row.corners for row in rows]}
        for axis, name in enumerate(("E_x", "E_y", "E_z")):
            columns[f"mean_{name}"] = [row.mean[axis] for row in rows]
            columns[f"deviation_{name}"] = [row.deviation[axis] for row in rows]
        return columns

    def to_csv(self) -> str:
        """Table 1 as comma-separated values, with a header line."""
        text = io.StringIO()
        writer, columns = csv.writer(text, lineterminator="\n"), self.to_dict()
        writer.writerow(columns)
        for view, corners, *numbers in zip(*columns.values(), strict=True):
            writer.writerow([view, corners, *(f"{value:.6g}" for value in numbers)])
        return text.getvalue()

    def _facts(self) -> list[str]:
        mean = ", ".join(f"{value:.3g}" for value in self.rows[-1].mean)
        return [f"{len(self.fit.views)} views fit", f"{len(self.test.views)} test", f"mean E_x, E_y, E_z {mean}"]

    def _columns(self) -> dict[str, list[Any]]:
        return self.to_dict()


def run_experiment(
    fit: Views,
    test: Views,
    board: Chessboard,
    distortion: LensModel = "brown5",
    strict: bool = False,
    shape: Shape = "flat",
) -> Experiment:
    """Run the paper's experiment.

    Args:
        fit: views that find the intrinsics and the lens.
        test: views whose corners are measured; each has its own pose, found with the intrinsics held.
        board: the board, in either frame.
        distortion: which lens to fit; the paper neglects it (`"none"`).
        strict: find each pose from every second corner and measure the others, so that no corner is measured with a
            pose that it contributed to. (The paper finds the pose from the corners that it measures.)
        shape: of the board. The paper takes it for the ideal grid (`"flat"`). With `"free"` the fitting views tell
            where each corner really is, and corners of the test views, which have no part in that, are put back on
            the plane of their own height and compared with these places.

    Returns:
        The outcome, in the board's unit.

    Raises:
        TypeError: not views, views and a board in this order, or another argument is of the wrong kind.
        ValueError: views and board do not fit together, or too few views or corners.
        CalibrationError: the fitting views do not determine the camera.

    Example:
        >>> import diffproj as dp
        >>> views = dp.example_views("left")
        >>> outcome = dp.run_experiment(views[:8], views[8:], dp.Chessboard(axes="paper"))
        >>> outcome.rows[-1].view, max(outcome.rows[-1].mean) < 0.09  # millimetres
        ('all', True)
    """
    as_views(fit, "fit")
    if as_views(test, "test").batch_shape or fit.batch_shape:
        batch = tuple(fit.batch_shape), tuple(test.batch_shape)
        raise ValueError(f"fit, test: want views of one camera, got batch shapes {batch[0]} and {batch[1]}")
    for name, views in (("fit", fit), ("test", test)):
        if len(views) == 0:
            raise ValueError(f"{name}: want at least one view, got none")
    as_board(board)
    strict = flag("strict", strict)
    calibration = calibrate(fit, board, distortion, shape=shape)
    held_out = torch.zeros(test.pixels.shape[-2], dtype=torch.bool, device=test.device)
    if strict:
        held_out[1::2] = True
    located = locate(test.hiding(held_out), board, calibration)
    measured = test.hiding(~held_out) if strict else test
    heights = calibration.points[:, 2]
    plane = Plane.z(0.0) if shape == "flat" else Plane.per_point([0.0, 0.0, 1.0], heights)
    points, valid = back_project(measured.pixels.to(torch.float64), located.cameras, plane)
    return Experiment(calibration, located, board, points, valid & measured.visible)


def default_split(count: int) -> tuple[list[int], list[int]]:
    """The first eight thirteenths of the views fit, the others test: 8 and 5 of 13."""
    fit = round(count * 8 / 13)
    return list(range(fit)), list(range(fit, count))


def parse_split(text: str, count: int) -> tuple[list[int], list[int]]:
    """Read which views fit and which test.

    Args:
        text: `"8"`, the first 8 fit and the others test; or numbers from 1 and ranges, as `"1-5,9/6-8"`: those that
            fit before the slash, those that test after it.
        count: how many views there are.

    Returns:
        Positions from 0 of the fitting and of the test views.

    Raises:
        ValueError: not of this form, out of range, or nothing left to fit or to test.

    Example:
        >>> parse_split("1-3,5/4", 5)
        ([0, 1, 2, 4], [3])
    """
    try:
        if "/" in text:
            fit, test = (_positions(part, count) for part in text.split("/"))
        else:
            fit = list(range(min(int(text), count + 1)))
            test = list(range(len(fit), count))
    except ValueError:
        raise ValueError(f"split: want a number such as 8, or lists such as 1-5,9/6-8, got {text!r}") from None
    outside = [position + 1 for position in (*fit, *test) if not 0 <= position < count]
    if outside:
        raise ValueError(f"split: want views from 1 to {count}, got {outside[0]}")
    if len(fit) < 2 or not test:
        raise ValueError(
            f"split: want at least 2 views to fit and 1 to test, got {len(fit)} and {len(test)} of {count}"
        )
    return fit, test


def _positions(text: str, count: int) -> list[int]:
    """Positions from 0; of those beyond the last view, one."""
    positions: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        positions += range(int(first) - 1, min(int(last or first), max(count, int(first) - 1) + 1))
    return positions


def _row(name: str, errors: Float[Tensor, "n 3"]) -> Row:
    mean = errors.mean(dim=0).tolist()
    # One corner alone has no standard deviation: NaN says so without a warning.
    deviation = errors.std(dim=0).tolist() if len(errors) > 1 else [float("nan")] * 3
    return Row(name, len(errors), (mean[0], mean[1], mean[2]), (deviation[0], deviation[1], deviation[2]))


def choose(views: Views, split: tuple[Sequence[int], Sequence[int]]) -> tuple[Views, Views]:
    """The fitting and the test views of a split."""
    return views[list(split[0])], views[list(split[1])]
