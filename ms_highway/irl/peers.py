"""Predict recorded drivers by peers of learned drivers, predictors of the literature.

The peers are constant velocity and the Intelligent Driver Model (IDM). By IDM, all cars
of a snapshot drive on together and steer to the centre of their first lane, as
highway-env's vehicles do.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import jax
import numpy as np
from jax import numpy as jnp
from msgspec import structs

from ms_highway.data.learned_drivers import (
    FittedPeer,
    LearnedDrivers,
    NotNegative,
    Positive,
)
from ms_highway.game.car_following import HIGHWAY_ENV_IDM, IdmParameters
from ms_highway.game.dynamics import coast
from ms_highway.game.scenario import PAPER_DYNAMICS, TIME_STEP
from ms_highway.irl.driving import lane_centre, leader_of, seen_states
from ms_highway.irl.horizons import robust_errors
from ms_highway.irl.mixture import Modes, fit_spread
from ms_highway.irl.recording import Cars, CarStates
from ms_highway.irl.snapshots import SNAPSHOT, Snapshots
from ms_highway.numerics.estimation import Parameters, minimum
from ms_highway.runtime.arrays import Scalar, Structure, pytree, read
from ms_highway.runtime.compilation import jit_quickly

PEER_PREDICTORS = {
    "constant_velocity": "constant velocity",
    "idm": "IDM of highway-env",
    "fitted_idm": "IDM, fitted",
}
"""Names and labels of all peers."""


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
        """How cars follow; without lengths, their bumpers are their centres."""
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


@dataclass(frozen=True)
class VehicleSteering:
    """Set how highway-env's vehicles steer."""

    slip_length: float = 2.5
    """Half of a car's length, with which slip angles turn into yaw rates [m]."""
    largest_heading: float = np.pi / 4
    """Largest heading relative to the lane [rad]."""
    largest_wheel_angle: float = np.pi / 3
    """Largest angle of the front wheels [rad]."""

    @property
    def largest_heading_sine(self) -> float:
        """Sine of the largest heading."""
        return np.sin(self.largest_heading)

    @property
    def largest_slip_sine(self) -> float:
        """Sine of the largest slip angle b, where ``tan b = tan(wheel angle) / 2``."""
        return np.sin(np.arctan(np.tan(self.largest_wheel_angle) / 2))


VEHICLE_STEERING = VehicleSteering()


def check_peers(learned: LearnedDrivers) -> None:
    """Check that all peers are there, with parameters that they can have.

    Raises:
        ValueError: naming the peer and the parameter.
    """
    for name in PEER_PREDICTORS:
        if name not in learned.peers:
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
    name: str,
    snapshots: Snapshots,
    parameters: Mapping[str, float],
) -> Modes:
    """Predict the drivers of snapshots by a peer: the path of each is its only mode.

    Args:
        name: of the peer.
        snapshots: to predict from.
        parameters: of IDM, by name; where there are none, highway-env's.
    """
    if name == "constant_velocity":
        now = snapshots.drivers(snapshots.now)
        motion = coast(PAPER_DYNAMICS, now, SNAPSHOT.future_steps)
        paths = jnp.stack([motion.x, motion.y], axis=-1)
    else:
        idm = read(parameters, IdmPeer) if parameters else HIGHWAY_ENV_PEER
        of_all = np.asarray(_idm_paths(idm, snapshots))  # [n, steps, cars, 2]
        paths = jnp.asarray(snapshots.drivers(np.moveaxis(of_all, 1, 2)))
    return Modes(jnp.ones((len(paths), 1)), paths[:, None])


def fit_peers(snapshots: Snapshots) -> dict[str, FittedPeer]:
    """Fit the spread of every peer, by name, and the parameters of IDM.

    The parameters minimise the mean of `robust_errors` of all cars of a snapshot that
    drive on together; by L-BFGS over their logarithms.
    """
    parameters: dict[str, dict[str, float]] = {name: {} for name in PEER_PREDICTORS}
    parameters["fitted_idm"] = structs.asdict(_fit_idm(snapshots))
    peers = {}
    for name, own in parameters.items():
        modes = predict_peer(name, snapshots, own)
        peers[name] = FittedPeer(own, fit_spread(modes, snapshots.recorded))
    return peers


def _fit_idm(snapshots: Snapshots) -> IdmPeer:
    """Return IDM with the parameters that predict best."""
    first = IdmPeer(
        speed=20.0,
        headway=1.2,
        gap=2.0,
        acceleration=1.0,
        braking=2.0,
        settling=5.0,
        steering=0.5,
    )
    fitted = 7  # of its parameters: all but the lengths and the margin
    evaluations = 50  # of the error, at most
    logarithms = minimum(
        _mean_idm_error,
        np.log(jax.tree.leaves(first)[:fitted]),
        jax.device_put(snapshots),
        maxfun=evaluations,
    )
    return IdmPeer(*np.exp(logarithms).tolist())


@jit_quickly
@jax.value_and_grad
def _mean_idm_error(logarithms: Parameters, snapshots: Snapshots) -> Scalar:
    """Return the mean of `robust_errors`, given the logarithms of IDM's parameters."""
    paths = _idm_of_all(IdmPeer(*jnp.exp(logarithms)), snapshots)
    counts = snapshots.predicted[:, None]
    errors, known = robust_errors(paths, snapshots.future, counts)
    return jnp.sum(errors) / jnp.sum(known)


@partial(jax.vmap, in_axes=(None, 0))
def _idm_of_all(parameters: IdmPeer, snapshot: Snapshots) -> CarStates:
    """Return the positions of all cars after each step [50, cars, 2]."""
    start = seen_states(snapshot.past[-1])
    lane = lane_centre(snapshot, 0)
    wanted_speed = jnp.maximum(start[:, 3], parameters.speed)
    desired_speed = jnp.clip(wanted_speed, 0.01, snapshot.speed_limit)
    width = snapshot.lane_width + 2 * parameters.margin
    sizes = snapshot.sizes * parameters.lengths
    around = replace(snapshot, sizes=sizes, lane_width=width)

    def drive(state: CarStates, _: None) -> tuple[CarStates, CarStates]:
        """Return the states after a step, and the positions."""
        x, y, heading, speed = state.T

        # Follow the car ahead.
        leader = leader_of(around, state, state, lane)
        gap = jnp.where(leader.there, leader.gap, jnp.inf)
        acceleration = parameters.following.acceleration(
            speed, desired_speed, gap, leader.speed
        )

        # highway-env's bicycle: the centre moves by the slip angle beside the heading.
        slip = _slip_angle(parameters, lane - y, heading, speed)
        distance = TIME_STEP * speed
        x_after = x + distance * jnp.cos(heading + slip)
        y_after = y + distance * jnp.sin(heading + slip)
        turned = distance * jnp.sin(slip) / VEHICLE_STEERING.slip_length
        heading_after = heading + turned
        speed_after = jnp.maximum(speed + TIME_STEP * acceleration, 0.0)
        after = jnp.stack([x_after, y_after, heading_after, speed_after], axis=-1)
        return after, after[:, :2]

    _, positions = jax.lax.scan(drive, start, None, length=SNAPSHOT.future_steps)
    return positions


_idm_paths = jit_quickly(_idm_of_all)


def _slip_angle(parameters: IdmPeer, offset: Cars, heading: Cars, speed: Cars) -> Cars:
    """Return the slip angles by which cars steer to the centre of their lane [rad].

    Args:
        parameters: of lane keeping.
        offset: of the lane's centre to the right of each car [m].
        heading: relative to the lane [rad].
        speed: [m/s].
    """
    moving = jnp.maximum(speed, 0.01)

    # The offset asks for a lateral speed, and so for a heading.
    sine = VEHICLE_STEERING.largest_heading_sine
    wanted_sine = offset / (parameters.settling * moving)
    wanted_heading = jnp.arcsin(jnp.clip(wanted_sine, -sine, sine))

    # The error of the heading asks for a yaw rate, and so for a slip angle.
    slip_sine = VEHICLE_STEERING.largest_slip_sine
    yaw_rate = (wanted_heading - heading) / parameters.steering
    wanted_slip_sine = VEHICLE_STEERING.slip_length / moving * yaw_rate
    return jnp.arcsin(jnp.clip(wanted_slip_sine, -slip_sine, slip_sine))
