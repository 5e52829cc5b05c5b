"""`BrownConrady`: OpenCV's lens model with an exact inverse and a domain on which it is proven to be one-to-one.

`distort` evaluates the equations of `brown_equations`. `undistort` inverts them by Newton's method (the tilt, a
homography, is inverted in closed form first), in three stages:

1. an initial estimate from a table of the inverse along the radius, with tangential and prism terms to first order;
2. a fixed number of Newton steps without autograd, then a globally convergent search, with a maximum number of steps,
   for the few points that have not converged;
3. where a derivative is wanted, what `brown_gradient` adds.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.arguments import Array
from diffproj._core.numerics import all_true, in_blocks, least_depth, rounding, side_by_side
from diffproj.lens import brown_domain
from diffproj.lens.brown_equations import COUNTS, Terms, bend, by_coefficients, radial, tilted
from diffproj.lens.brown_gradient import follows_gradient, recorded, with_gradient
from diffproj.lens.brown_inverse import search, squared_domain
from diffproj.lens.coefficients import CoefficientLens
from diffproj.lens.compiling import derivative_wanted
from diffproj.lens.table import inverse_table

LARGEST = 0.25
"""The power of the largest number up to which squared radii are distorted: what grows with their cube stays finite."""


class BrownConrady(CoefficientLens, tensors={"coefficients": 1}):
    """Radial, tangential, rational, thin-prism and tilt distortion, in OpenCV's order of coefficients.

    `k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tau_x tau_y]]]]`, without unit but for the tilt angles, which are in
    radians. Points are on the normalised plane `z = 1` of the camera frame (x right, y down, z forward). Results are
    valid on a disc around the axis, of radius `domain`, on which the lens is proven to be one-to-one; elsewhere
    `valid` is false and the result is (0, 0).

    Args:
        coefficients: `(*B, k)` with k one of 4, 5, 8, 12, 14; differentiable.

    Raises:
        TypeError: not a floating-point tensor.
        ValueError: another number of coefficients, or a coefficient that is not finite.

    Example:
        >>> lens = BrownConrady(torch.tensor([-0.25, 0.09, 0.0, 0.0, -0.02], dtype=torch.float64))
        >>> xy_distorted, valid = lens.distort(torch.tensor([[0.5, 0.2], [3.0, 0.0]], dtype=torch.float64))
        >>> valid
        tensor([ True, False])
        >>> xy, valid = lens.undistort(xy_distorted[:1])
        >>> xy
        tensor([[0.5000, 0.2000]], dtype=torch.float64)
    """

    counts = COUNTS

    @property
    def domain(self) -> Float[Tensor, "*lens"]:
        """Radius of the disc of undistorted points on which the lens is one-to-one, `(*B,)`, without gradient.

        The largest disc around the axis on which the symmetric part of the Jacobian is positive definite; its radius
        is rounded down. Infinite for a lens without a fold.
        """
        domain = self._domain()
        return torch.where(domain < torch.finfo(domain.dtype).max, domain, torch.inf)  # that of a buffer is finite

    def distort(
        self, xy: Float[Tensor, "*batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Distort points of the normalised plane.

        Args:
            xy: undistorted points `(*B, N, 2)`; batch axes broadcast against those of the lens.

        Returns:
            Distorted points, and `valid`: inside the domain and finite. (0, 0) with zero gradient where not valid.
        """
        xy = self._checked("xy", xy, 2)
        domain = self._domain()

        def forward(points: Tensor) -> tuple[Tensor, Tensor]:
            x, y = points.unbind(-1)
            s = (x * x + y * y).detach()
            valid = (s <= squared_domain(domain)) & (s < torch.finfo(s.dtype).max ** LARGEST)
            x, y = torch.where(valid, x, 0), torch.where(valid, y, 0)
            terms = Terms.of(self._usable(domain))
            x, y = bend(terms, x, y)
            if terms.tilt is not None:
                x, y = terms.tilt.apply(x, y)
            return torch.stack([x, y], dim=-1), valid

        return in_blocks(forward, xy, self.coefficients)  # type: ignore[return-value]

    def undistort(
        self, xy_distorted: Float[Tensor, "*batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Undistort points of the normalised plane: the exact inverse of `distort`.

        First and second derivatives by points and coefficients are those of the inverse function, in reverse and
        forward mode.

        Args:
            xy_distorted: distorted points `(*B, N, 2)`; batch axes broadcast against those of the lens.

        Returns:
            Undistorted points, and `valid`: a solution inside the domain was found. (0, 0) with zero gradient where
            not valid.
        """
        xy, valid = self.undistort_apart(xy_distorted)
        return xy.contiguous(), valid

    def undistort_apart(
        self, xy_distorted: Float[Tensor, "*batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """The same, with x and y perhaps each in one piece of memory, for what takes them apart again at once."""
        xy_distorted = self._checked("xy_distorted", xy_distorted, 2)
        plan = self._plan()

        def backward(points: Tensor) -> tuple[Tensor, Tensor]:
            coefficients = self._usable(plan.domain)
            x, y, valid = search(coefficients.detach(), plan, points.detach())
            if not all_true(valid):
                x, y = torch.where(valid, x, 0), torch.where(valid, y, 0)
            if not derivative_wanted(points, coefficients):
                return side_by_side([x, y]), valid
            if follows_gradient(points, coefficients):
                return with_gradient(coefficients, points, x, y, valid), valid
            return recorded(coefficients, points, x, y, valid), valid

        return in_blocks(backward, xy_distorted, self.coefficients)  # type: ignore[return-value]

    def project_direction(
        self, direction: Float[Tensor, "*batch n 3"] | Array
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Project directions of the camera frame to distorted points on the normalised plane.

        Args:
            direction: `(*B, N, 3)`, of any length.

        Returns:
            Distorted points `(*B, N, 2)`, and `valid`: in front of the camera and inside the domain. (0, 0) with zero
            gradient where not valid.
        """
        direction = self._checked("direction", direction, 3)
        x, y, z = direction.unbind(-1)
        in_front = (z > least_depth(z.dtype)) & torch.isfinite(x + y + z)
        x, y, z = torch.where(in_front, x, 0), torch.where(in_front, y, 0), torch.where(in_front, z, 1)
        xy_distorted, valid = self.distort(torch.stack([x / z, y / z], dim=-1))
        valid = valid & in_front
        return torch.where(valid.unsqueeze(-1), xy_distorted, 0), valid

    def unproject(
        self, xy_distorted: Float[Tensor, "*batch n 2"] | Array
    ) -> tuple[Float[Tensor, "*out n 3"], Bool[Tensor, "*out n"]]:
        """Directions `(x, y, 1)` whose projections are the distorted points; (0, 0, 1) where not valid."""
        xy, valid = self.undistort(xy_distorted)
        return torch.nn.functional.pad(xy, (0, 1), value=1.0), valid

    def by_direction(self, direction: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*out n 2 3"]:
        """Derivatives of the distorted points by valid directions `(*B, N, 3)`: `(*B, N, 2, 3)`."""
        x, y, z = direction.unbind(-1)
        x, y = x / z, y / z
        found = tilted(self._terms(), x, y)
        depth = found.depth * z
        a, b, c, d = (part / depth for part in found.jacobian)
        rows = [torch.stack([a, b, -(a * x + b * y)], dim=-1), torch.stack([c, d, -(c * x + d * y)], dim=-1)]
        return torch.stack(rows, dim=-2)

    def by_coefficients(self, direction: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*out n 2 k"]:
        """Derivatives of the distorted points of valid directions `(*B, N, 3)` by the coefficients `(*B, N, 2, k)`."""
        x, y, z = direction.unbind(-1)
        return by_coefficients(self._terms(), x / z, y / z, self.coefficients.shape[-1])

    def _terms(self) -> Terms:
        return Terms.of(self._usable(self._domain()))

    def turned(
        self, cosine: Float[Tensor, "*lens"], sine: Float[Tensor, "*lens"]
    ) -> tuple["BrownConrady", Bool[Tensor, "*lens"]]:
        """The lens turned about its axis, and whether there is one `(*lens,)`: it maps `q xy` to `q xy_distorted`.

        Tangential terms and prism turn like vectors, radial ones do not change. Behind a tilted sensor the image can
        be turned by 180 degrees, and by 90 where it is tilted about one of its axes only; else no coefficients say it.

        Args:
            cosine: of the angle that the rotation q turns by, from x towards y `(*lens,)`.
            sine: of the same angle.
        """
        columns = list(self.coefficients.unbind(-1))
        exact = torch.ones_like(cosine, dtype=torch.bool)
        if len(columns) == 14:
            upright, across = ((columns[i].abs() <= rounding(self.dtype)) for i in (12, 13))
            by_180, by_90 = (part.abs() <= rounding(self.dtype) for part in (sine, cosine))
            exact = by_180 | (upright & across) | (by_90 & (upright | across))
        # (x, y) of each vector: tangential (p2, p1), prism (s1, s3) and (s2, s4), tilt (tau_x, tau_y).
        for i, j in ((3, 2), (8, 10), (9, 11), (12, 13)):
            if max(i, j) < len(columns):
                x, y = columns[i], columns[j]
                columns[i], columns[j] = cosine * x - sine * y, sine * x + cosine * y
        return type(self)(torch.stack(columns, dim=-1)), exact

    @staticmethod
    def _find_domain(coefficients: Tensor) -> Tensor:
        return brown_domain.domain_radius(coefficients)

    @staticmethod
    def _tabulate(coefficients: Tensor, domain: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        terms = Terms.of(torch.where((domain > 0).unsqueeze(-1), coefficients, 0))
        end = brown_domain.table_radius(terms, domain)
        table = inverse_table(lambda r: r * radial(terms, r * r), end)
        reach, noise = brown_domain.reach(terms, domain), brown_domain.cancellation(terms, end)
        return reach, noise, table.rho_max, table.ratio
