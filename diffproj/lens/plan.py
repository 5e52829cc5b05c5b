"""The plan of a lens: what is worked out once for its coefficients, so that single points cost little.

In a compiled or recorded graph the plan is one opaque operation. Its hundreds of small steps would take minutes to
compile, the same coefficients would be worked out anew in each call, and a recording would take the number of steps
from its example.
"""

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj._core.numerics import in_float64
from diffproj._core.torch_private import in_recording
from diffproj.lens.compiling import with_batch_in_front
from diffproj.lens.table import NODES


class Plan(NamedTuple):
    """How far a lens reaches, how exact its equations are, and where to start to invert them.

    Attributes:
        domain: `(*B,)`, the largest undistorted radius, or the largest angle from the axis.
        reach: `(*B,)`, no point of the domain is distorted to a larger radius (the tilt undone).
        noise: `(*B,)`, how much larger than its result the terms of the radial sum get.
        rho_max: `(*B,)`, part of the table of the inverse.
        ratio: `(*B, 2, NODES)`, the other part.
    """

    domain: Tensor
    reach: Tensor
    noise: Tensor
    rho_max: Tensor
    ratio: Tensor


AXES = (0, 0, 0, 0, 2)
"""How many axes each part has behind those of the batch."""


class Recipe(NamedTuple):
    """How a kind of lens works out its plan, from coefficients in float64.

    Attributes:
        domain: takes coefficients `(*B, k)` to the domain; 0 where they are of no use.
        rest: takes coefficients and domain to the other parts.
    """

    domain: Callable[[Tensor], Tensor]
    rest: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]


RECENT = 16
"""Results that are remembered."""

_recipes: dict[str, Recipe] = {}
_recent: list[tuple[str, tuple[Tensor, ...], tuple[Tensor, ...]]] = []
_lock = threading.Lock()
"""Held while entries are added to `_recipes` or `_recent`, and never while a plan is worked out."""


def register_recipe(kind: type, recipe: Recipe) -> str:
    """Say how the plans of a class of lenses are worked out.

    Returns:
        The class's key: its full name, which a compiled graph can keep across processes, with a number behind it
        where another class already has that name.
    """
    full = key = f"{kind.__module__}.{kind.__qualname__}"
    with _lock:
        number = 1
        while key in _recipes:
            number += 1
            key = f"{full} {number}"
        _recipes[key] = recipe
    return key


def domain_of(key: str, coefficients: Tensor) -> Tensor:
    """The domain for coefficients `(*B, k)`, in their type and rounded inward; 0 for those of no use."""
    coefficients = coefficients.detach()
    return _domain(coefficients, key) if _in_graph() else _rounded(key, coefficients)


def plan_of(key: str, coefficients: Tensor, domain: Tensor) -> Plan:
    """The whole plan for coefficients `(*B, k)` and their domain, in their type."""
    coefficients = coefficients.detach()
    rest = _rest if _in_graph() else _worked_out
    return Plan(domain, *rest(coefficients, domain, key))


def _in_graph() -> bool:
    return torch.compiler.is_compiling() or in_recording()


def _rounded(key: str, coefficients: Tensor) -> Tensor:
    exact = _recipes[key].domain(in_float64(coefficients))
    domain = exact.to(coefficients.dtype)
    domain = torch.where(domain.to(exact.dtype) > exact, torch.nextafter(domain, torch.zeros_like(domain)), domain)
    limits = torch.finfo(coefficients.dtype)
    overflows = coefficients.abs().amax(-1) > limits.max / 1e4
    underflows = domain < limits.tiny**0.25  # the squares of errors would be lost
    return torch.where(overflows | underflows, 0, domain)


def _worked_out(coefficients: Tensor, domain: Tensor, key: str) -> tuple[Tensor, ...]:
    parts = _recipes[key].rest(in_float64(coefficients), in_float64(domain))
    return tuple(part.to(coefficients.dtype) for part in parts)


@torch.library.custom_op("diffproj::lens_domain", mutates_args=())
def _domain(coefficients: Tensor, key: str) -> Tensor:
    (domain,) = _remembered(f"{key} domain", lambda c: (_rounded(key, c),), coefficients)
    return domain


@torch.library.custom_op("diffproj::lens_plan", mutates_args=())
def _rest(coefficients: Tensor, domain: Tensor, key: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    reach, noise, rho_max, ratio = _remembered(
        key, lambda c, reached: _worked_out(c, reached, key), coefficients, domain
    )
    return reach, noise, rho_max, ratio


def _remembered(what: str, function: Callable[..., tuple[Tensor, ...]], *arguments: Tensor) -> tuple[Tensor, ...]:
    """Copies of the results, from memory if lately asked for. No memory on accelerators, where looking waits.

    Safe from any number of threads: whatever is found or worked out is held by this call alone, entries are never
    changed, and the list is only touched under the lock. Two threads may work the same thing out at the same time.
    """
    if arguments[0].device.type != "cpu":
        return tuple(part.contiguous() for part in function(*arguments))
    with _lock:
        entries = list(_recent)
    for entry in entries:
        if entry[0] == what and _alike(entry[1], arguments):
            break
    else:
        entry = what, tuple(argument.clone() for argument in arguments), function(*arguments)
    with _lock:
        _recent[:] = [entry, *(other for other in _recent if other is not entry)][:RECENT]
    return tuple(part.clone(memory_format=torch.contiguous_format) for part in entry[2])


def _alike(before: tuple[Tensor, ...], now: tuple[Tensor, ...]) -> bool:
    return all(a.dtype == b.dtype and torch.equal(a, b) for a, b in zip(before, now, strict=True))


@_domain.register_fake
def _domain_shape(coefficients: Tensor, key: str) -> Tensor:  # noqa: ARG001
    return coefficients.new_empty(coefficients.shape[:-1])


@_rest.register_fake
def _rest_shapes(coefficients: Tensor, domain: Tensor, key: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # noqa: ARG001
    batch = coefficients.shape[:-1]
    reach, noise, rho_max, ratio = (coefficients.new_empty((*batch, *size)) for size in ((), (), (), (2, NODES)))
    return reach, noise, rho_max, ratio


@_domain.register_vmap
def _domain_batched(
    _info: object, in_dims: tuple[int | None, None], coefficients: Tensor, key: str
) -> tuple[Tensor, int]:
    return _domain(coefficients.movedim(in_dims[0] or 0, 0), key), 0


@_rest.register_vmap
def _rest_batched(
    info: Any, in_dims: tuple[int | None, int | None, None], coefficients: Tensor, domain: Tensor, key: str
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], tuple[int, int, int, int]]:
    coefficients, domain = with_batch_in_front(info, in_dims, coefficients, domain)
    return _rest(coefficients, domain, key), (0, 0, 0, 0)
