"""Run the closed loop in pure JAX: human and robot plan, a rule decides, the world moves; many episodes at once.

The pure functions are those that the environments call, so that both loops agree. Planning times are not measured:
T(M) comes from a table.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int

from ms_highway.game.dynamics import keep_velocity, recover_control, step, within_grip
from ms_highway.game.features import features
from ms_highway.game.game import Game, swap_players
from ms_highway.metareasoning.rule import Memory, Outcome, decide_by, first_memory
from ms_highway.planning.effort import starts_warm
from ms_highway.planning.human_models import HumanModel, JointPlan, Naive, cold_start, plan_within_limits
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.simulation.devices import device_mesh, share_among
from ms_highway.simulation.following import Rest, follow, warm_plan
from ms_highway.simulation.records import DECIDES, Episodes, Loop, Records

__all__ = ["simulate"]

IN_ONE_MODULE = {"xla_cpu_parallel_codegen_split_count": 1}
"""Compiler options without which LLVM rounds differently where more threads compile."""


def simulate(loop: Loop, episodes: Episodes, mesh: Mesh | None = None) -> Records:
    """Run episodes from start to end, shared by the devices of a mesh, see `ms_highway.simulation.devices.share_among`.

    In every step, a device sorts its episodes by their models and computes them chunk by chunk, so that most chunks
    need a single model: under `jax.vmap` alone, every episode would compute every model.

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
    return share_among(mesh, partial(_simulate, loop), episodes, loop.chunk)


class _Now(NamedTuple):
    """What an episode carries from step to step."""

    state: Float[jax.Array, "cars 4"]
    memory: Memory
    gains: Float[jax.Array, "rungs"]
    robot: Rest[JointPlan]
    human: Rest[JointPlan]


class _Own(NamedTuple):
    """An episode's own numbers."""

    price: Float[jax.Array, ""]
    robot_weights: Float[jax.Array, "features"]
    human_weights: Float[jax.Array, "features"]


@partial(jit_quickly, options=IN_ONE_MODULE)
def _simulate(loop: Loop, episodes: Episodes, count: Int[jax.Array, "1"]) -> Records:
    """Run the first ``count`` episodes; the records of the others mean nothing."""
    size = len(episodes)
    own = _Own(*map(jnp.asarray, (episodes.prices, episodes.robot_weights, episodes.human_weights)))
    none = Rest(cold_start(loop.game), jnp.int32(0))
    unknown = jnp.full(len(loop.rule.ladder), jnp.nan)
    before = _Now(jnp.zeros(0), first_memory(loop.rule), unknown, none, none)
    first = jax.tree.map(lambda part: jnp.broadcast_to(part, (size, *part.shape)), before)
    first = first._replace(state=jnp.asarray(episodes.starts, jnp.float32))
    schedules = jnp.asarray(episodes.schedules)
    if loop.rule.chooses_first:
        first = _choose(loop, first, own, schedules[:, 0] == DECIDES, jax.vmap(partial(_still, loop.game))(first))
    chunks = (count[0] + loop.chunk - 1) // loop.chunk
    last = 2 * len(loop.models)  # behind all models

    def one_step(now: _Now, scheduled: Int[jax.Array, "2 episodes"]) -> tuple[_Now, Records]:
        models, decides = jnp.where(scheduled[0] == DECIDES, now.memory.rung, scheduled[0]), scheduled[1] == DECIDES
        now = now._replace(memory=now.memory._replace(rung=models))
        order = jnp.argsort(jnp.where(jnp.arange(size) < count, 2 * models + decides, last), stable=True)

        def one_chunk(number: Int[jax.Array, ""], done: tuple[_Now, Records]) -> tuple[_Now, Records]:
            places = jax.lax.dynamic_slice_in_dim(order, number * loop.chunk, loop.chunk)
            stepped = _step(loop, *jax.tree.map(lambda part: part[places], (now, own, decides)))
            return jax.tree.map(lambda part, new: part.at[places].set(new, unique_indices=True), done, stepped)

        return jax.lax.fori_loop(0, chunks, one_chunk, (now, _no_records(now)))

    following = jnp.concatenate([schedules[:, 1:], schedules[:, -1:]], axis=1)
    _, records = jax.lax.scan(one_step, first, jnp.stack([schedules.T, following.T], axis=1))
    return jax.tree.map(lambda part: jnp.swapaxes(part, 0, 1), records)


def _no_records(now: _Now) -> Records:
    """Return records of a step that are still to be filled in."""
    zero = jnp.zeros_like(now.state[:, 0, 0])
    number = zero.astype(jnp.int32)
    return Records(number, number, zero, zero.astype(bool), jnp.zeros_like(now.gains), jnp.zeros_like(now.state))


def _step(loop: Loop, now: _Now, own: _Own, decides: Bool[jax.Array, "chunk"]) -> tuple[_Now, Records]:
    """Advance a chunk of episodes by one step."""
    moved, records = jax.vmap(partial(_move, loop.game))(now, own, _plan(loop, now, own))
    return _choose(loop, now, own, decides, moved), records


def _game(game: Game, own: _Own) -> Game:
    """Return the game of one episode."""
    robot, human = game.robot, game.human
    return replace(
        game, robot=replace(robot, weights=own.robot_weights), human=replace(human, weights=own.human_weights)
    )


def _plan(loop: Loop, now: _Now, own: _Own) -> JointPlan:
    """Plan every episode; compute only the models that some episode uses."""

    def planned(model: HumanModel) -> JointPlan:
        start = jax.vmap(warm_plan)(now.robot) if loop.warm_start or starts_warm(model) else None
        return jax.vmap(lambda own, *now: plan_within_limits(model, _game(loop.game, own), *now))(own, now.state, start)

    still = jnp.zeros((loop.chunk, loop.game.planner.horizon, 2))
    chosen = JointPlan(still, still)
    for number, model in enumerate(loop.models):
        uses = now.memory.rung == number
        plan = jax.lax.cond(uses.any(), partial(planned, model), lambda: JointPlan(still, still))
        chosen = jax.tree.map(lambda new, old, uses=uses: jnp.where(uses[:, None, None], new, old), plan, chosen)
    return chosen


class _Moved(NamedTuple):
    """Outcome of a step."""

    now: _Now  # before the choice of the next rung
    outcome: Outcome


def _move(game: Game, now: _Now, own: _Own, plan: JointPlan) -> tuple[_Moved, Records]:
    """Let the human plan and the world move; reward the robot."""
    game, state = _game(game, own), now.state
    scale = game.planner.control_scale
    robot, status, robot_rest = follow(game, state[0], plan, now.robot)
    mirrored, mirrored_state = swap_players(game, state)
    human, _, human_rest = follow(mirrored, state[1], Naive().plan(mirrored, mirrored_state), now.human)
    driven = jnp.stack([robot, human]) * scale
    if game.planner.grip is not None:  # as vehicles do
        driven = within_grip(game.world, jnp.asarray(game.planner.grip), state[:2, 3], driven)
    after = step(game.world, state, jnp.concatenate([driven, keep_velocity(game.world, state[2:])]))
    phi = features(game.scene, game.robot, after)
    reward, collision = phi @ game.robot.weights, phi[game.robot.names.index("collision")] > 0
    observed = recover_control(game.world, state[1], after[1]) / scale
    records = Records(now.memory.rung, status, reward, collision, now.gains, after)
    following = _Now(after, now.memory, jnp.full_like(now.gains, jnp.nan), robot_rest, human_rest)
    return _Moved(following, Outcome(state, after, robot, observed, reward, robot_rest.plan)), records


def _still(game: Game, now: _Now) -> _Moved:
    """Return the outcome of the step before the first one, in which no car moved."""
    still = jnp.zeros((game.planner.horizon, 2))
    return _Moved(now, Outcome(now.state, now.state, still[0], still[0], jnp.zeros(()), JointPlan(still, still)))


def _choose(loop: Loop, before: _Now, own: _Own, decides: Bool[jax.Array, "chunk"], moved: _Moved) -> _Now:
    """Choose the rungs of the next step, where the rule decides."""

    def one(before: _Now, own: _Own, moved: _Moved) -> _Now:
        rule = replace(loop.rule, price=own.price)
        memory, gains, _ = decide_by(rule, _game(loop.game, own), before.memory, moved.outcome)
        return moved.now._replace(memory=memory, gains=jnp.asarray(gains))

    decided = jax.lax.cond(decides.any(), lambda: jax.vmap(one)(before, own, moved), lambda: moved.now)
    return jax.tree.map(
        lambda new, old: jnp.where(decides.reshape(-1, *[1] * (new.ndim - 1)), new, old), decided, moved.now
    )
