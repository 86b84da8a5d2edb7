"""Differentiate a trajectory's reward twice in the controls, and solve with Hessians.

Steps of an ascent and responses of humans follow from the Hessian.
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

    def path_of_ravelled(ravelled: Vector) -> Trajectory:
        return path(ravelled.reshape(-1, 2))

    return jax.jacfwd(path_of_ravelled)(controls.ravel())


def second_order_expansion(
    path: Callable[[Controls], Trajectory],
    controls: Controls,
    slope: Trajectory,
    hessians: Float[jax.Array, "fields fields steps"],
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
        hessians: Q of all steps.
        cost: of the controls themselves, a sum over them.
        jacobian: J; if it is given, the trajectory is taken as linear (Gauss-Newton),
            ``d2s_k / du2 = 0``.
    """

    def path_of_ravelled(ravelled: Vector) -> Trajectory:
        return path(ravelled.reshape(-1, 2))

    def pulled_back(ravelled: Vector) -> Vector:
        """Return ``sum_k J_k^T g_k`` at other controls, with the same g."""
        _, pull_back = jax.vjp(path_of_ravelled, ravelled)
        (gradient,) = pull_back(slope)
        return gradient

    point = controls.ravel()
    is_linear = jacobian is not None
    if jacobian is None:
        jacobian = trajectory_jacobian(path, controls)

    # sum_k J_k^T g_k
    rows = jacobian.reshape(-1, point.size)  # [fields * steps, n]
    products = hessians[..., None] * jacobian  # [fields, fields, steps, n]
    changes = jnp.sum(products, axis=1)  # Q_k J_k, one kernel, unlike an einsum
    gradient = slope.ravel() @ rows

    # sum_k J_k^T Q_k J_k, the Hessian along a linear trajectory
    hessian = rows.T @ changes.reshape(-1, point.size)

    # sum_k g_k d2s_k / du2, from the curvature of the trajectory itself
    if not is_linear:
        hessian += jax.jacfwd(pulled_back)(point)

    # The cost is a sum over controls, so that the change of its gradient along all of
    # them at once is the diagonal of its Hessian.
    everywhere = jnp.ones_like(controls)
    gradient_of_cost = jax.grad(cost)
    cost_gradient, diagonal = jax.jvp(gradient_of_cost, (controls,), (everywhere,))
    gradient = gradient - cost_gradient.ravel()
    hessian = hessian - jnp.diag(diagonal.ravel())
    return Expansion(gradient, hessian, jacobian)


def along_fields(
    function: Callable[[jax.Array], Result],
    steps: jax.Array,
) -> tuple[Result, Result]:
    """Return the value of a function at a trajectory, and its derivative in each field.

    Derivatives have a first axis of fields. The value at each step may depend only on
    the fields at this step, so that one direction per field serves all steps.

    Args:
        function: of a trajectory.
        steps: the trajectory, an array [fields, ...].
    """
    fields = len(steps)
    ones = [1] * (steps.ndim - 1)
    unit_vectors = jnp.eye(fields).reshape(fields, fields, *ones)
    directions = jnp.broadcast_to(unit_vectors, (fields, *steps.shape))

    def along(direction: jax.Array) -> tuple[Result, Result]:
        return jax.jvp(function, (steps,), (direction,))

    return jax.vmap(along, out_axes=(None, 0))(directions)


def minus_inverse_times(
    influence: Influence,
    hessian: Matrix,
    vector: Float[jax.Array, "n *columns"],
) -> Float[jax.Array, "n *columns"]:
    """Compute ``-H^-1 vector`` with the Hessian H of a reward.

    At an optimum, it is how the optimum moves if the gradient changes by the vector.

    * ``exact`` takes H as it is, like the paper and its released code. Before
      convergence, H may be indefinite or singular; the result is then arbitrary or not
      finite.
    * ``damped`` replaces H's eigenvalues l by ``-max(|l|, 1)``, so that every result
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
    magnitudes = jnp.maximum(jnp.abs(values), floor)
    return (vectors / magnitudes) @ vectors.T


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
    floored_values = jnp.maximum(values, floor)
    return (vectors * floored_values) @ vectors.T


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

    # V (F * (V^T dA V)) V^T
    turned = vectors.T @ change @ vectors
    by_matrix = vectors @ (differences * turned) @ vectors.T

    # The change of the floor itself moves the low eigenvalues.
    low_vectors = vectors * ~is_high
    by_floor = floor_change * low_vectors @ vectors.T

    floored_values = jnp.maximum(values, floor)
    value = (vectors * floored_values) @ vectors.T
    return value, by_matrix + by_floor
