"""Run many episodes of the closed loop at once in pure JAX: a rule decides, robot and
humans plan, the world moves.

Environments call the same pure functions, so that both loops agree. Planning times are
not measured: T comes from a table, and no plan is late.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.rule import (
    NOT_ESTIMATED,
    Decision,
    Memory,
    Outcome,
    at_price,
    is_of_package,
    refuse_rungs,
    unestimated,
)
from ms_highway.choice.rule import decide as chosen_by
from ms_highway.game.dynamics import keep_velocity, within_grip
from ms_highway.game.dynamics import step as move
from ms_highway.game.features import check_own_features, features
from ms_highway.game.game import Game, each_human, swap_players
from ms_highway.loop.records import DECIDES, HUMAN_PLANS, Episodes, Loop, Records
from ms_highway.loop.step import (
    PLANNED,
    Carry,
    Choice,
    NewPlan,
    Parts,
    RemainingPlan,
    begin,
    brake,
    choose,
    follow,
    no_plan,
    plan_start,
    step,
)
from ms_highway.planning.compiled_plans import plan_for
from ms_highway.planning.human_models import HumanModel, plan_alone, warn_of_limits
from ms_highway.planning.plans import Plan, Solution
from ms_highway.planning.way_out import keep_way_out
from ms_highway.runtime.arrays import Control, Flag, Index, Rungs, State, for_rows
from ms_highway.runtime.compilation import Devices, jit_quickly, share_among
from ms_highway.runtime.process import refuse_after_fork

EPISODES = "episodes"  # axis of a chunk, over which JAX maps


def simulate(loop: Loop, episodes: Episodes, devices: Devices | None = None) -> Records:
    """Run episodes, shared by devices, see
    `ms_highway.runtime.compilation.share_among`.

    A device computes the episodes chunk by chunk, and a human model only for chunks
    that use it. With several humans, it computes episodes one by one, as a plan takes
    as many rounds as there are humans to predict.

    Numbers are not checked: rewards are not finite where a state or a weight is not
    finite.

    Args:
        loop: what the episodes share.
        episodes: at least one.
        devices: by default, the first.

    Returns:
        NumPy arrays.

    Raises:
        ValueError: without an episode, and as `checked_records` does.
    """
    refuse_after_fork()
    if len(episodes) == 0:
        raise ValueError("there are no episodes to simulate; give one at least")
    check_own_features(
        loop.game.scene, loop.game.robot, loop.game.number, episodes.starts[0]
    )
    warn_of_limits(loop.models, loop.game, episodes.starts[0])
    shared = share_among(
        devices or jax.local_devices()[:1],
        partial(_simulate, loop),
        episodes,
        loop.together,
    )
    return checked_records(loop, shared)


def checked_records(loop: Loop, records: Records) -> Records:
    """Return records without what was to be checked in them.

    Raises:
        ValueError: if a rule of the user's chose what is no rung, or a user-defined
            feature is not finite.
    """
    if records.chosen is not None:
        refuse_rungs(loop.rule, records.chosen)
    robot = loop.game.robot
    if robot.own:
        rewards = np.asarray(records.reward)
        states = np.asarray(records.states)
        failed = states[~np.isfinite(rewards) & np.isfinite(states).all(axis=(-2, -1))]
        for state in failed[:1]:
            check_own_features(loop.game.scene, robot, 0, state, gradients=False)
    return records._replace(chosen=None)


class Now(NamedTuple):
    """What an episode carries from step to step.

    Attributes:
        state: all cars.
        robot: what the robot carries.
        humans: for each human, the plan to fall back on in the next step.
    """

    state: State
    robot: Carry
    humans: RemainingPlan


class StepInputs(NamedTuple):
    """What an episode gets for a step.

    Attributes:
        scheduled: numbers of the humans' models, see `Episodes`.
        controls: of the robot, if an agent drives it; None if it plans.
    """

    scheduled: Rungs
    controls: Control | None = None


def believed(game: Game, own: Episodes) -> Game:
    """Return the game as the robot of an episode believes it."""
    return replace(game, robot=replace(game.robot, weights=own.robot_weights))


@partial(
    jit_quickly, xla_cpu_parallel_codegen_split_count=1
)  # or LLVM rounds differently where more threads compile
def _simulate(loop: Loop, episodes: Episodes) -> Records:
    """Run a chunk of episodes."""
    begun = begin_episodes(loop, episodes.starts)
    by_step = StepInputs(jnp.swapaxes(episodes.schedules, 0, 1))
    _, records = jax.lax.scan(partial(step_episodes, loop, episodes), begun, by_step)
    return jax.tree.map(lambda part: jnp.swapaxes(part, 0, 1), records)


def begin_episodes(loop: Loop, starts: State) -> Now:
    """Return what episodes carry into their first step, given the states [episodes,
    cars, 4] of all cars.
    """
    game = loop.game

    def begun(start: State) -> Now:
        none = no_plan(game.planner.horizon, 1)
        humans = jax.tree.map(lambda part: jnp.stack([part] * game.number), none)
        return Now(start, begin(loop.rule, game, start), humans)

    return jax.vmap(begun)(starts)


def step_episodes(
    loop: Loop, own: Episodes, now: Now, inputs: StepInputs
) -> tuple[Now, Records]:
    """Advance a chunk of episodes by one step."""
    # A step needs neither the starts nor the schedules.
    own = replace(own, starts=None, schedules=None)  # type: ignore[arg-type]
    advance = partial(_step, loop)
    if loop.together > 1:
        return jax.vmap(advance, axis_name=EPISODES)(own, now, inputs)
    return for_rows(advance, own, now, inputs)


def _step(
    loop: Loop, own: Episodes, now: Now, inputs: StepInputs
) -> tuple[Now, Records]:
    """Advance an episode by one step: the robot plans, or executes an agent's control;
    then the world moves.
    """
    if inputs.controls is not None:
        return _steer(loop, now, own, inputs.controls)
    game = believed(loop.game, own)
    robot, result = step(now.robot, now.state, batch_parts(loop, own, inputs.scheduled))
    control = result.driven.plan.robot[0] * game.planner.control_scale
    control = _executed(game, now.state[0, 3], control)

    # Record the step. What a rule of the user's chose is checked afterwards.
    decision = result.choice.decision
    by_rule = inputs.scheduled == DECIDES
    records = Records(
        result.driven.rungs,
        result.choice.rungs,
        jnp.asarray(result.status),
        gains=jnp.asarray(decision.gains, jnp.float32),
        chosen=(
            None
            if is_of_package(loop.rule)
            else jnp.where(by_rule, decision.memory.rungs, 0)
        ),
    )
    return _world(loop, now._replace(robot=robot), own, control, records)


def batch_parts(loop: Loop, own: Episodes, scheduled: Rungs) -> Parts:
    """Return the parts of a step of the robot in an episode, see
    `ms_highway.loop.step`; no plan is late.

    Args:
        loop: what the episodes share.
        own: what is the episode's own.
        scheduled: numbers of the humans' models in this step, or `DECIDES`.
    """
    game = believed(loop.game, own)
    decide = partial(_decide, loop, own, game, scheduled)
    return Parts(
        partial(choose, game, loop.models, loop.unresponsive, decide),
        partial(_plan, loop, game),
        partial(brake, game),
        escape=partial(keep_way_out, game) if loop.way_out else None,
    )


def _decide(
    loop: Loop,
    own: Episodes,
    game: Game,
    scheduled: Rungs,
    memory: Memory,
    outcome: Outcome,
) -> Decision:
    """Take the models of a schedule or, where it says so, let the rule decide at the
    episode's price.
    """
    by_rule = scheduled == DECIDES
    decision = _where_needed(
        loop,
        by_rule.any(),
        lambda: chosen_by(at_price(loop.rule, own.prices), game, memory, outcome),
        unestimated(memory, memory.rungs),
    )
    rungs = jnp.where(by_rule, decision.memory.rungs, scheduled).astype(jnp.int32)
    return decision._replace(memory=decision.memory._replace(rungs=rungs))


def _where_needed(
    loop: Loop, needed: Flag, function: Callable[[], Any], otherwise: Any
) -> Any:
    """Compute a function if some episode of the chunk needs it; the other episodes keep
    ``otherwise``.
    """
    somewhere = jax.lax.pmax(needed, EPISODES) if loop.together > 1 else needed
    found = jax.lax.cond(somewhere, function, lambda: otherwise)
    return jax.tree.map(partial(jnp.where, needed), found, otherwise)


def _plan(
    loop: Loop, game: Game, state: State, choice: Choice, last: RemainingPlan
) -> NewPlan:
    """Plan for an episode; with one human, compute only the models that some episode of
    the chunk uses.
    """
    rungs = choice.rungs
    start = plan_start(loop.models, game, state, rungs, last)

    def planned(models: tuple[HumanModel, ...], used: Rungs) -> Solution:
        return plan_for(models, game, state, used, start)

    if game.number > 1:
        solution = planned(loop.models, rungs)
    else:
        still = jnp.zeros((game.planner.horizon, 2))
        solution = Solution(Plan(still, still[None]), jnp.int32(0), jnp.bool(False))
        for number, model in enumerate(loop.models):
            by_model = partial(planned, (model,), jnp.zeros_like(rungs))
            solution = _where_needed(loop, rungs[0] == number, by_model, solution)
    return NewPlan(solution.plan, solution.plan, solution.steps, solution.converged)


def _steer(
    loop: Loop, now: Now, own: Episodes, control: Control
) -> tuple[Now, Records]:
    """Let the robot execute a control, the humans plan and the world move; reward the
    robot.
    """
    none = jnp.zeros(loop.game.number, jnp.int32)
    gains = jnp.full(
        (loop.game.number, len(loop.rule.ladder)), NOT_ESTIMATED, jnp.float32
    )
    return _world(
        loop, now, own, control, Records(none, none, jnp.int32(PLANNED), gains=gains)
    )


def _executed(game: Game, speed: Any, controls: Any) -> Any:
    """Limit planned controls to what tyres hold at these speeds, as vehicles do."""
    grip = game.planner.grip
    return (
        controls
        if grip is None
        else within_grip(game.world, jnp.asarray(grip), speed, controls)
    )


def _world(
    loop: Loop, now: Now, own: Episodes, robot: Control, records: Records
) -> tuple[Now, Records]:
    """Let the humans plan and the world move under the robot's control, not scaled;
    complete the records.
    """
    game = believed(loop.game, own)
    state = now.state
    last = 1 + game.number
    truth = replace(
        loop.game, humans=replace(loop.game.humans, weights=own.human_weights)
    )

    def drive(human: Index) -> tuple[Control, RemainingPlan]:
        """Return a human's control, and the plan to fall back on in the next step."""
        view, turned = swap_players(truth, state, human)
        before = jax.tree.map(lambda part: part[human], now.humans)
        plan = plan_alone(view, turned).plan
        driven, fallback, _ = follow(
            NewPlan(plan, plan), before.rungs, before, turned, partial(brake, view)
        )
        control = driven.plan.robot[0] * game.planner.control_scale
        for number, driver in enumerate(loop.drivers, HUMAN_PLANS + 1):
            control = jnp.where(
                own.drivers[human] == number, driver(view, turned), control
            )
        return control, fallback

    # All cars move at once: humans as they drive, scripted cars at their velocity.
    controls, fallbacks = each_human(game, drive)
    controls = _executed(game, state[1:last, 3], controls)
    driven = jnp.concatenate(
        [robot[None], controls, keep_velocity(game.world, state[last:])]
    )
    after = move(game.world, state, driven)

    # Reward the robot.
    phi = features(game.scene, game.robot, after)
    reward = phi @ game.robot.weights
    collision = phi[game.robot.names.index("collision")] > 0
    return now._replace(state=after, humans=fallbacks), records._replace(
        reward=reward, collision=collision, states=after
    )
