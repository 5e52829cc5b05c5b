"""The calibration's other objective: residuals on the board, in world units, through the back-projection.

Each seen corner is put back on the plane z = 0 of its view; the residual is where it lands less where the board has it,
`(x, y)` in world units. With `X` the landing point and `uv = project(X)` the seen pixel by construction, the implicit
function theorem gives all derivatives from those of the projection at X:

    d(xy) = -M^-1 d(uv)        M = d(uv) / d(x, y) = J [r1 r2]
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from diffproj.calibration.least_squares.solver import LocalState
from diffproj.calibration.problem.reprojection import Reprojection
from diffproj.geometry.back_projection import back_project
from diffproj.geometry.plane import Plane


@dataclass(eq=False)
class BoardError(Reprojection):
    """The residuals on the board, as a problem of `solver.solve`; the attributes are those of `Reprojection`."""

    def linearise(self, shared: Tensor, local: LocalState) -> Tensor:
        """The panel in world units; not finite where a corner that counts cannot be put back on the board."""
        R, _ = local
        cameras = self.parameters.unpack(shared, local)
        landed, valid = back_project(self.pixels, cameras, Plane.z(0.0))
        landed = torch.where(valid.unsqueeze(-1), landed, self.points)
        panel = self.linearise_at(R @ landed.mT, shared, local)
        M = (R[..., :2].mT @ panel[:, :, -4:-1].flatten(-2)).unflatten(-1, (2, -1))  # (P, V, by x and y, uv, N)
        (a, c), (b, d) = (part.unbind(2) for part in M.unbind(2))
        determinant = torch.where(self.used, a * d - b * c, 1.0)
        determinant = torch.where(valid | ~self.used, determinant, torch.nan).unsqueeze(2)
        u, v = panel.unbind(3)
        b, c = b.unsqueeze(2), c.unsqueeze(2)
        image = panel.clone()
        torch.div(b * v - d.unsqueeze(2) * u, determinant, out=image[:, :, :, 0])
        torch.div(c * u - a.unsqueeze(2) * v, determinant, out=image[:, :, :, 1])
        lost = (~valid & self.used).unsqueeze(-1)
        image[:, :, -1] = torch.where(lost, torch.nan, landed - self.points)[..., :2].mT
        if self._unused is not None:
            image.masked_fill_(self._unused[:, :, None, None], 0.0)
        return image
