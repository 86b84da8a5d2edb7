"""Predict recorded drivers by name: by what was learned of them, or by the peers that this is compared with.

Learned drivers show their traits in the past. Nothing of the future is known, unless asked for: all cars of a snapshot
drive on together, each for the reward of its own traits, in closed loop at 10 Hz. What a driver does in each lane that
it may want is then predicted among the others as they drive there.
"""

from functools import partial
from typing import get_args

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float
from msgspec import structs

from ms_highway.game.learned_drivers import Drivers, FittedPeer, LearnedDrivers
from ms_highway.game.neighbours import Leader
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl import Others
from ms_highway.irl.mixture import SIDES, Mixture, Modes, fit_spread
from ms_highway.irl.peers import HIGHWAY_ENV_IDM, IdmParameters, fit_idm, predict_constant_velocity, predict_idm
from ms_highway.irl.recording import CarFlags, CarNumbers, Cars, CarStates, straight_on
from ms_highway.irl.snapshots import STEPS, Snapshots, lane_numbers
from ms_highway.planning.learned_driving import NOBODY, SECOND, leader_of, moved, seen_states, shown_traits
from ms_highway.runtime import retired
from ms_highway.runtime.compilation import in_batches
from ms_highway.runtime.structures import read

NEARNESS = 30.0  # m, by which a leader's speed counts less when lanes are compared

PEERS = {
    "constant_velocity": "constant velocity",
    "idm": "IDM of highway-env",
    "fitted_idm": "IDM, fitted",
}
"""Names and labels of the predictors of the literature."""

PREDICTORS = {"model": "learned drivers", **PEERS}
"""Names and labels of all predictors, the learned one first."""

REMEDY = "learn it from real recordings with `ms-highway irl fit`, or use us101, which comes with the package"

Traits = Float[jax.Array, "cars 3"]  # logarithms, as deviations from those of the medians


def predict_with(name: str, snapshots: Snapshots, learned: LearnedDrivers, others: Others = "predicted") -> Mixture:
    """Predict the drivers of snapshots by one of `PREDICTORS`.

    Args:
        name: of the predictor.
        snapshots: to predict from.
        learned: the drivers, and parameters and spread of the peers, see `check_drivers`.
        others: motion of the others around learned drivers, see `ms_highway.irl.Others`; peers predict all cars alone.

    Raises:
        ValueError: for an unknown name, or motion of the others.
    """
    if name not in PREDICTORS:
        gone = retired.replacement(retired.PREDICTORS, name)
        raise ValueError(gone or f"predictor is {name!r}; choose one of {', '.join(PREDICTORS)}")
    if name == "model":
        return Mixture(predict_drivers(snapshots, learned.bare, others), learned.spread)
    peer = learned.peers[name]
    return Mixture(_predict_peer(name, snapshots, peer.parameters), peer.spread)


def _predict_peer(name: str, snapshots: Snapshots, parameters: dict[str, float]) -> Modes:
    if name == "constant_velocity":
        return predict_constant_velocity(snapshots)
    return predict_idm(snapshots, IdmParameters(**parameters) if parameters else HIGHWAY_ENV_IDM)


def fit_peers(snapshots: Snapshots) -> dict[str, FittedPeer]:
    """Fit the parameters and the spread of every peer, by name, to be kept with learned drivers."""
    peers = {}
    for name in PEERS:
        parameters = structs.asdict(fit_idm(snapshots)) if name == "fitted_idm" else {}
        spread = fit_spread(_predict_peer(name, snapshots, parameters), snapshots.recorded)
        peers[name] = FittedPeer(parameters, spread)
    return peers


def check_drivers(drivers: LearnedDrivers | None, reward: str = "this reward") -> LearnedDrivers:
    """Return the drivers of a learned reward.

    Raises:
        ValueError: if it has none, or a peer or one of its parameters is missing.
    """
    if drivers is None:
        raise ValueError(f"{reward} has no drivers that were learned seconds ahead; {REMEDY}")
    if lacking := set(PEERS) - set(drivers.peers):
        raise ValueError(f"{reward} lacks the peers {', '.join(sorted(lacking))}; {REMEDY}")
    try:
        read(drivers.peers["fitted_idm"].parameters, IdmParameters)
    except ValueError as error:
        raise ValueError(f"the peer fitted_idm of {reward} is damaged: {error}; {REMEDY}") from error
    return drivers


def predict_drivers(snapshots: Snapshots, drivers: Drivers, others: Others = "predicted") -> Modes:
    """Predict the drivers of snapshots by what was learned: they keep their lane, or change to the left or right.

    Args:
        snapshots: whose future is read only if the others move as recorded.
        drivers: what was learned.
        others: motion of the other cars, see `ms_highway.irl.Others`.

    Raises:
        ValueError: if the motion of the others is unknown.
    """
    if others not in get_args(Others):
        raise ValueError(f"others are {others!r}; give one of {', '.join(get_args(Others))}")
    modes = in_batches(lambda some: _modes_of_all(drivers, some, others), snapshots)
    return Modes(*map(snapshots.drivers, modes))


@partial(jax.jit, static_argnums=2)
@partial(jax.vmap, in_axes=(None, 0, None))
def _modes_of_all(drivers: Drivers, snapshot: Snapshots, others: Others) -> Modes:
    """Return the modes of all cars."""
    traits, (advantages, exist) = shown_traits(drivers, snapshot, snapshot.past), lane_advantages(snapshot)
    odds = jnp.asarray(drivers.intention.biases) + advantages @ jnp.asarray(drivers.intention.weights)
    odds = jnp.where(exist, odds, -jnp.inf)
    chance = jax.nn.softmax(jnp.concatenate([jnp.zeros((len(odds), 1)), odds], axis=1), axis=1)
    sides = jnp.asarray(SIDES)
    around = _expected_traffic(drivers, snapshot, traits, sides[chance.argmax(axis=-1)], others)
    paths = jax.vmap(lambda side: roll_out(drivers, snapshot, traits, jnp.full(len(chance), side), around))(sides)
    return Modes(chance, jnp.moveaxis(paths, 2, 0)[..., :2])


def _expected_traffic(
    drivers: Drivers, snapshot: Snapshots, traits: Traits, side: CarNumbers, others: Others
) -> CarStates:
    """Return the states of all cars before each step [50, cars, 4], as the others are expected to move."""
    now = seen_states(snapshot.past[-1])
    if others == "recorded":
        return seen_states(jnp.concatenate([snapshot.past[-1:], snapshot.future[:-1]]))
    if others == "coasting":
        return straight_on(now, TIME_STEP * jnp.arange(STEPS)[:, None] * now[:, 3])
    after = roll_out(drivers, snapshot, traits, side)
    return jnp.concatenate([now[None], after[:-1]])


def roll_out(
    drivers: Drivers, snapshot: Snapshots, traits: Traits, side: CarNumbers, around: CarStates | None = None
) -> CarStates:
    """Let all cars of one snapshot drive for 5 s; return their states after each step [50, cars, 4].

    Args:
        drivers: what was learned.
        snapshot: the start.
        traits: see `shown_traits`.
        side: lanes to the right by which each changes lanes, -1, 0 or 1; who changes follows the leader there.
        around: states before each step [50, cars, 4] of the others that each car meets; by default, all drive together.
    """
    wanted = _lane_centre(snapshot, side)

    @jax.checkpoint  # whose memory gradients of 5 s would exhaust
    def go(now: CarStates, others: CarStates | None) -> tuple[CarStates, CarStates]:
        after, _ = moved(drivers, snapshot, traits, side, wanted, now, others)
        return after, after

    return jax.lax.scan(go, seen_states(snapshot.past[-1]), around, length=STEPS)[1]


def lane_advantages(snapshot: Snapshots) -> tuple[CarStates, CarFlags]:
    """Return the advantages of the lanes to the left and right [cars, 2, 6], and whether these lanes exist.

    The advantages are those that `ms_highway.game.learned_drivers.Intention` weighs.
    """
    states, centre = seen_states(snapshot.past[-1]), _lane_centre(snapshot, 0)
    _, y, heading, speed = states.T
    drift = speed * jnp.sin(heading)
    times = TIME_STEP * (np.arange(SECOND + 1) - SECOND / 2)
    drifted = times @ snapshot.past[-SECOND - 1 :, :, 1] / (times @ times)
    drifted = jnp.where(jnp.isfinite(drifted), drifted, drift)
    own = leader_of(snapshot, states, states, centre)

    def hurry(leader: Leader) -> Cars:
        """Return the speed of leaders relative to the followers, weighed by their nearness [m/s]."""
        near = jnp.where(leader.there, jnp.exp(-jnp.maximum(leader.gap, 0.0) / NEARNESS), 0.0)
        return near * (leader.speed - speed)

    def advantages(right: int) -> tuple[jax.Array, CarFlags]:
        beside = _lane_centre(snapshot, right)
        other = leader_of(snapshot, states, states, beside)
        room = jnp.clip(other.gap, 0.0, NOBODY) - jnp.clip(own.gap, 0.0, NOBODY)
        sideways = [right * (y - centre) / snapshot.lane_width, right * drift, right * drifted]
        return jnp.stack([*sideways, hurry(other) - hurry(own), room / 10, speed / 10], axis=-1), beside != centre

    found, exist = zip(*map(advantages, (-1, 1)), strict=True)
    return jnp.stack(found, axis=1), jnp.stack(exist, axis=1)


def _lane_centre(snapshot: Snapshots, side: int | CarNumbers) -> Cars:
    """Return the centre of the lane that is so many lanes to the right of each car's, or at the edge of the road."""
    lane = lane_numbers(snapshot.lanes, seen_states(snapshot.past[-1])[:, 1])
    return snapshot.lanes[jnp.clip(lane + side, 0, len(snapshot.lanes) - 1)]
