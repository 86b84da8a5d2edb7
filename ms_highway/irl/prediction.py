"""Predict recorded drivers by learned drivers, or by their peers.

Learned drivers have traits, which their past shows. All cars of a snapshot first drive
on together, in closed loop at 10 Hz, each for the reward of its own traits. Each
driver's modes, to keep its lane or to change to the left or right, are then predicted
among the others as they drove there. Predictors use nothing of the future.
"""

from functools import partial

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.data.learned_drivers import Drivers, LearnedDrivers
from ms_highway.game.scenario import TIME_STEP
from ms_highway.game.scene import Leader
from ms_highway.irl.driving import (
    lane_centre,
    leader_of,
    roll_out,
    seen_states,
    shown_traits,
)
from ms_highway.irl.mixture import SIDES, Mixture, Modes
from ms_highway.irl.peers import PEER_PREDICTORS, predict_peer
from ms_highway.irl.recording import CarFlags, Cars, CarStates
from ms_highway.irl.snapshots import SNAPSHOT, Snapshots
from ms_highway.planning.learned_driving import HELD_CONTROL
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import in_batches

PREDICTORS = {"model": "learned drivers", **PEER_PREDICTORS}
"""Names and labels of all predictors, the learned one first."""


def predict_with(
    name: str,
    snapshots: Snapshots,
    learned: LearnedDrivers | None,
) -> Mixture:
    """Predict the drivers of snapshots by one of `PREDICTORS`.

    Args:
        name: of the predictor.
        snapshots: to predict from.
        learned: the learned drivers, with the parameters and the spread of their peers.

    Raises:
        ValueError: for an unknown name, no drivers, or drivers without this peer.
    """
    if name not in PREDICTORS:
        raise ValueError(
            f"predictor is {name!r}; choose one of {', '.join(PREDICTORS)}"
        )
    if learned is None or name not in ("model", *learned.peers):
        raise ValueError(
            "this reward has nothing learned seconds ahead for the predictor"
            f" {name}; learn it from real recordings with `ms-highway irl fit`, or use"
            " us101, which comes with the package"
        )
    if name == "model":
        return Mixture(predict_drivers(snapshots, learned), learned.spread)
    peer = learned.peers[name]
    return Mixture(predict_peer(name, snapshots, peer.parameters), peer.spread)


def predict_drivers(snapshots: Snapshots, drivers: Drivers) -> Modes:
    """Predict the drivers of snapshots by learned drivers.

    They keep their lane, or change to the left or right.
    """
    of_all = in_batches(partial(_modes_of_all, drivers), snapshots)
    probability = snapshots.drivers(of_all.probability)
    path = snapshots.drivers(of_all.path)
    return Modes(probability, path)


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def _modes_of_all(drivers: Drivers, snapshot: Snapshots) -> Modes:
    """Return the modes of all cars."""
    # How likely each car keeps its lane, with the log odds 0, or changes.
    traits = shown_traits(drivers, snapshot)
    advantages, exist = lane_advantages(snapshot)
    biases = jnp.asarray(drivers.intention.biases)
    odds = biases + advantages @ jnp.asarray(drivers.intention.weights)
    odds = jnp.where(exist, odds, -jnp.inf)  # [cars, 2]
    keeping = jnp.zeros((len(odds), 1))
    log_odds = jnp.concatenate([keeping, odds], axis=1)  # [cars, modes]
    probability = jax.nn.softmax(log_odds, axis=1)

    # All cars drive together, each in its likeliest mode.
    sides = jnp.asarray(SIDES)
    now = seen_states(snapshot.past[-1])
    likeliest = sides[probability.argmax(axis=-1)]
    after = roll_out(drivers, snapshot, traits, likeliest)
    before = jnp.concatenate([now[None], after[:-1]])

    # Each car drives in each mode, among the others as they drove then.
    def in_mode(side: jax.Array) -> CarStates:
        sides_of_all = jnp.full(len(now), side)
        return roll_out(drivers, snapshot, traits, sides_of_all, before)

    states = jax.vmap(in_mode)(sides)  # [modes, steps, cars, 4]
    of_cars = jnp.moveaxis(states, 2, 0)  # [cars, modes, steps, 4]
    return Modes(probability, of_cars[..., :2])


def lane_advantages(
    snapshot: Snapshots,
) -> tuple[Float[Array, "cars 2 6"], Bool[Array, "cars 2"]]:
    """Return the advantages of the lanes beside [cars, 2, 6], and which exist.

    The lane to the left comes first. The advantages are those that
    `ms_highway.data.learned_drivers.Intention` weighs.
    """
    states = seen_states(snapshot.past[-1])
    centre = lane_centre(snapshot, 0)
    _, y, heading, speed = states.T
    own_leader = leader_of(snapshot, states, states, centre)
    drift, recent_drift = _drift(snapshot, heading, speed)

    def advantages(right: int) -> tuple[jax.Array, CarFlags]:
        """Return the advantages of the lane on one side, and whether it exists."""
        beside = lane_centre(snapshot, right)
        leader = leader_of(snapshot, states, states, beside)
        free_gap = HELD_CONTROL.free_gap
        gap = jnp.clip(leader.gap, 0.0, free_gap)
        own_gap = jnp.clip(own_leader.gap, 0.0, free_gap)
        offset = right * (y - centre) / snapshot.lane_width
        faster = _relative_speed(leader, speed) - _relative_speed(own_leader, speed)
        columns = [
            offset,
            right * drift,
            right * recent_drift,
            faster,
            (gap - own_gap) / 10,
            speed / 10,
        ]
        return jnp.stack(columns, axis=-1), beside != centre

    left, left_exists = advantages(-1)
    right, right_exists = advantages(1)
    both = jnp.stack([left, right], axis=1)
    exist = jnp.stack([left_exists, right_exists], axis=1)
    return both, exist


def _drift(snapshot: Snapshots, heading: Cars, speed: Cars) -> tuple[Cars, Cars]:
    """Return lateral speeds to the right, now and over the last second [m/s].

    The latter are by linear regression.
    """
    drift = speed * jnp.sin(heading)
    second = SNAPSHOT.steps_per_second
    times = TIME_STEP * (np.arange(second + 1) - second / 2)
    recent_y = snapshot.past[-second - 1 :, :, 1]
    slope = times @ recent_y / (times @ times)  # NaN for cars that were not seen
    recent_drift = jnp.where(jnp.isfinite(slope), slope, drift)
    return drift, recent_drift


def _relative_speed(leader: Leader, speed: Cars) -> Cars:
    """Return the speed of leaders relative to their followers, by nearness [m/s].

    Args:
        leader: of each car.
        speed: of each car [m/s].
    """
    nearness = 30.0  # m, gap at which the speed of a leader counts 1 / e as much
    gap = jnp.maximum(leader.gap, 0.0)
    weight = jnp.where(leader.there, jnp.exp(-gap / nearness), 0.0)
    return weight * (leader.speed - speed)
