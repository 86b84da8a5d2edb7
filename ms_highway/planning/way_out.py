"""Keep a way out: a control is executed only if, after it, the robot can still escape from humans who do not yield.

Theory of mind counts on humans who answer; one who does not is hit. After a control, a way out is a simple manoeuvre,
braking or speeding up in this lane or another, that collides with nobody if all others keep their velocity: passive
safety against velocity-keepers, as in contingency planning.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.arrays import State
from ms_highway.game.collision_risk import collision_risk
from ms_highway.game.dynamics import Motion, coast, observe, step
from ms_highway.game.features import motion_reward
from ms_highway.game.game import Game
from ms_highway.optimization.arrays import Control
from ms_highway.planning.manoeuvres import manoeuvres
from ms_highway.runtime.arrays import Flag, Index, unrolled_sum

ESCAPE_STEPS = 25  # steps of an escape: 2.5 s at 0.1 s, a full stop from 20 m/s
MARGIN = 0.15  # m between bodies that is wanted, as others do not keep their velocity exactly


class Escape(NamedTuple):
    """What drives on.

    Attributes:
        control: scaled, the given one or the first of an escape.
        replaced: whether it is of an escape.
    """

    control: Control
    replaced: Flag


def keep_way_out(game: Game, state: State, control: Control) -> Escape:
    """Return the robot's control if it leaves as good a way out as any, else the first control of the best escape.

    A way out is better if it keeps `MARGIN` to all others than if it only does not collide. Of equally good escapes,
    that which earns most is the best. Where nothing is free of collisions, the control stays.

    Args:
        game: of the robot.
        state: all cars now.
        control: scaled, about to be executed.
    """
    after = step(game.dynamics, state[0], control * game.planner.control_scale)
    others = coast(game.dynamics, state[1:], ESCAPE_STEPS + 1)
    first, later, now = (_during(others, *steps) for steps in ((0, 1), (1, None), (0, -1)))
    clearance = jax.vmap(partial(_clearance, game), in_axes=(0, None))
    _, ways = manoeuvres(game, after, ESCAPE_STEPS)
    kept = jnp.minimum(clearance(ways, later).max(), _clearance(game, after[None], first))
    controls, escapes = manoeuvres(game, state[0], ESCAPE_STEPS)
    clear = clearance(escapes, now)
    earned = jax.vmap(lambda way: unrolled_sum(motion_reward(game.scene, game.robot, observe(way), now)))(escapes)
    best = jnp.argmax(jnp.where(clear == clear.max(), earned, -jnp.inf))
    replaced = clear.max() > kept
    return Escape(jnp.where(replaced, controls[best, 0], control), replaced)


def _during(others: Motion, first: int, last: int | None) -> Motion:
    """Return a part of a motion."""
    return Motion(*(field[:, first:last] for field in others))


def _clearance(game: Game, way: Float[jax.Array, "steps 4"], others: Motion) -> Index:
    """Return 2 if a car keeps the margin to all others and obstacles on its way, 1 if it collides with none, else 0."""
    scene, own = game.scene, observe(way)
    wider = replace(
        scene,
        car_size=jnp.asarray(scene.car_size) + MARGIN,
        obstacle_size=jnp.asarray(scene.obstacle_size) + MARGIN,
    )
    free = [~(collision_risk(checked, own, others)[1] > 0).any() for checked in (scene, wider)]
    return jnp.sum(jnp.stack(free))
