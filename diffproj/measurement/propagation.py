"""What makes measured points uncertain, and how that reaches the quantities that depend on them.

All points share the errors of camera, pose and plane; each has those of its own pixel. `Noise` holds both. `Propagated`
is what they do to M vectors of r components, each a function of k points: to first order as a covariance, and as the
points that given errors lead to, on the curve.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from diffproj.calibration.results.covariance import zero_where_infinite
from diffproj.measurement.each import at_each
from diffproj.measurement.sight import Sight, Straight


@dataclass(frozen=True, eq=False)
class Noise:
    """The errors of N points.

    Attributes:
        sight: the pixels, and what maps them to the plane.
        common: the derivative of the points by camera, pose and plane `(*B, N, 3, Q)`.
        sigma: the covariance of these `(*B, Q, Q)`, infinite on the diagonal only.
        own: the derivative of each point by its pixel's error in standard deviations `(*B, N, 3, 2)`.
        degrees_of_freedom: of the scale of the calibration's covariance `(*B,)`.
        pixels_too: whether the standard deviation of the pixels was estimated along with it.
    """

    sight: Sight | Straight
    common: Tensor
    sigma: Tensor
    own: Tensor
    degrees_of_freedom: Tensor
    pixels_too: bool

    def unknown(self, rows: Tensor) -> Tensor:
        """Which rows `(..., r, Q)` depend on what the calibration does not determine, `(..., r, 1)`."""
        lost = self.sigma.diagonal(dim1=-2, dim2=-1).isinf()
        while lost.ndim < rows.ndim - 1:
            lost = lost.unsqueeze(-2)
        return (rows.abs() * lost.unsqueeze(-2)).sum(-1, keepdim=True) > 0

    def root(self) -> Tensor:
        """A matrix L `(*B, Q, Q)` with `L L^T = sigma`, as if what is not determined were known."""
        return root(self.sigma)


@dataclass(frozen=True, eq=False)
class Propagated:
    """The errors of M vectors of r components.

    Attributes:
        noise: of the points.
        index: the numbers of the k points of each vector `(M, k)`.
        common: the derivative of the vectors by camera, pose and plane `(*B, M, r, Q)`.
        own: and by the error of each of its points, in standard deviations `(*B, M, k, r, 2)`. A point that is named
            twice has its errors together in both places.
    """

    noise: Noise
    index: Tensor
    common: Tensor
    own: Tensor

    @classmethod
    def of(cls, noise: Noise, index: Tensor, jacobian: Tensor) -> "Propagated":
        """What the noise does to functions of points with these Jacobians `(*B, M, r, k, 3)`."""
        J = jacobian.movedim(-2, -3)  # (*B, M, k, r, 3)
        common = (J @ noise.common[..., index, :, :]).sum(-3)
        return cls(noise, index, common, _together(index, J @ noise.own[..., index, :, :]))

    @property
    def covariance(self) -> Tensor:
        """Of each vector `(*B, M, r, r)`, as if what is not determined were known."""
        sigma = zero_where_infinite(self.noise.sigma).unsqueeze(-3)
        once = self.own * _firsts(self.index)[..., None, None]
        return self.common @ sigma @ self.common.mT + (once @ self.own.mT).sum(-3)

    def degrees_of_freedom(self, direction: Tensor) -> Tensor:
        """Of the variance `(*B, M)` of the vectors along a direction `(*B, M, r)`.

        A variance that is known in part has more of them than the estimated part (Welch 1947, Satterthwaite 1946).
        """
        common, own = self._along(direction.detach())
        q = self.noise.sight.by_theta.shape[-1]
        sigma = zero_where_infinite(self.noise.sigma).detach()
        shaky = self._variance(common[..., :q], sigma[..., :q, :q])
        total = self._variance(common, sigma)
        pixels = (own * own * _firsts(self.index).unsqueeze(-1)).sum((-2, -1))
        shaky, total = shaky + pixels * self.noise.pixels_too, total + pixels
        share = torch.where(total > 0, shaky / torch.where(total > 0, total, 1.0), 1.0)
        freedom = self.noise.degrees_of_freedom.unsqueeze(-1).expand_as(share)
        return torch.where(share > 0, freedom / share.square().clamp(min=1e-300), torch.inf)

    def rows(self) -> Tensor:
        """The derivative of the vectors by independent errors of deviation 1, `(*B, M, r, E)`: see `points`."""
        shared = self.common.detach() @ self.noise.root().unsqueeze(-3)
        own = self.own.detach() * _firsts(self.index)[..., None, None]  # (*B, M, k, r, 2)
        return torch.cat([shared, own.movedim(-3, -2).flatten(-2)], dim=-1)

    def points(self, errors: Tensor) -> tuple[Tensor, Tensor]:
        """The points where all errors are what is given, on the curve.

        Args:
            errors: independent ones in standard deviations `(*B, M, E)`: Q for camera, pose and plane, then two for the
                pixel of each of k points, whose errors count where the point is named first.

        Returns:
            The points `(*B, M, k, 3)`, and whether all of them are on the plane `(*B, M)`.
        """
        Q, k = self.noise.sigma.shape[-1], self.index.shape[-1]
        theta = errors[..., :Q] @ self.noise.root().mT
        own = errors[..., Q:].unflatten(-1, (k, 2))
        same = (self.index.unsqueeze(-1) == self.index.unsqueeze(-2)) & (_firsts(self.index) > 0).unsqueeze(-2)
        points, valid = self.noise.sight.points(self.index, theta, same.to(own) @ own)
        return points, valid.all(-1)

    def steps(self) -> Tensor:
        """The steps `(*B, M, E, k, 3)` of the points by one deviation of each independent error, to first order."""
        noise, index = self.noise, self.index
        shared = (noise.common @ noise.root().unsqueeze(-3))[..., index, :, :]  # (*B, M, k, 3, Q)
        same = (index.unsqueeze(-1) == index.unsqueeze(-2)) * _firsts(index).unsqueeze(-2)
        own = noise.own[..., index, :, None, :] * same[..., :, None, :, None]  # (*B, M, k, 3, k, 2): of l by j
        return torch.cat([shared, own.flatten(-2)], dim=-1).movedim(-1, -3)

    def _along(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """The derivative of the component along a direction by what is common `(*B, M, Q)` and own `(*B, M, k, 2)`."""
        common = (self.common.detach() * direction.unsqueeze(-1)).sum(-2)
        return common, (self.own.detach() * direction[..., None, :, None]).sum(-2)

    @staticmethod
    def _variance(rows: Tensor, sigma: Tensor) -> Tensor:
        return ((rows @ sigma) * rows).sum(-1)


def kink_variance(function: Callable[[Tensor], Tensor], steps: Tensor, points: Tensor, first: Tensor) -> Tensor:
    """What the variance to first order lacks where a function has a kink, as a distance has at 0.

    The mean square change of the function over steps of one deviation to both sides is its variance where it is linear,
    and the mean square error where it turns back, as `|x|` does. Away from kinks the excess e of a smooth function is
    small beside the variance v, and `e^2 / (v + e)` is negligible.

    Args:
        function: of k points `(k, 3)`.
        steps: see `Propagated.columns`.
        points: `(*B, M, k, 3)`.
        first: the variance to first order `(*B, M)`.
    """
    M_shape, C = points.shape[:-2], steps.shape[-3]

    def values(at: Tensor) -> Tensor:
        return at_each(function)(at).nan_to_num(0.0, 0.0, 0.0)

    here = values(points).reshape(*M_shape, 1)
    changes = [
        (values(points.unsqueeze(-3) + side * steps).reshape(*M_shape, C) - here).square().sum(-1) for side in (-1, 1)
    ]
    excess = ((changes[0] + changes[1]) / 2 - first).clamp(min=0)
    total = first + excess
    return torch.where(total > 0, excess.square() / torch.where(total > 0, total, 1.0), 0.0)


def _together(index: Tensor, own: Tensor) -> Tensor:
    """Terms of points `(*B, M, k, r, 2)` with those of the same point in other places added."""
    same = (index.unsqueeze(-1) == index.unsqueeze(-2)).to(own)  # (M, k, k)
    return (same @ own.flatten(-2)).unflatten(-1, own.shape[-2:])


def _firsts(index: Tensor) -> Tensor:
    """1 where a point is named the first time in its row of `(M, k)`, else 0."""
    same = (index.unsqueeze(-1) == index.unsqueeze(-2)).tril(-1)
    return (~same.any(-1)).to(torch.float64)


@torch.no_grad()
def root(sigma: Tensor) -> Tensor:
    """A matrix L `(*B, Q, Q)` with `L L^T = sigma`; infinite variances count as 0."""
    sigma = zero_where_infinite(sigma.detach())
    scale = sigma.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    unit = torch.where(scale > 0, scale, 1.0)
    values, vectors = torch.linalg.eigh(sigma / unit.unsqueeze(-1) / unit.unsqueeze(-2))
    return scale.unsqueeze(-1) * vectors * values.clamp(min=0).sqrt().unsqueeze(-2)


def without_unknown(C: Tensor, unknown: Tensor) -> Tensor:
    """The covariance with infinite variances, and no covariances, where a coordinate `(..., r, 1)` is not known."""
    kept = torch.where(unknown | unknown.mT, 0.0, C)
    return kept + torch.diag_embed(torch.where(unknown, torch.inf, 0.0).to(C).squeeze(-1))
