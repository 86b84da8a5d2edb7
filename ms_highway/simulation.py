"""The closed loop in pure JAX: human and robot plan, switching decides, the world moves; many episodes at once.

The pure functions are those that the environments call, so that both loops agree. Planning times are not measured here:
T(M) comes from a table.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.compiled import QUICKLY
from ms_highway.dynamics import Array, keep_velocity, recover_control, step
from ms_highway.game import Game, constant_velocity, swap
from ms_highway.human_models import HumanModel, Naive
from ms_highway.reward import features
from ms_highway.switching import Memory, Switching, decide, first_memory

__all__ = ["DECIDES", "Episodes", "Loop", "Records", "simulate"]

DECIDES = -1
"""In a schedule: Algorithm 1 chooses the rung of this step."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Loop:
    """What all episodes of a simulation have in common.

    Attributes:
        game: what is played.
        switching: ladder, costs, and the numbers of Algorithm 1; its price is each episode's own.
        chunk: episodes that are computed together (static). Each human model is computed only for the chunks that use
            it, so that smaller chunks compute less in vain, and larger ones make better use of wide hardware.
    """

    game: Game
    switching: Switching
    chunk: int = field(default=32, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episodes:
    """Where episodes differ.

    Attributes:
        starts: all cars at the start, robot first, then the human.
        prices: lambda, where Algorithm 1 decides.
        schedules: the rung that each step is planned with, or `DECIDES`.
        robot_weights, human_weights: of both rewards, in the order of their features.
    """

    starts: Float[Array, "episodes cars 4"]
    prices: Float[Array, "episodes"]
    schedules: Int[Array, "episodes steps"]
    robot_weights: Float[Array, "episodes features"]
    human_weights: Float[Array, "episodes features"]


class Records(NamedTuple):
    """What happened, a record per step, like those of `ms_highway.experiment.episode`.

    Attributes:
        rung: place in the ladder of the model that planned.
        reward: the robot's, after the step.
        collision: whether the robot collided in it.
        gain_up, gain_down: estimated before the step, NaN where none was.
        planned: whether the robot's plan was finite; where it was not, the robot kept its velocity.
        states: all cars after the step.
    """

    rung: Int[jax.Array, "episodes steps"]
    reward: Float[jax.Array, "episodes steps"]
    collision: Bool[jax.Array, "episodes steps"]
    gain_up: Float[jax.Array, "episodes steps"]
    gain_down: Float[jax.Array, "episodes steps"]
    planned: Bool[jax.Array, "episodes steps"]
    states: Float[jax.Array, "episodes steps cars 4"]


class _Now(NamedTuple):
    """What an episode carries from step to step."""

    state: Float[jax.Array, "cars 4"]
    memory: Memory
    gain_up: Float[jax.Array, ""]
    gain_down: Float[jax.Array, ""]


class _Own(NamedTuple):
    """An episode's own numbers."""

    price: Float[jax.Array, ""]
    robot_weights: Float[jax.Array, "features"]
    human_weights: Float[jax.Array, "features"]


@partial(jax.jit, compiler_options=QUICKLY)
def simulate(loop: Loop, episodes: Episodes) -> Records:
    """Run episodes, as many as a multiple of ``loop.chunk``, from start to end in one computation.

    In every step, episodes are put in the order of their rungs and computed chunk by chunk, so that most chunks need a
    single model: under `jax.vmap` alone, every episode would pay for every rung.
    """
    count = len(episodes.starts)
    own = _Own(episodes.prices, episodes.robot_weights, episodes.human_weights)
    memory = jax.tree.map(lambda part: jnp.broadcast_to(part, (count, *part.shape)), first_memory(loop.switching))
    none = jnp.full(count, jnp.nan, jnp.float32)
    start = _Now(jnp.asarray(episodes.starts, jnp.float32), memory, none, none)

    def one_step(now: _Now, scheduled: Int[jax.Array, "episodes"]) -> tuple[_Now, Records]:
        rungs = jnp.where(scheduled == DECIDES, now.memory.rung, scheduled)
        now = now._replace(memory=now.memory._replace(rung=rungs))
        order = jnp.argsort(rungs, stable=True)
        together = jax.tree.map(
            lambda part: part[order].reshape(-1, loop.chunk, *part.shape[1:]), (now, own, scheduled == DECIDES)
        )
        done = jax.lax.map(lambda chunk: _step(loop, *chunk), together)
        back = jnp.argsort(order)
        return jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:])[back], done)

    _, records = jax.lax.scan(one_step, start, jnp.asarray(episodes.schedules).T)
    return jax.tree.map(lambda part: jnp.swapaxes(part, 0, 1), records)


def _step(loop: Loop, now: _Now, own: _Own, decides: Bool[jax.Array, "chunk"]) -> tuple[_Now, Records]:
    """One step of a chunk of episodes."""
    rung, robot = now.memory.rung, _plan(loop, now, own)
    moved = jax.vmap(partial(_move, loop.game))(now.state, own, robot)
    chosen = _choose(loop, now, own, decides, moved)
    records = Records(rung, moved.reward, moved.collision, now.gain_up, now.gain_down, moved.planned, moved.state)
    return chosen._replace(state=moved.state), records


def _game(game: Game, own: _Own) -> Game:
    """The game of one episode."""
    robot, human = game.robot, game.human
    return replace(
        game, robot=replace(robot, weights=own.robot_weights), human=replace(human, weights=own.human_weights)
    )


def _plan(loop: Loop, now: _Now, own: _Own) -> Float[jax.Array, "chunk 2"]:
    """The robot's first scaled control in every episode; only the models that some episode uses are computed."""

    def first(model: HumanModel) -> Float[jax.Array, "chunk 2"]:
        return jax.vmap(lambda own, state: model.plan(_game(loop.game, own), state).robot[0])(own, now.state)

    none = jnp.zeros((loop.chunk, 2))
    chosen = none
    for place, model in enumerate(loop.switching.ladder):
        uses = now.memory.rung == place
        planned = jax.lax.cond(uses.any(), partial(first, model), lambda: none)
        chosen = jnp.where(uses[:, None], planned, chosen)
    return chosen


class _Moved(NamedTuple):
    """What a step came to."""

    state: Float[jax.Array, "cars 4"]
    robot: Float[jax.Array, "2"]  # scaled, as executed
    human: Float[jax.Array, "2"]  # scaled, as observed
    reward: Float[jax.Array, ""]
    collision: Bool[jax.Array, ""]
    planned: Bool[jax.Array, ""]


def _move(game: Game, state: Float[jax.Array, "cars 4"], own: _Own, robot: Float[jax.Array, "2"]) -> _Moved:
    """The human plans, the world moves, and the robot earns its reward."""
    game = _game(game, own)
    scale, planned = game.planner.control_scale, jnp.isfinite(robot).all()
    robot = jnp.where(planned, robot, constant_velocity(game, state[0])[0])
    human = Naive().plan(*swap(game, state)).robot[0]
    human = jnp.where(jnp.isfinite(human).all(), human, constant_velocity(game, state[1])[0])
    controls = jnp.concatenate([jnp.stack([robot, human]) * scale, keep_velocity(game.world, state[2:])])
    after = step(game.world, state, controls)
    phi = features(game.scene, game.robot, after)
    observed = recover_control(game.world, state[1], after[1]) / scale
    collision = phi[game.robot.names.index("collision")] > 0
    return _Moved(after, robot, observed, phi @ game.robot.weights, collision, planned)


def _choose(loop: Loop, now: _Now, own: _Own, decides: Bool[jax.Array, "chunk"], moved: _Moved) -> _Now:
    """The rungs of the next step, where Algorithm 1 decides about them."""

    def one(now: _Now, own: _Own, moved: _Moved) -> _Now:
        switching = replace(loop.switching, price=own.price)
        arguments = now.memory, now.state, moved.robot, moved.human, moved.reward
        decision = decide(switching, _game(loop.game, own), *arguments)
        return _Now(now.state, decision.memory, decision.gain_up, decision.gain_down)

    none = jnp.full(loop.chunk, jnp.nan, jnp.float32)
    kept = now._replace(gain_up=none, gain_down=none)
    decided = jax.lax.cond(decides.any(), lambda: jax.vmap(one)(now, own, moved), lambda: kept)
    return jax.tree.map(lambda new, old: jnp.where(decides.reshape(-1, *[1] * (new.ndim - 1)), new, old), decided, kept)
