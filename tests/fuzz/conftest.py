"""Arguments that are wrong in some way, and a look at what a call makes of them."""

import math
import random
import re
import signal
import warnings
from collections.abc import Callable, Mapping, Sequence
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import diffproj as dp

SECONDS = 20
"""After which a call counts as hanging."""

D = torch.float64


# ------------------------------------------------------------------------------------------------- wrong arguments


def spoilt(value: Any, draw: random.Random, strangers: Sequence[Any]) -> Any:
    """A value in the place of a right one: like it with something wrong, or anything at all."""
    if draw.random() < 0.35:
        return draw.choice(strangers)
    if isinstance(value, Tensor | np.ndarray):
        return _spoilt_tensor(torch.as_tensor(value), draw)
    if isinstance(value, bool):
        return draw.choice([not value, 2, -1, 0.5, "x", "False", None, np.bool_(value), torch.tensor(value), math.nan])
    if isinstance(value, int | float):
        close = [
            -value,
            0,
            value + 0.5,
            100 * value,
            1e-9,
            1e300,
            math.nan,
            math.inf,
            str(value),
            None,
            [value],
            (value, value),
        ]
        return draw.choice(
            [*close, np.float32(value), np.int64(1), torch.tensor(float(value)), torch.tensor([value]), value * 1j]
        )
    if isinstance(value, str):
        return draw.choice(
            [value.upper(), value + "x", "", value.encode(), [value], None, 0, "auto", "brown5", (value, value)]
        )
    if isinstance(value, tuple | list):
        return _spoilt_sequence(value, draw, strangers)
    if isinstance(value, dict):
        name = draw.choice(list(value))
        changed = spoilt(value[name], draw, strangers)
        return draw.choice(
            [{**value, name: changed}, {name + "x": value[name]}, {3: 4}, list(value), {**value, "f_y": changed}]
        )
    if isinstance(value, dp.Camera | dp.Plane | dp.Views):
        return _spoilt_object(value, draw)
    return draw.choice(strangers)


def _spoilt_tensor(tensor: Tensor, draw: random.Random) -> Any:
    def at_one_place(number: float) -> Tensor:
        if tensor.numel() == 0 or not tensor.is_floating_point():
            return tensor
        copy = tensor.clone()
        copy.view(-1)[draw.randrange(tensor.numel())] = number
        return copy

    def array(kind: Any = None) -> np.ndarray:
        return tensor.numpy(force=True).astype(kind) if kind else tensor.numpy(force=True).copy()

    axis = draw.randrange(tensor.ndim) if tensor.ndim else 0
    last = tensor.ndim - 1
    ways: list[Callable[[], Any]] = [
        lambda: tensor.to(
            draw.choice([torch.float32, torch.half, torch.bfloat16, torch.int64, torch.bool, torch.complex128])
        ),
        lambda: array(),
        lambda: array(draw.choice([np.float32, np.int32, np.uint8, bool, complex, object, str])),
        lambda: np.flip(array()),
        lambda: array()[..., ::-1],
        lambda: np.asfortranarray(array()),
        lambda: tensor.tolist(),
        lambda: tuple(tensor.tolist()) if tensor.ndim else tensor.tolist(),
        lambda: [array()],
        lambda: list(tensor) if tensor.ndim else [tensor],
        lambda: at_one_place(draw.choice([math.nan, math.inf, -math.inf, 1e300, 1e20, -1e20, 1e-30, 0.0])),
        lambda: tensor * draw.choice([0, -1, 1e30, 1e300, 1e-30, 1e-300, math.nan, 1e5]),
        lambda: tensor.detach().clone().requires_grad_() if tensor.is_floating_point() else tensor,
        lambda: tensor.unsqueeze(0),
        lambda: tensor.unsqueeze(-1),
        lambda: tensor.expand(3, *tensor.shape),
        lambda: tensor.expand(0, *tensor.shape),
        lambda: tensor.transpose(axis, last) if tensor.ndim else tensor,
        lambda: tensor.narrow(axis, 0, 0) if tensor.ndim else tensor,
        lambda: tensor.narrow(axis, 0, max(0, tensor.shape[axis] - 1)) if tensor.ndim else tensor,
        lambda: tensor.narrow(axis, 0, 1) if tensor.ndim and tensor.shape[axis] else tensor,
        lambda: torch.cat([tensor, tensor], axis) if tensor.ndim else tensor,
        lambda: tensor[0] if tensor.ndim and len(tensor) else tensor,
        lambda: tensor.to("meta"),
        lambda: tensor.flatten(),
        lambda: str(tensor),
    ]
    return draw.choice(ways)()


def _objects(items: Sequence[Any]) -> np.ndarray:
    array = np.empty(len(items), dtype=object)
    for place, item in enumerate(items):
        array[place] = item
    return array


def _spoilt_sequence(value: Any, draw: random.Random, strangers: Sequence[Any]) -> Any:
    kind, items = type(value), list(value)
    ways: list[Callable[[], Any]] = [
        lambda: kind(items[:-1]),
        lambda: kind([*items, *items[:1]]),
        lambda: kind(reversed(items)),
        lambda: [items],
        lambda: None,
        lambda: iter(items),
        lambda: _objects(items),
        lambda: kind(),
    ]
    if items and all(isinstance(item, int | float) and not isinstance(item, bool) for item in items):
        ways += [
            lambda: np.array(items),
            lambda: torch.tensor(items),
            lambda: [-item for item in items],
            lambda: items[0],
        ]
    if items:
        place = draw.randrange(len(items))
        changed = [spoilt(items[place], draw, strangers) if i == place else item for i, item in enumerate(items)]
        ways += [lambda: kind(changed)] * 4
    return draw.choice(ways)()


def _spoilt_object(value: Any, draw: random.Random) -> Any:
    batched = len(value.batch_shape) > 0 or isinstance(value, dp.Views)
    ways: list[Callable[[], Any]] = [
        lambda: value.to(torch.float32),
        lambda: value.to("meta"),
        lambda: [value],
        lambda: type(value),
        lambda: type(value).stack([value, value]),
        lambda: type(value).stack([value, value, value]),
        lambda: value[:0] if batched else value.expand(0),
        lambda: value[0] if batched else value.expand(2, 2),
        lambda: value.detach(),
        lambda: None,
    ]
    return draw.choice(ways)()


# -------------------------------------------------------------------------------------------------------- the look

OWN_WORDS = re.compile(r"\bwant\b|do not broadcast|no such file|found no board|determine|converge|views|explains")
"""What the package's own messages say."""
RELATION = re.compile(r"broadcast|\bas \w+ has\b|device|batch shape|corners in each|fit\b|an axis from")
"""What they say of two arguments that do not fit together."""
ALIASES = {
    "photographs": r"photographs|image \d+",
    "test": r"test|views",
    "fit": r"fit|views",
    "board": r"board|target",
}
"""Other names that a message may give to an argument, where one function hands it to another."""


class HangError(Exception):
    """A call that took too long."""


def tried(call: Any, spoilt_ones: dict[str, Any]) -> str | None:
    """Call with some arguments replaced; `None`, or what is wrong about the answer, in a line."""
    given = {**call.given, **spoilt_ones}
    versions = {id(x): x._version for x in given.values() if isinstance(x, Tensor) and not x.is_inference()}

    def stop(_: int, __: FrameType | None) -> None:
        raise HangError

    previous = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            answer = call.function(**given)
    except HangError:
        return "hangs"
    except Exception as error:
        return _about(error, call, spoilt_ones)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, previous)
    if any(x._version != versions[id(x)] for x in given.values() if id(x) in versions):
        return "writes to its argument"
    return unsound(answer)


def _about(error: Exception, call: Any, spoilt_ones: dict[str, Any]) -> str | None:
    text, kind = str(error), type(error)
    if kind is dp.CalibrationError or issubclass(kind, OSError):
        return None
    if any(callable(value) and argument in ("progress", "function") for argument, value in spoilt_ones.items()):
        return None  # what a user's own function raises is the user's
    line = text.splitlines()[0][:150] if text else ""
    if not (kind in (TypeError, ValueError, dp.BoardNotFoundError) or (kind is IndexError and "want" in text)):
        return f"{kind.__name__}: {line}"
    if not OWN_WORDS.search(text):
        return f"a message from the inside, {kind.__name__}: {line}"
    named = [argument for argument in call.given if re.search(rf"\b{ALIASES.get(argument, argument)}\b", text)]
    named += ["path"] * (str(spoilt_ones.get("path", call)) in text)
    # A message about two arguments that do not fit together may begin with either.
    if not named or (not set(named) & set(spoilt_ones) and not RELATION.search(text)):
        return f"a message that does not name {', '.join(spoilt_ones)}: {line}"
    return None


ENDLESS = ("domain", "reach")
"""Buffers of a lens's plan that may be infinite."""


def unsound(answer: Any) -> str | None:
    """What is wrong with an answer: values that are not finite where `valid` says that they hold, or shapes."""
    if (
        isinstance(answer, tuple)
        and len(answer) > 1
        and isinstance(answer[-1], Tensor)
        and answer[-1].dtype == torch.bool
    ):
        *parts, valid = answer
        return next((wrong for part in parts if (wrong := _unsound_where(part, valid))), None)
    if isinstance(answer, dp.Camera):
        return _not_finite(K=answer.K, R=answer.R, t=answer.t) or (_singular(answer.K))
    if isinstance(answer, dp.Plane):
        zero = (
            answer.normal.numel()
            and not answer.normal.is_meta
            and bool((answer.unit_normal.norm(dim=-1) - 1).abs().amax() > 1e-3)
        )
        return _not_finite(normal=answer.normal, offset=answer.offset) or (
            "a normal without direction" if zero else None
        )
    if isinstance(answer, dp.Views):
        return _not_finite(pixels=answer.pixels)
    if isinstance(answer, dp.PlaneMap):
        return _not_finite(matrix=answer.matrix)
    if isinstance(answer, dp.Measurement):
        return _unsound_where(answer.points, answer.valid) or _unsound_deviation(answer)
    if isinstance(answer, dp.Calibration):
        sound = answer.converged
        return _unsound_where(answer.camera.K, sound) or _unsound_where(answer.cameras.t, sound)
    if isinstance(answer, nn.Module):
        held = {**dict(answer.named_parameters()), **dict(answer.named_buffers())}
        return _not_finite(**{name: held[name] for name in held if not name.endswith(ENDLESS)})
    return None


def _unsound_where(values: Tensor, valid: Tensor) -> str | None:
    if not isinstance(values, Tensor) or values.is_meta or valid.is_meta:
        return None
    if values.shape[: valid.ndim] != valid.shape and values.shape[-2:] != valid.shape[-2:]:
        return f"shape {tuple(values.shape)} beside valid {tuple(valid.shape)}"
    if values.shape[: valid.ndim] == valid.shape and not bool(values[valid].isfinite().all()):
        return "values that are not finite where valid"
    return None


def _unsound_deviation(answer: dp.Measurement) -> str | None:
    spread = answer.deviations
    if bool((spread[answer.valid].isnan() | (spread[answer.valid] < 0)).any()):
        return "deviations that are NaN where valid"
    return None


def _not_finite(**tensors: Tensor) -> str | None:
    for name, tensor in tensors.items():
        if not tensor.is_meta and tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            return f"{name} that is not finite"
    return None


def _singular(K: Tensor) -> str | None:
    if K.is_meta or not K.numel():
        return None
    F = K[..., :2, :2]
    return "K without inverse" if bool((torch.linalg.det(F.double()) == 0).any()) else None


# ------------------------------------------------------------------------------------------------------- many calls


class Hostile:
    """Calls with spoilt arguments.

    Args:
        calls: by name, each with `function`, its arguments by name as `given`, and `weight`: how often it is tried.
        strangers: things of any type that may stand for an argument.
    """

    def __init__(self, calls: Mapping[str, Any], strangers: Sequence[Any]) -> None:
        self.calls, self.strangers = calls, strangers

    def attempt(self, seed: int, number: int) -> str | None:
        """One call, drawn by chance; `None`, or what is wrong about its answer, in a line."""
        draw = random.Random(f"{seed} {number}")  # noqa: S311
        (name,) = draw.choices(list(self.calls), [call.weight for call in self.calls.values()])
        call = self.calls[name]
        arguments = draw.sample(list(call.given), min(len(call.given), 1 if draw.random() < 0.85 else 2))
        wrong = {argument: spoilt(call.given[argument], draw, self.strangers) for argument in arguments}
        fault = tried(call, wrong)
        return fault and f"{number}: {name}({', '.join(f'{key}={_short(x)}' for key, x in wrong.items())}): {fault}"


@pytest.fixture(scope="session")
def hostile() -> type[Hostile]:
    """What makes calls with wrong arguments."""
    return Hostile


def _short(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"tensor{tuple(value.shape)} {value.dtype} {value.device.type}" + (
            f" {value.flatten()[:4].tolist()}" if not value.is_meta else ""
        )
    if isinstance(value, np.ndarray):
        return f"array{value.shape} {value.dtype} {value.flatten()[:4]}"
    return repr(value)[:80]
