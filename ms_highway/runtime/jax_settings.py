"""Configure JAX: for low latency or high throughput, with compiled functions on disk."""

import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

from ms_highway.runtime.sources import import_modules

KERNEL_BYTES = 100_000
"""Loops with less memory traffic per iteration become one kernel: those of plans and
decisions, but not those of batches, which run faster as many vectorised kernels.
"""

WRITABLE_BY_OTHERS = 0o022


def low_latency() -> None:
    """Configure JAX for many small computations on the CPU, before it computes
    anything.

    This applies to this process and those that it starts. Much of a plan's time is
    spent on dispatch to another thread and on starting a hundred kernels per iteration.
    That dispatch is switched off, and XLA compiles loops of up to `KERNEL_BYTES` per
    iteration as one kernel, by default only much smaller ones. ``XLA_FLAGS`` with that
    option or with the name of a file are left unchanged. Called after JAX has begun, it
    makes plans slower.

    The last digits of plans change, and chaotic episodes amplify them: in Stay Back,
    single episodes may end differently, and means over 30 episodes differ in the first
    digit. To reproduce results of the command, call this.
    """
    option = "xla_cpu_small_while_loop_byte_threshold"
    _add_flag(option, f"--xla_backend_extra_options={option}={KERNEL_BYTES}")
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def high_throughput() -> None:
    """Configure JAX for many episodes at once (`ms_highway.loop.batch`) on the CPU,
    before it computes anything.

    This applies to this process and those that it starts. XLA is limited to
    instructions of AVX2: wider ones gain little, and make the last digits of a number
    depend on its place in a batch; chaotic episodes amplify them. ``XLA_FLAGS`` with
    that option or with the name of a file are left unchanged.
    """
    _add_flag("xla_cpu_max_isa", "--xla_cpu_max_isa=AVX2")


def _add_flag(option: str, flag: str) -> None:
    flags = os.environ.get("XLA_FLAGS", "")
    if option not in flags and (not flags or flags.startswith("-")):
        os.environ["XLA_FLAGS"] = f"{flags} {flag}".strip()


_double = ContextVar(
    "double", default=False
)  # whether a block asks for double precision


def single_precision() -> AbstractContextManager[Any]:
    """Let JAX compute in float32 in a block, even if the user has switched
    ``jax_enable_x64`` on.
    """
    double = jax.config.jax_enable_x64 and not _double.get()  # type: ignore[attr-defined]
    return jax.enable_x64(False) if double else nullcontext()


@contextmanager
def double_precision() -> Iterator[None]:
    """Let JAX compute in float64 in a block, even in blocks of `single_precision`
    within it.
    """
    before = _double.set(True)
    try:
        with jax.enable_x64(True):
            yield
    finally:
        _double.reset(before)


def check_platforms() -> None:
    """Start JAX if ``JAX_PLATFORMS`` asks for more than the CPU.

    Raises:
        ValueError: if JAX finds no such devices.
    """
    platforms = jax.config.values["jax_platforms"]
    if platforms and platforms != "cpu":
        try:
            jax.devices()
        except (
            AssertionError,
            RuntimeError,
        ) as error:  # an assertion if the plugin is not installed
            why = f" ({error})" if str(error) else ""
            remedy = "unset it, or install JAX for these devices"
            raise ValueError(
                f"JAX_PLATFORMS is {platforms!r}, of which JAX finds no device{why};"
                f" {remedy}"
            ) from error


def cores() -> int:
    """Return the number of cores that this process may use."""
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count() or 1
    )


def keep_compilations(directory: Path | str | None = None) -> Path:
    """Keep compiled functions in a directory for later runs, in JAX's persistent cache;
    return the directory.

    They are machine code and run unverified, so that nobody else may write to the
    directory. Only JAX's option ``jax_compilation_cache_max_size`` limits its size.

    Args:
        directory: by default the one in the environment variable
            ``JAX_COMPILATION_CACHE_DIR``, or else ``ms_highway/compiled`` in the user's
            cache directory.

    Raises:
        OSError: if the directory cannot be made, or others can write to it; then
            nothing is kept or used.
    """
    home = Path(
        os.environ.get("XDG_CACHE_HOME", "")
    )  # by the standard, ignored if it is relative
    usual = (
        (home if home.is_absolute() else Path.home() / ".cache")
        / "ms_highway"
        / "compiled"
    )
    directory = Path(directory or os.environ.get("JAX_COMPILATION_CACHE_DIR") or usual)
    jax.config.update("jax_compilation_cache_dir", None)
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = directory.stat()
    if hasattr(os, "getuid") and (
        status.st_uid != os.getuid() or status.st_mode & WRITABLE_BY_OTHERS
    ):
        why = f"others may write to {directory}, and their machine code would run"
        raise PermissionError(
            f"{why}; choose a directory of your own, or change that: chmod go-w"
            f" {directory}"
        )
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    compilation_cache.reset_cache()  # or else JAX keeps using an earlier directory
    return directory


def own_process(
    configure: Callable[[], None],
    modules: Sequence[str] = (),
) -> ProcessPoolExecutor:
    """Start a process that uses this one's compilation cache, and ends when this one
    ends for any reason.

    Args:
        configure: sets JAX up in it, such as
            `ms_highway.runtime.jax_settings.high_throughput`.
        modules: to import in it, for scenarios and models that they add.
    """
    cache = jax.config.values["jax_compilation_cache_dir"]
    return ProcessPoolExecutor(
        1, get_context("spawn"), _prepare, (configure, cache, modules)
    )


def low_latency_on_core(number: int) -> None:
    """Keep this process on one of its processors, if the system allows that, and set
    `low_latency`.

    The first half of the numbers stands for every second processor, as neighbours may
    share a core.
    """
    if hasattr(os, "sched_setaffinity"):
        available = sorted(os.sched_getaffinity(0))
        apart = available[::2] + available[1::2]
        os.sched_setaffinity(0, {apart[number % len(apart)]})
    low_latency()


def _prepare(
    configure: Callable[[], None],
    cache: str | None,
    modules: Sequence[str],
) -> None:
    Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # the command reports interrupts
    warnings.simplefilter("ignore")  # and has warned of the configuration
    configure()
    if cache is not None:
        keep_compilations(Path(cache))
    import_modules(modules)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
