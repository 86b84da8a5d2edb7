"""Run many episodes of the closed loop at once in pure JAX.

In each step of an episode, a rule decides, robot and humans plan, and the world moves.

Environments call the same pure functions, so that both loops agree. Planning times are
not measured: T comes from a table, and no plan is late.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

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
from ms_highway.choice.rule import decide as decide_by
from ms_highway.game.dynamics import keep_velocity, within_grip
from ms_highway.game.dynamics import step as move
from ms_highway.game.features import check_user_features, features
from ms_highway.game.game import Game, each_human, swap_players
from ms_highway.loop.braking import brake
from ms_highway.loop.game_parts import choose, plan_start
from ms_highway.loop.records import DECIDES, HUMAN_PLANS, Episodes, Loop, Records
from ms_highway.loop.step import (
    GameCarry,
    GameChoice,
    GameParts,
    GamePlan,
    NewPlan,
    Parts,
    RemainingPlan,
    begin,
    follow,
    no_plan,
    status_number,
    step,
)
from ms_highway.planning.compiled_plans import plan_for
from ms_highway.planning.human_models import HumanModel, plan_alone, warn_of_limits
from ms_highway.planning.plans import Plan, Solution
from ms_highway.planning.way_out import keep_way_out
from ms_highway.runtime.arrays import (
    Array,
    Control,
    Flag,
    HumansControl,
    Index,
    Rungs,
    State,
    for_rows,
)
from ms_highway.runtime.compilation import Devices, jit_quickly, share_among
from ms_highway.runtime.process import refuse_after_fork


def simulate(loop: Loop, episodes: Episodes, devices: Devices | None = None) -> Records:
    """Run episodes, shared by devices.

    See `ms_highway.runtime.compilation.share_among`. A device computes the episodes
    chunk by chunk, and a human model only for chunks that use it. With several humans,
    it computes episodes one by one, as a plan takes as many rounds as there are humans
    to predict.

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

    # Check in one state what compiled code cannot.
    game = loop.game
    start = episodes.starts[0]
    check_user_features(game.scene, game.robot, game.number, start)
    warn_of_limits(loop.models, game, start)

    devices = devices or jax.local_devices()[:1]
    run_chunk = partial(_simulate, loop)
    records = share_among(devices, run_chunk, episodes, loop.together)
    return checked_records(loop, records)


def checked_records(loop: Loop, records: Records) -> Records:
    """Return records without what was to be checked in them.

    Raises:
        ValueError: if a rule of the user's chose what is no rung, or a user-defined
            feature is not finite.
    """
    if records.chosen is not None:
        refuse_rungs(loop.rule, records.chosen)

    # A reward that is not finite in a finite state comes from a feature of the user's.
    robot = loop.game.robot
    if robot.user_features:
        rewards = np.asarray(records.reward)
        states = np.asarray(records.states)
        finite_states = np.isfinite(states).all(axis=(-2, -1))
        failed = states[~np.isfinite(rewards) & finite_states]
        for state in failed[:1]:
            check_user_features(loop.game.scene, robot, 0, state, gradients=False)
    return records._replace(chosen=None)


class EpisodeCarry(NamedTuple):
    """What an episode carries from step to step.

    Attributes:
        state: all cars.
        robot: what the robot carries.
        humans: for each human, the plan to fall back on in the next step.
    """

    state: State
    robot: GameCarry
    humans: RemainingPlan[Plan]


class StepInputs(NamedTuple):
    """What an episode gets for a step.

    Attributes:
        scheduled: rungs of the humans' models, see `Episodes`.
        controls: of the robot, if an agent drives it; None if it plans.
    """

    scheduled: Rungs
    controls: Control | None = None


def believed(game: Game, episode: Episodes) -> Game:
    """Return the game as the robot of an episode believes it."""
    return replace(game, robot=replace(game.robot, weights=episode.robot_weights))


# LLVM would round differently where more threads compile.
@partial(jit_quickly, xla_cpu_parallel_codegen_split_count=1)
def _simulate(loop: Loop, episodes: Episodes) -> Records:
    """Run a chunk of episodes."""
    first = begin_episodes(loop, episodes.starts)
    by_step = StepInputs(jnp.swapaxes(episodes.schedules, 0, 1))
    advance = partial(step_episodes, loop, episodes)
    _, records = jax.lax.scan(advance, first, by_step)  # [steps, episodes, ...]
    return jax.tree.map(lambda part: jnp.swapaxes(part, 0, 1), records)


def begin_episodes(loop: Loop, starts: Float[Array, "episodes cars 4"]) -> EpisodeCarry:
    """Return what episodes carry into their first step, from these states."""
    game = loop.game

    def begin_one(start: State) -> EpisodeCarry:
        robot = begin(loop.rule, game, start)
        none = no_plan(game.planner.horizon, 1)
        humans = jax.tree.map(lambda part: jnp.stack([part] * game.number), none)
        return EpisodeCarry(start, robot, humans)

    return jax.vmap(begin_one)(starts)


def step_episodes(
    loop: Loop,
    episodes: Episodes,
    carry: EpisodeCarry,
    inputs: StepInputs,
) -> tuple[EpisodeCarry, Records]:
    """Advance a chunk of episodes by one step."""
    # A step needs neither the start nor the schedule of an episode.
    episodes = replace(episodes, starts=None, schedules=None)  # type: ignore[arg-type]
    advance = partial(_step, loop)
    if loop.together > 1:
        return jax.vmap(advance, axis_name=loop.axis)(episodes, carry, inputs)
    return for_rows(advance, episodes, carry, inputs)


def _step(
    loop: Loop,
    episode: Episodes,
    carry: EpisodeCarry,
    inputs: StepInputs,
) -> tuple[EpisodeCarry, Records]:
    """Advance an episode by one step.

    The robot plans, or executes an agent's control; then the world moves.
    """
    if inputs.controls is not None:
        return _steer(loop, episode, carry, inputs.controls)

    # Let the robot choose models, plan, and execute its first control.
    game = believed(loop.game, episode)
    parts = batch_parts(loop, episode, inputs.scheduled)
    robot, result = step(carry.robot, carry.state, parts)
    control = result.executed.plan.robot[0] * game.planner.control_scale
    control = _within_grip(game, carry.state[0, 3], control)

    # Record the step. What a rule of the user's chose is checked afterwards.
    decision = result.choice.decision
    by_rule = inputs.scheduled == DECIDES
    gains = jnp.asarray(decision.gains, jnp.float32)
    chosen = None
    if not is_of_package(loop.rule):
        chosen = jnp.where(by_rule, decision.memory.rungs, 0)
    records = Records(
        rungs=result.executed.rungs,
        planned=result.choice.rungs,
        status=jnp.asarray(result.status),
        gains=gains,
        chosen=chosen,
    )
    return _move_world(loop, episode, carry._replace(robot=robot), control, records)


def batch_parts(loop: Loop, episode: Episodes, scheduled: Rungs) -> GameParts:
    """Return the parts of a step of the robot in an episode; no plan is late.

    See `ms_highway.loop.step`.

    Args:
        loop: what the episodes share.
        episode: what is its own.
        scheduled: rungs of the humans' models in this step, or `DECIDES`.
    """
    game = believed(loop.game, episode)
    decide = partial(_decide, loop, episode, game, scheduled)
    return Parts(
        choose=partial(choose, game, loop.models, loop.unresponsive, decide),
        plan=partial(_plan, loop, game),
        brake=partial(brake, game),
        escape=partial(keep_way_out, game) if loop.way_out else None,
    )


def _decide(
    loop: Loop,
    episode: Episodes,
    game: Game,
    scheduled: Rungs,
    memory: Memory,
    outcome: Outcome[State],
) -> Decision:
    """Take the models of a schedule or, where it says so, let the rule decide.

    The rule decides at the episode's price.
    """
    by_rule = scheduled == DECIDES
    is_needed = by_rule.any()
    undecided = unestimated(memory, memory.rungs)

    def decide() -> Decision:
        rule = at_price(loop.rule, episode.prices)
        return decide_by(rule, game, memory, outcome)

    # Decide, and put in the rungs of the schedule.
    decision = _where_needed(loop, is_needed, decide, undecided)
    decided = decision.memory
    rungs = jnp.where(by_rule, decided.rungs, scheduled).astype(jnp.int32)
    return decision._replace(memory=decided._replace(rungs=rungs))


Result = TypeVar("Result")


def _where_needed(
    loop: Loop,
    needed: Flag,
    function: Callable[[], Result],
    otherwise: Result,
) -> Result:
    """Compute a function if some episode of the chunk needs it.

    The other episodes keep ``otherwise``.
    """
    somewhere = needed
    if loop.together > 1:
        somewhere = jax.lax.pmax(needed, loop.axis)
    found = jax.lax.cond(somewhere, function, lambda: otherwise)
    return jax.tree.map(partial(jnp.where, needed), found, otherwise)


def _plan(
    loop: Loop,
    game: Game,
    state: State,
    choice: GameChoice,
    last: RemainingPlan[Plan],
) -> GamePlan:
    """Plan for an episode.

    With one human, compute only the models that some episode of the chunk uses.
    """
    rungs = choice.rungs
    start = plan_start(loop.models, game, state, rungs, last)

    def plan_by(models: tuple[HumanModel, ...], used: Rungs) -> Solution:
        return plan_for(models, game, state, used, start)

    if game.number > 1:
        solution = plan_by(loop.models, rungs)
    else:
        zeros = jnp.zeros((game.planner.horizon, 2))
        solution = Solution(Plan(zeros, zeros[None]), jnp.int32(0), jnp.bool(False))
        for rung, model in enumerate(loop.models):
            by_model = partial(plan_by, (model,), jnp.zeros_like(rungs))
            solution = _where_needed(loop, rungs[0] == rung, by_model, solution)

    plan = solution.plan
    return NewPlan(plan, plan, solution.steps, solution.converged, details=None)


def _steer(
    loop: Loop,
    episode: Episodes,
    carry: EpisodeCarry,
    control: Control,
) -> tuple[EpisodeCarry, Records]:
    """Let the robot execute a control, and the world move; reward the robot."""
    humans = loop.game.number
    first_rungs = jnp.zeros(humans, jnp.int32)
    gains = jnp.full((humans, len(loop.rule.ladder)), NOT_ESTIMATED, jnp.float32)
    status = jnp.int32(status_number("planned"))
    records = Records(first_rungs, first_rungs, status, gains=gains)
    return _move_world(loop, episode, carry, control, records)


def _within_grip(
    game: Game,
    speeds: Float[Array, "*cars"],
    controls: Float[Array, "*cars 2"],
) -> Float[Array, "*cars 2"]:
    """Limit planned controls to what tyres hold at these speeds, as vehicles do."""
    grip = game.planner.grip
    if grip is None:
        return controls
    return within_grip(game.world, jnp.asarray(grip), speeds, controls)


def _move_world(
    loop: Loop,
    episode: Episodes,
    carry: EpisodeCarry,
    control: Control,
    records: Records,
) -> tuple[EpisodeCarry, Records]:
    """Let the humans plan and all cars move; complete the records.

    Args:
        loop: what the episodes share.
        episode: what is its own.
        carry: what the episode carries into the step, but the robot's part out of it.
        control: control of the robot, not scaled.
        records: records of the robot's step.
    """
    game = believed(loop.game, episode)
    state = carry.state
    human_cars = slice(1, 1 + game.number)

    # All cars move at once: humans as they drive, scripted cars at their velocity.
    planned, fallbacks = _drive_humans(loop, episode, carry)
    controls = _within_grip(game, state[human_cars, 3], planned)
    scripted_cars = slice(human_cars.stop, None)
    coasting = keep_velocity(game.world, state[scripted_cars])
    all_controls = jnp.concatenate([control[None], controls, coasting])  # [cars, 2]
    after = move(game.world, state, all_controls)

    # Reward the robot.
    phi = features(game.scene, game.robot, after)
    reward = phi @ game.robot.weights  # r = theta . phi
    collision_feature = game.robot.names.index("collision")
    collision = phi[collision_feature] > 0
    records = records._replace(reward=reward, collision=collision, states=after)
    return carry._replace(state=after, humans=fallbacks), records


def _drive_humans(
    loop: Loop,
    episode: Episodes,
    carry: EpisodeCarry,
) -> tuple[HumansControl, RemainingPlan[Plan]]:
    """Return the humans' controls, not scaled, and the plans to fall back on next.

    Humans plan for their own rewards, or a driver of `Loop.drivers` drives them.
    """
    true_rewards = replace(loop.game.humans, weights=episode.human_weights)
    truth = replace(loop.game, humans=true_rewards)

    def drive(human: Index) -> tuple[Control, RemainingPlan[Plan]]:
        """Return a human's control, and the plan to fall back on in the next step."""
        view, seen = swap_players(truth, carry.state, human)
        last = jax.tree.map(lambda part: part[human], carry.humans)

        # The control of its plan, or of what takes its place.
        plan = plan_alone(view, seen).plan
        new_plan = NewPlan(plan, plan, 0, False, details=None)
        executed, fallback, _ = follow(
            new_plan, last.rungs, last, seen, partial(brake, view)
        )
        control = executed.plan.robot[0] * loop.game.planner.control_scale

        # The control of a driver, where one drives.
        for number, driver in enumerate(loop.drivers, HUMAN_PLANS + 1):
            drives = episode.drivers[human] == number
            control = jnp.where(drives, driver(view, seen), control)
        return control, fallback

    return each_human(loop.game, drive)
