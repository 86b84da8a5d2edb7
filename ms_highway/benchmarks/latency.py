"""How long plans, decisions and environment steps take, and how long they take to compile."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import gymnasium as gym
import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import Float

from ms_highway.benchmarks.casadi_peer import compiled_peer
from ms_highway.envs.base import InteractionEnv
from ms_highway.experiments.runner import make_environment
from ms_highway.game.game import Game
from ms_highway.metareasoning.compiled_decision import CompiledDecision
from ms_highway.metareasoning.rule import PUBLISHED_COSTS, first_memory
from ms_highway.metareasoning.switching import Switching
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.files import temporary_directory
from ms_highway.runtime.timing import forget, timed

__all__ = ["BATCHES", "bench", "one_core"]

State = Float[np.ndarray, "cars 4"]

REPEATS = 600
TURN = 20  # runs of one thing before the next
BATCHES = (1, 32, 1024)  # of vmapped plans
CACHE, CACHED_FROM = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
AGREEMENT = 1e-3  # between ours and the peer's scaled controls


def bench(scenario: str, peer: bool = False, **planning: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure each rung of a scenario's ladder, in microseconds, from its first start.

    Compilation is measured on all cores, everything else warm, on one core. Yields for every rung its name and:

    * ``plan_us``: median (p50) and p99 of a plan, until its result is there;
    * ``peer_us``: median of the same plan in CasADi's C code, checked to agree before, and run in turns with ours, so
      that both see the same moods of the machine (only with ``peer``);
    * ``decision_us``: median of a decision at this rung, one in three of which checks the rung below;
    * ``step_us``: median of a step of the environment less the plans of both cars;
    * ``compile_s``: tracing and compiling the plan after those of the rungs below, as a process does that has just
      begun, ``cold`` and from a persistent cache, ``cached``;
    * ``flop``: floating-point operations of a plan, from XLA's cost analysis;
    * ``plans_per_s``: throughput of vmapped plans by batch size.

    Args:
        scenario: its name.
        peer: whether to measure the peer.
        planning: how robot and human plan, by key of the environment's configuration.

    Raises:
        ImportError: if the peer is wanted and CasADi is not there.
        RuntimeError: if the peer plans something else.
    """
    env = make_environment(scenario, "naive", human_reward="published", **planning)  # which is what the peer knows
    env.reset(seed=0)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    game, models, state = inner.game, inner.models, checked_state(inner.car_states)
    with one_core():
        step = _step_without_planning(env, inner)
    env.close()
    compiling = {kind: _compile_seconds(game, models, state, kind) for kind in ("cold", "cached")}
    for rung, model in enumerate(models):
        seconds = {kind: times[rung] for kind, times in compiling.items()}
        with one_core():
            yield model.name, _measured(game, models, rung, state, peer) | {"step_us": step, "compile_s": seconds}


def _measured(game: Game, models: tuple[HumanModel, ...], rung: int, state: State, peer: bool) -> dict[str, Any]:
    """Measure one rung, warm."""
    compiled, model = CompiledPlans(game), models[rung]
    plans: dict[str, Callable[[], None]] = {
        "plan_us": partial(_run, compiled.function(model), *compiled.arguments(state))
    }
    with temporary_directory() as directory:
        if peer:
            plans["peer_us"] = _peer(game, model, state, np.asarray(compiled.plan(model, state)[0].robot), directory)
        times = _times(plans)
    return {
        "plan_us": {"p50": _median(times["plan_us"]), "p99": float(np.quantile(times["plan_us"], 0.99))},
        **({"peer_us": {"p50": _median(times["peer_us"])}} if peer else {}),
        "decision_us": _decision(game, models, rung, state),
        "flop": _operations(game, models[rung], state),
        "plans_per_s": {str(size): _throughput(game, models[rung], state, size) for size in BATCHES},
    }


def _run(function: Callable[..., Any], *arguments: Any) -> None:
    """Run a compiled function until its result is there."""
    jax.block_until_ready(function(*arguments))


def _times(runs: Mapping[str, Callable[[], None]], repeats: int = REPEATS) -> dict[str, list[float]]:
    """Microseconds of each of many warm runs; where there are several things to run, in turns of `TURN` runs."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(-(-repeats // TURN)):
        for name, run in runs.items():
            times[name] += [1e6 * timed(run)[1] for _ in range(TURN)]
    return times


def _median(times: list[float]) -> float:
    return float(np.median(times))


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


def _compile_seconds(
    game: Game, models: Sequence[HumanModel], state: State, kind: Literal["cold", "cached"]
) -> list[float]:
    """Seconds to trace and compile the plan of each rung, one after the other; leaves the user's cache alone."""
    kept = {name: jax.config.values[name] for name in (CACHE, CACHED_FROM)}
    plans = CompiledPlans(game)
    seconds: list[float] = []
    with temporary_directory() as directory:
        try:
            jax.config.update(CACHE, str(directory) if kind == "cached" else None)
            jax.config.update(CACHED_FROM, 0.0)
            for _ in range(2 if kind == "cached" else 1):  # the first time fills the cache
                compilation_cache.reset_cache()
                forget()
                seconds = []
                for model in models:
                    start = perf_counter()
                    plans.function(model).lower(*plans.arguments(state)).compile()
                    seconds.append(perf_counter() - start)
        finally:
            for name, value in kept.items():
                jax.config.update(name, value)
            compilation_cache.reset_cache()
    return seconds


def _peer(
    game: Game, model: HumanModel, state: State, ours: Float[np.ndarray, "steps 2"], directory: Path
) -> Callable[[], None]:
    """Return what repeats the peer's plan, after checking that its first result agrees with ours."""
    call, repeat = compiled_peer(game, model.name, len(state), directory)
    apart = float(abs(call(np.asarray(state)) - ours).max())
    if not apart < AGREEMENT:
        raise RuntimeError(f"CasADi's {model.name} plan is {apart:.1e} away from ours; they must agree to be compared")
    return repeat


def _decision(game: Game, models: tuple[HumanModel, ...], rung: int, state: State) -> float:
    """Time a decision that never goes up, so that it checks the rung below whenever the cooldown allows."""
    switching = Switching(np.array([PUBLISHED_COSTS[model.name] for model in models]), 1e9, models)
    compiled, checking = CompiledDecision(switching, game), first_memory(switching, rung)
    waiting = checking._replace(last_check=np.zeros_like(checking.last_check))
    observed = compiled.nothing_happened(state)
    memories = {"checking": checking, "waiting": waiting}
    times = _times(
        {
            name: partial(_run, compiled.function, *compiled.arguments(memory, observed))
            for name, memory in memories.items()
        }
    )
    cooldown = int(switching.cooldown)
    return (_median(times["checking"]) + (cooldown - 1) * _median(times["waiting"])) / cooldown


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
            cars = inner.robot, inner.human
            times.append(1e6 * (seconds - sum(car.last_step.planning_seconds for car in cars if car.last_step)))
    return _median(times)


def _operations(game: Game, model: HumanModel, state: State) -> float:
    """XLA counts the body of a loop once, however often it runs; the little outside of the loop is counted as often."""
    plans = CompiledPlans(game)
    analysis = plans.function(model).lower(*plans.arguments(state)).compile().cost_analysis() or {}
    return game.planner.iterations * float(analysis["flops"])


def _throughput(game: Game, model: HumanModel, state: State, size: int) -> float:
    states = np.broadcast_to(state, (size, *state.shape))
    plans = jax.jit(jax.vmap(lambda state: model.plan(game, state)))
    return size / _median(_times({"plans": partial(_run, plans, states)}, TURN)["plans"]) * 1e6
