"""Run many episodes of the closed loop at once in pure JAX: a rule decides, robot and humans plan, the world moves.

Environments call the same pure functions, so that both loops agree. Planning times are not measured: T comes from a
table, and no plan is late.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.rule import NOT_ESTIMATED, Decision, at_price, is_of_package, refuse_rungs, unestimated
from ms_highway.choice.rule import decide as chosen_by
from ms_highway.game.dynamics import keep_velocity, step, within_grip
from ms_highway.game.features import check_own_features, features
from ms_highway.game.game import Game, each_human, swap_players
from ms_highway.loop.records import DECIDES, PLANS, Episodes, Loop, Records
from ms_highway.loop.step import (
    PLANNED,
    Carry,
    Rest,
    advance,
    begin,
    complete_outcome,
    continues_plan,
    follow,
    follow_escape,
    no_rest,
    or_brake,
    responsive_rungs,
)
from ms_highway.planning.compiled_plans import plan_for
from ms_highway.planning.human_models import HumanModel, plan_alone, warn_of_limits
from ms_highway.planning.plans import Plan, cold_start, may_continue, one_step_later
from ms_highway.planning.way_out import keep_way_out
from ms_highway.runtime.arrays import Control, Flag, Index, Rungs, State, for_rows
from ms_highway.runtime.compilation import Devices, jit_quickly, share_among
from ms_highway.runtime.process import refuse_after_fork

EPISODES = "episodes"  # axis of a chunk, over which JAX maps


def simulate(loop: Loop, episodes: Episodes, devices: Devices | None = None) -> Records:
    """Run episodes, shared by devices, see `ms_highway.runtime.compilation.share_among`.

    A device computes the episodes chunk by chunk, and a human model only for chunks that use it. With several humans,
    it computes episodes one by one, as a plan takes as many rounds as there are humans to predict.

    Numbers are not checked: rewards are not finite where a state or a weight is not finite.

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
    check_own_features(loop.game.scene, loop.game.robot, loop.game.number, episodes.starts[0])
    warn_of_limits(loop.models, loop.game, episodes.starts[0])
    shared = share_among(devices or jax.local_devices()[:1], partial(_simulate, loop), episodes, loop.together)
    return checked_records(loop, shared)


def checked_records(loop: Loop, records: Records) -> Records:
    """Return records without what was to be checked in them.

    Raises:
        ValueError: if a rule of the user's chose what is no rung, or a user-defined feature is not finite.
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
    """What an episode carries from step to step."""

    state: State
    robot: Carry
    rest: Rest  # of the robot's plan
    humans: Rest  # of each human's


class Given(NamedTuple):
    """What is given for a step.

    Attributes:
        scheduled: numbers of the humans' models, see `Episodes`.
        errors: of what the robot sees, see `Episodes`; None for no errors.
        controls: of the robot, if an agent drives it; None if it plans.
    """

    scheduled: Rungs
    errors: State | None = None
    controls: Control | None = None


def believed(game: Game, own: Episodes) -> Game:
    """Return the game as the robot of an episode believes it."""
    return replace(game, robot=replace(game.robot, weights=own.robot_weights))


@partial(jit_quickly, xla_cpu_parallel_codegen_split_count=1)  # or LLVM rounds differently where more threads compile
def _simulate(loop: Loop, episodes: Episodes) -> Records:
    """Run a chunk of episodes."""
    begun = begin_episodes(loop, episodes.starts)
    given = Given(episodes.schedules, None if episodes.errors is None else episodes.errors[:, :-1])
    by_step = jax.tree.map(lambda part: jnp.swapaxes(part, 0, 1), given)
    _, records = jax.lax.scan(lambda now, given: step_episodes(loop, episodes, now, given), begun, by_step)
    return jax.tree.map(lambda part: jnp.swapaxes(part, 0, 1), records)


def begin_episodes(loop: Loop, starts: State) -> Now:
    """Return what episodes carry into their first step, given the states [episodes, cars, 4] of all cars."""
    game, horizon = loop.game, loop.game.planner.horizon

    def begun(start: State) -> Now:
        drivers = jax.tree.map(lambda part: jnp.stack([part] * game.number), no_rest(horizon, 1))
        return Now(start, begin(loop.rule, game, start), no_rest(horizon, game.number), drivers)

    return jax.vmap(begun)(starts)


def step_episodes(loop: Loop, own: Episodes, now: Now, given: Given) -> tuple[Now, Records]:
    """Advance a chunk of episodes by one step."""
    own = replace(own, starts=None, schedules=None, errors=None)  # which a step does not need
    step = partial(_step, loop)
    if loop.together > 1:
        return jax.vmap(step, axis_name=EPISODES)(own, now, given)
    return for_rows(step, own, now, given)


def _step(loop: Loop, own: Episodes, now: Now, given: Given) -> tuple[Now, Records]:
    """Advance an episode by one step: look, choose, plan, and move."""
    game = believed(loop.game, own)
    if given.controls is not None:
        return _steer(loop, now, own, given.controls)
    seen = now.state if given.errors is None else now.state.at[: len(given.errors)].add(given.errors)
    robot, by_rule = complete_outcome(game, now.robot, seen, loop.belief), given.scheduled == DECIDES

    def decide() -> Decision:
        return chosen_by(at_price(loop.rule, own.prices), game, robot.memory, robot.outcome)

    decision = _where_needed(loop, by_rule.any(), decide, unestimated(robot.memory, robot.memory.rungs))
    chosen = None if is_of_package(loop.rule) else jnp.where(by_rule, decision.memory.rungs, 0)
    rungs = jnp.where(by_rule, decision.memory.rungs, given.scheduled).astype(jnp.int32)
    rungs = responsive_rungs(loop.models, rungs, robot.belief, loop.unresponsive)
    decision = decision._replace(memory=decision.memory._replace(rungs=rungs))
    plan = _plan(loop, game, seen, now.rest, rungs)
    followed = or_brake(game, seen[0], follow(plan, rungs, now.rest))
    if loop.way_out:
        followed = follow_escape(followed, keep_way_out(game, seen, followed.now.plan.robot[0]))
    control = _executed(game, now.state[0, 3], followed.now.plan.robot[0] * game.planner.control_scale)
    gains = jnp.asarray(decision.gains, jnp.float32)
    now = now._replace(robot=advance(robot, decision, followed, seen), rest=followed.kept)
    records = Records(followed.now.rungs, rungs, followed.status, gains=gains, chosen=chosen)
    return _world(loop, now, own, control, records)


def _where_needed(loop: Loop, needed: Flag, function: Callable[[], Any], otherwise: Any) -> Any:
    """Compute a function if some episode of the chunk needs it; the other episodes keep ``otherwise``."""
    somewhere = jax.lax.pmax(needed, EPISODES) if loop.together > 1 else needed
    found = jax.lax.cond(somewhere, function, lambda: otherwise)
    return jax.tree.map(partial(jnp.where, needed), found, otherwise)


def _plan(loop: Loop, game: Game, seen: State, rest: Rest, rungs: Rungs) -> Plan:
    """Plan for an episode; with one human, compute only the models that some episode of the chunk uses."""

    def planned(models: tuple[HumanModel, ...], used: Rungs) -> Plan:
        start = cold_start(game, seen)
        if may_continue(models, game):
            left = continues_plan(models, game, used, rest)
            start = jax.tree.map(partial(jnp.where, left), one_step_later(rest.start), start)
        return plan_for(models, game, seen, used, start).plan

    if game.number > 1:
        return planned(loop.models, rungs)
    still = jnp.zeros((game.planner.horizon, 2))
    plan = Plan(still, still[None])
    for number, model in enumerate(loop.models):
        plan = _where_needed(loop, rungs[0] == number, partial(planned, (model,), jnp.zeros_like(rungs)), plan)
    return plan


def _steer(loop: Loop, now: Now, own: Episodes, control: Control) -> tuple[Now, Records]:
    """Let the robot execute a control, the humans plan and the world move; reward the robot."""
    none = jnp.zeros(loop.game.number, jnp.int32)
    gains = jnp.full((loop.game.number, len(loop.rule.ladder)), NOT_ESTIMATED, jnp.float32)
    return _world(loop, now, own, control, Records(none, none, jnp.int32(PLANNED), gains=gains))


def _executed(game: Game, speed: Any, controls: Any) -> Any:
    """Limit planned controls to what tyres hold at these speeds, as vehicles do."""
    grip = game.planner.grip
    return controls if grip is None else within_grip(game.world, jnp.asarray(grip), speed, controls)


def _world(loop: Loop, now: Now, own: Episodes, robot: Control, records: Records) -> tuple[Now, Records]:
    """Let the humans plan and the world move under the robot's control, not scaled; complete the records."""
    game, state, last = believed(loop.game, own), now.state, 1 + loop.game.number
    truth = replace(loop.game, humans=replace(loop.game.humans, weights=own.human_weights))

    def drive(human: Index) -> tuple[Control, Rest]:
        view, turned = swap_players(truth, state, human)
        rest = jax.tree.map(lambda part: part[human], now.humans)
        driving = or_brake(view, turned[0], follow(plan_alone(view, turned).plan, rest.rungs, rest))
        control = driving.now.plan.robot[0] * game.planner.control_scale
        for number, driver in enumerate(loop.drivers, PLANS + 1):
            control = jnp.where(own.drivers[human] == number, driver(view, turned), control)
        return control, driving.kept

    controls, rests = each_human(game, drive)
    controls = _executed(game, state[1:last, 3], controls)
    driven = jnp.concatenate([robot[None], controls, keep_velocity(game.world, state[last:])])
    after = step(game.world, state, driven)
    phi = features(game.scene, game.robot, after)
    reward, collision = phi @ game.robot.weights, phi[game.robot.names.index("collision")] > 0
    return now._replace(state=after, humans=rests), records._replace(reward=reward, collision=collision, states=after)
