"""Predict recorded drivers: by learned drivers, or by their peers, predictors of the
literature.

Learned drivers have traits, which their past shows. All cars of a snapshot first drive
on together, in closed loop at 10 Hz, each for the reward of its own traits. Each
driver's modes, to keep its lane or to change to the left or right, are then predicted
among the others as they drove there. Predictors use nothing of the future.

The peers are constant velocity and the Intelligent Driver Model (IDM). By IDM, all cars
of a snapshot drive on together and steer to the centre of their first lane, as
highway-env's vehicles do.
"""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
from jax import numpy as jnp
from msgspec import structs

from ms_highway.data.learned_drivers import (
    Drivers,
    FittedPeer,
    LearnedDrivers,
    NotNegative,
    Positive,
)
from ms_highway.game.car_following import HIGHWAY_ENV_IDM, IdmParameters
from ms_highway.game.dynamics import coast
from ms_highway.game.scenario import PAPER_DYNAMICS, TIME_STEP
from ms_highway.game.scene import Leader
from ms_highway.irl.driving import (
    STEPS_PER_SECOND,
    lane_centre,
    leader_of,
    roll_out,
    seen_states,
    shown_traits,
)
from ms_highway.irl.mixture import SIDES, Mixture, Modes, fit_spread
from ms_highway.irl.recording import CarFlags, Cars, CarStates
from ms_highway.irl.snapshots import AT, SCALES, STEPS, Snapshots
from ms_highway.numerics.estimation import Parameters, minimum
from ms_highway.planning.learned_driving import HELD_CONTROL
from ms_highway.runtime.arrays import Scalar, Structure, pytree, read
from ms_highway.runtime.compilation import in_batches, jit_quickly

# m, gap at which the speed of a leader counts 1 / e as much when lanes are compared
NEARNESS = 30.0
# m, half of a car's length, with which highway-env turns slip angles into yaw rates
AXLES = 2.5
SLIP = np.sin(np.arctan(np.tan(np.pi / 3) / 2))  # sine of the largest slip angle
SINE = np.sin(np.pi / 4)  # of the largest heading
EVALUATIONS = 50  # of the error of IDM, in a fit

PREDICTORS = {
    "model": "learned drivers",
    "constant_velocity": "constant velocity",
    "idm": "IDM of highway-env",
    "fitted_idm": "IDM, fitted",
}
"""Names and labels of all predictors, the learned one first."""


@pytree
class IdmPeer(Structure):
    """Parameters of the Intelligent Driver Model, and of its lane keeping.

    Attributes:
        speed: least desired speed [m/s]; cars that are faster at the start keep that
            speed as their desired one.
        headway: desired time headway [s].
        gap: desired gap at standstill [m], see `lengths`.
        acceleration: from standstill on a free road [m/s^2].
        braking: comfortable deceleration [m/s^2].
        settling: time constant with which the offset from the lane's centre decays [s].
        steering: time constant with which the heading follows [s].
        lengths: 1 if gaps are from bumper to bumper, 0 if they are from centre to
            centre.
        margin: how far beyond the lane's edge the centre of a leader may be [m].
    """

    speed: NotNegative
    headway: NotNegative
    gap: NotNegative
    acceleration: Positive
    braking: Positive
    settling: Positive
    steering: Positive
    lengths: NotNegative = 1.0
    margin: NotNegative = 0.0

    @property
    def following(self) -> IdmParameters:
        """How cars follow; without lengths, cars are points, whose bumpers are centres."""
        return IdmParameters(
            self.headway,
            self.gap,
            self.acceleration,
            self.braking,
            between="bumpers",
        )


HIGHWAY_ENV_PEER = IdmPeer(
    speed=0.0,
    headway=float(HIGHWAY_ENV_IDM.headway),
    gap=float(HIGHWAY_ENV_IDM.standstill),
    acceleration=float(HIGHWAY_ENV_IDM.max_acceleration),
    braking=float(HIGHWAY_ENV_IDM.comfortable_braking),
    settling=0.6,
    steering=0.2,
    lengths=0.0,
    margin=1.0,
)
"""Parameters of highway-env's IDMVehicle, whose desired speed is the one at the start.
"""

FIRST_PEER = IdmPeer(
    speed=20.0,
    headway=1.2,
    gap=2.0,
    acceleration=1.0,
    braking=2.0,
    settling=5.0,
    steering=0.5,
)
"""Parameters that a fit starts from."""


def predict_with(
    name: str, snapshots: Snapshots, learned: LearnedDrivers | None
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
        remedy = (
            "learn it from real recordings with `ms-highway irl fit`, or use us101,"
            " which comes with the package"
        )
        raise ValueError(
            f"this reward has nothing learned seconds ahead for the predictor {name};"
            f" {remedy}"
        )
    if name == "model":
        return Mixture(predict_drivers(snapshots, learned), learned.spread)
    peer = learned.peers[name]
    return Mixture(predict_peer(name, snapshots, peer.parameters), peer.spread)


def check_peers(learned: LearnedDrivers) -> None:
    """Check that all peers are there, with parameters that they can have.

    Raises:
        ValueError: naming the peer and the parameter.
    """
    for name in PREDICTORS:
        if name != "model" and name not in learned.peers:
            raise ValueError(
                f"drivers.peers lacks {name}; learn the reward again with `ms-highway"
                " irl fit`"
            )
    for name, peer in learned.peers.items():
        if peer.parameters:
            try:
                read(peer.parameters, IdmPeer)
            except ValueError as error:
                raise ValueError(f"drivers.peers.{name}.parameters: {error}") from error


def predict_peer(
    name: str, snapshots: Snapshots, parameters: dict[str, float]
) -> Modes:
    """Predict the drivers of snapshots by a peer: the path of each is its only mode.

    Args:
        name: of the peer.
        snapshots: to predict from.
        parameters: of IDM, by name; where there are none, highway-env's.
    """
    if name == "constant_velocity":
        motion = coast(PAPER_DYNAMICS, snapshots.drivers(snapshots.now), STEPS)
        path = jnp.stack([motion.x, motion.y], axis=-1)
    else:
        idm = read(parameters, IdmPeer) if parameters else HIGHWAY_ENV_PEER
        path = snapshots.drivers(
            np.moveaxis(np.asarray(_idm_paths(idm, snapshots)), 1, 2)
        )
    return Modes(jnp.ones((len(path), 1)), jnp.asarray(path)[:, None])


def fit_peers(snapshots: Snapshots) -> dict[str, FittedPeer]:
    """Fit the spread of every peer, by name, and the parameters of IDM that predict
    best, in closed loop.

    Minimises the mean of `robust_errors`, of all cars of a snapshot together, by L-BFGS
    over the logarithms of the parameters.
    """
    first = np.log(jax.tree.leaves(FIRST_PEER)[:7])
    data = jax.device_put(snapshots)
    best = np.exp(minimum(_mean_idm_error, first, data, maxfun=EVALUATIONS)).tolist()
    parameters: dict[str, dict] = {name: {} for name in PREDICTORS if name != "model"}
    parameters["fitted_idm"] = structs.asdict(IdmPeer(*best))
    return {
        name: FittedPeer(
            own, fit_spread(predict_peer(name, snapshots, own), snapshots.recorded)
        )
        for name, own in parameters.items()
    }


@jit_quickly
@jax.value_and_grad
def _mean_idm_error(logarithms: Parameters, snapshots: Snapshots) -> Scalar:
    paths = _idm_of_all(IdmPeer(*jnp.exp(logarithms)), snapshots)
    errors, known = robust_errors(paths, snapshots.future, snapshots.predicted[:, None])
    return jnp.sum(errors) / jnp.sum(known)


def robust_errors(
    paths: CarStates, future: CarStates, chosen: CarFlags
) -> tuple[CarStates, CarFlags]:
    """Return ``sqrt(1 + (error / scale)^2) - 1`` along and across the road after 1, 2,
    3 and 5 s, for fits.

    Args:
        paths: predicted positions after each step [*n, 50, cars, 2].
        future: recorded states after each step, see `Snapshots`.
        chosen: cars whose errors count [*n, 1, cars].

    Returns:
        The errors [*n, 4, cars, 2], 0 where they do not count; and whether they count
        [*n, 4, cars].
    """
    recorded = future[..., AT, :, :2]
    known = jnp.isfinite(recorded).all(axis=-1) & chosen
    errors = (
        jnp.where(
            known[..., None], paths[..., AT, :, :] - jnp.nan_to_num(recorded), 0.0
        )
        / SCALES[:, None]
    )
    return jnp.sqrt(1 + errors**2) - 1, known


@partial(jax.vmap, in_axes=(None, 0))
def _idm_of_all(parameters: IdmPeer, snapshot: Snapshots) -> CarStates:
    """Return the positions of all cars after each step [50, cars, 2]."""
    start = seen_states(snapshot.past[-1])
    lane = lane_centre(snapshot, 0)
    desired = jnp.clip(
        jnp.maximum(start[:, 3], parameters.speed), 0.01, snapshot.speed_limit
    )
    width = snapshot.lane_width + 2 * parameters.margin
    around = replace(
        snapshot, sizes=snapshot.sizes * parameters.lengths, lane_width=width
    )

    def go(state: CarStates, _: None) -> tuple[CarStates, CarStates]:
        x, y, heading, speed = state.T
        leader = leader_of(around, state, state, lane)
        gap = jnp.where(leader.there, leader.gap, jnp.inf)
        acceleration = parameters.following.acceleration(
            speed, desired, gap, leader.speed
        )
        moving = jnp.maximum(speed, 0.01)
        aim = jnp.arcsin(
            jnp.clip((lane - y) / (parameters.settling * moving), -SINE, SINE)
        )
        slip = jnp.arcsin(
            jnp.clip(
                AXLES / moving * ((aim - heading) / parameters.steering), -SLIP, SLIP
            )
        )
        distance = TIME_STEP * speed
        x = x + distance * jnp.cos(heading + slip)
        y = y + distance * jnp.sin(heading + slip)
        faster = jnp.maximum(speed + TIME_STEP * acceleration, 0.0)
        after = jnp.stack(
            [x, y, heading + distance * jnp.sin(slip) / AXLES, faster], axis=-1
        )
        return after, after[:, :2]

    return jax.lax.scan(go, start, None, length=STEPS)[1]


_idm_paths = jit_quickly(_idm_of_all)


def predict_drivers(snapshots: Snapshots, drivers: Drivers) -> Modes:
    """Predict the drivers of snapshots by learned drivers: they keep their lane, or
    change to the left or right.
    """
    modes = in_batches(partial(_modes_of_all, drivers), snapshots)
    return Modes(*map(snapshots.drivers, modes))


@jax.jit
@partial(jax.vmap, in_axes=(None, 0))
def _modes_of_all(drivers: Drivers, snapshot: Snapshots) -> Modes:
    """Return the modes of all cars."""
    traits, (advantages, exist) = (
        shown_traits(drivers, snapshot),
        lane_advantages(snapshot),
    )
    odds = jnp.asarray(drivers.intention.biases) + advantages @ jnp.asarray(
        drivers.intention.weights
    )
    odds = jnp.where(exist, odds, -jnp.inf)
    probability = jax.nn.softmax(
        jnp.concatenate([jnp.zeros((len(odds), 1)), odds], axis=1), axis=1
    )
    sides = jnp.asarray(SIDES)
    now = seen_states(snapshot.past[-1])
    after = roll_out(drivers, snapshot, traits, sides[probability.argmax(axis=-1)])
    around = jnp.concatenate([now[None], after[:-1]])
    paths = jax.vmap(
        lambda side: roll_out(
            drivers, snapshot, traits, jnp.full(len(now), side), around
        )
    )(sides)
    return Modes(probability, jnp.moveaxis(paths, 2, 0)[..., :2])


def lane_advantages(snapshot: Snapshots) -> tuple[CarStates, CarFlags]:
    """Return the advantages of the lanes to the left and right [cars, 2, 6], and
    whether these lanes exist.

    The advantages are those that `ms_highway.data.learned_drivers.Intention` weighs.
    """
    states = seen_states(snapshot.past[-1])
    centre = lane_centre(snapshot, 0)
    _, y, heading, speed = states.T
    drift = speed * jnp.sin(heading)
    times = TIME_STEP * (np.arange(STEPS_PER_SECOND + 1) - STEPS_PER_SECOND / 2)
    drifted = times @ snapshot.past[-STEPS_PER_SECOND - 1 :, :, 1] / (times @ times)
    drifted = jnp.where(jnp.isfinite(drifted), drifted, drift)
    own = leader_of(snapshot, states, states, centre)

    def relative_speed(leader: Leader) -> Cars:
        """Return the speed of leaders relative to their followers, weighed by their
        nearness [m/s].
        """
        near = jnp.where(
            leader.there, jnp.exp(-jnp.maximum(leader.gap, 0.0) / NEARNESS), 0.0
        )
        return near * (leader.speed - speed)

    def advantages(right: int) -> tuple[jax.Array, CarFlags]:
        beside = lane_centre(snapshot, right)
        other = leader_of(snapshot, states, states, beside)
        most = HELD_CONTROL.free_gap
        room = jnp.clip(other.gap, 0.0, most) - jnp.clip(own.gap, 0.0, most)
        sideways = [
            right * (y - centre) / snapshot.lane_width,
            right * drift,
            right * drifted,
        ]
        faster = relative_speed(other) - relative_speed(own)
        return (
            jnp.stack([*sideways, faster, room / 10, speed / 10], axis=-1),
            beside != centre,
        )

    found, exist = zip(*map(advantages, (-1, 1)), strict=True)
    return jnp.stack(found, axis=1), jnp.stack(exist, axis=1)
