"""How long plans among several humans take, by number of humans, horizon and models; compilation and memory."""

import resource
from collections.abc import Iterator, Mapping, Sequence
from time import perf_counter
from typing import Any

import jax
import numpy as np

from ms_highway.benchmarks.latency import one_core
from ms_highway.benchmarks.processes import own_process
from ms_highway.game.crowd_scenario import crowd_game, crowd_scenario, draw_crowd
from ms_highway.game.planning_settings import PlanningSettings
from ms_highway.planning.compiled_crowd import CompiledCrowdPlans
from ms_highway.planning.compiled_plans import checked_state
from ms_highway.planning.crowd import NAIVE, TOM, TURN
from ms_highway.runtime.jax_settings import low_latency

__all__ = ["crowd_latency"]

REPEATS = 60
KIBIBYTE = 1024


def crowd_latency(
    scenario: str, humans: Sequence[int], config: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure plans from a scenario's first start, warm, on one core; each size in a process of its own.

    Args:
        scenario: name of one with several humans.
        humans: numbers of humans.
        config: of the environment, of which only ``horizon`` is known here.

    Yields:
        For every number of humans its name, and:

        * ``plan_ms``: median and p99 of plans, by assignment: ``naive``, ``turn`` and ``tom`` for all humans,
          ``tom_one`` for one, naive for the others;
        * ``compile_s``: seconds to compile the plan, which serves all assignments;
        * ``memory_mib``: the most memory that the process has had.

    Raises:
        ValueError: for a number below 1.
    """
    for number in humans:
        with own_process(low_latency) as process:
            yield f"{number} humans", process.submit(_measured, scenario, number, config.get("horizon", 20)).result()


def _measured(scenario: str, humans: int, horizon: int) -> dict[str, Any]:
    """Measure plans among so many humans."""
    jax.config.update("jax_compilation_cache_dir", None)
    chosen = crowd_scenario(scenario)
    crowd = crowd_game(chosen, humans, planning=PlanningSettings(horizon=horizon))
    starts, _ = draw_crowd(chosen, humans, np.random.default_rng(0))
    plans, state = CompiledCrowdPlans(crowd), checked_state(starts)
    start = perf_counter()
    plans.warm_up(state)
    compiling = perf_counter() - start
    one = [NAIVE] * humans
    one[humans // 2] = TOM
    assignments = {"naive": [NAIVE] * humans, "turn": [TURN] * humans, "tom_one": one, "tom": [TOM] * humans}
    with one_core():
        seconds = {name: [plans.plan(state, rungs)[1] for _ in range(REPEATS)] for name, rungs in assignments.items()}
    quantiles = {name: (1e3 * np.quantile(times, [0.5, 0.99])).tolist() for name, times in seconds.items()}
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIBIBYTE
    return {"plan_ms": quantiles, "compile_s": compiling, "memory_mib": memory}
