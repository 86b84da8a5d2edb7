"""Set JAX up: for low latency or high throughput, and what it compiles kept on disk."""

import os
from pathlib import Path

import jax

from ms_highway.runtime.compilation_cache import check_owner, use_checked_cache

__all__ = ["high_throughput", "keep_compilations", "low_latency"]

KERNEL_BYTES = 100_000
"""Loops that touch less per iteration become one kernel: those of a plan or a decision do, those of batches, which
run faster as many vectorised kernels, do not."""


def low_latency() -> None:
    """Set JAX up for many small computations on the CPU, before it computes anything.

    It holds for the whole process and for those that it starts. Two things make up much of a plan's time: handing a
    computation over to another thread, and starting a hundred kernels per iteration. The first is switched off; against
    the second, XLA is told to compile loops of up to `KERNEL_BYTES` per iteration as one kernel, as it does by itself
    only with much smaller ones. Where ``XLA_FLAGS`` has that option already or names a file, it stays as it is; and
    where JAX has begun already, plans are slower.

    The last digits of plans are others than without it, as everything that is compiled otherwise rounds otherwise.
    Chaotic episodes make much of them: in Stay Back, single episodes may end otherwise, and means over 30 of them
    differ in the first digit. So whoever compares with results of the command needs this call as well.
    """
    option = "xla_cpu_small_while_loop_byte_threshold"
    _tell_xla(option, f"--xla_backend_extra_options={option}={KERNEL_BYTES}")
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def high_throughput() -> None:
    """Set JAX up for many episodes at once (`ms_highway.simulation.loop`) on the CPU, before it computes anything.

    It holds for the whole process and for those that it starts. XLA is told to keep to instructions of AVX2: wider ones
    gain little here, and with them the last digits of a number depend on its place in a batch, of which chaotic
    episodes make much. Where ``XLA_FLAGS`` has that option already or names a file, it stays as it is.
    """
    _tell_xla("xla_cpu_max_isa", "--xla_cpu_max_isa=AVX2")


def _tell_xla(option: str, flag: str) -> None:
    flags = os.environ.get("XLA_FLAGS", "")
    if option not in flags and (not flags or flags.startswith("-")):
        os.environ["XLA_FLAGS"] = f"{flags} {flag}".strip()


def keep_compilations(directory: Path | None = None) -> Path:
    """Keep compiled functions in a directory of the user's, for later runs; returns it.

    Args:
        directory: where; without, what the environment variable ``JAX_COMPILATION_CACHE_DIR`` names, or else
            ``ms_highway/compiled`` in the user's cache directory.

    Raises:
        OSError: if that cannot be made, or others can write to it: then nothing is kept, nor used.
    """
    chosen, cache = os.environ.get("JAX_COMPILATION_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME")
    home = Path(cache) if cache and Path(cache).is_absolute() else Path.home() / ".cache"
    directory = directory or (Path(chosen) if chosen else home / "ms_highway" / "compiled")
    jax.config.update("jax_compilation_cache_dir", None)
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_owner(directory)
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    use_checked_cache()
    return directory
