"""Keep a way out: execute a control only if the escapes after it are as good as those from now.

Theory of mind counts on humans who respond; it hits a human who does not. A way out is a simple manoeuvre after a
control, braking or speeding up in this lane or another, that collides with nothing if all others keep their velocity.
It is passive safety against cars that keep their velocity, as in contingency planning.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.collision_risk import touches
from ms_highway.game.dynamics import Motion, coast, observe, step
from ms_highway.game.features import motion_reward
from ms_highway.game.game import Game
from ms_highway.game.scene import FAR_AWAY
from ms_highway.planning.manoeuvres import manoeuvres
from ms_highway.runtime.arrays import Control, Controls, Flag, Index, State

ESCAPE_STEPS = 30  # steps of an escape: 3 s at 0.1 s, a full stop from 24 m/s, as robots drive faster than the limit
STEPS_AMONG_CARS = 25  # of these, in which other cars count: they do not keep their velocity for long
ACCELERATIONS = np.array([-8.0, -4.0, 0.0, 4.0], np.float32)  # m/s^2, of the manoeuvres
CLEARANCE = 0.15  # m, wanted between bodies, as others do not keep their velocity exactly


class Escape(NamedTuple):
    """The best escape from a state.

    Attributes:
        controls: scaled, over the planner's horizon; the last one is repeated beyond `ESCAPE_STEPS`.
        replaces: whether the first one replaces the planned control.
    """

    controls: Controls
    replaces: Flag


def keep_way_out(game: Game, state: State, control: Control) -> Escape:
    """Return the best escape, and whether it replaces the robot's control, after which no way out is as good.

    The best escape is the manoeuvre that collides latest. Among manoeuvres that never collide, those that keep
    `CLEARANCE` to cars and obstacles are better; among equals, the one that earns most is. The control, followed by the
    best manoeuvre after it, is judged over the same `ESCAPE_STEPS` as the escapes, and stays if it is as good.

    Args:
        game: of the robot.
        state: all cars now.
        control: scaled, about to be executed.
    """
    others = _within_road(game, coast(game.dynamics, state[1:], ESCAPE_STEPS))
    early = others._replace(x=jnp.where(np.arange(ESCAPE_STEPS) < STEPS_AMONG_CARS, others.x, state[0, 0] - FAR_AWAY))
    after = step(game.dynamics, state[0], control * game.planner.control_scale)
    drive = jax.vmap(lambda car: manoeuvres(game, car, ESCAPE_STEPS, ACCELERATIONS))
    (controls, _), (escapes, later) = drive(jnp.stack([state[0], after]))
    # The control is the first step of the ways that keep it.
    kept = jnp.concatenate([jnp.broadcast_to(after, later[:, :1].shape), later[:, :-1]], axis=1)
    clearance = jax.vmap(lambda way: _clearance(game, way, early))(jnp.concatenate([escapes, kept]))
    of_escapes, of_kept = jnp.split(clearance, 2)
    earned = jax.vmap(lambda way: jnp.sum(motion_reward(game.scene, game.robot, observe(way), others)))(escapes)
    best = jnp.argmax(jnp.where(of_escapes == of_escapes.max(), earned, -jnp.inf))
    steps = np.minimum(np.arange(game.planner.horizon), ESCAPE_STEPS - 1)
    return Escape(controls[best][steps], of_escapes.max() > of_kept.max())


def _within_road(game: Game, others: Motion) -> Motion:
    """Stop motion off the road: at its edge, or where a car beyond the edge is after a step."""
    scene, first = game.scene, others.y[..., :1]
    lanes, room = jnp.asarray(scene.lanes), (scene.lane_width - jnp.asarray(scene.car_size)[1]) / 2
    low, high = jnp.minimum(lanes.min() - room, first), jnp.maximum(lanes.max() + room, first)
    return others._replace(y=jnp.clip(others.y, low, high))


def _clearance(game: Game, way: Float[jax.Array, "steps 4"], others: Motion) -> Index:
    """Return the number of steps before a car collides on its way, one more if it keeps `CLEARANCE` to everything."""
    scene, own = game.scene, observe(way)
    wider = replace(
        scene,
        car_size=jnp.asarray(scene.car_size) + CLEARANCE,
        obstacle_size=jnp.asarray(scene.obstacle_size) + CLEARANCE,
    )
    free, clear = (~touches(checked, own, others) for checked in (scene, wider))
    return jnp.sum(jnp.cumprod(free)) + clear.all()
