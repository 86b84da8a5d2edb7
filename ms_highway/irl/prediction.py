"""Predict recorded drivers by name: by what was learned of them, or by the literature's predictors, their peers.

Learned drivers show their traits in the past. Nothing of the future is known: all cars of a snapshot drive on together,
each for the reward of its own traits, in closed loop at 10 Hz. What a driver does in each lane that it may want is then
predicted among the others as they drive there.

The peers keep their velocity, or drive by the Intelligent Driver Model (IDM), all cars together, and steer to the
centre of the lane that they are in at first, as highway-env's do.
"""

from functools import partial

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float
from msgspec import structs

from ms_highway.game.learned_drivers import Drivers, FittedPeer, LearnedDrivers
from ms_highway.game.neighbours import Leader
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.mixture import SIDES, Mixture, Modes, fit_spread
from ms_highway.irl.recording import CarFlags, CarNumbers, Cars, CarStates, straight_on
from ms_highway.irl.snapshots import AT, SCALES, STEPS, Snapshots, lane_numbers
from ms_highway.numerics.estimation import Parameters, minimum
from ms_highway.planning.car_following import idm_acceleration
from ms_highway.planning.learned_driving import (
    FREE_GAP,
    STEPS_PER_SECOND,
    Surroundings,
    leader_of,
    moved,
    seen_states,
    shown_traits,
)
from ms_highway.runtime import retired
from ms_highway.runtime.arrays import Scalar
from ms_highway.runtime.compilation import in_batches, jit_quickly
from ms_highway.runtime.structures import Finite, Structure, pytree, read

NEARNESS = 30.0  # m, by which a leader's speed counts less when lanes are compared
AXLES = 2.5  # m, half the length from which highway-env steers
SLIP = np.sin(np.arctan(np.tan(np.pi / 3) / 2))  # of the largest slip angle, the sine
SINE = np.sin(np.pi / 4)  # of the largest heading
EVALUATIONS = 50  # of the error of IDM, in a fit

PREDICTORS = {
    "model": "learned drivers",
    "constant_velocity": "constant velocity",
    "idm": "IDM of highway-env",
    "fitted_idm": "IDM, fitted",
}
"""Names and labels of all predictors, the learned one first."""

Traits = Float[jax.Array, "cars 3"]  # logarithms, as deviations from those of the medians


@pytree
class IdmParameters(Structure):
    """Parameters of the Intelligent Driver Model, and of the lane keeping beside it.

    Attributes:
        speed: desired [m/s], or that at the start for who drives faster; 0: that at the start for all.
        headway: desired time headway [s].
        gap: desired at standstill, from bumper to bumper or from centre to centre, see `lengths` [m].
        acceleration: from standstill on a free road [m/s^2].
        braking: comfortable deceleration [m/s^2].
        settling: time constant with which the offset from the lane's centre decays [s].
        steering: time constant with which the heading follows [s].
        lengths: share of the cars' lengths that is subtracted from the distance of their centres: 1 or 0.
        margin: how far beyond the lane's edge the centre of a leader may be [m].
    """

    speed: Finite
    headway: Finite
    gap: Finite
    acceleration: Finite
    braking: Finite
    settling: Finite
    steering: Finite
    lengths: Finite = 1.0
    margin: Finite = 0.0


HIGHWAY_ENV_IDM = IdmParameters(0.0, 1.5, 10.0, 3.0, 5.0, 0.6, 0.2, lengths=0.0, margin=1.0)
"""As in IDMVehicle of highway-env, whose target is its first speed."""

FIRST_IDM = IdmParameters(20.0, 1.2, 2.0, 1.0, 2.0, 5.0, 0.5)
"""Parameters that a fit starts from."""


def predict_with(name: str, snapshots: Snapshots, learned: LearnedDrivers | None) -> Mixture:
    """Predict the drivers of snapshots by one of `PREDICTORS`.

    Args:
        name: of the predictor.
        snapshots: to predict from.
        learned: the drivers, and parameters and spread of the peers.

    Raises:
        ValueError: for an unknown name, no drivers, or drivers without this peer.
    """
    if name not in PREDICTORS:
        gone = retired.replacement(retired.PREDICTORS, name)
        raise ValueError(gone or f"predictor is {name!r}; choose one of {', '.join(PREDICTORS)}")
    if learned is None or name not in ("model", *learned.peers):
        remedy = "learn it from real recordings with `ms-highway irl fit`, or use us101, which comes with the package"
        raise ValueError(f"this reward has nothing learned seconds ahead for the predictor {name}; {remedy}")
    if name == "model":
        return Mixture(predict_drivers(snapshots, learned.bare), learned.spread)
    peer = learned.peers[name]
    return Mixture(predict_peer(name, snapshots, peer.parameters), peer.spread)


def predict_peer(name: str, snapshots: Snapshots, parameters: dict[str, float]) -> Modes:
    """Predict the drivers of snapshots by a peer: the path of each is its only mode.

    They keep their speed and heading, or all cars of a snapshot drive by IDM in their present lanes.

    Args:
        name: of the peer.
        snapshots: to predict from.
        parameters: of IDM, by name; highway-env's without any.
    """
    if name == "constant_velocity":
        now = snapshots.drivers(snapshots.now)[:, None]
        path = straight_on(now, now[..., 3] * TIME_STEP * np.arange(1, STEPS + 1))[..., :2]
    else:
        idm = read(parameters, IdmParameters) if parameters else HIGHWAY_ENV_IDM
        path = snapshots.drivers(np.moveaxis(np.asarray(_idm_paths(idm, snapshots)), 1, 2))
    return Modes(jnp.ones((len(path), 1)), jnp.asarray(path)[:, None])


def fit_peers(snapshots: Snapshots) -> dict[str, FittedPeer]:
    """Fit the parameters and the spread of every peer, by name, to be kept with learned drivers."""
    peers = {}
    for name in [*PREDICTORS][1:]:
        parameters = structs.asdict(fit_idm(snapshots)) if name == "fitted_idm" else {}
        spread = fit_spread(predict_peer(name, snapshots, parameters), snapshots.recorded)
        peers[name] = FittedPeer(parameters, spread)
    return peers


def fit_idm(snapshots: Snapshots) -> IdmParameters:
    """Fit the parameters that predict best, in closed loop, all cars of a snapshot together.

    Minimises ``sqrt(1 + (error / scale)^2)`` of the positions along and across the road after 1, 2, 3 and 5 s, by
    L-BFGS over the logarithms of the parameters. This is the only use of the snapshots' future.
    """
    first, data = np.log(jax.tree.leaves(FIRST_IDM)[:7]), jax.device_put(snapshots)
    return IdmParameters(*np.exp(minimum(_mean_idm_error, first, data, maxfun=EVALUATIONS)).tolist())


@jit_quickly
@jax.value_and_grad
def _mean_idm_error(logarithms: Parameters, snapshots: Snapshots) -> Scalar:
    """Return the robust error, averaged over all known positions."""
    recorded, paths = snapshots.future[:, AT, :, :2], _idm_of_all(IdmParameters(*jnp.exp(logarithms)), snapshots)
    known = jnp.isfinite(recorded).all(axis=-1) & snapshots.predicted[:, None]
    off = jnp.where(known[..., None], paths[:, AT] - jnp.nan_to_num(recorded), 0.0) / SCALES[:, None]
    return jnp.sum(jnp.sqrt(1 + off**2) - 1) / jnp.sum(known)


@partial(jax.vmap, in_axes=(None, 0))
def _idm_of_all(parameters: IdmParameters, snapshot: Snapshots) -> CarStates:
    """Return the positions of all cars after each step [50, cars, 2]."""
    start, lane = seen_states(snapshot.past[-1]), _lane_centre(snapshot, 0)
    desired = jnp.clip(jnp.maximum(start[:, 3], parameters.speed), 0.01, snapshot.speed_limit)
    width = snapshot.lane_width + 2 * parameters.margin
    around = Surroundings(snapshot.sizes * parameters.lengths, width, snapshot.speed_limit)

    def go(state: CarStates, _: None) -> tuple[CarStates, CarStates]:
        x, y, heading, speed = state.T
        leader = leader_of(around, state, state, lane)
        acceleration = idm_acceleration(
            speed,
            desired,
            jnp.where(leader.there, leader.gap, jnp.inf),
            leader.speed,
            parameters.headway,
            parameters.gap,
            parameters.acceleration,
            parameters.braking,
        )
        moving = jnp.maximum(speed, 0.01)
        aim = jnp.arcsin(jnp.clip((lane - y) / (parameters.settling * moving), -SINE, SINE))
        slip = jnp.arcsin(jnp.clip(AXLES / moving * ((aim - heading) / parameters.steering), -SLIP, SLIP))
        distance = TIME_STEP * speed
        x, y = x + distance * jnp.cos(heading + slip), y + distance * jnp.sin(heading + slip)
        faster = jnp.maximum(speed + TIME_STEP * acceleration, 0.0)
        return jnp.stack([x, y, heading + distance * jnp.sin(slip) / AXLES, faster], axis=-1), jnp.stack([x, y], -1)

    return jax.lax.scan(go, start, None, length=STEPS)[1]


_idm_paths = jit_quickly(_idm_of_all)


def predict_drivers(snapshots: Snapshots, drivers: Drivers) -> Modes:
    """Predict the drivers of snapshots by what was learned: they keep their lane, or change to the left or right."""
    modes = in_batches(lambda some: _modes_of_all(drivers, some), snapshots)
    return Modes(*map(snapshots.drivers, modes))


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def _modes_of_all(drivers: Drivers, snapshot: Snapshots) -> Modes:
    """Return the modes of all cars."""
    traits, (advantages, exist) = shown_traits(drivers, snapshot, snapshot.past), lane_advantages(snapshot)
    odds = jnp.asarray(drivers.intention.biases) + advantages @ jnp.asarray(drivers.intention.weights)
    odds = jnp.where(exist, odds, -jnp.inf)
    chance = jax.nn.softmax(jnp.concatenate([jnp.zeros((len(odds), 1)), odds], axis=1), axis=1)
    sides, now = jnp.asarray(SIDES), seen_states(snapshot.past[-1])
    after = roll_out(drivers, snapshot, traits, sides[chance.argmax(axis=-1)])
    around = jnp.concatenate([now[None], after[:-1]])
    paths = jax.vmap(lambda side: roll_out(drivers, snapshot, traits, jnp.full(len(chance), side), around))(sides)
    return Modes(chance, jnp.moveaxis(paths, 2, 0)[..., :2])


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
    times = TIME_STEP * (np.arange(STEPS_PER_SECOND + 1) - STEPS_PER_SECOND / 2)
    drifted = times @ snapshot.past[-STEPS_PER_SECOND - 1 :, :, 1] / (times @ times)
    drifted = jnp.where(jnp.isfinite(drifted), drifted, drift)
    own = leader_of(snapshot, states, states, centre)

    def hurry(leader: Leader) -> Cars:
        """Return the speed of leaders relative to the followers, weighed by their nearness [m/s]."""
        near = jnp.where(leader.there, jnp.exp(-jnp.maximum(leader.gap, 0.0) / NEARNESS), 0.0)
        return near * (leader.speed - speed)

    def advantages(right: int) -> tuple[jax.Array, CarFlags]:
        beside = _lane_centre(snapshot, right)
        other = leader_of(snapshot, states, states, beside)
        room = jnp.clip(other.gap, 0.0, FREE_GAP) - jnp.clip(own.gap, 0.0, FREE_GAP)
        sideways = [right * (y - centre) / snapshot.lane_width, right * drift, right * drifted]
        return jnp.stack([*sideways, hurry(other) - hurry(own), room / 10, speed / 10], axis=-1), beside != centre

    found, exist = zip(*map(advantages, (-1, 1)), strict=True)
    return jnp.stack(found, axis=1), jnp.stack(exist, axis=1)


def _lane_centre(snapshot: Snapshots, side: int | CarNumbers) -> Cars:
    """Return the centre of the lane that is so many lanes to the right of each car's, or at the edge of the road."""
    lane = lane_numbers(snapshot.lanes, seen_states(snapshot.past[-1])[:, 1])
    return snapshot.lanes[jnp.clip(lane + side, 0, len(snapshot.lanes) - 1)]
