"""Functions that JAX traces and differentiates once, however many plans call them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import jax

__all__ = ["inlining", "traced_once"]

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

_INLINING: ContextVar[bool] = ContextVar("inlining", default=False)


def traced_once(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same function, compiled by itself or with what calls it, and traced once for all, but within `inlining`."""
    called: Any = jax.jit(function)

    @wraps(function)
    def call(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        return (function if _INLINING.get() else called)(*arguments, **options)

    return call


@contextmanager
def inlining() -> Iterator[None]:
    """Within, `traced_once` functions are traced wherever they are called, as if they were not compiled by themselves.

    XLA simplifies programs with calls, and derivatives of calls, otherwise for one device than for several, so that
    the two differ in their last digits.
    """
    token = _INLINING.set(True)
    try:
        yield
    finally:
        _INLINING.reset(token)
