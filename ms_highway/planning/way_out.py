"""Keep a way out: execute a control only if it leaves as good an escape as now.

Theory of mind counts on humans who respond; it hits a human who does not. A way out is
a simple manoeuvre that the robot can drive after a control: brake, or speed up, in this
lane or another. It is free if it collides with nothing while all others keep their
velocity. This is passive safety against such cars, as in contingency planning.

`keep_way_out` compares two sets of ways over the same time. *Kept ways* begin with the
planned control and go on with a manoeuvre. *Escapes* are manoeuvres from now on. If an
escape stays free for longer than every kept way, the best escape replaces the control.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.car_following import CAR_LIMITS
from ms_highway.game.collision_risk import touches
from ms_highway.game.dynamics import Motion, coast, observe, step
from ms_highway.game.features import motion_reward
from ms_highway.game.game import Game
from ms_highway.game.scene import FAR_AWAY
from ms_highway.planning.manoeuvres import manoeuvres
from ms_highway.runtime.arrays import Car, Control, Controls, Flag, Scalar, State

Ways = Float[jax.Array, "ways steps 4"]


@dataclass(frozen=True)
class EscapeSettings:
    """Set how far and how hard ways out drive, and how free they have to be."""

    steps: int = 30
    """Steps of a way out: 3 s at 0.1 s, a full stop from 24 m/s, as robots drive faster
    than the limit.
    """
    steps_among_cars: int = 25
    """Steps in which other cars count: they do not keep their velocity for long."""
    accelerations: tuple[float, ...] = (
        -CAR_LIMITS.braking,
        -CAR_LIMITS.braking / 2,
        0.0,
        CAR_LIMITS.acceleration,
    )
    """Accelerations of the manoeuvres, each into each lane [m/s^2]."""
    clearance: float = 0.15
    """Gap between bodies of a clear way [m]: others do not keep their velocity exactly.
    """


ESCAPE = EscapeSettings()


class Escape(NamedTuple):
    """Controls to execute, an escape or the planned control.

    Attributes:
        controls: scaled, over the planner's horizon. If ``replaces``, those of the best
            escape, the last one repeated beyond its steps; otherwise the planned
            control, repeated.
        replaces: whether the escape replaces the planned control.
    """

    controls: Controls
    replaces: Flag


def keep_way_out(game: Game, state: State, control: Control) -> Escape:
    """Return the best escape if it beats every way out after the control.

    Otherwise return the control: it stays if a way out after it is as good as the
    escapes.

    The best escape is the manoeuvre that collides latest. Among manoeuvres that never
    collide, those that keep the clearance to cars and obstacles are better; among
    equals, the one that earns most is. Escapes are only searched for where no way out
    after the control keeps the clearance; under `jax.vmap`, they always are.

    Args:
        game: of the robot.
        state: all cars now.
        control: scaled, about to be executed.
    """
    others = _within_road(game, coast(game.dynamics, state[1:], ESCAPE.steps))
    counted = _among_cars(others, state[0])

    # How long the best way out after the control stays free.
    after = step(game.dynamics, state[0], control * game.planner.control_scale)
    freest_kept = _free_steps(game, _kept_ways(game, after), counted).max()

    def search() -> Escape:
        controls, ways = manoeuvres(game, state[0], ESCAPE.steps, ESCAPE.accelerations)
        free = _free_steps(game, ways, counted)
        earned = jax.vmap(lambda way: _earned(game, way, others))(ways)
        best = jnp.argmax(jnp.where(free == free.max(), earned, -jnp.inf))

        # A horizon that is longer than the escape repeats its last control.
        steps = np.minimum(np.arange(game.planner.horizon), ESCAPE.steps - 1)
        return Escape(controls[best][steps], free.max() > freest_kept)

    unchanged = Escape(
        jnp.tile(control, (game.planner.horizon, 1)), jnp.zeros((), bool)
    )
    is_clear = freest_kept > ESCAPE.steps  # no escape can be better
    return jax.lax.cond(is_clear, lambda: unchanged, search)


def _within_road(game: Game, others: Motion) -> Motion:
    """Stop motion off the road at its edge.

    A car that is beyond the edge after the first step stops there.
    """
    scene = game.scene
    lanes = jnp.asarray(scene.lanes)
    room = (scene.lane_width - jnp.asarray(scene.car_size)[1]) / 2
    first = others.y[..., :1]
    low = jnp.minimum(lanes.min() - room, first)
    high = jnp.maximum(lanes.max() + room, first)
    return others._replace(y=jnp.clip(others.y, low, high))


def _among_cars(others: Motion, robot: Car) -> Motion:
    """Put others far behind the robot in the last steps, where they do not count."""
    counts = np.arange(ESCAPE.steps) < ESCAPE.steps_among_cars
    return others._replace(x=jnp.where(counts, others.x, robot[0] - FAR_AWAY))


def _earned(game: Game, way: Float[jax.Array, "steps 4"], others: Motion) -> Scalar:
    """Return what the robot earns on a way, by the features of its motion."""
    return jnp.sum(motion_reward(game.scene, game.robot, observe(way), others))


def _kept_ways(game: Game, after: Car) -> Ways:
    """Return the ways that begin with the robot's control and end with a manoeuvre.

    Args:
        game: of the robot.
        after: state of the robot after its control, the first step of these ways.
    """
    _, later = manoeuvres(game, after, ESCAPE.steps, ESCAPE.accelerations)
    first = jnp.broadcast_to(after, later[:, :1].shape)
    return jnp.concatenate([first, later[:, :-1]], axis=1)


def _free_steps(game: Game, ways: Ways, others: Motion) -> Int[jax.Array, "ways"]:
    """Return for how many steps each way collides with nothing.

    A way that keeps the clearance to everything counts one step more.

    Args:
        game: of the robot.
        ways: states of the robot after each step.
        others: motion of all others, arrays [others, steps].
    """

    def count(way: Float[jax.Array, "steps 4"]) -> jax.Array:
        own = observe(way)
        is_free = ~touches(game.scene, own, others)
        is_clear = ~touches(game.scene, own, others, ESCAPE.clearance)
        until_collision = jnp.cumprod(is_free)
        return jnp.sum(until_collision) + is_clear.all()

    return jax.vmap(count)(ways)
