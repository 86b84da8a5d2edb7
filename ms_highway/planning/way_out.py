"""Keep a way out: execute a control only if the escapes after it are as good as those
from now.

Theory of mind counts on humans who respond; it hits a human who does not. A way out is
a simple manoeuvre after a control, braking or speeding up in this lane or another, that
collides with nothing if all others keep their velocity. It is passive safety against
cars that keep their velocity, as in contingency planning.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.collision_risk import touches
from ms_highway.game.dynamics import Motion, coast, observe, step
from ms_highway.game.features import motion_reward
from ms_highway.game.game import Game
from ms_highway.game.scene import FAR_AWAY
from ms_highway.planning.manoeuvres import manoeuvres
from ms_highway.runtime.arrays import Control, Controls, Flag, State

# steps of an escape: 3 s at 0.1 s, a full stop from 24 m/s, as robots drive faster than
# the limit
ESCAPE_STEPS = 30
STEPS_AMONG_CARS = (
    25  # of these, in which other cars count: they do not keep their velocity for long
)
ACCELERATIONS = np.array([-8.0, -4.0, 0.0, 4.0], np.float32)  # m/s^2, of the manoeuvres
CLEARANCE = (
    0.15  # m, wanted between bodies, as others do not keep their velocity exactly
)


class Escape(NamedTuple):
    """What to drive from a state.

    Attributes:
        controls: scaled, over the planner's horizon. If ``replaces``, those of the best
            escape, the last one repeated beyond `ESCAPE_STEPS`; otherwise the planned
            control, repeated.
        replaces: whether the first one replaces the planned control.
    """

    controls: Controls
    replaces: Flag


def keep_way_out(game: Game, state: State, control: Control) -> Escape:
    """Return the best escape if it is better than every way out after the robot's
    control, or else the control.

    The best escape is the manoeuvre that collides latest. Among manoeuvres that never
    collide, those that keep `CLEARANCE` to cars and obstacles are better; among equals,
    the one that earns most is. The control, followed by the best manoeuvre after it, is
    judged over the same `ESCAPE_STEPS` as the escapes, and stays if it is as good.
    Escapes are only searched for where no manoeuvre after the control keeps
    `CLEARANCE`; under `jax.vmap`, they always are.

    Args:
        game: of the robot.
        state: all cars now.
        control: scaled, about to be executed.
    """
    others = _within_road(game, coast(game.dynamics, state[1:], ESCAPE_STEPS))
    early = others._replace(
        x=jnp.where(
            np.arange(ESCAPE_STEPS) < STEPS_AMONG_CARS, others.x, state[0, 0] - FAR_AWAY
        )
    )
    after = step(game.dynamics, state[0], control * game.planner.control_scale)
    _, later = manoeuvres(game, after, ESCAPE_STEPS, ACCELERATIONS)
    # The control is the first step of the ways that keep it.
    kept = jnp.concatenate(
        [jnp.broadcast_to(after, later[:, :1].shape), later[:, :-1]], axis=1
    )
    best_kept = _steps_free(game, kept, early).max()

    def search() -> Escape:
        controls, escapes = manoeuvres(game, state[0], ESCAPE_STEPS, ACCELERATIONS)
        of_escapes = _steps_free(game, escapes, early)
        earned = jax.vmap(
            lambda way: jnp.sum(
                motion_reward(game.scene, game.robot, observe(way), others)
            )
        )(escapes)
        best = jnp.argmax(jnp.where(of_escapes == of_escapes.max(), earned, -jnp.inf))
        steps = np.minimum(np.arange(game.planner.horizon), ESCAPE_STEPS - 1)
        return Escape(controls[best][steps], of_escapes.max() > best_kept)

    unchanged = Escape(
        jnp.tile(control, (game.planner.horizon, 1)), jnp.zeros((), bool)
    )
    return jax.lax.cond(best_kept > ESCAPE_STEPS, lambda: unchanged, search)


def _within_road(game: Game, others: Motion) -> Motion:
    """Stop motion off the road: at its edge, or where a car beyond the edge is after a
    step.
    """
    scene = game.scene
    first = others.y[..., :1]
    lanes = jnp.asarray(scene.lanes)
    room = (scene.lane_width - jnp.asarray(scene.car_size)[1]) / 2
    low = jnp.minimum(lanes.min() - room, first)
    high = jnp.maximum(lanes.max() + room, first)
    return others._replace(y=jnp.clip(others.y, low, high))


def _steps_free(
    game: Game, ways: Float[jax.Array, "ways steps 4"], others: Motion
) -> Int[jax.Array, "ways"]:
    """Return the number of steps before a car collides on each way, one more if it
    keeps `CLEARANCE` to everything.
    """
    scene = game.scene

    def count(way: Float[jax.Array, "steps 4"]) -> jax.Array:
        own = observe(way)
        free = ~touches(scene, own, others)
        clear = ~touches(scene, own, others, CLEARANCE)
        return jnp.sum(jnp.cumprod(free)) + clear.all()

    return jax.vmap(count)(ways)
