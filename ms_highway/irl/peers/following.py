"""Predict drivers by the Intelligent Driver Model (IDM): highway-env's, or with fitted parameters.

Cars steer to the centre of the lane that they are in at first, as highway-env's do. The part of the desired gap that
depends on speeds is at least 0 (Treiber et al. 2000); highway-env squares a negative one, of who falls far behind.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int
from scipy import optimize

from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.errors import AT, SCALES
from ms_highway.irl.moments import STEPS, Moments, lanes_of
from ms_highway.irl.outlook import Modes
from ms_highway.runtime.compilation import jit_quickly

__all__ = ["FIRST_IDM", "HIGHWAY_ENV_IDM", "IdmParameters", "fit_idm", "idm"]

EXPONENT = 4.0  # of the speed
STRONGEST = 6.0  # m/s^2, acceleration
AXLES = 2.5  # m, half the length from which highway-env steers
SLIP = np.sin(np.arctan(np.tan(np.pi / 3) / 2))  # of the largest slip angle, the sine
SINE = np.sin(np.pi / 4)  # of the largest heading
EVALUATIONS = 50


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class IdmParameters:
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

    speed: float | Float[Any, ""]
    headway: float | Float[Any, ""]
    gap: float | Float[Any, ""]
    acceleration: float | Float[Any, ""]
    braking: float | Float[Any, ""]
    settling: float | Float[Any, ""]
    steering: float | Float[Any, ""]
    lengths: float = 1.0
    margin: float = 0.0


HIGHWAY_ENV_IDM = IdmParameters(0.0, 1.5, 10.0, 3.0, 5.0, 0.6, 0.2, lengths=0.0, margin=1.0)
"""As in IDMVehicle of highway-env, whose target is its first speed."""

FIRST_IDM = IdmParameters(20.0, 1.2, 2.0, 1.0, 2.0, 5.0, 0.5)
"""Parameters that a fit starts from."""


class _Scene(NamedTuple):
    """All cars of n moments.

    Attributes:
        start: state of every car, 0 where there is none.
        present: which cars there are.
        lane: lateral position of the centre of each car's lane [m].
        length: of each car [m].
        half_width: of the lanes [m].
        speed_limit: of the road [m/s].
    """

    start: Float[jax.Array, "n cars 4"]
    present: Bool[jax.Array, "n cars"]
    lane: Float[jax.Array, "n cars"]
    length: Float[jax.Array, "n cars"]
    half_width: Float[jax.Array, "n 1 1"]
    speed_limit: Float[jax.Array, "n 1"]


def idm(moments: Moments, parameters: IdmParameters) -> Modes:
    """Predict drivers who follow their leaders by IDM in their present lane, all cars of a moment together."""
    path = moments.drivers(np.asarray(_roll_out(parameters, _scene(moments))))
    return Modes(jnp.ones((len(path), 1)), jnp.asarray(path)[:, None])


def fit_idm(moments: Moments, evaluations: int = EVALUATIONS) -> IdmParameters:
    """Fit the parameters that predict best, in closed loop, all cars of a moment together.

    Minimises ``sqrt(1 + (error / scale)^2)`` of the positions along and across the road after 1, 2, 3 and 5 s, by
    L-BFGS over the logarithms of the parameters.

    Args:
        moments: to fit to; the only use of their future.
        evaluations: of the error, at most.
    """
    scene = _scene(moments)
    positions = np.moveaxis(np.asarray(moments.future)[:, AT, :, :2], 1, 2)
    known = jnp.asarray(np.isfinite(positions).all(axis=-1) & moments.predicted[..., None])
    targets = jnp.asarray(np.nan_to_num(positions))

    def value(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        error, slope = _error(logarithms, scene, targets, known)
        return float(error), np.asarray(slope, dtype=float)

    first = np.log(jax.tree.leaves(FIRST_IDM)[:7])
    found = optimize.minimize(value, first, jac=True, method="L-BFGS-B", options={"maxfun": evaluations})
    return IdmParameters(*map(float, np.exp(found.x)))


@jit_quickly
def _error(
    logarithms: Float[jax.Array, "7"],
    scene: _Scene,
    positions: Float[jax.Array, "n cars horizons 2"],
    known: Bool[jax.Array, "n cars horizons"],
) -> tuple[Float[jax.Array, ""], Float[jax.Array, "7"]]:
    """Return the robust error, averaged over all known positions, and its gradient."""

    def error(logarithms: jax.Array) -> jax.Array:
        paths = _rolled(IdmParameters(*jnp.exp(logarithms)), scene)[:, :, AT]
        off = jnp.where(known[..., None], paths - positions, 0.0) / jnp.array(SCALES)
        return jnp.sum(jnp.sqrt(1 + off**2) - 1) / jnp.sum(known)

    return jax.value_and_grad(error)(logarithms)


def _rolled(parameters: IdmParameters, scene: _Scene) -> Float[jax.Array, "n cars 50 2"]:
    """Return the positions of all cars after each step."""
    fast = scene.start[..., 3]
    desired = jnp.clip(jnp.maximum(fast, parameters.speed), 0.01, scene.speed_limit)

    def go(state: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        x, y, heading, speed = jnp.moveaxis(state, -1, 0)
        leader, follows = _leaders(parameters, scene, state)
        ahead = jnp.take_along_axis(state, leader[..., None], axis=1)
        length = (scene.length + jnp.take_along_axis(scene.length, leader, axis=1)) / 2
        distance = jnp.maximum(ahead[..., 0] - x - parameters.lengths * length, 0.01)
        closing = speed - ahead[..., 3] * jnp.cos(ahead[..., 2] - heading)
        comfortable = 2 * jnp.sqrt(parameters.acceleration * parameters.braking)
        gap = parameters.gap + jnp.maximum(speed * (parameters.headway + closing / comfortable), 0.0)
        interaction = jnp.where(follows, (gap / distance) ** 2, 0.0)
        acceleration = parameters.acceleration * (1 - (speed / desired) ** EXPONENT - interaction)
        acceleration = jnp.clip(acceleration, -STRONGEST, STRONGEST)

        moving = jnp.maximum(speed, 0.01)
        aim = jnp.arcsin(jnp.clip((scene.lane - y) / (parameters.settling * moving), -SINE, SINE))
        turn_rate = (aim - heading) / parameters.steering
        slip = jnp.arcsin(jnp.clip(AXLES / moving * turn_rate, -SLIP, SLIP))
        moved = [
            x + TIME_STEP * speed * jnp.cos(heading + slip),
            y + TIME_STEP * speed * jnp.sin(heading + slip),
            heading + TIME_STEP * speed * jnp.sin(slip) / AXLES,
            jnp.maximum(speed + TIME_STEP * acceleration, 0.0),
        ]
        return jnp.stack(moved, axis=-1), jnp.stack(moved[:2], axis=-1)

    return jnp.moveaxis(jax.lax.scan(go, scene.start, None, length=STEPS)[1], 0, 2)


_roll_out = jit_quickly(_rolled)


def _leaders(
    parameters: IdmParameters, scene: _Scene, state: Float[jax.Array, "n cars 4"]
) -> tuple[Int[jax.Array, "n cars"], Bool[jax.Array, "n cars"]]:
    """Return the nearest car ahead in each car's lane, and whether there is any."""
    ahead = state[:, None, :, 0] - state[:, :, None, 0]
    beside = jnp.abs(state[:, None, :, 1] - scene.lane[..., None]) <= scene.half_width + parameters.margin
    fits = (ahead > 0) & beside & scene.present[:, None, :]
    return jnp.argmin(jnp.where(fits, ahead, jnp.inf), axis=-1), jnp.any(fits, axis=-1)


def _scene(moments: Moments) -> _Scene:
    now, lanes = np.asarray(moments.now), np.asarray(moments.lanes)
    present = np.isfinite(now).all(axis=-1)
    start = np.nan_to_num(now)
    lane = np.take_along_axis(lanes, lanes_of(lanes, start[..., 1]), axis=-1)
    half_width = np.asarray(moments.lane_width)[:, None, None] / 2
    length = np.asarray(moments.sizes)[..., 0]
    return _Scene(*map(jnp.asarray, (start, present, lane, length, half_width, moments.speed_limit[:, None])))
