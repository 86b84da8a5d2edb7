"""Keep a way out: a control is executed only if, after it, the robot can still escape from humans who do not yield.

Theory of mind counts on humans who answer; one who does not is hit. After a control, a way out is a simple manoeuvre,
braking or speeding up in this lane or another, that collides with nobody if all others keep their velocity: passive
safety against velocity-keepers, as in contingency planning.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.collision_risk import collision_risk
from ms_highway.game.crowd import along_others
from ms_highway.game.dynamics import Motion, coast, observe, step
from ms_highway.game.game import Game
from ms_highway.planning.manoeuvres import manoeuvres

__all__ = ["ESCAPE_STEPS", "Escape", "keep_way_out"]

ESCAPE_STEPS = 25  # steps of an escape: 2.5 s at 0.1 s, a full stop from 20 m/s
MARGIN = 1.25  # size of obstacles in these checks, relative to their own: cars stop short of them


class Escape(NamedTuple):
    """What drives on.

    Attributes:
        control: scaled, the given one or the first of an escape.
        replaced: whether it is of an escape.
    """

    control: Float[jax.Array, "2"]
    replaced: Bool[jax.Array, ""]


def keep_way_out(game: Game, state: Float[jax.Array, "cars 4"], control: Float[jax.Array, "2"]) -> Escape:
    """Return the robot's control if it leaves a way out, else the first of the escape that earns most.

    Where there is no escape either, the control stays: nothing better is known.

    Args:
        game: of the robot.
        state: all cars now.
        control: scaled, about to be executed.
    """
    after = step(game.dynamics, state[0], control * game.planner.control_scale)
    others = coast(game.dynamics, state[1:], ESCAPE_STEPS + 1)
    next_steps = Motion(*(field[:, 1:] for field in others))
    _, ways = manoeuvres(game, after, ESCAPE_STEPS)
    first = Motion(*(field[:, :1] for field in others))
    hits_now = _collides(game, after[None], first)
    free = ~jax.vmap(lambda way: _collides(game, way, next_steps))(ways) & ~hits_now
    controls, escapes = manoeuvres(game, state[0], ESCAPE_STEPS)
    now = Motion(*(field[:, :-1] for field in others))
    escaping = ~jax.vmap(lambda way: _collides(game, way, now))(escapes)
    paths = jnp.stack(now, axis=1)
    earned = jax.vmap(lambda way: along_others(game.scene, game.robot, jnp.stack(observe(way)), paths), in_axes=0)(
        escapes
    )
    best = jnp.argmax(jnp.where(escaping, earned, -jnp.inf))
    replaced = ~free.any() & escaping.any()
    return Escape(jnp.where(replaced, controls[best, 0], control), replaced)


def _collides(game: Game, way: Float[jax.Array, "steps 4"], others: Motion) -> Bool[jax.Array, ""]:
    """Return whether a car on its way collides with others, or leaves the road."""
    scene = game.scene
    wider = replace(scene, obstacle_size=MARGIN * jnp.asarray(scene.obstacle_size))
    _, collision = collision_risk(wider, observe(way), others)
    return (collision > 0).any()
