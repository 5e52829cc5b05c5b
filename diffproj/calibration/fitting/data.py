"""What calibration is given, checked: views, board and weights."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffproj._core.arguments import Array, first_of, tensor_of
from diffproj._core.numerics import check_untransformed, in_float64
from diffproj.calibration.fitting.own_frame import OwnFrame, flattened, own_frame
from diffproj.calibration.fitting.task import Task
from diffproj.calibration.least_squares.losses import SMALLEST
from diffproj.calibration.problem.constraints import of_points
from diffproj.calibration.results.distinct import shares
from diffproj.lens.models import LensModel
from diffproj.targets.landmarks import Landmarks
from diffproj.targets.target import Target, points_of
from diffproj.targets.views import Views, as_views

OUTSIDE = 0.02
"""Part of the image's size by which a corner may lie outside of it, by noise or a cut-off board."""
BOARD_SIZE = "do columns and rows of the board fit?"
"""The remedy where a board's views have another number of corners."""
BLOCK = 1024
"""How many points at a time are compared with all others."""


class Data:
    """Views and board, checked, in float64, with the cameras' axes flattened to P.

    Attributes:
        views, target: as given.
        batch: `*B`.
        frame: the points' own frame, without graph, which is solved in.
        middle: its origin `(3,)`, the centroid of the points, which poses turn about.
        points: the target's points in their own frame `(N, 3)`, without graph; on z = 0 where they lie on a plane.
        pixels: `(P, V, N, 2)`, without graph.
        used: `(P, V, N)`: seen, in a view with at least 4 corners.
        weights: `(P, V, N)`, without graph, or `None`.
        spread: the covariances of landmarks in their own frame `(N, 3, 3)`; `None` where they are exact.
        known_noise: whether the weights are one over the variances, and not only proportional to them.
        given_points, given_pixels, given_weights: with graph, and with `*B` in front; points in the world.

    Raises:
        TypeError: views are no `Views`, the target is none, or the weights are no numbers.
        ValueError: views, board and weights do not fit together, the board is of no use, or values cannot be read
            under a transform of `torch.func`.
    """

    def __init__(
        self,
        views: Views,
        target: Target,
        weights: Tensor | Array | float | None,
        pixel_sigma: Tensor | Array | float | None = None,
    ) -> None:
        check_untransformed(
            "views",
            "views of many cameras are a batch, and refine(..., differentiable=True) carries gradients for "
            "torch.autograd.grad",
        )
        if len(as_views(views)) == 0:
            raise ValueError("views: want at least one, got none")
        if 0 in views.batch_shape:
            raise ValueError(f"views: want those of at least one camera, got batch shape {tuple(views.batch_shape)}")
        if views.pixels.is_meta:
            raise ValueError("views: want corners with values, got some on the meta device")
        self.views, self.target, self.batch = views, target, views.batch_shape
        self.given_points = in_float64(points_of(target).to(views.device))
        self.given_pixels = in_float64(views.pixels)
        points = self.given_points.detach()
        count = views.pixels.shape[-2]
        if points.shape != (count, 3):
            of_landmarks = isinstance(target, Landmarks)
            remedy = "a pixel for each, in their order, or visible=False" if of_landmarks else BOARD_SIZE
            raise ValueError(f"views: want {points.shape[0]} corners in each as the target has, got {count}; {remedy}")
        _check_points(points)
        self.frame = own_frame(points)
        self.middle = self.frame.middle
        self.points = flattened(self.frame.own(points), points)
        self.spread = _spread(target, self.frame)
        self.pixels = self.given_pixels.detach().reshape(-1, *views.pixels.shape[-3:])
        visible = views.visible
        self.given_weights, self.weights = None, None
        self.known_noise = pixel_sigma is not None
        if pixel_sigma is not None:
            weights = _weights_of(pixel_sigma, views)
        if weights is not None:
            given = _of_corners("weights", weights, views)
            counted = torch.where(visible, given.detach(), 0.0)
            wrong = ~((counted >= 0) & counted.isfinite())
            if bool(wrong.any()):
                got = f"{first_of(counted, wrong)}, a corner that was seen"
                raise ValueError(f"weights: want finite numbers of at least 0, got {got}")
            wrong = ~((counted == 0) | ((counted >= SMALLEST) & (counted <= 1 / SMALLEST)))
            if bool(wrong.any()):
                raise ValueError(
                    f"weights: want 0 or numbers from {SMALLEST:g} to {1 / SMALLEST:g}, got {first_of(counted, wrong)}"
                )
            self.given_weights = torch.where(visible, given, 0.0)
            self.weights = self.given_weights.detach().reshape(self.pixels.shape[:-1])
            visible = visible & (self.given_weights.detach() > 0)
        visible = visible.reshape(self.pixels.shape[:-1])
        self.used = visible & (visible.sum(-1, keepdim=True) >= 4)
        _check_inside(views, self.pixels, self.used)

    @property
    def uncertain(self) -> Tensor | None:
        """Which landmarks come with an error of their own `(N,)`; `None` where none does."""
        return None if self.spread is None else (self.spread != 0).flatten(1).any(-1)

    @cached_property
    def shares(self) -> Tensor | None:
        """How much each view counts in what all views share `(P, V)`; `None` where all count fully."""
        return shares(self.points, self.pixels, self.used)

    def check_options(self, objective: str, shape: str, named: Sequence[str] = ()) -> None:
        """Check what a target can be asked for in `calibrate` and `refine`.

        Args:
            objective: what is minimised.
            shape: of the target.
            named: parameters that are fixed, or have a prior.

        Raises:
            ValueError: it cannot.
        """
        level = bool((self.given_points.detach()[:, 2] == 0).all())
        if objective == "plane" and not level:
            raise ValueError(
                "objective: want 'image' for points that are not all on z = 0, got 'plane', which puts corners back "
                "there"
            )
        if shape == "bow" and not level:
            raise ValueError(
                "shape: want 'flat' for points that are not all on z = 0, got 'bow', which flat boards have"
            )
        if shape == "free" and not level and self.spread is None:
            raise ValueError(
                "shape: want 'flat' for points that are not all on z = 0, got 'free'; give Landmarks a sigma instead"
            )
        if self.spread is None:
            return
        if objective == "plane":
            raise ValueError("objective: want 'image' for landmarks with a sigma, got 'plane'; or leave out the sigma")
        if shape == "bow":
            raise ValueError("shape: want 'flat' for landmarks with a sigma, got 'bow'; or leave out the sigma")
        points = [name for name in named if of_points(name)]
        if points:
            raise ValueError(
                f"fixed, priors: want no {points[0]!r} beside landmarks with a sigma, which says how they are known, "
                "coordinate by coordinate; 0 holds one"
            )

    def surveyed(self, shape: str) -> bool:
        """Whether landmarks' own errors are unknowns that views share; of one view they weigh as noise does."""
        several = shape == "free" or int(self.used.any(-1).sum(-1).amax()) > 1
        return self.spread is not None and several

    def task(self, model: LensModel, **options: Any) -> Task:
        """What is to be minimised on these corners."""
        noise = {"weights": self.weights, "known_noise": self.known_noise, "spread": self.spread}
        return Task(self.points, self.pixels, self.used, model, **noise, **options)


def _spread(target: Target, frame: OwnFrame) -> Tensor | None:
    """The covariances of landmarks in their own frame; `None` where there are none."""
    given = target.covariances if isinstance(target, Landmarks) else None
    if given is None or not bool((given != 0).any()):
        return None
    given = given.detach().to(frame.middle)
    return given if frame.axes is None else frame.axes @ given @ frame.axes.mT


def _of_corners(name: str, value: Tensor | Array | float, views: Views) -> Tensor:
    """A number for each corner `(*B, V, N)`."""
    given = tensor_of(name, value)
    if given.is_complex() or given.is_meta or given.dtype == torch.bool:
        raise TypeError(f"{name}: want real numbers, got {given.dtype} on {given.device}")
    try:
        return in_float64(given.to(views.device)).expand(views.visible.shape)
    except RuntimeError:
        want, got = tuple(views.visible.shape), tuple(given.shape)
        raise ValueError(f"{name}: want a shape that broadcasts to {want}, got {got}") from None


def _weights_of(pixel_sigma: Tensor | Array | float, views: Views) -> Tensor:
    """One over the variance of each corner."""
    given = _of_corners("pixel_sigma", pixel_sigma, views)
    counted = torch.where(views.visible, given.detach(), 1.0)
    least, most = SMALLEST**0.5, SMALLEST**-0.5
    wrong = ~((counted >= least) & (counted <= most))
    if bool(wrong.any()):
        got = first_of(counted, wrong)
        raise ValueError(f"pixel_sigma: want standard deviations in px from {least:g} to {most:g}, got {got}")
    return torch.where(views.visible, given, 1.0).square().reciprocal()


def _check_inside(views: Views, pixels: Tensor, used: Tensor) -> None:
    if views.size is None:
        return
    size = pixels.new_tensor(views.size)
    outside = used & ((pixels < -OUTSIDE * size) | (pixels > (1 + OUTSIDE) * size)).any(-1)
    if bool(outside.any()):
        camera, view, corner = outside.nonzero()[0].tolist()
        u, v = pixels[camera, view, corner].tolist()
        raise ValueError(
            f"views: want corners inside the photographs of {views.size[0]} x {views.size[1]} px, "
            f"got ({u:.1f}, {v:.1f}) in {views.names[view]!r}; is size (width, height), and of these photographs?"
        )


def _check_points(points: Tensor) -> None:
    if not bool(points.isfinite().all()):
        raise ValueError(f"target: want finite points, got {first_of(points, ~points.isfinite().all(-1))}")
    if len(points) < 4:
        why = ", for three leave up to four poses open" if len(points) == 3 else ""
        raise ValueError(
            f"target: want at least 4 points{why}, got {len(points)}; dp.adjust takes fewer, as dp.Seen, along with "
            "other evidence"
        )
    points = points - points.mean(0)  # far from the origin squares of coordinates cancel
    extent = points.abs().amax()
    if (pair := _alike(points, 1e-9 * extent)) is not None:
        i, j = pair
        raise ValueError(f"target: want points that are all distinct, got {len(points)} with {i} and {j} alike")
    if float(torch.linalg.svdvals(points)[1]) <= 1e-9 * float(extent):
        raise ValueError("target: want points that do not lie on one line")


def _alike(points: Tensor, least: Tensor) -> tuple[int, int] | None:
    """Two points no farther apart than that; block by block, for all distances of a scan would not fit into memory."""
    for first in range(0, len(points), BLOCK):
        # By products, as it does for speed, it would leave points that are the same 1e-8 apart.
        apart = torch.cdist(points[first : first + BLOCK], points, compute_mode="donot_use_mm_for_euclid_dist")
        apart.diagonal(first).fill_(torch.inf)
        if bool(apart.amin() <= least):
            i, j = divmod(int(apart.argmin()), len(points))
            return first + i, j
    return None
