"""Compile functions: quickly, or into one kernel."""

from collections.abc import Callable, Hashable, Mapping
from functools import cache, wraps
from typing import Any

import jax
from jax import numpy as jnp

__all__ = ["QUICKLY", "in_one_kernel", "jit_quickly", "known_options"]

QUICKLY = {"xla_cpu_use_fusion_emitters": False}
"""Compiler options that halve compilation, where XLA knows them (JAX up to 0.11.0); they cost small plans a tenth of
their speed, and large ones nothing."""


def in_one_kernel(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """The same function of float arrays, the first of which begins with a finite number, as a loop that runs once.

    See `low_latency`; without that, the loop does no harm. XLA must not see that it runs once, nor that what it works
    on stays the same, or else it would take it apart. NaN where the first number is NaN.
    """

    @wraps(function)
    def looped(*arguments: jax.Array) -> jax.Array:
        shape = jax.eval_shape(function, *arguments)

        def run(carry: tuple[jax.Array, tuple[jax.Array, ...], jax.Array]) -> tuple[Any, ...]:
            _, given, _ = carry
            return jnp.bool(True), tuple(jnp.zeros_like(argument) for argument in given), function(*given)

        first = jnp.isnan(arguments[0].ravel()[0]), arguments, jnp.full(shape.shape, jnp.nan, shape.dtype)
        return jax.lax.while_loop(lambda carry: ~carry[0], run, first)[-1]

    return looped


def jit_quickly(
    function: Callable[..., Any], *, static_argnums: tuple[int, ...] = (), options: Mapping[str, Any] | None = None
) -> Callable[..., Any]:
    """`jax.jit` with the compiler options `QUICKLY`, and any others, as far as this version of XLA knows them.

    XLA is asked when the function is first called: whoever only imports a module does not start JAX.

    Args:
        function: what to compile.
        static_argnums: see `jax.jit`.
        options: further compiler options by name.
    """
    chosen = {**QUICKLY, **(options or {})}

    @cache
    def compiled() -> jax.stages.Wrapped:
        return jax.jit(function, static_argnums=static_argnums, compiler_options=known_options(chosen))

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return compiled()(*arguments)

    return call


def known_options(options: Mapping[str, Hashable]) -> dict[str, Hashable]:
    """Those of the compiler options that this version of XLA knows; starts JAX."""
    return {name: value for name, value in options.items() if _knows(name, value)}


@cache
def _knows(option: str, value: Hashable) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options={option: value}).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True
