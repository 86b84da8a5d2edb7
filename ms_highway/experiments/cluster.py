"""Compute the parts of a sweep on a cluster of dask.distributed.

Workers return rows, and this process writes them. A part whose worker is lost is
computed again on another one. Workers need no disk in common with this process, but the
same versions of packages, on which the last digits depend.
"""

import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import partial
from importlib.metadata import version
from itertools import islice

import distributed
import jax
from distributed.comm import get_address_host_port

from ms_highway.experiments.batch import Tables, simulate_parts
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.directory import PACKAGES
from ms_highway.experiments.runner import Compute
from ms_highway.runtime.definitions import source_now
from ms_highway.runtime.jax_settings import keep_compilations
from ms_highway.runtime.process import jax_has_begun
from ms_highway.runtime.sources import Sources, import_modules


class Setup(distributed.WorkerPlugin):
    """Sets up workers like this process, including workers that join later.

    Args:
        modules: modules that workers import.
        sources: digests of what results depend on, which must be the same there.
    """

    name = "ms_highway"

    def __init__(self, modules: Sequence[str], sources: Sources) -> None:
        self.modules = modules
        self.sources = sources
        self.versions = _versions()
        self.xla_flags = os.environ.get("XLA_FLAGS", "")
        self.keeps_compilations = (
            jax.config.values["jax_compilation_cache_dir"] is not None
        )

    def setup(self, worker: distributed.Worker) -> None:
        """Set up a worker.

        Raises:
            ValueError: if it has other versions or other content of a file, or its JAX
                runs with other flags.
            ImportError: if a module cannot be imported.
        """
        for there, wanted in zip(_versions(), self.versions, strict=True):
            if there != wanted:
                remedy = f"install {wanted} there and start it again"
                raise ValueError(
                    f"worker {worker.address} has {there} instead of {wanted}; {remedy}"
                )
        if os.environ.get("XLA_FLAGS", "") != self.xla_flags:
            if jax_has_begun():
                reason = "runs JAX with other XLA_FLAGS, which change the last digits"
                raise ValueError(f"worker {worker.address} {reason}; start it again")
            os.environ["XLA_FLAGS"] = self.xla_flags
        if self.keeps_compilations:
            with suppress(OSError):
                keep_compilations()
        import_modules(self.modules)
        for name, content in self.sources.items():
            if source_now(name) != content:
                remedy = "copy its file there and start the worker again"
                raise ValueError(
                    f"worker {worker.address} has other content of {name}; {remedy}"
                )


@contextmanager
def connected(
    address: str,
    comparison: Comparison,
    modules: Sequence[str] = (),
) -> Iterator[Compute]:
    """Connect to a scheduler, set up its workers, and yield what computes there.

    Args:
        address: address of the scheduler, such as ``tcp://host:8786``.
        comparison: what is computed.
        modules: modules that workers import, for scenarios, models and rules that they
            add.

    Raises:
        ValueError: if there is no scheduler, or a worker has other versions or cannot
            be set up.
    """
    # The client's errors are raised as well.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        get_address_host_port(address, strict=True)
        # A scheduler has to answer within 10 s.
        client = distributed.Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        remedy = (
            "start it with `dask scheduler` and give its address, such as"
            " tcp://host:8786"
        )
        raise ValueError(
            f"no scheduler answers at {address} ({error}); {remedy}"
        ) from error
    with client:
        if not client.nthreads():
            start = f"start some with `dask worker {address}`"
            print(
                f"ms-highway: waiting for the first worker of {address}; {start}",
                file=sys.stderr,
            )
            client.wait_for_workers(1)
        sources: Sources = {}
        for controllers in comparison.sources().values():
            for own in controllers.values():
                sources = {**own, **sources}
        client.register_plugin(Setup(modules, sources))
        yield partial(_compute, client, address)


def _versions() -> list[str]:
    """Return the packages that may change results, with their versions."""
    return [f"{package} {version(package)}" for package in PACKAGES]


def _compute_there(
    comparison: Comparison,
    name: str,
    part: range,
) -> tuple[str, Tables]:
    """Simulate one part, in the process of a worker."""
    return next(simulate_parts(comparison, {name: part}))


def _compute(
    client: distributed.Client,
    address: str,
    comparison: Comparison,
    parts: Mapping[str, range],
) -> Iterator[tuple[str, Tables]]:
    """Submit parts to the workers; yield each with its tables when it is done.

    Raises:
        ValueError: if workers die again and again, or the scheduler is lost.
    """
    compute = partial(_compute_there, comparison)
    waiting = iter(parts.items())
    running = distributed.as_completed([], loop=client.loop)

    def submit(count: int) -> None:
        for name, part in islice(waiting, count):
            running.add(client.submit(compute, name, part, pure=False))

    # Two parts per thread of a worker: more would only wait in memory.
    threads = max(sum(client.nthreads().values()), 1)
    submit(2 * threads)
    try:
        for done in running:
            submit(1)
            yield done.result()
    except (distributed.KilledWorker, CancelledError) as error:
        reason = " ".join(str(error).split())
        remedy = (
            "see the logs of its workers and scheduler, and start the sweep again to"
            " resume it"
        )
        raise ValueError(f"{address} gave up a part ({reason}); {remedy}") from error
