"""Checks of every annotation of the package at run time: jaxtyping's shapes with beartype.

jaxtyping's own decorator binds and checks all arguments a second time to check what a function returns, and makes two
checkers a function; that was a quarter to a third of the time of tests. Here one checker looks at arguments and
answer, under the same record of what the names in the shapes stand for.
"""

import dataclasses
import functools
import inspect
import sys
import types
from collections.abc import Callable
from typing import Any, get_type_hints

import beartype
import jaxtyping

_of_jaxtyping = jaxtyping.jaxtyped
_check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True, violation_type=TypeError))
"""Lets an int stand for a float, as Python's typing does."""


def install(package: str) -> None:
    """Check the annotations of all that is imported from a package after this."""
    checker = types.ModuleType("shape_checker")
    checker.check = _check  # the hook takes its checker by name
    sys.modules["shape_checker"] = checker
    jaxtyping.install_import_hook(package, "shape_checker.check")
    jaxtyping.jaxtyped = _jaxtyped  # what the hook writes above functions and classes


def _jaxtyped(*args: Any, **kwargs: Any) -> Any:
    return _of_jaxtyping(*args, **kwargs) if args else checked


def checked(target: Any) -> Any:
    """A function, a method or a data class whose calls are checked."""
    if isinstance(target, type):
        own = target.__dict__.get("__init__")
        if dataclasses.is_dataclass(target) and own is not None and not hasattr(own, "__wrapped__"):
            target.__init__ = checked(own)
        return target
    if isinstance(target, classmethod | staticmethod):
        return type(target)(checked(target.__func__))
    if isinstance(target, property):
        return property(*(part and checked(part) for part in (target.fget, target.fset, target.fdel)))
    if inspect.isgeneratorfunction(target):
        return _of_jaxtyping(target, typechecker=_check)  # its body runs when the call is over
    return _checked_function(target)


def _checked_function(function: Callable[..., Any]) -> Callable[..., Any]:
    if not function.__annotations__:
        return function
    checking: Callable[..., Any] | None = None

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        nonlocal checking
        if checking is None:  # made when first needed: most of the package is there then, and a process uses a part
            checking = _check(_with_hints(function))
        with _of_jaxtyping("context"):  # one record of sizes for arguments and answer
            return checking(*args, **kwargs)

    return call


def _with_hints(function: Callable[..., Any]) -> Callable[..., Any]:
    """A copy of a function whose annotations are what they stand for."""
    names = function.__globals__
    copy = types.FunctionType(function.__code__, names, function.__name__, function.__defaults__, function.__closure__)
    copy.__kwdefaults__ = function.__kwdefaults__
    copy.__module__ = function.__module__
    copy.__qualname__ = function.__qualname__
    copy.__annotations__ = {name: _resolved(hint, names) for name, hint in function.__annotations__.items()}
    return copy


def _resolved(hint: Any, names: dict[str, Any]) -> Any:
    """What a hint stands for; `Any` where it names what is there for type checkers only."""
    holder = types.SimpleNamespace(__annotations__={"hint": hint})
    try:
        return get_type_hints(holder, names, include_extras=True)["hint"]
    except NameError:
        return Any
