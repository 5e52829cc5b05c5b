"""The plan of a lens: what is worked out once for its coefficients, so that single points cost little.

In a compiled graph the plan is one opaque operation. Its hundreds of small steps would take minutes to compile, and
the same coefficients would be worked out anew in each call.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from diffproj._numerics import precise
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

Model = Callable[[Tensor], Plan]

_models: dict[str, Model] = {}
_recent: list[tuple[str, Tensor, Plan]] = []
RECENT = 8


def know(name: str, model: Model) -> None:
    """Register under a name how a plan is worked out for coefficients in float64."""
    _models[name] = model


def plan_of(name: str, coefficients: Tensor) -> Plan:
    """The plan for coefficients `(*B, k)`, in their type; the domain is rounded inward, and 0 for those of no use."""
    coefficients = coefficients.detach()
    return Plan(*_planned(coefficients, name)) if torch.compiler.is_compiling() else _rounded(name, coefficients)


def _rounded(name: str, coefficients: Tensor) -> Plan:
    plan = _models[name](precise(coefficients))
    domain, *others = (part.to(coefficients.dtype) for part in plan)
    domain = torch.where(
        domain.to(plan.domain.dtype) > plan.domain, torch.nextafter(domain, torch.zeros_like(domain)), domain
    )
    limits = torch.finfo(coefficients.dtype)
    overflows = coefficients.abs().amax(-1) > limits.max / 1e4
    underflows = domain < limits.tiny**0.25  # the squares of errors would be lost
    return Plan(torch.where(overflows | underflows, 0, domain), *others)


@torch.library.custom_op("diffproj::lens_plan", mutates_args=())
def _planned(coefficients: Tensor, name: str) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    plan = _remembered(name, coefficients) if coefficients.device.type == "cpu" else _rounded(name, coefficients)
    domain, reach, noise, rho_max, ratio = (part.clone(memory_format=torch.contiguous_format) for part in plan)
    return domain, reach, noise, rho_max, ratio


def _remembered(name: str, coefficients: Tensor) -> Plan:
    """The plan, from memory if these coefficients were asked for lately. Not on accelerators, where looking waits."""
    for index, (known, values, plan) in enumerate(_recent):
        if known == name and values.dtype == coefficients.dtype and torch.equal(values, coefficients):
            _recent.insert(0, _recent.pop(index))
            return plan
    plan = _rounded(name, coefficients)
    _recent.insert(0, (name, coefficients.clone(), plan))
    del _recent[RECENT:]
    return plan


@_planned.register_fake
def _planned_shapes(coefficients: Tensor, name: str) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # noqa: ARG001
    batch = coefficients.shape[:-1]
    sizes = [(), (), (), (3,), (NODES,)]
    domain, reach, noise, rho_max, ratio = (coefficients.new_empty((*batch, *size)) for size in sizes)
    return domain, reach, noise, rho_max, ratio


@_planned.register_vmap
def _planned_batched(
    _info: object, in_dims: tuple[int | None, None], coefficients: Tensor, name: str
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor, Tensor], tuple[int, int, int, int, int]]:
    return _planned(coefficients.movedim(in_dims[0] or 0, 0), name), (0, 0, 0, 0, 0)
