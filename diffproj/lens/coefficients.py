"""What the package's own lenses share: coefficients, batch axes, and a plan worked out once and remembered."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from diffproj._core.arguments import Array
from diffproj._core.batched import Batched, Rearrange
from diffproj._core.numerics import broadcast_batches, check_same_kind, check_tensor, has_values, version_of
from diffproj._core.torch_private import outside_of_tracing, traced_beside
from diffproj.lens.plan import AXES, Plan, Recipe, domain_of, plan_of, register_recipe
from diffproj.lens.protocol import distorted, undistorted

L = TypeVar("L", bound="CoefficientLens")

MOST_STEPS = 16
"""Rearrangements in a row through which a plan is followed back to where it was worked out."""


class CoefficientLens(Batched, ABC):
    """A lens that its coefficients `(*B, k)` describe; see `diffproj.lens.Lens` for what a lens is.

    A subclass says which counts of coefficients it knows (`counts`), and works out its plan.
    """

    counts: tuple[int, ...]
    coefficients: Tensor
    _key: str  # of the class, among the recipes of `plan`

    def __init__(self, coefficients: Float[Tensor, "*lens k"] | Array):
        coefficients = check_tensor("coefficients", coefficients, "k")
        if coefficients.shape[-1] not in self.counts:
            counts = ", ".join(map(str, self.counts))
            raise ValueError(f"coefficients: want {counts} of them on the last axis, got {coefficients.shape[-1]}")
        if has_values(coefficients) and not bool(coefficients.isfinite().all()):
            raise ValueError(f"coefficients: want finite numbers, got {coefficients.tolist()}")
        self._assign(coefficients)

    def _assign(self, coefficients: Any) -> None:
        self.coefficients = coefficients
        # The version of the coefficients, their domain and perhaps their plan: replaced as a whole, for threads.
        self._known: tuple[int, Tensor, Plan | None] | None = None
        # Of a rearranged lens: whose coefficients these are, their version at the time, and what was done to them.
        self._origin: tuple[CoefficientLens, int, tuple[Rearrange, ...]] | None = None
        self._given: Plan | None = None

    @classmethod
    def unchecked(cls: type[L], coefficients: Any) -> L:
        """A lens of these coefficients, without a look at them."""
        lens = cls.__new__(cls)
        lens._assign(coefficients)
        return lens

    @classmethod
    def planned(cls: type[L], coefficients: Any, plan: Plan) -> L:
        """A lens of these coefficients with a plan that was worked out for them before; both without a look."""
        lens = cls.unchecked(coefficients)
        lens._given = plan
        return lens

    def plan(self) -> Plan:
        """All that was worked out for the coefficients; see `Plan`."""
        return self._plan()

    def __getstate__(self) -> dict[str, Any]:
        return {"coefficients": self.coefficients}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._assign(state["coefficients"])

    def _facts(self) -> list[str]:
        return [f"coefficients {tuple(self.coefficients.shape)}", str(self.dtype), str(self.device)]

    def to(self: L, *args: Any, **kwargs: Any) -> L:
        """The lens in another dtype or on another device; see `Batched.to`. It works its plan out anew."""
        return type(self)(super().to(*args, **kwargs).coefficients)

    def _rearranged(self: L, rearrange: Rearrange, part: Callable[[Any], Any]) -> L:  # noqa: ARG002
        """The same coefficients in another arrangement: the plan is this lens's, rearranged the same way."""
        lens = self.unchecked(rearrange(self.coefficients, 1))
        if self._given is not None:
            lens._given = _rearranged_plan(self._given, (rearrange,))
        else:
            root, version, steps = self._origin or (self, version_of(self.coefficients), ())
            if len(steps) < MOST_STEPS:  # further on it works its plan out anew
                lens._origin = root, version, (*steps, rearrange)
        return lens

    def detach(self: L) -> L:
        """The same cut off from the graph, with all that is known of it."""
        lens = self.unchecked(self.coefficients.detach())
        lens._known, lens._given = self._known, self._given
        lens._origin = self._origin or (self, version_of(self.coefficients), ())
        return lens

    # ----------------------------------------------------------------------------------------------------- the plan

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls._key = register_recipe(cls, Recipe(cls._find_domain, cls._tabulate))

    @property
    @abstractmethod
    def domain(self) -> Tensor:
        """How far the lens reaches `(*B,)`; see `Lens`."""

    @abstractmethod
    def project_direction(self, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Directions to distorted points; see `Lens`."""

    @abstractmethod
    def unproject(self, xy_distorted: Tensor) -> tuple[Tensor, Tensor]:
        """Distorted points to directions; see `Lens`."""

    def distort(self, xy: Float[Tensor, "*batch n 2"]) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Distorted points of undistorted ones; see `Lens`."""
        return distorted(self.project_direction, check_tensor("xy", xy, "N", 2))

    def undistort(
        self, xy_distorted: Float[Tensor, "*batch n 2"]
    ) -> tuple[Float[Tensor, "*out n 2"], Bool[Tensor, "*out n"]]:
        """Undistorted points of distorted ones, those in front of the camera; see `Lens`."""
        return undistorted(self.unproject, xy_distorted)

    @abstractmethod
    def by_direction(self, direction: Tensor) -> Tensor:
        """Derivatives of the distorted points by valid directions `(*B, N, 3)`: `(*B, N, 2, 3)`, in closed form."""

    @abstractmethod
    def by_coefficients(self, direction: Tensor) -> Tensor:
        """Derivatives of the distorted points of valid directions by the coefficients `(*B, N, 2, k)`."""

    @abstractmethod
    def turned(self: L, cosine: Tensor, sine: Tensor) -> tuple[L, Tensor]:
        """The lens turned about its axis by an angle `(*B,)`, and whether there is one `(*B,)`."""

    @staticmethod
    @abstractmethod
    def _find_domain(coefficients: Tensor) -> Tensor:
        """The domain `(*B,)` for coefficients in float64; 0 where they are of no use."""

    @staticmethod
    @abstractmethod
    def _tabulate(coefficients: Tensor, domain: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The other parts of the plan, in float64; anything where the domain is 0."""

    def _domain(self) -> Tensor:
        """The domain, all that the way forward needs; remembered for as long as nobody writes to the coefficients."""
        if self._given is not None:
            return self._given.domain
        if not has_values(self.coefficients):
            if traced_beside(self.coefficients):
                return outside_of_tracing(lambda: self._plan_of_values().domain)
            return domain_of(self._key, self.coefficients)
        origin = self._root()
        if origin is not None:
            root, steps = origin
            return _rearranged_part(root._remembered()[1], steps, 0)
        return self._remembered()[1]

    def _plan(self) -> Plan:
        """The whole plan, which the way back needs, remembered likewise."""
        if self._given is not None:
            return self._given
        if not has_values(self.coefficients):
            if traced_beside(self.coefficients):
                return outside_of_tracing(self._plan_of_values)
            return plan_of(self._key, self.coefficients, self._domain())
        return self._plan_of_values()

    def _plan_of_values(self) -> Plan:
        origin = self._root()
        if origin is not None:
            root, steps = origin
            return _rearranged_plan(root._plan_of_values(), steps)
        version, domain, plan = self._remembered()
        if plan is None:
            with torch.inference_mode(False), torch.no_grad():
                plan = plan_of(self._key, self.coefficients, domain)
            self._known = version, domain, plan
        return plan

    def _root(self) -> "tuple[CoefficientLens, tuple[Rearrange, ...]] | None":
        """Whose coefficients these are and how they were rearranged, if nobody has written to them since."""
        if self._origin is None:
            return None
        root, version, steps = self._origin
        return (root, steps) if version_of(root.coefficients) == version else None

    def _remembered(self) -> tuple[int, Tensor, Plan | None]:
        version = version_of(self.coefficients)
        known = self._known
        if known is None or known[0] != version:
            with torch.inference_mode(False), torch.no_grad():
                known = self._known = version, domain_of(self._key, self.coefficients), None
        return known

    def _usable(self, domain: Tensor) -> Tensor:
        """The coefficients, zero where the lens is of no use, so that no NaN gets into a gradient."""
        return torch.where((domain > 0).unsqueeze(-1), self.coefficients, 0)

    def _checked(self, name: str, points: Tensor | Array, size: int) -> Tensor:
        """Points in the lens's own kind, with all batch axes."""
        points = check_tensor(name, points, "N", size, like=self.coefficients)
        check_same_kind(coefficients=self.coefficients, **{name: points})
        batch = broadcast_batches(lens=self.batch_shape, **{name: points.shape[:-2]})
        return points.expand(*batch, *points.shape[-2:])


def _rearranged_part(part: Tensor, steps: tuple[Rearrange, ...], axes: int) -> Tensor:
    for rearrange in steps:
        part = rearrange(part, axes)
    return part


def _rearranged_plan(plan: Plan, steps: tuple[Rearrange, ...]) -> Plan:
    return Plan(*(_rearranged_part(part, steps, axes) for part, axes in zip(plan, AXES, strict=True)))
