"""How long plans, decisions and environment steps take, and how long they take to compile."""

import os
import resource
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from ms_highway.envs.base import InteractionEnv
from ms_highway.experiments.runner import make_environment
from ms_highway.game.game import Game
from ms_highway.metareasoning.compiled_decision import CompiledDecision
from ms_highway.metareasoning.rule import PUBLISHED_COSTS, first_memory
from ms_highway.metareasoning.switching import Switching
from ms_highway.planning.compiled_plans import CompiledPlans, Costs, checked_state
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.several import plan_for
from ms_highway.runtime.arrays import Controls, State
from ms_highway.runtime.files import temporary_directory
from ms_highway.runtime.jax_settings import low_latency, own_process
from ms_highway.runtime.timing import forget, timed

REPEATS = 600
TURN = 20  # runs of one thing before the next
BATCHES = (1, 32, 1024)  # of vmapped plans
CACHE, CACHED_FROM = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
AGREEMENT = 1e-3  # between ours and the peer's scaled controls
SEVERAL_REPEATS = 60
KIBIBYTE = 1024


def bench(scenario: str, peer: bool = False, **config: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure each rung of the ladder of a scenario with one human, in microseconds, from its first start.

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
        config: of the environment.

    Raises:
        ImportError: if the peer is wanted and CasADi is not there.
        RuntimeError: if the peer plans something else.
    """
    env, inner = _environment(scenario, human_reward="published", **config)  # which is what the peer knows
    game, models, state = inner.game, inner.settings.models, checked_state(inner.car_states)
    with one_core():
        step = _step_without_planning(env, inner)
    env.close()
    compiling = {kind: _compile_seconds(game, models, state, kind == "cached") for kind in ("cold", "cached")}
    for rung, model in enumerate(models):
        seconds = {kind: times[rung] for kind, times in compiling.items()}
        with one_core():
            yield model.name, _measured(game, models, rung, state, peer) | {"step_us": step, "compile_s": seconds}


def _environment(scenario: str, **config: Any) -> tuple[gym.Env, InteractionEnv]:
    """Return the environment of a scenario at its first start, and without its wrappers."""
    env = make_environment(scenario, "naive", **config)
    env.reset(seed=0)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    return env, inner


def _measured(game: Game, models: tuple[HumanModel, ...], rung: int, state: State, peer: bool) -> dict[str, Any]:
    """Measure one rung, warm."""
    compiled, model = CompiledPlans(game, models), models[rung]
    function, *arguments = compiled.call(state, [rung])
    plans: dict[str, Callable[[], None]] = {"plan_us": partial(_run, function, *arguments)}
    with temporary_directory() as directory:
        if peer:
            plans["peer_us"] = _peer(game, model, state, np.asarray(compiled.plan(state, [rung])[0].robot), directory)
        times = _times(plans)
    flops = float((function.lower(*arguments).compile().cost_analysis() or {})["flops"])
    return {
        "plan_us": {"p50": median(times["plan_us"]), "p99": float(np.quantile(times["plan_us"], 0.99))},
        **({"peer_us": {"p50": median(times["peer_us"])}} if peer else {}),
        "decision_us": _decision(game, models, rung, state),
        "flop": game.planner.iterations * flops,  # XLA counts the body of the loop once, and little is outside of it
        "plans_per_s": {str(size): _throughput(game, model, state, size) for size in BATCHES},
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


def _compile_seconds(game: Game, models: Sequence[HumanModel], state: State, cached: bool) -> list[float]:
    """Seconds to trace and compile the plan of each rung, one after the other; leaves the user's cache alone."""
    kept = {name: jax.config.values[name] for name in (CACHE, CACHED_FROM)}
    plans, seconds = CompiledPlans(game, models), list[float]()
    with temporary_directory() as directory:
        try:
            jax.config.update(CACHE, str(directory) if cached else None)
            jax.config.update(CACHED_FROM, 0.0)
            for _ in range(2 if cached else 1):  # the first time fills the cache
                compilation_cache.reset_cache()
                forget()
                seconds = []
                for rung in range(len(models)):
                    start = perf_counter()
                    function, *arguments = plans.call(state, [rung])
                    function.lower(*arguments).compile()
                    seconds.append(perf_counter() - start)
        finally:
            for name, value in kept.items():
                jax.config.update(name, value)
            compilation_cache.reset_cache()
    return seconds


def _peer(game: Game, model: HumanModel, state: State, ours: Controls, directory: Path) -> Callable[[], None]:
    """Return what repeats the peer's plan, after checking that its first result agrees with ours."""
    from ms_highway.benchmarks.casadi_peer import compiled_peer  # which needs an extra

    call, repeat = compiled_peer(game, model.name, len(state), directory)
    apart = float(abs(call(np.asarray(state)) - ours).max())
    if not apart < AGREEMENT:
        raise RuntimeError(f"CasADi's {model.name} plan is {apart:.1e} away from ours; they must agree to be compared")
    return repeat


def _decision(game: Game, models: tuple[HumanModel, ...], rung: int, state: State) -> float:
    """Time a decision that never goes up, so that it checks the rung below whenever the cooldown allows."""
    costs = Costs(0.0, np.array([PUBLISHED_COSTS.get(model.name, 0.0) for model in models]))
    compiled = CompiledDecision(Switching(costs, 1e9, models), game)
    checking = first_memory(compiled.rule, 1)._replace(rungs=np.array([rung]), step=np.ones((), int))
    waiting = checking._replace(last_check=np.zeros_like(checking.last_check))
    runs = {
        name: partial(_run, compiled.function, *compiled.arguments(memory, compiled.still(state)))
        for name, memory in (("checking", checking), ("waiting", waiting))
    }
    times, cooldown = _times(runs), Switching.cooldown
    return (median(times["checking"]) + (cooldown - 1) * median(times["waiting"])) / cooldown


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
    return size / median(_times({"plans": partial(_run, plans, states)}, TURN)["plans"]) * 1e6


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
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIBIBYTE
    return {"plan_ms": quantiles, "compile_s": compiling, "memory_mib": memory}
