"""How a car moves: one step, a rollout of several, and the inverse of a step.

A car's state is ``(x, y, heading, speed)`` and its control ``(omega, acceleration)``. What a control does to the car
is told by two words:

* steering ``curvature``: omega is the curvature of the path [1/m], ``heading' = v omega`` (Sec. IV-A of the paper);
  ``yaw_rate``: omega is the yaw rate [rad/s], ``heading' = omega`` (the paper's released code).
* friction ``linear``: ``v' = a - drag v`` with drag in 1/s (Sec. IV-A); ``quadratic``: ``v' = a - drag v^2`` with drag
  in 1/m (the released code's world).

`step`, `keep_velocity` and `recover_control` take NumPy arrays as well as JAX arrays and answer in kind, so that
vehicles (float64, NumPy) and planners (float32, JAX) share the equations.
"""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

__all__ = [
    "Array",
    "Dynamics",
    "Motion",
    "SameArray",
    "coast",
    "keep_velocity",
    "observe",
    "recover_control",
    "rollout",
    "step",
]

Array: TypeAlias = jax.Array | np.ndarray
SameArray = TypeVar("SameArray", jax.Array, np.ndarray)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Dynamics:
    """A law of motion with its numbers.

    Attributes:
        steering: what omega is, ``curvature`` or ``yaw_rate`` (static).
        friction: how drag depends on speed, ``linear`` or ``quadratic`` (static).
        drag: coefficient of friction, in 1/s or 1/m.
        time_step: duration of one step [s].
    """

    steering: Literal["curvature", "yaw_rate"] = field(metadata={"static": True})
    friction: Literal["linear", "quadratic"] = field(metadata={"static": True})
    drag: float | Float[Array, ""]
    time_step: float | Float[Array, ""]


class Motion(NamedTuple):
    """What rewards look at: where cars are, where they point, how fast they are; arrays of one shape [*cars, *times].

    Attributes:
        x, y: position [m].
        cosine, sine: of the heading.
        speed: [m/s].
    """

    x: jax.Array
    y: jax.Array
    cosine: jax.Array
    sine: jax.Array
    speed: jax.Array


def observe(states: Float[Array, "*shape 4"]) -> Motion:
    """The motion, arrays [*shape], that an array of states describes."""
    x, y, heading, speed = jnp.moveaxis(jnp.asarray(states), -1, 0)
    return Motion(x, y, jnp.cos(heading), jnp.sin(heading), speed)


def _resistance(dynamics: Dynamics, speed: SameArray) -> SameArray:
    """Deceleration by friction [m/s^2]."""
    return (speed if dynamics.friction == "linear" else speed**2) * dynamics.drag


def step(
    dynamics: Dynamics, state: Float[SameArray, "*cars 4"], control: Float[SameArray, "*cars 2"]
) -> Float[SameArray, "*cars 4"]:
    """The state one time step later.

    With a' the acceleration less friction, ``d = v dt + a' dt^2 / 2``, and old values on the right-hand side::

        x += d cos(heading);  y += d sin(heading);  heading += yaw_rate dt;  v += a' dt
    """
    xp = state.__array_namespace__()
    heading, speed = state[..., 2], state[..., 3]
    yaw_rate = speed * control[..., 0] if dynamics.steering == "curvature" else control[..., 0]
    acceleration = control[..., 1] - _resistance(dynamics, speed)
    dt = dynamics.time_step
    distance = speed * dt + acceleration * dt**2 / 2
    return xp.stack(
        [
            state[..., 0] + distance * xp.cos(heading),
            state[..., 1] + distance * xp.sin(heading),
            heading + yaw_rate * dt,
            speed + acceleration * dt,
        ],
        axis=-1,
    )


def rollout(
    dynamics: Dynamics, state: Float[jax.Array, "*cars 4"], controls: Float[jax.Array, "*cars steps 2"]
) -> Motion:
    """The motion after each of a sequence of controls, arrays [*cars, steps] (the initial state is left out).

    The same as as many calls of `step`, but all steps at once: with linear friction, speeds are a weighted sum of the
    accelerations, ``v_k = (1 - drag dt)^k v_0 + dt sum_j (1 - drag dt)^(k-1-j) a_j``, and headings and positions are
    cumulative sums. A few array operations compile and run many times faster than a chain of small ones.

    Raises:
        ValueError: for quadratic friction, which has no such form.
    """
    if dynamics.friction != "linear":
        raise ValueError("a rollout needs linear friction; with quadratic friction, repeat `step`")
    dt, terms = dynamics.time_step, np.arange(controls.shape[-2] + 1)
    age = terms[:, None] - terms  # steps from each term of a sum to each state; below 0: not yet
    plain = jnp.asarray(age >= 0, dtype=controls.dtype)
    fading = plain * (1 - dynamics.drag * dt) ** np.maximum(age, 0)

    def accumulate(weights: Float[jax.Array, "states terms"], initial: jax.Array, changes: jax.Array) -> jax.Array:
        """An initial value and its sums with the changes so far; unlike a small matrix product, fused with the rest."""
        return jnp.sum(weights * jnp.concatenate([initial[..., None], changes], axis=-1)[..., None, :], axis=-1)

    speed = accumulate(fading, state[..., 3], controls[..., 1] * dt)
    before = speed[..., :-1]
    yaw_rate = before * controls[..., 0] if dynamics.steering == "curvature" else controls[..., 0]
    heading = accumulate(plain, state[..., 2], yaw_rate * dt)
    # The barrier keeps XLA from working out sines and cosines again wherever they are used.
    direction = jax.lax.optimization_barrier(jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-2))
    distance = before * dt + (controls[..., 1] - _resistance(dynamics, before)) * dt**2 / 2
    position = accumulate(plain[1:], state[..., :2], distance[..., None, :] * direction[..., :-1])
    x, y, cosine, sine = (pair[..., i, :] for pair in (position, direction[..., 1:]) for i in range(2))
    return Motion(x, y, cosine, sine, speed[..., 1:])


def coast(dynamics: Dynamics, state: Float[jax.Array, "*cars 4"], steps: int) -> Motion:
    """The motion over ``steps`` steps at constant velocity, arrays [*cars, steps] (the initial state is left out)."""
    now = Motion(*(field[..., None] for field in observe(state)))
    distance = now.speed * jnp.arange(1, steps + 1) * dynamics.time_step
    moved = now._replace(x=now.x + distance * now.cosine, y=now.y + distance * now.sine)
    return Motion(*jnp.broadcast_arrays(*moved))


def keep_velocity(dynamics: Dynamics, state: Float[SameArray, "*cars 4"]) -> Float[SameArray, "*cars 2"]:
    """The control that keeps speed and heading: it only makes up for friction."""
    xp = state.__array_namespace__()
    speed = state[..., 3]
    return xp.stack([xp.zeros_like(speed), _resistance(dynamics, speed)], axis=-1)


def recover_control(
    dynamics: Dynamics, state: Float[SameArray, "*cars 4"], next_state: Float[SameArray, "*cars 4"]
) -> Float[SameArray, "*cars 2"]:
    """The control that led from one state to the next: the inverse of `step`.

    A standing car does not turn, so its curvature is unobservable at speed 0 and reported as 0.
    """
    xp = state.__array_namespace__()
    speed = state[..., 3]
    yaw_rate = (next_state[..., 2] - state[..., 2]) / dynamics.time_step
    acceleration = (next_state[..., 3] - speed) / dynamics.time_step + _resistance(dynamics, speed)
    if dynamics.steering == "yaw_rate":
        return xp.stack([yaw_rate, acceleration], axis=-1)
    moving = speed != 0
    omega = xp.where(moving, yaw_rate / xp.where(moving, speed, 1.0), 0.0)
    return xp.stack([omega, acceleration], axis=-1)
