"""Compute the parts of a sweep on a cluster of dask.distributed: workers return rows, and this process writes them.

A part whose worker is lost is computed again on another one. Workers need no disk in common with this process, but the
same versions, as these decide the last digits.
"""

import logging
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import version
from itertools import islice
from typing import NamedTuple

import distributed
import jax
from distributed.comm import get_address_host_port

from ms_highway.experiments.directory import PACKAGES
from ms_highway.experiments.sweep import Compute, Sweep, Tables, compute_here
from ms_highway.runtime.extras import import_modules
from ms_highway.runtime.forks import jax_has_begun
from ms_highway.runtime.jax_settings import keep_compilations

PATIENCE = 10  # s, in which a scheduler has to answer
AHEAD = 2  # parts that are submitted per thread of a worker: more would wait in memory


class Setup(NamedTuple):
    """How a worker has to be set up: like this process."""

    modules: tuple[str, ...]
    versions: tuple[str, ...]
    xla_flags: str
    keeps_compilations: bool


@contextmanager
def connected(address: str, modules: Sequence[str] = ()) -> Iterator[Compute]:
    """Connect to a scheduler and set its workers up; yield what computes there.

    Args:
        address: of the scheduler, such as ``tcp://host:8786``.
        modules: that workers have to import, for scenarios, models and rules that they add.

    Raises:
        ValueError: if there is no scheduler, or a worker has other versions or cannot be set up.
    """
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # errors are raised as well
    keeps = jax.config.values["jax_compilation_cache_dir"] is not None
    setup = Setup(tuple(modules), _versions(), os.environ.get("XLA_FLAGS", ""), keeps)
    try:
        get_address_host_port(address, strict=True)
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        remedy = "start it with `dask scheduler` and give its address, such as tcp://host:8786"
        raise ValueError(f"no scheduler answers at {address} ({error}); {remedy}") from error
    with client:
        if not client.nthreads():
            start = f"start some with `dask worker {address}`"
            print(f"ms-highway: waiting for the first worker of {address}; {start}", file=sys.stderr)
            client.wait_for_workers(1)
        for worker, problem in client.run(set_up, setup, on_error="return").items():
            if problem is not None:
                raise ValueError(f"worker {worker} of {address}: {problem}; it needs {setup.versions[0]}")
        yield partial(_compute, client, address, setup)


def _versions() -> tuple[str, ...]:
    return tuple(f"{package} {version(package)}" for package in PACKAGES)


@cache
def set_up(setup: Setup) -> None:
    """Set this worker up, once.

    Raises:
        ValueError: if it has other versions, JAX has begun with other flags, or a module cannot be imported.
    """
    for there, wanted in zip(_versions(), setup.versions, strict=True):
        if there != wanted:
            raise ValueError(f"{there} is there and {wanted} here; install {wanted} there and start it again")
    if os.environ.get("XLA_FLAGS", "") != setup.xla_flags:
        if jax_has_begun():
            raise ValueError("JAX has begun there with other XLA_FLAGS, which change the last digits; start it again")
        os.environ["XLA_FLAGS"] = setup.xla_flags
    if setup.keeps_compilations:
        with suppress(OSError):
            keep_compilations()
    import_modules(setup.modules)


def compute_there(sweep: Sweep, part: int, setup: Setup) -> tuple[int, Tables]:
    """Compute a part on this worker, which may have come late; return it with its rows."""
    set_up(setup)
    (done,) = compute_here(sweep, [part])
    return done


def _compute(
    client: distributed.Client, address: str, setup: Setup, sweep: Sweep, parts: Sequence[int]
) -> Iterator[tuple[int, Tables]]:
    """Submit parts as workers become free; yield each with its rows as it comes back.

    Raises:
        ValueError: if workers die again and again, or the scheduler is lost.
    """
    waiting, running = iter(parts), distributed.as_completed(loop=client.loop)
    while True:
        room = max(AHEAD * sum(client.nthreads().values()), 1) - running.count()
        for part in islice(waiting, max(room, 0)):  # the copy of the sweep has no batch yet
            running.add(client.submit(compute_there, replace(sweep), part, setup, pure=False))
        if not running.count():
            return
        try:
            yield next(running).result()
        except (distributed.KilledWorker, CancelledError) as error:
            reason = " ".join(str(error).split())
            remedy = "see the logs of its workers and scheduler, and start the sweep again to resume it"
            raise ValueError(f"{address} gave a part up ({reason}); {remedy}") from error
