"""The plan of a lens: what is worked out once for its coefficients, so that single points cost little.

In a compiled graph the plan is one opaque operation. Its hundreds of small steps would take minutes to compile, and
the same coefficients would be worked out anew in each call.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffproj._numerics import precise
from diffproj.lens.compiling import with_batch_in_front
from diffproj.lens.table import NODES


class Plan(NamedTuple):
    """How far a lens reaches, how exact its equations are, and where to start to invert them.

    Attributes:
        domain: `(*B,)`, the largest undistorted radius, or the largest angle from the axis.
        reach: `(*B,)`, no point of the domain is distorted to a larger radius (the tilt undone).
        noise: `(*B,)`, how much larger than its result the terms of the radial sum get.
        rho_max: `(*B, 3)`, part of the table of the inverse.
        ratio: `(*B, NODES)`, the other part.
    """

    domain: Tensor
    reach: Tensor
    noise: Tensor
    rho_max: Tensor
    ratio: Tensor


AXES = (0, 0, 0, 1, 1)
"""How many axes each part has behind those of the batch."""


class Model(NamedTuple):
    """How a kind of lens works out its plan, from coefficients in float64.

    Attributes:
        domain: takes coefficients `(*B, k)` to the domain; 0 where they are of no use.
        rest: takes coefficients and domain to the other parts.
    """

    domain: Callable[[Tensor], Tensor]
    rest: Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]


_models: dict[str, Model] = {}
_recent: list[tuple[str, tuple[Tensor, ...], tuple[Tensor, ...]]] = []
RECENT = 16


def know(name: str, model: Model) -> None:
    """Register under a name how a plan is worked out."""
    _models[name] = model


def domain_of(name: str, coefficients: Tensor) -> Tensor:
    """The domain for coefficients `(*B, k)`, in their type and rounded inward; 0 for those of no use."""
    coefficients = coefficients.detach()
    return _domain(coefficients, name) if torch.compiler.is_compiling() else _rounded(name, coefficients)


def plan_of(name: str, coefficients: Tensor, domain: Tensor) -> Plan:
    """The whole plan for coefficients `(*B, k)` and their domain, in their type."""
    coefficients = coefficients.detach()
    rest = _rest if torch.compiler.is_compiling() else _worked_out
    return Plan(domain, *rest(coefficients, domain, name))


def _rounded(name: str, coefficients: Tensor) -> Tensor:
    exact = _models[name].domain(precise(coefficients))
    domain = exact.to(coefficients.dtype)
    domain = torch.where(domain.to(exact.dtype) > exact, torch.nextafter(domain, torch.zeros_like(domain)), domain)
    limits = torch.finfo(coefficients.dtype)
    overflows = coefficients.abs().amax(-1) > limits.max / 1e4
    underflows = domain < limits.tiny**0.25  # the squares of errors would be lost
    return torch.where(overflows | underflows, 0, domain)


def _worked_out(coefficients: Tensor, domain: Tensor, name: str) -> tuple[Tensor, ...]:
    parts = _models[name].rest(precise(coefficients), precise(domain))
    return tuple(part.to(coefficients.dtype) for part in parts)


@torch.library.custom_op("diffproj::lens_domain", mutates_args=())
def _domain(coefficients: Tensor, name: str) -> Tensor:
    (domain,) = _remembered(f"{name} domain", lambda c: (_rounded(name, c),), coefficients)
    return domain


@torch.library.custom_op("diffproj::lens_plan", mutates_args=())
def _rest(coefficients: Tensor, domain: Tensor, name: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    reach, noise, rho_max, ratio = _remembered(
        name, lambda c, reached: _worked_out(c, reached, name), coefficients, domain
    )
    return reach, noise, rho_max, ratio


def _remembered(name: str, function: Callable[..., tuple[Tensor, ...]], *arguments: Tensor) -> tuple[Tensor, ...]:
    """Copies of the results, from memory if lately asked for. No memory on accelerators, where looking waits."""
    if arguments[0].device.type != "cpu":
        return tuple(part.contiguous() for part in function(*arguments))
    for index, (known, values, _) in enumerate(_recent):
        if known == name and all(
            before.dtype == now.dtype and torch.equal(before, now)
            for before, now in zip(values, arguments, strict=True)
        ):
            _recent.insert(0, _recent.pop(index))
            break
    else:
        _recent.insert(0, (name, tuple(argument.clone() for argument in arguments), function(*arguments)))
        del _recent[RECENT:]
    return tuple(part.clone(memory_format=torch.contiguous_format) for part in _recent[0][2])


@_domain.register_fake
def _domain_shape(coefficients: Tensor, name: str) -> Tensor:  # noqa: ARG001
    return coefficients.new_empty(coefficients.shape[:-1])


@_rest.register_fake
def _rest_shapes(coefficients: Tensor, domain: Tensor, name: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # noqa: ARG001
    batch = coefficients.shape[:-1]
    reach, noise, rho_max, ratio = (coefficients.new_empty((*batch, *size)) for size in ((), (), (3,), (NODES,)))
    return reach, noise, rho_max, ratio


@_domain.register_vmap
def _domain_batched(
    _info: object, in_dims: tuple[int | None, None], coefficients: Tensor, name: str
) -> tuple[Tensor, int]:
    return _domain(coefficients.movedim(in_dims[0] or 0, 0), name), 0


@_rest.register_vmap
def _rest_batched(
    info: Any, in_dims: tuple[int | None, int | None, None], coefficients: Tensor, domain: Tensor, name: str
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], tuple[int, int, int, int]]:
    coefficients, domain = with_batch_in_front(info, in_dims, coefficients, domain)
    return _rest(coefficients, domain, name), (0, 0, 0, 0)
