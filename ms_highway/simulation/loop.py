"""Run the closed loop in pure JAX: humans and robot plan, a rule decides, the world moves; many episodes at once.

The pure functions are those that the environments call, so that both loops agree. Planning times are not measured:
T comes from a table, and no plan is late.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int

from ms_highway.control.fallback import Followed, Rest, braking_control, follow, follow_escape, no_rest
from ms_highway.control.yielding import unmoved_control
from ms_highway.game.dynamics import keep_velocity, recover_control, step, within_grip
from ms_highway.game.features import features
from ms_highway.game.game import Game, each_human, swap_players
from ms_highway.metareasoning.belief import counted_on, first_belief, infer
from ms_highway.metareasoning.rule import NOT_ESTIMATED, Memory, Order, Outcome, at_price, decide, first_memory
from ms_highway.planning.effort import starts_warm
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.planning.plans import Plan, cold_start, one_step_later
from ms_highway.planning.several import plan_for
from ms_highway.planning.way_out import keep_way_out
from ms_highway.runtime.arrays import (
    Belief,
    Car,
    Control,
    Flag,
    Gains,
    HumansWeights,
    Index,
    Rungs,
    Scalar,
    State,
    Weights,
)
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.simulation.devices import device_mesh, share_among
from ms_highway.simulation.records import ALWAYS_YIELDS, DECIDES, USUAL, Episodes, Loop, Records


def simulate(loop: Loop, episodes: Episodes, mesh: Mesh | None = None) -> Records:
    """Run episodes from start to end, shared by the devices of a mesh, see `ms_highway.simulation.devices.share_among`.

    In every step, a device sorts its episodes by their models and computes them chunk by chunk, so that most chunks
    need a single model: under `jax.vmap` alone, every episode would compute every model. Among several humans, it
    computes them one by one: a plan takes as many rounds as there are humans to predict.

    Nothing is checked: where a state or a weight is not finite, rewards are not either.

    Args:
        loop: what the episodes share.
        episodes: one at least.
        mesh: of `ms_highway.simulation.devices.device_mesh`; by default, the first device.

    Returns:
        NumPy arrays.

    Raises:
        ValueError: without an episode.
    """
    if len(episodes) == 0:
        raise ValueError("there are no episodes to simulate; give one at least")
    mesh = device_mesh(jax.local_devices()[:1]) if mesh is None else mesh
    return share_among(mesh, partial(_simulate, loop), episodes, loop.together)


class _Now(NamedTuple):
    """What an episode carries from step to step."""

    state: State
    memory: Memory
    gains: Gains
    belief: Belief
    robot: Rest
    humans: Rest  # of each human


class _Step(NamedTuple):
    """What is given for a step of every episode.

    Attributes:
        scheduled: models of the humans in it, and in the next one.
        errors: of what the robot sees of the first cars before it, and before the next one; None where there are none.
    """

    scheduled: Int[jax.Array, "2 episodes humans"]
    errors: Float[jax.Array, "2 episodes cars 4"] | None

    def seen(self, state: State, later: int = 0) -> State:
        """Return a state as the robot sees it before the step, or one step later."""
        if self.errors is None:
            return state
        return state.at[..., : self.errors.shape[-2], :].add(self.errors[later])


class _Own(NamedTuple):
    """An episode's own numbers."""

    price: Scalar
    robot_weights: Weights
    human_weights: HumansWeights
    yielding: Rungs

    def robots(self, game: Game) -> Game:
        """Return the game as the robot believes it."""
        return replace(game, robot=replace(game.robot, weights=self.robot_weights))

    def truly(self, game: Game) -> Game:
        """Return the game with the rewards that humans drive by."""
        return replace(game, humans=replace(game.humans, weights=self.human_weights))


@partial(jit_quickly, xla_cpu_parallel_codegen_split_count=1)  # or LLVM rounds differently where more threads compile
def _simulate(loop: Loop, episodes: Episodes, count: Int[jax.Array, "1"]) -> Records:
    """Run the first ``count`` episodes; the records of the others mean nothing."""
    size, together, decides = len(episodes), loop.together, not isinstance(loop.rule, Order)
    numbers = episodes.prices, episodes.robot_weights, episodes.human_weights, episodes.yielding
    own = _Own(*map(jnp.asarray, numbers))
    first = jax.tree.map(lambda part: jnp.broadcast_to(part, (size, *part.shape)), _before(loop))
    first = first._replace(state=jnp.asarray(episodes.starts, jnp.float32))
    schedules = jnp.moveaxis(jnp.asarray(episodes.schedules), 1, 0)  # [steps, episodes, humans]
    if decides:  # a step before the first one, in which nothing moves, so that choices are compiled once
        schedules = jnp.concatenate([jnp.full_like(schedules[:1], DECIDES), schedules])
    following = jnp.concatenate([schedules[1:], schedules[-1:]])
    errors = episodes.errors
    if errors is not None:
        errors = jnp.moveaxis(jnp.asarray(errors, jnp.float32), 1, 0)
        errors = jnp.concatenate([errors[:1], errors]) if decides else errors
        errors = jnp.stack([errors[:-1], errors[1:]], axis=1)
    chunks, last = (count[0] + together - 1) // together, 2 * len(loop.models)  # behind all models

    def one_step(now: _Now, step: tuple[Flag, _Step]) -> tuple[_Now, Records]:
        begins, given = step
        scheduled = given.scheduled[0]
        rungs = _counted(loop, jnp.where(scheduled == DECIDES, now.memory.rungs, scheduled), now.belief)
        now = now._replace(memory=now.memory._replace(rungs=rungs))
        kinds = 2 * rungs[:, 0] + (given.scheduled[1] == DECIDES).any(axis=1)
        order = jnp.argsort(jnp.where(jnp.arange(size) < count, kinds, last), stable=True)

        def one_chunk(number: Index, done: tuple[_Now, Records]) -> tuple[_Now, Records]:
            places = jax.lax.dynamic_slice_in_dim(order, number * together, together)
            these, theirs = jax.tree.map(lambda part: part[places], (now, own))
            stepped = _step(loop, begins, these, theirs, jax.tree.map(lambda part: part[:, places], given))
            return jax.tree.map(lambda part, new: part.at[places].set(new, unique_indices=True), done, stepped)

        return jax.lax.fori_loop(0, chunks, one_chunk, (now, _no_records(now)))

    begins = jnp.arange(len(schedules)) < decides
    _, records = jax.lax.scan(one_step, first, (begins, _Step(jnp.stack([schedules, following], axis=1), errors)))
    return jax.tree.map(lambda part: jnp.swapaxes(part[int(decides) :], 0, 1), records)


def _for_each(loop: Loop, function: Callable[..., Any], *items: Any) -> Any:
    """Apply a function to every episode: to all at once with one human, else one after the other."""
    if loop.game.number == 1:
        return jax.vmap(function)(*items)
    if len(jax.tree.leaves(items)[0]) > 1:
        return jax.lax.map(lambda each: function(*each), items)
    return jax.tree.map(lambda part: part[None], function(*jax.tree.map(lambda part: part[0], items)))


def _before(loop: Loop) -> _Now:
    """Return what an episode begins with, but for its state."""
    humans, horizon = loop.game.number, loop.game.planner.horizon
    memory = jax.tree.map(jnp.asarray, first_memory(loop.rule, humans))
    robot, driver = (jax.tree.map(jnp.asarray, no_rest(horizon, number)) for number in (humans, 1))
    drivers = jax.tree.map(lambda part: jnp.broadcast_to(part, (humans, *part.shape)), driver)
    unknown = jnp.full(memory.last_check.shape, NOT_ESTIMATED)
    return _Now(jnp.zeros(0), memory, unknown, jnp.asarray(first_belief(humans)), robot, drivers)


def _no_records(now: _Now) -> Records:
    """Return records of a step that are still to be filled in."""
    zero = jnp.zeros_like(now.state[:, 0, 0])
    status = zero.astype(jnp.int32)
    rungs, gains = jnp.zeros_like(now.memory.rungs), jnp.zeros_like(now.gains)
    return Records(rungs, status, zero, zero.astype(bool), gains, jnp.zeros_like(now.state))


def _counted(
    loop: Loop, rungs: Int[jax.Array, "episodes humans"], belief: Float[jax.Array, "episodes humans models"]
) -> Rungs:
    """Return the rungs, another one for humans who show that they do not respond, see `ms_highway.control.driver`."""
    if not loop.belief:
        return rungs
    responds, names = jnp.array([model.responds for model in loop.models]), [model.name for model in loop.models]
    usual = names.index(Naive.name) if isinstance(loop.rule, Order) else 0
    return jnp.where(responds[rungs] & ~jax.vmap(counted_on)(belief), usual, rungs)


def _step(loop: Loop, begins: Flag, now: _Now, own: _Own, given: _Step) -> tuple[_Now, Records]:
    """Advance a chunk of episodes by one step; before they begin, only choose the rungs of the first one."""
    of_each = jax.tree.map(lambda part: jnp.moveaxis(part, 1, 0), given)

    def go() -> tuple[_Moved, Records]:
        plans = _plan(loop, now._replace(state=given.seen(now.state)), own)
        return _for_each(loop, partial(_move, loop), now, own, plans, of_each)

    if isinstance(loop.rule, Order):
        moved, records = go()
        return moved.now, records

    def wait() -> tuple[_Moved, Records]:
        return _for_each(loop, partial(_still, loop.game), now, given.seen(now.state)), _no_records(now)

    moved, records = jax.lax.cond(begins, wait, go)
    return _choose(loop, now, own, given.scheduled[1], moved), records


def _plan(loop: Loop, now: _Now, own: _Own) -> Plan:
    """Plan every episode; with one human, compute only the models that some episode uses."""

    def planned(models: tuple[HumanModel, ...], now: _Now, own: _Own) -> Plan:
        game, start, warm = own.robots(loop.game), None, np.array([starts_warm(model) for model in models])
        if game.planner.persistent or warm.any():
            left = game.planner.persistent | jnp.asarray(warm)[now.memory.rungs if len(warm) > 1 else 0].any()
            goes_on, rest = left & (now.robot.steps > 0), one_step_later(now.robot.start)
            start = jax.tree.map(partial(jnp.where, goes_on), rest, cold_start(game, now.state))
        return plan_for(models, game, now.state, now.memory.rungs, start)

    if loop.game.number > 1:
        return _for_each(loop, partial(planned, loop.models), now, own)
    still = jnp.zeros((loop.together, loop.game.planner.horizon, 2))
    nothing = chosen = Plan(still, still[:, None])
    for number, model in enumerate(loop.models):
        uses = now.memory.rungs[:, 0] == number
        plan = jax.lax.cond(
            uses.any(), lambda model=model: jax.vmap(partial(planned, (model,)))(now, own), lambda: nothing
        )
        chosen = jax.tree.map(
            lambda new, old, uses=uses: jnp.where(uses.reshape(-1, *[1] * (new.ndim - 1)), new, old), plan, chosen
        )
    return chosen


def _follow(game: Game, car: Car, plan: Plan, rungs: Rungs, before: Rest) -> Followed:
    """Return what drives a car, see `ms_highway.control.fallback`."""
    followed = follow(plan, rungs, before)
    (robot, humans), steps, *_ = followed.now
    braking = braking_control(game, car) / game.planner.control_scale
    return followed.instead(Plan(jnp.where(steps == 0, braking, robot), humans))


class _Moved(NamedTuple):
    """Outcome of a step."""

    now: _Now  # before the choice of the next rungs
    outcome: Outcome


def _move(loop: Loop, now: _Now, own: _Own, plan: Plan, given: _Step) -> tuple[_Moved, Records]:
    """Let the humans plan and the world move; reward the robot."""
    game, truth, state, last = own.robots(loop.game), own.truly(loop.game), now.state, 1 + loop.game.number
    scale, seen = game.planner.control_scale, given.seen(state)
    followed = _follow(game, seen[0], plan, now.memory.rungs, now.robot)
    if loop.way_out:
        followed = follow_escape(followed, keep_way_out(game, seen, followed.now.plan.robot[0]))
    own_plan, _, rungs, _ = followed.now

    def drive(human: Index) -> tuple[Control, Rest]:
        view, turned = swap_players(truth, state, human)
        rest = jax.tree.map(lambda part: part[human], now.humans)
        driving = _follow(view, turned[0], Naive().plan(view, turned), rest.rungs, rest)
        control = driving.now.plan.robot[0]
        if loop.yielding:
            unmoved = unmoved_control(view, turned, own.yielding[human] == ALWAYS_YIELDS) / scale
            control = jnp.where(own.yielding[human] == USUAL, control, unmoved)
        return control, driving.kept

    controls, human_rests = each_human(game, drive)
    driven = jnp.concatenate([own_plan.robot[:1], controls]) * scale
    if game.planner.grip is not None:  # as vehicles do
        driven = within_grip(game.world, jnp.asarray(game.planner.grip), state[:last, 3], driven)
    after = step(game.world, state, jnp.concatenate([driven, keep_velocity(game.world, state[last:])]))
    phi = features(game.scene, game.robot, after)
    reward, collision = phi @ game.robot.weights, phi[game.robot.names.index("collision")] > 0
    seen_after = given.seen(after, 1)
    observed = recover_control(game.world, seen[1:last], seen_after[1:last]) / scale
    told = reward if given.errors is None else features(game.scene, game.robot, seen_after) @ game.robot.weights
    outcome = Outcome(seen, seen_after, own_plan.robot[0], observed, told, own_plan)
    records = Records(rungs, followed.status, reward, collision, now.gains, after)
    belief = infer(game, now.belief, seen, seen_after, own_plan.robot) if loop.belief else now.belief
    memory = now.memory._replace(rungs=rungs, step=now.memory.step + 1)
    unknown = jnp.full_like(now.gains, NOT_ESTIMATED)
    return _Moved(_Now(after, memory, unknown, belief, followed.kept, human_rests), outcome), records


def _still(game: Game, now: _Now, seen: State) -> _Moved:
    """Return the outcome of the step before the first one, in which no car moved, from what is seen."""
    still = jnp.zeros((1 + game.number, game.planner.horizon, 2))
    plan = Plan(still[0], still[1:])
    outcome = Outcome(seen, seen, still[0, 0], still[1:, 0], jnp.zeros(()), plan)
    return _Moved(now._replace(memory=now.memory._replace(step=now.memory.step + 1)), outcome)


def _choose(loop: Loop, before: _Now, own: _Own, coming: Int[jax.Array, "chunk humans"], moved: _Moved) -> _Now:
    """Choose the rungs of the next step, where the rule decides."""
    decides: Bool[jax.Array, "chunk"] = (coming == DECIDES).any(axis=1)

    def one(before: _Now, own: _Own, moved: _Moved) -> _Now:
        memory = before.memory._replace(rungs=moved.now.memory.rungs)
        decision = decide(at_price(loop.rule, own.price), own.robots(loop.game), memory, moved.outcome)
        return moved.now._replace(memory=decision.memory, gains=jnp.asarray(decision.gains, jnp.float32))

    decided = jax.lax.cond(decides.any(), lambda: _for_each(loop, one, before, own, moved), lambda: moved.now)
    return jax.tree.map(
        lambda new, old: jnp.where(decides.reshape(-1, *[1] * (new.ndim - 1)), new, old), decided, moved.now
    )
