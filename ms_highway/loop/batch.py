"""Run the closed loop in pure JAX: humans and robot plan, a rule decides, the world moves; many episodes at once.

The pure functions are those that the environments call, so that both loops agree. Planning times are not measured:
T comes from a table, and no plan is late.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
from jax import numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Int

from ms_highway.choice.rule import Decision, unestimated
from ms_highway.game.dynamics import keep_velocity, step, within_grip
from ms_highway.game.features import features
from ms_highway.game.game import Game, each_human, swap_players
from ms_highway.loop.devices import device_mesh, share_among
from ms_highway.loop.fallback import PLANNED, Followed, Rest, braking_control, follow, follow_escape, no_rest
from ms_highway.loop.records import DECIDES, PLANS, Episodes, Loop, Records
from ms_highway.loop.step import (
    Carry,
    advance,
    begin,
    complete_outcome,
    continues_plan,
    responsive_rungs,
)
from ms_highway.planning.human_models import HumanModel, Naive, warn_of_limits
from ms_highway.planning.plans import Plan, cold_start, may_continue, one_step_later
from ms_highway.planning.several import plan_for
from ms_highway.planning.way_out import keep_way_out
from ms_highway.runtime.arrays import (
    Car,
    Control,
    Flag,
    HumansWeights,
    Index,
    Rungs,
    Scalar,
    State,
    Weights,
)
from ms_highway.runtime.compilation import jit_quickly


def simulate(loop: Loop, episodes: Episodes, mesh: Mesh | None = None) -> Records:
    """Run episodes from start to end, shared by the devices of a mesh, see `ms_highway.loop.devices.share_among`.

    A device computes the episodes chunk by chunk, and a human model only for chunks that use it. Among several humans,
    it computes them one by one: a plan takes as many rounds as there are humans to predict.

    Nothing is checked: where a state or a weight is not finite, rewards are not either.

    Args:
        loop: what the episodes share.
        episodes: one at least.
        mesh: of `ms_highway.loop.devices.device_mesh`; by default, the first device.

    Returns:
        NumPy arrays.

    Raises:
        ValueError: without an episode.
    """
    if len(episodes) == 0:
        raise ValueError("there are no episodes to simulate; give one at least")
    warn_of_limits(loop.models, loop.game, episodes.starts[0])
    mesh = device_mesh(jax.local_devices()[:1]) if mesh is None else mesh
    return share_among(mesh, partial(_simulate, loop), episodes, loop.together)


class Now(NamedTuple):
    """What an episode carries from step to step."""

    state: State
    robot: Carry
    rest: Rest  # of the robot's plan
    humans: Rest  # of each human's


class Given(NamedTuple):
    """What is given for a step.

    Attributes:
        scheduled: models of the humans.
        errors: of what the robot sees of the first cars; None where there are none.
        controls: of the robot, where an agent drives it; None where it plans.
    """

    scheduled: Rungs
    errors: State | None = None
    controls: Control | None = None


class Own(NamedTuple):
    """An episode's own numbers."""

    price: Scalar
    robot_weights: Weights
    human_weights: HumansWeights
    drivers: Rungs

    @classmethod
    def of(cls, episodes: Episodes) -> "Own":
        """Return the own numbers of episodes, with an axis of episodes."""
        return cls(episodes.prices, episodes.robot_weights, episodes.human_weights, episodes.drivers)

    def robots(self, game: Game) -> Game:
        """Return the game as the robot believes it."""
        return replace(game, robot=replace(game.robot, weights=self.robot_weights))

    def truly(self, game: Game) -> Game:
        """Return the game with the rewards that humans drive by."""
        return replace(game, humans=replace(game.humans, weights=self.human_weights))


@partial(jit_quickly, xla_cpu_parallel_codegen_split_count=1)  # or LLVM rounds differently where more threads compile
def _simulate(loop: Loop, episodes: Episodes, count: Int[jax.Array, "1"]) -> Records:
    """Run the first ``count`` episodes, chunk by chunk; the records of the others mean nothing."""
    together = loop.together

    def run(episodes: Episodes) -> Records:
        own = Own(*map(jnp.asarray, Own.of(episodes)))
        begun = jax.vmap(partial(begin_episode, loop))(jnp.asarray(episodes.starts, jnp.float32))
        errors = None if episodes.errors is None else jnp.asarray(episodes.errors[:, :-1], jnp.float32)
        given = Given(episodes.schedules, errors)
        by_step = jax.tree.map(lambda part: jnp.swapaxes(jnp.asarray(part), 0, 1), given)
        _, records = jax.lax.scan(lambda now, given: step_episodes(loop, own, now, given), begun, by_step)
        return jax.tree.map(lambda part: jnp.swapaxes(part, 0, 1), records)

    def run_chunk(number: Index, records: Records) -> Records:
        first = number * together
        chunk = jax.tree.map(lambda part: jax.lax.dynamic_slice_in_dim(part, first, together), episodes)
        return jax.tree.map(
            lambda part, new: jax.lax.dynamic_update_slice_in_dim(part, new, first, 0), records, run(chunk)
        )

    sample = jax.eval_shape(run, jax.tree.map(lambda part: part[:together], episodes))
    nothing = jax.tree.map(lambda part: jnp.zeros((len(episodes), *part.shape[1:]), part.dtype), sample)
    return jax.lax.fori_loop(0, (count[0] + together - 1) // together, run_chunk, nothing)


def _for_each(loop: Loop, function: Callable[..., Any], *items: Any) -> Any:
    """Apply a function to every episode of a chunk: to all at once, or to the only one."""
    if loop.together > 1:
        return jax.vmap(function)(*items)
    return jax.tree.map(lambda part: part[None], function(*jax.tree.map(lambda part: part[0], items)))


def begin_episode(loop: Loop, state: State) -> Now:
    """Return what an episode begins with."""
    humans, horizon = loop.game.number, loop.game.planner.horizon
    drivers = jax.tree.map(lambda part: jnp.broadcast_to(part, (humans, *jnp.shape(part))), no_rest(horizon, 1))
    robot, rest = jax.tree.map(jnp.asarray, (begin(loop.rule, loop.game, state), no_rest(horizon, humans)))
    return Now(state, robot, rest, drivers)


def step_episodes(loop: Loop, own: Own, now: Now, given: Given) -> tuple[Now, Records]:
    """Advance a chunk of episodes by one step: look, choose, plan, and move."""
    if given.controls is not None:
        return _for_each(loop, partial(_steer, loop), now, own, given.controls)
    each, decides = partial(_for_each, loop), given.scheduled == DECIDES
    seen = now.state if given.errors is None else now.state.at[:, : given.errors.shape[1]].add(given.errors)

    def look_back(own: Own, robot: Carry, seen: State) -> Carry:
        return complete_outcome(own.robots(loop.game), robot, seen, loop.belief)

    def decide(own: Own, robot: Carry) -> Decision:
        return loop.rule.at_price(own.price).decide(own.robots(loop.game), robot.memory, robot.outcome)

    def take(robot: Carry, decision: Decision, scheduled: Rungs) -> Decision:
        rungs = jnp.where(scheduled == DECIDES, decision.memory.rungs, scheduled).astype(jnp.int32)
        rungs = responsive_rungs(loop.models, rungs, robot.belief, loop.unresponsive)
        return decision._replace(memory=decision.memory._replace(rungs=rungs))

    robot = each(look_back, own, now.robot, seen)
    kept = each(lambda robot: unestimated(robot.memory, robot.memory.rungs), robot)
    decided = jax.lax.cond(decides.any(), lambda: each(decide, own, robot), lambda: kept)
    chooses = decides.any(axis=1)
    decision = each(take, robot, choose_episodes(chooses, decided, kept), given.scheduled)
    plans = _plan(loop, own, seen, now.rest, decision.memory.rungs)
    return each(partial(_move, loop), now._replace(robot=robot), own, decision, plans, seen)


def _plan(loop: Loop, own: Own, seen: State, rest: Rest, rungs: Rungs) -> Plan:
    """Plan every episode of a chunk; with one human, compute only the models that some episode uses."""

    def planned(models: tuple[HumanModel, ...], own: Own, seen: State, rest: Rest, rungs: Rungs) -> Plan:
        game, used = own.robots(loop.game), rungs if len(models) > 1 else jnp.zeros_like(rungs)
        start = cold_start(game, seen)
        if may_continue(models, game):
            left = continues_plan(models, game, used, rest)
            start = jax.tree.map(lambda new, cold: jnp.where(left, new, cold), one_step_later(rest.start), start)
        return plan_for(models, game, seen, rungs, start)

    each, given = partial(_for_each, loop), (own, seen, rest, rungs)
    if loop.game.number > 1:
        return each(partial(planned, loop.models), *given)
    still = jnp.zeros((loop.together, loop.game.planner.horizon, 2))
    nothing = chosen = Plan(still, still[:, None])
    for number, model in enumerate(loop.models):
        uses = rungs[:, 0] == number
        plan = jax.lax.cond(uses.any(), lambda model=model: each(partial(planned, (model,)), *given), lambda: nothing)
        chosen = choose_episodes(uses, plan, chosen)
    return chosen


def choose_episodes(chosen: jax.Array, new: Any, old: Any) -> Any:
    """Take the new leaves for the chosen episodes and the old ones for the rest; the first axis is that of episodes."""
    return jax.tree.map(lambda new, old: jnp.where(chosen.reshape(-1, *[1] * (new.ndim - 1)), new, old), new, old)


def _follow(game: Game, car: Car, plan: Plan, rungs: Rungs, before: Rest) -> Followed:
    """Return what drives a car, see `ms_highway.loop.fallback`."""
    followed = follow(plan, rungs, before)
    (robot, humans), steps, *_ = followed.now
    braking = braking_control(game, car) / game.planner.control_scale
    return followed.instead(Plan(jnp.where(steps == 0, braking, robot), humans))


def _move(loop: Loop, now: Now, own: Own, decision: Decision, plan: Plan, seen: State) -> tuple[Now, Records]:
    """Let the robot follow its plan, the humans plan and the world move; reward the robot."""
    game, robot = own.robots(loop.game), now.robot
    followed = _follow(game, seen[0], plan, decision.memory.rungs, now.rest)
    if loop.way_out:
        followed = follow_escape(followed, keep_way_out(game, seen, followed.now.plan.robot[0]))
    control = _executed(game, now.state[0, 3], followed.now.plan.robot[0] * game.planner.control_scale)
    after, humans, reward, collision = _world(loop, now, own, control)
    gains = jnp.asarray(decision.gains, jnp.float32)
    records = Records(followed.now.rungs, decision.memory.rungs, followed.status, reward, collision, gains, after)
    return Now(after, advance(robot, decision, followed, seen), followed.kept, humans), records


def _steer(loop: Loop, now: Now, own: Own, control: Control) -> tuple[Now, Records]:
    """Let the robot execute a control, the humans plan and the world move; reward the robot."""
    after, humans, reward, collision = _world(loop, now, own, control)
    number, rungs = loop.game.number, len(loop.rule.ladder)
    gains = jnp.full((number, rungs), jnp.nan, jnp.float32)
    none = jnp.zeros(number, jnp.int32)
    records = Records(none, none, jnp.int32(PLANNED), reward, collision, gains, after)
    return now._replace(state=after, humans=humans), records


def _executed(game: Game, speed: Any, controls: Any) -> Any:
    """Limit planned controls to what tyres hold at these speeds, as vehicles do."""
    grip = game.planner.grip
    return controls if grip is None else within_grip(game.world, jnp.asarray(grip), speed, controls)


def _world(loop: Loop, now: Now, own: Own, robot: Control) -> tuple[State, Rest, Scalar, Flag]:
    """Let the humans plan and the world move; return the state, what is left of the humans' plans, reward, collision.

    Args:
        loop: what all episodes share.
        now: of an episode.
        own: the episode's own numbers.
        robot: its control, not scaled.
    """
    game, truth, state, last = own.robots(loop.game), own.truly(loop.game), now.state, 1 + loop.game.number
    scale = game.planner.control_scale

    def drive(human: Index) -> tuple[Control, Rest]:
        view, turned = swap_players(truth, state, human)
        rest = jax.tree.map(lambda part: part[human], now.humans)
        driving = _follow(view, turned[0], Naive().plan(view, turned), rest.rungs, rest)
        control = driving.now.plan.robot[0] * scale
        for number, driver in enumerate(loop.drivers, PLANS + 1):
            control = jnp.where(own.drivers[human] == number, driver(view, turned), control)
        return control, driving.kept

    controls, rests = each_human(game, drive)
    controls = _executed(game, state[1:last, 3], controls)
    driven = jnp.concatenate([robot[None], controls, keep_velocity(game.world, state[last:])])
    after = step(game.world, state, driven)
    phi = features(game.scene, game.robot, after)
    return after, rests, phi @ game.robot.weights, phi[game.robot.names.index("collision")] > 0
