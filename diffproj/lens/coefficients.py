"""What the package's own lenses share: coefficients, batch axes, and a plan worked out once and remembered."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from diffproj._core.numerics import broadcast_batches, check_same_kind, check_tensor, converted, index_batch, readable
from diffproj.lens.plan import AXES, Model, Plan, domain_of, plan_of, register_model

L = TypeVar("L", bound="CoefficientLens")


class CoefficientLens(ABC):
    """A lens that its coefficients `(*B, k)` describe; see `diffproj.lens.Lens` for what a lens is.

    A subclass says which counts of coefficients it knows (`counts`), and works out its plan.
    """

    counts: tuple[int, ...]
    coefficients: Tensor
    _model: str  # the key of the class among the models of `plan`

    def __init__(self, coefficients: Float[Tensor, "*lens k"]):
        coefficients = check_tensor("coefficients", coefficients, "k")
        if coefficients.shape[-1] not in self.counts:
            counts = ", ".join(map(str, self.counts))
            raise ValueError(f"coefficients: want {counts} of them on the last axis, got {coefficients.shape[-1]}")
        if readable(coefficients) and not bool(coefficients.isfinite().all()):
            raise ValueError(f"coefficients: want finite numbers, got {coefficients.tolist()}")
        self._assign(coefficients)

    def _assign(self, coefficients: Any) -> None:
        self.coefficients = coefficients
        # The version of the coefficients, their domain and perhaps their plan: replaced as a whole, for threads.
        self._known: tuple[int, Tensor, Plan | None] | None = None
        self._origin: tuple[CoefficientLens, Callable[[Tensor, int], Tensor]] | None = None

    @classmethod
    def _unchecked(cls: type[L], coefficients: Any) -> L:
        lens = cls.__new__(cls)
        lens._assign(coefficients)
        return lens

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self)._unchecked, (self.coefficients,)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(coefficients {tuple(self.coefficients.shape)}, {self.dtype}, {self.device})"

    @property
    def batch_shape(self) -> torch.Size:
        """The batch axes `*B`."""
        return self.coefficients.shape[:-1]

    @property
    def dtype(self) -> torch.dtype:
        """The type of the coefficients."""
        return self.coefficients.dtype

    @property
    def device(self) -> torch.device:
        """Where the coefficients are."""
        return self.coefficients.device

    def to(self: L, *args: Any, **kwargs: Any) -> L:
        """The lens in another dtype or on another device: arguments as `torch.Tensor.to`."""
        return type(self)(converted(self.coefficients, *args, **kwargs))

    def detach(self: L) -> L:
        """The lens cut from the graph of its coefficients."""
        return self._rearranged(self.coefficients.detach(), lambda part, _: part)

    def expand(self: L, *batch_shape: int) -> L:
        """The lens with its batch axes broadcast to `batch_shape`, without copying."""

        def stretch(part: Tensor, axes: int) -> Tensor:
            return part.expand((*batch_shape, *part.shape[part.ndim - axes :]))

        return self._rearranged(stretch(self.coefficients, 1), stretch)

    def __getitem__(self: L, index: Any) -> L:
        """Lenses of the batch, chosen by indexing its batch axes."""

        def choose(part: Tensor, axes: int) -> Tensor:
            return index_batch(part, index, axes)

        return self._rearranged(choose(self.coefficients, 1), choose)

    def _rearranged(self: L, coefficients: Tensor, rearrange: Callable[[Tensor, int], Tensor]) -> L:
        """The same coefficients in another arrangement: the plan is this lens's, rearranged the same way."""
        lens = self._unchecked(coefficients)
        lens._origin = self, rearrange
        return lens

    # ----------------------------------------------------------------------------------------------------- the plan

    def __init_subclass__(cls) -> None:
        cls._model = register_model(cls, Model(cls._find_domain, cls._tabulate))

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
        if not readable(self.coefficients):
            return domain_of(self._model, self.coefficients)
        if self._origin is not None:
            origin, rearrange = self._origin
            return rearrange(origin._domain(), 0)
        return self._remembered()[1]

    def _plan(self) -> Plan:
        """The whole plan, which the way back needs, remembered likewise."""
        if not readable(self.coefficients):
            return plan_of(self._model, self.coefficients, self._domain())
        if self._origin is not None:
            origin, rearrange = self._origin
            return Plan(*(rearrange(part, axes) for part, axes in zip(origin._plan(), AXES, strict=True)))
        version, domain, plan = self._remembered()
        if plan is None:
            with torch.inference_mode(False), torch.no_grad():
                plan = plan_of(self._model, self.coefficients, domain)
            self._known = version, domain, plan
        return plan

    def _remembered(self) -> tuple[int, Tensor, Plan | None]:
        version = 0 if self.coefficients.is_inference() else self.coefficients._version
        known = self._known
        if known is None or known[0] != version:
            with torch.inference_mode(False), torch.no_grad():
                known = self._known = version, domain_of(self._model, self.coefficients), None
        return known

    def _usable(self, domain: Tensor) -> Tensor:
        """The coefficients, zero where the lens is of no use, so that no NaN gets into a gradient."""
        return torch.where((domain > 0).unsqueeze(-1), self.coefficients, 0)

    def _checked(self, name: str, points: Tensor, size: int) -> Tensor:
        """Points in the lens's own kind, with all batch axes."""
        points = check_tensor(name, points, "N", size)
        check_same_kind(coefficients=self.coefficients, **{name: points})
        batch = broadcast_batches(lens=self.batch_shape, **{name: points.shape[:-2]})
        return points.expand(*batch, *points.shape[-2:])
