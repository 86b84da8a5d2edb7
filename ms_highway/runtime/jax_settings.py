"""Configure JAX for low latency or high throughput, and keep compiled functions."""

import os
import signal
import stat
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread

import jax
from jax.experimental.compilation_cache import compilation_cache

from ms_highway.runtime.sources import import_modules


def low_latency() -> None:
    """Configure JAX for many small computations on the CPU, before it computes.

    This applies to this process and those that it starts. Much of a plan's time is
    spent on dispatch to another thread and on starting a hundred kernels per iteration.
    That dispatch is switched off, and XLA compiles larger loops as one kernel, by
    default only small ones. ``XLA_FLAGS`` with that option or with the name of a file
    are left unchanged. Called after JAX has begun, it makes plans slower.

    The last digits of plans change, and chaotic episodes amplify them: in Stay Back,
    single episodes may end differently, and means over 30 episodes differ in the first
    digit. To reproduce results of the command, call this.
    """
    # Loops with less memory traffic per iteration become one kernel: those of plans and
    # decisions, but not those of batches, which run faster as many vectorised kernels.
    kernel_bytes = 100_000

    option = "xla_cpu_small_while_loop_byte_threshold"
    _add_flag(option, f"--xla_backend_extra_options={option}={kernel_bytes}")
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def high_throughput() -> None:
    """Configure JAX for many episodes at once on the CPU, before it computes.

    See `ms_highway.loop.batch`. This applies to this process and those that it starts.
    XLA is limited to instructions of AVX2: wider ones gain little, and make the last
    digits of a number depend on its place in a batch; chaotic episodes amplify them.
    ``XLA_FLAGS`` with that option or with the name of a file are left unchanged.
    """
    _add_flag("xla_cpu_max_isa", "--xla_cpu_max_isa=AVX2")


def _add_flag(option: str, flag: str) -> None:
    """Add a flag to ``XLA_FLAGS``, unless they name the option or a file of flags."""
    flags = os.environ.get("XLA_FLAGS", "")
    names_a_file = flags != "" and not flags.startswith("-")
    if option not in flags and not names_a_file:
        os.environ["XLA_FLAGS"] = f"{flags} {flag}".strip()


# Whether a block asks for double precision.
_double = ContextVar("double", default=False)


def single_precision() -> AbstractContextManager[object]:
    """Let JAX compute in float32 in a block.

    It does so even if the user has switched ``jax_enable_x64`` on.
    """
    in_double = jax.config.jax_enable_x64  # type: ignore[attr-defined]
    if in_double and not _double.get():
        return jax.enable_x64(False)
    return nullcontext()


@contextmanager
def double_precision() -> Iterator[None]:
    """Let JAX compute in float64 in a block, and in `single_precision` within it."""
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
        except (AssertionError, RuntimeError) as error:
            # It is an assertion if JAX's plugin for the devices is not installed.
            why = f" ({error})" if str(error) else ""
            remedy = "unset it, or install JAX for these devices"
            raise ValueError(
                f"JAX_PLATFORMS is {platforms!r}, of which JAX finds no device{why};"
                f" {remedy}"
            ) from error


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def keep_compilations(directory: Path | str | None = None) -> Path:
    """Keep compiled functions for later runs, in JAX's persistent cache.

    They are machine code and run unverified, so that nobody else may write to the
    directory. Only JAX's option ``jax_compilation_cache_max_size`` limits its size.

    Args:
        directory: by default the one in the environment variable
            ``JAX_COMPILATION_CACHE_DIR``, or else ``ms_highway/compiled`` in the user's
            cache directory.

    Returns:
        The directory.

    Raises:
        OSError: if the directory cannot be made, or others can write to it; then
            nothing is kept or used.
    """
    # The standard of this variable says: ignore a relative path.
    user_cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not user_cache.is_absolute():
        user_cache = Path.home() / ".cache"
    usual = user_cache / "ms_highway" / "compiled"
    directory = Path(directory or os.environ.get("JAX_COMPILATION_CACHE_DIR") or usual)

    # Use no cache until the new directory is known to be safe.
    jax.config.update("jax_compilation_cache_dir", None)
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_private(directory):
        why = f"others may write to {directory}, and their machine code would run"
        raise PermissionError(
            f"{why}; choose a directory of your own, or change that: chmod go-w"
            f" {directory}"
        )
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    # Or else JAX keeps using an earlier directory.
    compilation_cache.reset_cache()
    return directory


def _is_private(directory: Path) -> bool:
    """Return whether this user alone may write to a directory, where that is known."""
    if not hasattr(os, "getuid"):
        return True
    status = directory.stat()
    writable_by_others = stat.S_IWGRP | stat.S_IWOTH
    return status.st_uid == os.getuid() and not status.st_mode & writable_by_others


def own_process(
    configure: Callable[[], None],
    modules: Sequence[str] = (),
) -> ProcessPoolExecutor:
    """Start a process that uses this one's compilation cache, and ends with it.

    It ends for whatever reason this one ends.

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
    """Keep this process on one of its processors, and set `low_latency`.

    Where the system cannot do that, only `low_latency` is set. The first half of the
    numbers stands for every second processor, as neighbours may share a core.
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
    """Prepare a process of `own_process`."""
    Thread(target=_end_with_parent, daemon=True).start()
    # The command reports interrupts, and has warned of the configuration.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    warnings.simplefilter("ignore")
    configure()
    if cache is not None:
        keep_compilations(Path(cache))
    import_modules(modules)


def _end_with_parent() -> None:
    """Wait for the end of the parent process, and then end this one."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
