"""Errors that go together within a view: fields that are smooth over the board, others in each view."""

import torch
from torch import Tensor

import diffproj as dp
from diffproj import synthetic

D = torch.float64


def seen_at_random(camera: dp.Camera, board: dp.Chessboard, sets: int, views: int) -> dp.Views:
    """Views `(sets, views)` of the board by one camera, with noise of 0.1 px."""
    true = synthetic.random_cameras(camera, board, sets * views, seed=views)
    posed = camera.at(true.R.unflatten(0, (sets, views)), true.t.unflatten(0, (sets, views)))
    return synthetic.corner_views(posed, board, noise_px=0.1, seed=3)


def with_smooth_errors(views: dp.Views, points: Tensor, px: float, seed: int = 1) -> dp.Views:
    """The same with a polynomial of second degree in the board's x and y, -1 to 1, of such coefficients, in each view."""
    middle = points[:, :2].to(D) - points[:, :2].to(D).mean(0)
    x, y = (middle / middle.abs().max()).unbind(-1)
    terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)
    shape, generator = (*views.pixels.shape[:-2], 6, 2), torch.Generator().manual_seed(seed)
    together = terms @ torch.randn(shape, generator=generator, dtype=D)
    return dp.Views(views.pixels + px * together, views.visible, size=views.size)
