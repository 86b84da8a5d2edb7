"""Differentiate a trajectory's reward twice in the controls.

Steps and responses follow from the Hessian.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias, TypeVar

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.runtime.arrays import (
    Controls,
    Matrix,
    Scalar,
    Trajectory,
    Vector,
)

Influence: TypeAlias = Literal["exact", "damped"]

Result = TypeVar("Result")  # a pytree of arrays


class Expansion(NamedTuple):
    """Expansion of a trajectory's reward to second order in its n ravelled controls.

    Attributes:
        gradient: of the reward in the controls.
        hessian: of the reward in the controls.
        jacobian: of the trajectory in the controls.
    """

    gradient: Vector
    hessian: Matrix
    jacobian: Float[jax.Array, "fields steps n"]


def trajectory_jacobian(
    path: Callable[[Controls], Trajectory],
    controls: Controls,
) -> Float[jax.Array, "fields steps n"]:
    """Return the derivative of a trajectory in its n ravelled controls."""
    return jax.jacfwd(lambda point: path(point.reshape(-1, 2)))(controls.ravel())


def second_order_expansion(
    path: Callable[[Controls], Trajectory],
    controls: Controls,
    slope: Trajectory,
    bends: Float[jax.Array, "fields fields steps"],
    cost: Callable[[Controls], Scalar],
    jacobian: Float[jax.Array, "fields steps n"] | None = None,
) -> Expansion:
    """Return gradient and Hessian in the controls of a sum over steps, less a cost.

    By the chain rule, with s_k the motion at step k, ``J_k = ds_k / du``, and g_k and
    Q_k the reward's gradient and Hessian at s_k::

        gradient = sum_k J_k^T g_k;  H = sum_k J_k^T Q_k J_k + sum_k g_k d2s_k / du2

    The expensive reward is differentiated twice in as many directions as a motion has
    fields, whatever the number of controls; only the cheap trajectory is differentiated
    in every control.

    Args:
        path: trajectory under the controls.
        controls: where to expand.
        slope: g of all steps.
        bends: Q of all steps.
        cost: of the controls themselves, a sum over them.
        jacobian: J; if it is given, the trajectory is taken as linear (Gauss-Newton),
            ``d2s_k / du2 = 0``.
    """

    def ravelled(controls: Vector) -> Trajectory:
        return path(controls.reshape(-1, 2))

    def pulled_back(controls: Vector) -> Vector:
        """Return ``sum_k J_k^T g_k`` at other controls, with the same g."""
        _, pull_back = jax.vjp(ravelled, controls)
        (gradient,) = pull_back(slope)
        return gradient

    point = controls.ravel()
    is_linear = jacobian is not None
    if jacobian is None:
        jacobian = trajectory_jacobian(path, controls)

    # The gradient, and the Hessian of the reward along a linear trajectory.
    flat = jacobian.reshape(-1, point.size)  # [fields * steps, n]
    bent = jnp.sum(bends[..., None] * jacobian, axis=1)  # one kernel, unlike an einsum
    gradient = slope.ravel() @ flat
    hessian = flat.T @ bent.reshape(-1, point.size)

    # The curvature of the trajectory itself.
    if not is_linear:
        hessian += jax.jacfwd(pulled_back)(point)

    # The cost: of a sum over controls, the derivative along all of them at once is the
    # diagonal of the Hessian.
    everywhere = jnp.ones_like(controls)
    marginal, diagonal = jax.jvp(jax.grad(cost), (controls,), (everywhere,))
    return Expansion(
        gradient - marginal.ravel(), hessian - jnp.diag(diagonal.ravel()), jacobian
    )


def along_fields(
    function: Callable[[jax.Array], Result],
    steps: jax.Array,
) -> tuple[Result, Result]:
    """Return a function of trajectories and its derivatives in each field.

    They have a first axis of fields. The value at each step may depend only on the
    fields at this step, so that one direction per field serves all steps.
    """
    fields = len(steps)
    unit = jnp.eye(fields).reshape(fields, fields, *[1] * (steps.ndim - 1))
    directions = jnp.broadcast_to(unit, (fields, *steps.shape))

    def along(direction: jax.Array) -> tuple[Result, Result]:
        return jax.jvp(function, (steps,), (direction,))

    return jax.vmap(along, out_axes=(None, 0))(directions)


def response(
    influence: Influence,
    hessian: Matrix,
    vector: Float[jax.Array, "n *columns"],
) -> Float[jax.Array, "n *columns"]:
    """Compute ``-H^-1 vector``, how an optimum moves if the gradient changes.

    H is the Hessian of a reward at its optimum, and ``vector`` the change of its
    gradient.

    * ``exact`` takes H as it is, like the paper and its released code. Before
      convergence, H may be indefinite or singular; the response is then arbitrary or
      not finite.
    * ``damped`` replaces H's eigenvalues l by ``-max(|l|, 1)``, so that every response
      ascends and is bounded.
    """
    if influence == "damped":
        return damped_inverse(hessian, 1.0) @ vector
    return -jnp.linalg.solve(hessian, vector)


def damped_inverse(hessian: Matrix, floor: float) -> Matrix:
    """Compute ``-H^-1`` with H's eigenvalues l replaced by ``-max(|l|, floor)``.

    It is positive definite, so that steps ascend.
    """
    values, vectors = jnp.linalg.eigh(hessian)
    return (vectors / jnp.maximum(jnp.abs(values), floor)) @ vectors.T


@jax.custom_jvp
def floored(
    symmetric: Float[jax.Array, "d d"],
    floor: Scalar,
) -> Float[jax.Array, "d d"]:
    """Return a symmetric matrix with its eigenvalues below a floor set to the floor.

    Its derivative is exact even at equal eigenvalues, where derivatives of eigenvectors
    are not finite: with divided differences F of max(., floor), ``d floored = V (F *
    (V^T dA V)) V^T``.
    """
    values, vectors = jnp.linalg.eigh(symmetric)
    return (vectors * jnp.maximum(values, floor)) @ vectors.T


@floored.defjvp
def _floored_jvp(
    primals: tuple[jax.Array, jax.Array],
    tangents: tuple[jax.Array, jax.Array],
) -> tuple[jax.Array, jax.Array]:
    symmetric, floor = primals
    change, floor_change = tangents
    values, vectors = jnp.linalg.eigh(symmetric)
    is_high = values > floor

    # Divided differences F_ij = (max(l_i, floor) - max(l_j, floor)) / (l_i - l_j): 1
    # for two high eigenvalues, 0 for two low ones, which may be equal. For one of each,
    # stand-ins for the other kind keep the division finite.
    high = jnp.where(is_high, values, floor)[:, None]
    low = jnp.where(is_high, floor - 1.0, values)[None, :]
    high_and_low = (high - floor) / (high - low)
    either = jnp.where(is_high[:, None], high_and_low, high_and_low.T)
    one_of_two = is_high[:, None] ^ is_high[None, :]
    both_high = is_high[:, None] & is_high[None, :]
    differences = jnp.where(one_of_two, either, both_high)

    # V (F * (V^T dA V)) V^T, and the change of the floor itself.
    turned = vectors.T @ change @ vectors
    by_matrix = vectors @ (differences * turned) @ vectors.T
    by_floor = floor_change * (vectors * ~is_high) @ vectors.T
    value = (vectors * jnp.maximum(values, floor)) @ vectors.T
    return value, by_matrix + by_floor
