"""Keep a way out: replace a control after which an escape would be worse than now.

A plan under theory of mind relies on humans who respond, and may hit one who does not.
So each control is checked before it is executed: this is a safety filter with fallback
manoeuvres over a finite horizon, as in fail-safe and contingency planning.

* A *fallback manoeuvre* holds an acceleration and steers to the middle of a lane.
* A *way* is the motion of the robot for 3 s. *Ways after the control* begin with the
  planned control and go on with a manoeuvre; *escapes* are manoeuvres from now on.
* Meanwhile, all others keep their velocity, but stay on the road. Other cars count for
  2.5 s, obstacles for 3 s.

`keep_way_out` ranks ways by how long they stay free of collisions; of those that never
collide, the ones with a clearance to everything rank highest. If an escape ranks higher
than every way after the control, the best escape replaces the control.
"""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

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
from ms_highway.runtime.arrays import Car, Control, Controls, Flag, State

Way: TypeAlias = Float[jax.Array, "steps 4"]
Ways: TypeAlias = Float[jax.Array, "ways steps 4"]


@dataclass(frozen=True)
class EscapeSettings:
    """Set how far and how hard ways drive, and how free they have to be."""

    steps: int = 30
    """Steps of a way. At 0.1 s, these are 3 s, in which 8 m/s^2 stop a robot from 24
    m/s; robots may drive faster than the limit of 20 m/s.
    """
    steps_with_cars: int = 25
    """Steps in which other cars count: they do not keep their velocity for long."""
    accelerations: tuple[float, ...] = (
        -CAR_LIMITS.braking,
        -CAR_LIMITS.braking / 2,
        0.0,
        CAR_LIMITS.acceleration,
    )
    """Accelerations of the manoeuvres, each into each lane [m/s^2]."""
    clearance: float = 0.15
    """Gap between bodies on ways of the highest rank [m]: others do not keep their
    velocity exactly. Each of two bodies is made longer and wider by half of it on every
    side.
    """


ESCAPE = EscapeSettings()


class Escape(NamedTuple):
    """The best escape, and whether it replaces the planned control.

    Attributes:
        controls: scaled, over the planner's horizon. They mean nothing unless the
            escape ``replaces`` the planned control.
        replaces: whether the escape replaces the planned control.
    """

    controls: Controls
    replaces: Flag


def keep_way_out(game: Game, state: State, control: Control) -> Escape:
    """Return the best escape; it replaces a control if it outranks all ways after it.

    Ways rank by the time of their first collision. Of ways that never collide, those
    that keep the clearance to cars and obstacles rank highest. Of escapes of the same
    rank, the one with the highest reward is the best. A control stays if a way after it
    ranks as high as the best escape: the filter interferes as little as it can.

    Escapes are searched for only where no way after the control has the highest rank;
    under `jax.vmap`, they are always computed, with the same result.

    Args:
        game: of the robot.
        state: all cars now.
        control: scaled, about to be executed.
    """
    coasting = coast(game.dynamics, state[1:], ESCAPE.steps)
    others = _within_road(game, coasting)
    others_in_time = _only_first_steps(others, state[0])

    # The best rank of a way after the control.
    unscaled = control * game.planner.control_scale
    after = step(game.dynamics, state[0], unscaled)
    ways_after = _ways_after(game, after)
    rank_after = _ranks(game, ways_after, others_in_time).max()

    def search() -> Escape:
        controls, escapes = manoeuvres(
            game, state[0], ESCAPE.steps, ESCAPE.accelerations
        )
        ranks = _ranks(game, escapes, others_in_time)

        # Rewards only break ties, so that they may count all others until the end.
        rewards = _total_rewards(game, escapes, others)
        is_highest = ranks == ranks.max()
        comparable = jnp.where(is_highest, rewards, -jnp.inf)
        best = jnp.argmax(comparable)

        # Cut the escape to the planner's horizon, or repeat its last control.
        steps = np.arange(game.planner.horizon)
        steps = np.minimum(steps, ESCAPE.steps - 1)
        best_controls = controls[best][steps]
        is_better = ranks.max() > rank_after
        return Escape(best_controls, is_better)

    placeholder = jnp.tile(control, (game.planner.horizon, 1))
    unchanged = Escape(placeholder, jnp.zeros((), bool))

    # ESCAPE.steps + 1 is the highest rank: no escape can be better.
    is_highest = rank_after > ESCAPE.steps
    return jax.lax.cond(is_highest, lambda: unchanged, search)


def _within_road(game: Game, others: Motion) -> Motion:
    """Keep the lateral positions of others on the road, as drivers do not leave it.

    A car that is beyond the edge after the first step goes no farther out.
    """
    scene = game.scene
    lanes = jnp.asarray(scene.lanes)
    car_width = jnp.asarray(scene.car_size)[1]
    room = (scene.lane_width - car_width) / 2  # beside a car in its lane
    first = others.y[..., :1]
    low = jnp.minimum(lanes.min() - room, first)
    high = jnp.maximum(lanes.max() + room, first)
    y = jnp.clip(others.y, low, high)
    return others._replace(y=y)


def _only_first_steps(others: Motion, robot: Car) -> Motion:
    """Let others count in the first steps only.

    After them, they are so far behind the robot that it cannot collide with them.
    """
    is_early = np.arange(ESCAPE.steps) < ESCAPE.steps_with_cars
    x = jnp.where(is_early, others.x, robot[0] - FAR_AWAY)
    return others._replace(x=x)


def _total_rewards(
    game: Game,
    ways: Ways,
    others: Motion,
) -> Float[jax.Array, "ways"]:
    """Return the robot's reward on each way, without that of its controls."""

    def total(way: Way) -> jax.Array:
        own = observe(way)
        rewards = motion_reward(game.scene, game.robot, own, others)
        return jnp.sum(rewards)

    return jax.vmap(total)(ways)


def _ways_after(game: Game, after: Car) -> Ways:
    """Return the ways that begin with the robot's control and go on with a manoeuvre.

    Args:
        game: of the robot.
        after: state of the robot after its control, the first step of these ways.
    """
    _, ways_from_there = manoeuvres(game, after, ESCAPE.steps, ESCAPE.accelerations)
    first = jnp.broadcast_to(after, ways_from_there[:, :1].shape)
    later = ways_from_there[:, :-1]
    return jnp.concatenate([first, later], axis=1)


def _ranks(game: Game, ways: Ways, others: Motion) -> Int[jax.Array, "ways"]:
    """Rank ways by their number of steps before the first collision.

    A way that keeps the clearance to everything in all steps ranks one higher.

    Args:
        game: of the robot.
        ways: states of the robot after each step.
        others: motion of all others, arrays [others, steps].
    """

    def rank(way: Way) -> jax.Array:
        own = observe(way)
        is_free = ~touches(game.scene, own, others)
        is_clear = ~touches(game.scene, own, others, ESCAPE.clearance)
        is_before_collision = jnp.cumprod(is_free)
        return jnp.sum(is_before_collision) + is_clear.all()

    return jax.vmap(rank)(ways)
