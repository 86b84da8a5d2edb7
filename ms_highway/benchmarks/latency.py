"""How long plans, decisions and environment steps take, and how long they take to compile."""

import os
import resource
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import gymnasium as gym
import jax
import numpy as np

from ms_highway.choice.quadratic import Switching
from ms_highway.choice.rule import PUBLISHED_COSTS
from ms_highway.envs.base import InteractionEnv
from ms_highway.experiments.runner import make_environment
from ms_highway.game.game import Game
from ms_highway.loop.driver import decision_function
from ms_highway.loop.step import begin
from ms_highway.planning.compiled_plans import CompiledPlans, Costs, checked_state
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.several import plan_for
from ms_highway.runtime.arrays import State
from ms_highway.runtime.jax_settings import keep_compilations, low_latency, own_process
from ms_highway.runtime.timing import timed

REPEATS, BATCH_REPEATS, SEVERAL_REPEATS = 600, 20, 60
BATCHES = (1, 32, 1024)  # of vmapped plans
CACHE, CACHED_FROM = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
KIBIBYTE = 1024


def bench(scenario: str, **config: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure each rung of the ladder of a scenario with one human, in microseconds, from its first start.

    Compilation is measured on all cores, everything else warm, on one core. Yields for every rung its name and:

    * ``plan_us``: median (p50) and p99 of a plan, until its result is there;
    * ``decision_us``: median of a decision at this rung, one in three of which checks the rung below;
    * ``step_us``: median of a step of the environment less the plans of both cars;
    * ``compile_s``: tracing and compiling the plan after those of the rungs below, as a process does that has just
      begun, ``cold`` and from a persistent cache, ``cached``;
    * ``flop``: floating-point operations of a plan, from XLA's cost analysis;
    * ``plans_per_s``: throughput of vmapped plans by batch size.

    Args:
        scenario: its name.
        config: of the environment.
    """
    env, inner = _environment(scenario, **config)
    game, models, state = inner.game, inner.settings.models, checked_state(inner.car_states)
    with one_core():
        step = _step_without_planning(env, inner)
    env.close()
    compiling = _compile_seconds(game, models, state)
    for rung, (model, seconds) in enumerate(zip(models, compiling, strict=True)):
        with one_core():
            yield model.name, _measured(game, models, rung, state) | {"step_us": step, "compile_s": seconds}


def _environment(scenario: str, **config: Any) -> tuple[gym.Env, InteractionEnv]:
    """Return the environment of a scenario at its first start, and without its wrappers."""
    env = make_environment(scenario, "naive", **config)
    env.reset(seed=0)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    return env, inner


def _measured(game: Game, models: tuple[HumanModel, ...], rung: int, state: State) -> dict[str, Any]:
    """Measure one rung, warm."""
    function, *arguments = CompiledPlans(game, models).call(state, [rung])
    p50, p99 = np.quantile(_times(function, *arguments), [0.5, 0.99]).tolist()
    flops = float((function.lower(*arguments).compile().cost_analysis() or {})["flops"])
    return {
        "plan_us": {"p50": p50, "p99": p99},
        "decision_us": _decision(game, models, rung, state),
        "flop": game.planner.iterations * flops,  # XLA counts the body of the loop once, and little is outside of it
        "plans_per_s": {str(size): _throughput(game, models[rung], state, size) for size in BATCHES},
    }


def _times(function: Callable[..., Any], *arguments: Any, repeats: int = REPEATS) -> list[float]:
    """Return the microseconds of each of many warm runs of a compiled function."""
    jax.block_until_ready(function(*arguments))
    return [1e6 * timed(function, *arguments)[1] for _ in range(repeats)]


@contextmanager
def one_core() -> Iterator[None]:
    """Keep to one core, where the system lets a process choose."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def _compile_seconds(*plans: Any) -> list[dict[str, float]]:
    """Return the seconds to trace and compile the plan of each rung, in two processes that share a new cache."""
    measured = []
    with TemporaryDirectory() as directory:
        for _ in range(2):
            with own_process(low_latency) as process:
                measured.append(process.submit(_compile_each, directory, *plans).result())
    return [{"cold": cold, "cached": cached} for cold, cached in zip(*measured, strict=True)]


def _compile_each(directory: str, game: Game, models: tuple[HumanModel, ...], state: State) -> list[float]:
    """Return the seconds to compile the plan of each rung in this process, with a cache for all of them."""
    keep_compilations(directory)
    jax.config.update(CACHED_FROM, 0.0)
    jax.devices()  # begins JAX, which is not measured
    plans, seconds = CompiledPlans(game, models), []
    for rung in range(len(models)):
        start = perf_counter()
        function, *arguments = plans.call(state, [rung])
        function.lower(*arguments).compile()
        seconds.append(perf_counter() - start)
    return seconds


def _decision(game: Game, models: tuple[HumanModel, ...], rung: int, state: State) -> float:
    """Time a decision that never goes up, so that it checks the rung below whenever the cooldown allows."""
    costs = Costs(0.0, np.array([PUBLISHED_COSTS.get(model.name, 0.0) for model in models]))
    rule = Switching(costs, 1e9, models)
    carry = begin(rule, game, state)
    checking = carry.memory._replace(rungs=np.array([rung], np.int32), step=np.ones((), np.int32))
    waiting = checking._replace(last_check=np.zeros_like(checking.last_check))
    numbers = jax.device_put((rule, game))
    function = decision_function(None).of(*numbers, carry, state)
    check, wait = (
        median(_times(function, *numbers, carry._replace(memory=memory), state)) for memory in (checking, waiting)
    )
    return (check + (Switching.cooldown - 1) * wait) / Switching.cooldown


def _step_without_planning(env: gym.Env, inner: InteractionEnv) -> float:
    times: list[float] = []
    for seed in range(2):  # the first episode compiles
        env.reset(seed=seed)
        done, times = False, []
        while not done:
            start = perf_counter()
            *_, terminated, truncated, _ = env.step(0)
            seconds = perf_counter() - start
            done = terminated or truncated
            steps = [car.last_step for car in (inner.robot, *inner.humans)]
            times.append(1e6 * (seconds - sum(step.planning_seconds for step in steps if step)))
    return median(times)


def _throughput(game: Game, model: HumanModel, state: State, size: int) -> float:
    states = np.broadcast_to(state, (size, *state.shape))
    plans = jax.jit(jax.vmap(lambda state: plan_for((model,), game, state)))
    return size / median(_times(plans, states, repeats=BATCH_REPEATS)) * 1e6


def bench_several(
    scenario: str, humans: Sequence[int], config: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure plans from a scenario's first start, warm, on one core; each number of humans in a process of its own.

    Args:
        scenario: its name.
        humans: their numbers.
        config: of the environment.

    Yields:
        For every number of humans the name of the row, and:

        * ``plan_ms``: median and p99 of plans, by assignment: ``naive``, ``turn`` and ``tom`` for all humans,
          ``tom_one`` for one, naive for the others;
        * ``compile_s``: seconds to compile the plan, which serves all assignments;
        * ``memory_mib``: the most memory that the process has had.
    """
    for number in humans:
        with own_process(low_latency) as process:
            yield f"{number} humans", process.submit(_measured_several, scenario, number, dict(config)).result()


def _measured_several(scenario: str, humans: int, config: dict[str, Any]) -> dict[str, Any]:
    """Measure plans among so many humans; a single one is the first of two."""
    jax.config.update(CACHE, None)
    _, env = _environment(scenario, **config, humans=max(humans, 2), ladder=["naive", "turn", "tom"])
    game = replace(env.game, humans=replace(env.game.humans, weights=env.weights[:humans]))
    plans, state = CompiledPlans(game, env.settings.models), checked_state(env.car_states[: 1 + humans])
    start = perf_counter()
    plans.warm_up(state)
    compiling = perf_counter() - start
    naive, turn, tom = ([rung] * humans for rung in range(3))
    assignments = {"naive": naive, "turn": turn, "tom_one": [*tom[:1], *naive[1:]], "tom": tom}
    with one_core():
        seconds = {
            name: [plans.plan(state, rungs)[1] for _ in range(SEVERAL_REPEATS)] for name, rungs in assignments.items()
        }
    quantiles = {name: (1e3 * np.quantile(times, [0.5, 0.99])).tolist() for name, times in seconds.items()}
    return {"plan_ms": quantiles, "compile_s": compiling, "memory_mib": most_memory()}


def most_memory() -> float:
    """Return the most memory that this process has had [MiB]."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIBIBYTE  # of its parent, too, if that had more
    return int(status.read_text().partition("VmHWM:")[2].split()[0]) / KIBIBYTE
