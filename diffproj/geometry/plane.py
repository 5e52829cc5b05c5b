"""`Plane`: the plane `a x + b y + c z = d` in the world, or a batch of planes.

Convention: `n . X = d` with `n = (a, b, c)`, which need not be a unit vector; scaling `n` and `d` together changes
nothing. (Kornia's `Hyperplane` has the opposite sign of the offset: `n . X + d = 0`.)

A plane made of Python numbers alone, such as `Plane.z(0.0)`, has no dtype of its own to defend: like a Python number
in PyTorch's arithmetic it takes on the dtype and device of the camera or points that it meets.
"""

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.arguments import Array, called, instance, meeting, tensor_of
from diffproj._core.batched import Batched
from diffproj._core.numerics import (
    broadcast_batches,
    check_same_kind,
    check_tensor,
    dot,
    has_values,
)

Numbers = Array | float


class Plane(Batched, tensors={"normal": 1, "offset": 0}, constants=("is_per_point", "adopts")):
    """A plane `n . X = d`, or a batch of planes with batch shape `*B`.

    The plane is immutable in spirit and a PyTree, as `Camera` is.

    Attributes:
        normal: `(*B, 3)`, any length but zero.
        offset: `(*B,)`, in world units times the length of the normal.
        is_per_point: whether the last batch axis runs over the points, one plane for each (`Plane.per_point`).
        adopts: whether the plane was made of Python numbers and takes on others' dtype and device.

    Example:
        >>> plane = Plane([0.0, 0.0, 2.0], 50.0)  # 2 z = 50
        >>> plane.distance(torch.tensor([[1.0, 2.0, 30.0]])).tolist()
        [5.0]
    """

    __slots__ = ("adopts", "is_per_point", "normal", "offset")

    normal: Tensor
    offset: Tensor
    is_per_point: bool
    adopts: bool

    def __init__(
        self, normal: Float[Tensor, "*#batch 3"] | Numbers, offset: Float[Tensor, "*#batch"] | Numbers = 0.0
    ) -> None:
        """Build a plane and check it.

        Args:
            normal: `(a, b, c)`, a tensor `(*B, 3)` or three numbers.
            offset: `d`, a tensor `(*B,)` or a number.

        Raises:
            TypeError: tensors that are not of floating-point type, or of mixed dtypes.
            ValueError: wrong shapes or devices, a zero normal, or values that are not finite (checked where values
                can be read).
        """
        adopts = not isinstance(normal, Tensor) and not isinstance(offset, Tensor)
        normal, offset = _as_tensors(normal, offset)
        normal, offset = check_tensor("normal", normal, 3), check_tensor("offset", offset)
        check_same_kind(normal=normal, offset=offset)
        batch = broadcast_batches(normal=normal.shape[:-1], offset=offset.shape)
        if has_values(normal, offset):
            if not bool(normal.isfinite().all() and offset.isfinite().all()):
                raise ValueError("plane: want a finite normal and offset, got NaN or infinity")
            if bool((normal == 0).all(dim=-1).any()):
                raise ValueError("normal: want a vector other than zero, got (0, 0, 0)")
        self.normal, self.offset = normal.expand(*batch, 3), offset.expand(batch)
        self.is_per_point, self.adopts = False, adopts

    @classmethod
    def unchecked(cls, normal: Any, offset: Any, is_per_point: bool = False, adopts: bool = False) -> "Plane":
        """A plane of these parts, without a look at them."""
        plane = cls.__new__(cls)
        plane.normal, plane.offset, plane.is_per_point, plane.adopts = normal, offset, is_per_point, adopts
        return plane

    # ------------------------------------------------------------------------------------------------ ways to make

    @classmethod
    def z(cls, offset: Float[Tensor, "*batch"] | Numbers = 0.0) -> "Plane":
        """The plane `z = offset`, in world units: `Plane.z(0.0)` is the chessboard's.

        Example:
            >>> Plane.z(12.5)
            Plane(normal=[0.0, 0.0, 1.0], offset=12.5)
        """
        if not isinstance(offset, Tensor):
            return cls([0.0, 0.0, 1.0], offset)
        offset = check_tensor("offset", offset)
        return cls(torch.tensor([0.0, 0.0, 1.0], dtype=offset.dtype, device=offset.device), offset)

    @classmethod
    def per_point(
        cls, normal: Float[Tensor, "*#points 3"] | Numbers, offset: Float[Tensor, "*#points"] | Numbers
    ) -> "Plane":
        """A plane for each point: the last batch axis `N` runs along with the pixels' axis.

        Args:
            normal: `(*B, N, 3)`, or one normal for all.
            offset: `(*B, N)`, or one offset for all.

        Raises:
            TypeError: as the constructor.
            ValueError: as the constructor, or neither argument has a points' axis.

        Example:
            >>> heights = torch.tensor([0.0, 10.0, 20.0])
            >>> Plane.per_point([0.0, 0.0, 1.0], heights).is_per_point
            True
        """
        plane = cls(normal, offset)
        if not plane.batch_shape:
            raise ValueError("per_point: want normal (*B, N, 3) or offset (*B, N), got a single plane")
        plane.is_per_point = True
        return plane

    @classmethod
    def from_points(cls, points: Float[Tensor, "*batch n 3"] | Array) -> "Plane":
        """The plane through points in the sense of least squared orthogonal distances; `rms` gives its fit error.

        The unit normal's largest component is positive. Derivatives with respect to the points are exact to second
        order, also for symmetric arrangements such as a grid, where those of an eigendecomposition are not finite.

        Args:
            points: `(*B, N, 3)` with N >= 3, not all on one line, in world units.

        Raises:
            TypeError: `points` is no floating-point tensor.
            ValueError: fewer than three points, points on a line, or values that are not finite.

        Example:
            >>> corners = torch.tensor([[0.0, 0, 1], [4, 0, 1], [0, 4, 1], [4, 4, 1.4]], dtype=torch.float64)
            >>> plane = Plane.from_points(corners)
            >>> round(float(plane.rms(corners)), 4)  # world units
            0.0998
        """
        points = check_tensor("points", points, "N", 3)
        if points.shape[-2] < 3:
            raise ValueError(f"points: want at least 3, got {points.shape[-2]}")
        if has_values(points) and not bool(points.isfinite().all()):
            raise ValueError("points: want finite values, got NaN or infinity")
        centroid = points.mean(dim=-2)
        spread = points - centroid.unsqueeze(-2)
        size = spread.detach().abs().amax((-2, -1), keepdim=True)
        spread = spread / torch.where(size > 0, size, 1.0)  # the normal is the same, and no square overflows
        scatter = (spread.unsqueeze(-1) * spread.unsqueeze(-2)).sum(dim=-3)
        normal = _smallest_eigenvector(scatter)
        sign = normal.detach().gather(-1, normal.detach().abs().argmax(dim=-1, keepdim=True)).sign()
        normal = normal * sign
        return cls.unchecked(normal, dot(normal, centroid))

    @classmethod
    def _alike(cls, items: list[Any]) -> list[Any]:
        """Those made of Python numbers take on the dtype and device of the others."""
        firm = [item.normal for item in items if not item.adopts]
        return [item.like(firm[0]) for item in items] if firm else items

    # ------------------------------------------------------------------------------------------------- as a tensor

    def to(self, *args: Any, **kwargs: Any) -> "Plane":
        """The plane in another dtype or on another device; see `Batched.to`.

        One made of Python numbers goes on taking on others' dtype unless a dtype is asked for.
        """
        plane = super().to(*args, **kwargs)
        kinds = {torch.empty(0, dtype=kind, device="cpu").to(*args, **kwargs).dtype for kind in _TWO_KINDS}
        return self.unchecked(plane.normal, plane.offset, self.is_per_point, self.adopts and len(kinds) > 1)

    def like(self, tensor: Tensor) -> "Plane":
        """The plane ready to meet `tensor`: one made of Python numbers takes on its dtype and device."""
        if not (isinstance(tensor, Tensor) and tensor.is_floating_point()):
            raise TypeError(f"tensor: want one of floating-point type, got {getattr(tensor, 'dtype', called(tensor))}")
        if not self.adopts or (self.normal.is_meta and not tensor.is_meta):  # one without values has none to give
            return self
        return self.unchecked(self.normal.to(tensor), self.offset.to(tensor), self.is_per_point)

    def __getitem__(self, index: Any) -> "Plane":
        """Planes picked from the batch, as one indexes a tensor of shape `*B`; one for each point is not indexed.

        Raises:
            IndexError: the planes belong to points.
        """
        if self.is_per_point:
            raise IndexError("plane: want a batch of planes to index, got planes per point; index normal and offset")
        return super().__getitem__(index)

    def __iter__(self) -> Iterator["Plane"]:
        """The planes of the first batch axis, one after the other.

        Raises:
            TypeError: there is no batch axis, or the planes belong to points.
        """
        if self.is_per_point:
            raise TypeError("plane: want a batch of planes to go through, got planes per point; take normal and offset")
        return super().__iter__()

    def _facts(self) -> list[str]:
        if self.batch_shape or not has_values(self.normal):
            return [f"batch_shape={tuple(self.batch_shape)}", f"per_point={self.is_per_point}", str(self.dtype)]
        return [f"normal={self.normal.tolist()}", f"offset={self.offset.item():g}"]

    # ---------------------------------------------------------------------------------------------------- geometry

    @property
    def unit_normal(self) -> Float[Tensor, "*batch 3"]:
        """The normal scaled to length 1."""
        return self.normalised()[0]

    def normalised(self) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
        """The unit normal `(*B, 3)`, and the plane's signed distance from the world's origin along it `(*B,)`."""
        normal, size = self._sized()
        length = normal.norm(dim=-1, keepdim=True)
        return normal / length, self.offset / size.squeeze(-1) / length.squeeze(-1)

    @property
    def length(self) -> Float[Tensor, "*batch"]:
        """The length of the normal."""
        normal, size = self._sized()
        return normal.norm(dim=-1) * size.squeeze(-1)

    def _sized(self) -> tuple[Tensor, Tensor]:
        """The normal in units of its largest component, and this `(*B, 1)`: the square of 1e20 overflows in float32."""
        size = self.normal.detach().abs().amax(-1, keepdim=True)
        return self.normal / size, size

    def tangents(self) -> Float[Tensor, "*batch 3 2"]:
        """Two unit vectors of the plane at right angles to each other and to the normal, as columns `(*B, 3, 2)`.

        The first is at right angles to the axis of the world that the normal is furthest from. It jumps where two axes
        are equally far: for directions that everybody shares, see `plane_axes`.

        Example:
            >>> Plane.z(0.0).tangents().T.tolist()
            [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
        """
        normal, _ = self._sized()
        furthest = torch.nn.functional.one_hot(normal.abs().argmin(dim=-1), 3).to(normal)
        first = torch.nn.functional.normalize(torch.linalg.cross(normal, furthest), dim=-1)
        second = torch.nn.functional.normalize(torch.linalg.cross(normal, first), dim=-1)
        return torch.stack([first, second], dim=-1)

    def parallel(self, distance: Float[Tensor, "*#batch"] | Array | float) -> "Plane":
        """The parallel plane at a signed distance along the normal, in world units.

        Raises:
            TypeError: no number, array or tensor of the plane's dtype.
            ValueError: it is not finite, or does not broadcast to the planes.

        Example:
            >>> Plane([0.0, 0.0, -2.0], 0.0).parallel(3.0)  # the normal points down
            Plane(normal=[0.0, 0.0, -2.0], offset=6)
        """
        given = check_tensor("distance", distance, like=self.normal)
        plane = self.like(given) if isinstance(distance, Tensor) else self
        check_same_kind(plane=plane.normal, distance=given)
        broadcast_batches(plane=plane.batch_shape, distance=given.shape)
        if has_values(given) and not bool(given.isfinite().all()):
            raise ValueError("distance: want finite numbers, got NaN or infinity")
        offset = plane.offset + given * plane.length
        normal = plane.normal.expand(*offset.shape, 3)
        return self.unchecked(normal, offset, self.is_per_point, self.adopts and not isinstance(distance, Tensor))

    def distance(self, points: Float[Tensor, "*#batch n 3"] | Array) -> Float[Tensor, "*#batch n"]:
        """Signed orthogonal distances of points `(*B, N, 3)`, positive on the normal's side, in world units."""
        points = check_tensor("points", points, "N", 3, like=None if self.adopts else self.normal)
        plane = self.like(points)
        check_same_kind(plane=plane.normal, points=points)
        broadcast_batches(plane=self.batch_shape, points=points.shape[:-1] if self.is_per_point else points.shape[:-2])
        normal, offset = plane.normalised()
        if not self.is_per_point:
            normal, offset = normal.unsqueeze(-2), offset.unsqueeze(-1)
        return dot(points, normal) - offset

    def rms(self, points: Float[Tensor, "*#batch n 3"] | Array) -> Float[Tensor, "*#batch"]:
        """Root mean square of the points' distances, in world units: the fit error of `from_points`.

        Raises:
            TypeError: no floating-point tensor or array, or another dtype than the plane's.
            ValueError: no points, or a wrong shape.
        """
        distance = self.distance(points)
        if distance.shape[-1] == 0:
            raise ValueError("points: want at least one, got none")
        size = distance.detach().abs().amax(-1, keepdim=True)
        size = torch.where(size > 0, size, 1.0)
        squared = (distance / size).square().mean(dim=-1)
        some = squared > 0  # the root's slope at 0 is infinite
        return torch.where(some, torch.where(some, squared, 1.0).sqrt(), 0.0) * size.squeeze(-1)


_TWO_KINDS = (torch.float32, torch.float64)
"""Of which one stays what it is where no dtype is asked for."""


def as_plane(plane: Plane) -> Plane:
    """A plane as it is.

    Raises:
        TypeError: it is none.
    """
    if isinstance(plane, Plane):
        return plane
    remedy = "dp.Plane(normal, offset) makes one, dp.Plane.z(0.0) the board's"
    return instance("plane", plane, Plane, "a dp.Plane", remedy)


def _as_tensors(normal: Any, offset: Any) -> tuple[Tensor, Tensor]:
    """Python numbers in the dtype and on the device of the tensor beside them, in float64 if there is none."""
    kind = meeting(*(value for value in (normal, offset) if isinstance(value, Tensor)))
    kind = torch.empty(0, dtype=torch.float64, device="cpu") if kind is None else kind
    return tensor_of("normal", normal, kind), tensor_of("offset", offset, kind)


def _smallest_eigenvector(scatter: Tensor) -> Tensor:
    """Unit eigenvector of the smallest eigenvalue of symmetric `(*B, 3, 3)`, with exact first and second derivatives.

    An eigendecomposition's derivative divides by all gaps between eigenvalues, also by the one between the two large
    ones, which is zero for a square grid. So: decompose without a tape, then two Newton steps with the tape on for
    `S n - m n = 0, n0 . n = 1`, whose system is regular as long as the smallest eigenvalue is simple.
    """
    with torch.no_grad():
        values, vectors = torch.linalg.eigh(scatter.detach())
        if has_values(values) and bool((values[..., 1] <= 64 * torch.finfo(values.dtype).eps * values[..., 2]).any()):
            raise ValueError("points: want three that are not on one line, got points on a line")
        start, value = vectors[..., 0], values[..., 0]
    identity = torch.eye(3, dtype=scatter.dtype, device=scatter.device)
    normal = start
    for _ in range(2):
        shifted = scatter - value[..., None, None] * identity
        top = torch.cat([shifted, -normal.unsqueeze(-1)], dim=-1)
        bottom = torch.cat([start, torch.zeros_like(start[..., :1])], dim=-1).unsqueeze(-2)
        constraint = dot(start, normal) - 1
        residual = torch.cat([dot(shifted, normal.unsqueeze(-2)), constraint.unsqueeze(-1)], dim=-1)
        step = torch.linalg.solve(torch.cat([top, bottom], dim=-2), residual)
        normal, value = normal - step[..., :3], value - step[..., 3]
    return normal / normal.norm(dim=-1, keepdim=True)
