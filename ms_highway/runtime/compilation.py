"""Compile functions: quickly, or into one kernel."""

from collections.abc import Callable, Hashable, Mapping
from functools import cache, wraps
from types import MappingProxyType
from typing import Any

import jax
from jax import numpy as jnp

QUICKLY = {"xla_cpu_use_fusion_emitters": False}
"""Compiler options that halve compilation time, where XLA knows them (JAX up to 0.11.0); they make small plans
a tenth slower, and large ones not."""


def in_one_kernel(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """Wrap a function of float arrays, the first of which begins with a finite number, in a loop that runs once.

    With `ms_highway.runtime.jax_settings.low_latency`, XLA compiles it as one kernel; without, the loop does no harm.
    XLA must not find out that it runs once or that its inputs stay the same, or it would remove it. Returns NaN where
    the first number is NaN.
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
    function: Callable[..., Any],
    *,
    static_argnums: tuple[int, ...] = (),
    options: Mapping[str, Hashable] = MappingProxyType({}),
) -> Callable[..., Any]:
    """Apply `jax.jit` with the compiler options `QUICKLY`, and others, as far as this version of XLA knows them.

    XLA is asked at the first call, so that importing a module does not start JAX.
    """

    @cache
    def compiled() -> jax.stages.Wrapped:
        chosen = known_options({**QUICKLY, **options})
        return jax.jit(function, static_argnums=static_argnums, compiler_options=chosen)

    return wraps(function)(lambda *arguments: compiled()(*arguments))


def known_options(options: Mapping[str, Hashable]) -> dict[str, Hashable]:
    """Select the compiler options that this version of XLA knows; starts JAX."""
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
