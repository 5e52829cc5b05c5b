"""What the package uses of PyTorch beyond its promises still does what it is used for."""

from typing import Any

import pytest
import torch
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

from diffproj._core.torch_private import (
    constant_in_graphs,
    has_storage,
    in_forward_mode,
    in_functional_transform,
    in_recording,
    stands_for_a_batch,
)


def test_functional_transforms_are_seen() -> None:
    seen = []

    def function(x: torch.Tensor) -> torch.Tensor:
        seen.append(in_functional_transform())
        return x.sum()

    x = torch.ones(2, 2)
    function(x)
    torch.func.vmap(function)(x)
    torch.func.grad(function)(x)
    torch.func.jvp(function, (x,), (x,))
    function(x)
    assert seen == [False, True, True, True, False]


def test_what_stands_for_a_batch_is_seen_on_every_level() -> None:
    seen = []

    def function(x: torch.Tensor) -> torch.Tensor:
        seen.append(stands_for_a_batch(x))
        return (x * x).sum()

    x = torch.ones(2, 2)
    for one in (function, torch.func.grad(function), torch.func.jacfwd(function), torch.func.hessian(function)):
        one(x)
    torch.func.jvp(function, (x,), (x,))
    torch.func.functionalize(function)(x)
    torch.func.vmap(lambda _: function(torch.ones(2)))(x)
    assert not any(seen)
    seen.clear()
    torch.func.vmap(function)(x)
    torch.func.vmap(torch.func.vmap(function))(x)
    torch.func.vmap(torch.func.grad(function))(x)
    torch.func.grad(lambda x: torch.func.vmap(function)(x).sum())(x)
    torch.func.vmap(torch.func.hessian(function))(x)
    assert len(seen) == 5
    assert all(seen)


def test_what_stands_for_a_batch_has_no_storage() -> None:
    seen = []

    class Looking(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
            return x.clone()

        @staticmethod
        def backward(ctx: Any, *grad_outputs: torch.Tensor) -> torch.Tensor:
            seen.append(has_storage(grad_outputs[0]))
            return grad_outputs[0]

    x = torch.ones(2, requires_grad=True)
    y = Looking.apply(x)
    torch.autograd.grad(y, x, torch.eye(2), is_grads_batched=True, retain_graph=True)
    torch.func.vmap(lambda v: torch.autograd.grad(y, x, v, retain_graph=True)[0])(torch.eye(2))
    torch.autograd.grad(y, x, torch.ones(2))
    assert seen == [False, False, True]


def test_forward_mode_is_seen() -> None:
    assert not in_forward_mode()
    with forward_ad.dual_level():
        assert in_forward_mode()
        with torch.no_grad():
            assert in_forward_mode()
    assert not in_forward_mode()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_recordings_are_seen() -> None:
    seen = []

    def function(x: torch.Tensor) -> torch.Tensor:
        seen.append(in_recording())
        return x + 1

    function(torch.ones(2))
    torch.jit.trace(function, (torch.ones(2),), check_trace=False)
    make_fx(function)(torch.ones(2))
    function(torch.ones(2))
    assert seen == [False, True, True, False]


def test_a_constant_is_marked_as_pytorch_marks_it() -> None:
    def ours() -> bool:
        return True

    def theirs() -> bool:
        return True

    constant_in_graphs(ours)
    torch.compiler.assume_constant_result(theirs)
    assert vars(ours) == vars(theirs) != {}
