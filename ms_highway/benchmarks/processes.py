"""A process of its own, for what needs other settings of JAX than the command's."""

import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path

import jax

from ms_highway.runtime.jax_settings import keep_compilations

__all__ = ["own_process"]


def own_process(configure: Callable[[], None], modules: Sequence[str] = ()) -> ProcessPoolExecutor:
    """Start a process that uses this one's compilation cache.

    Args:
        configure: sets JAX up there, such as `ms_highway.runtime.jax_settings.high_throughput`.
        modules: to import there, for scenarios and models that they add.
    """
    cache = jax.config.values["jax_compilation_cache_dir"]
    return ProcessPoolExecutor(1, get_context("spawn"), _prepare, (configure, cache, modules))


def _prepare(configure: Callable[[], None], cache: str | None, modules: Sequence[str]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # the command reports interrupts
    configure()
    if cache is not None:
        keep_compilations(Path(cache))
    for module in modules:
        import_module(module)
