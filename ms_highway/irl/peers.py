"""Predictors of the literature: constant velocity, and the Intelligent Driver Model (IDM).

Under IDM, cars steer to the centre of the lane that they are in at first, as highway-env's do.
"""

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.neighbours import leaders
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.mixture import Modes, one_mode
from ms_highway.irl.recording import CarFlags, CarStates, straight_on
from ms_highway.irl.snapshots import AT, SCALES, STEPS, Paths, Snapshots, lane_numbers
from ms_highway.numerics.estimation import Parameters, minimum
from ms_highway.planning.car_following import idm_acceleration
from ms_highway.runtime.arrays import Scalar
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.structures import Finite, Structure, pytree

AXLES = 2.5  # m, half the length from which highway-env steers
SLIP = np.sin(np.arctan(np.tan(np.pi / 3) / 2))  # of the largest slip angle, the sine
SINE = np.sin(np.pi / 4)  # of the largest heading
EVALUATIONS = 50


def predict_constant_velocity(snapshots: Snapshots) -> Modes:
    """Predict drivers that keep their speed and heading."""
    now = snapshots.drivers(snapshots.now)[:, None]
    return one_mode(straight_on(now, now[..., 3] * TIME_STEP * np.arange(1, STEPS + 1))[..., :2])


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


def predict_idm(snapshots: Snapshots, parameters: IdmParameters) -> Modes:
    """Simulate all cars of each snapshot by IDM in their present lanes; return the paths of the drivers."""
    return one_mode(snapshots.drivers(np.asarray(_compiled_positions(parameters, snapshots))))


def fit_idm(snapshots: Snapshots) -> IdmParameters:
    """Fit the parameters that predict best, in closed loop, all cars of a snapshot together.

    Minimises ``sqrt(1 + (error / scale)^2)`` of the positions along and across the road after 1, 2, 3 and 5 s, by
    L-BFGS over the logarithms of the parameters. This is the only use of the snapshots' future.
    """
    positions = np.moveaxis(snapshots.future[:, AT, :, :2], 1, 2)
    known = np.isfinite(positions).all(axis=-1) & snapshots.predicted[..., None]
    first = np.log(jax.tree.leaves(FIRST_IDM)[:7])
    data = jax.device_put((snapshots, np.nan_to_num(positions), known))
    return IdmParameters(*np.exp(minimum(_mean_idm_error, first, *data, maxfun=EVALUATIONS)).tolist())


@jit_quickly
@jax.value_and_grad
def _mean_idm_error(logarithms: Parameters, snapshots: Snapshots, positions: CarStates, known: CarFlags) -> Scalar:
    """Return the robust error, averaged over all known positions."""
    paths = _positions(IdmParameters(*jnp.exp(logarithms)), snapshots)[:, :, AT]
    off = jnp.where(known[..., None], paths - positions, 0.0) / jnp.array(SCALES)
    return jnp.sum(jnp.sqrt(1 + off**2) - 1) / jnp.sum(known)


def _positions(parameters: IdmParameters, snapshots: Snapshots) -> Paths:
    """Return the positions of all cars after each step [n, cars, 50, 2]."""
    start, length = jnp.nan_to_num(snapshots.now), snapshots.sizes[..., 0]
    present = jnp.isfinite(snapshots.now).all(axis=-1)[:, None]
    lane = jnp.take_along_axis(snapshots.lanes, lane_numbers(snapshots.lanes, start[..., 1]), axis=-1)
    reach = snapshots.lane_width[:, None, None] / 2 + parameters.margin
    desired = jnp.clip(jnp.maximum(start[..., 3], parameters.speed), 0.01, snapshots.speed_limit[:, None])

    def go(state: CarStates, _: None) -> tuple[CarStates, CarStates]:
        x, y, heading, speed = jnp.moveaxis(state, -1, 0)
        leader, follows = leaders(x, lane, state, present, reach)
        ahead = jnp.take_along_axis(state, leader[..., None], axis=1)
        lengths = (length + jnp.take_along_axis(length, leader, axis=1)) / 2
        acceleration = idm_acceleration(
            speed,
            desired,
            jnp.where(follows, ahead[..., 0] - x - parameters.lengths * lengths, jnp.inf),
            ahead[..., 3] * jnp.cos(ahead[..., 2] - heading),
            parameters.headway,
            parameters.gap,
            parameters.acceleration,
            parameters.braking,
        )

        moving = jnp.maximum(speed, 0.01)
        aim = jnp.arcsin(jnp.clip((lane - y) / (parameters.settling * moving), -SINE, SINE))
        slip = jnp.arcsin(jnp.clip(AXLES / moving * ((aim - heading) / parameters.steering), -SLIP, SLIP))
        moved = [
            x + TIME_STEP * speed * jnp.cos(heading + slip),
            y + TIME_STEP * speed * jnp.sin(heading + slip),
            heading + TIME_STEP * speed * jnp.sin(slip) / AXLES,
            jnp.maximum(speed + TIME_STEP * acceleration, 0.0),
        ]
        return jnp.stack(moved, axis=-1), jnp.stack(moved[:2], axis=-1)

    return jnp.moveaxis(jax.lax.scan(go, start, None, length=STEPS)[1], 0, 2)


_compiled_positions = jit_quickly(_positions)
