"""Measure how close a car is to colliding: a smooth risk with derivatives by hand, and an indicator."""

from functools import partial

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.dynamics import Motion
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Array, Times, unrolled_reduce, unrolled_sum

CAR_SHARPNESS = 1.5
OBSTACLE_SHARPNESS = 4.0
OBSTACLE_SHARE = 0.5  # weight of an obstacle's risk relative to a car's
NEAR, CONTACT = 0.6, 0.3  # D - 1 at which the smooth indicator begins to rise, and the factor of its cube
CARS_AT_ONCE = 2  # XLA unrolls and vectorises loops over two cars, but not over three
CORNERS = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)], dtype=np.float32)
MIDDLES = np.array([(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5), (0, 0)], dtype=np.float32)  # of edges and of the body


def collision_risk(scene: Scene, own: Motion, others: Motion, smooth: bool = False) -> tuple[Times, Times]:
    """Return the risk of a collision, and its indicator: 1 where any point has D < 1, else 0.

    Nine points of the car's body (corners, middles of the edges, centre) are measured in the frame of every other car
    and obstacle by ``D = (2 dx / length)^2 + (2 dy / width)^2``; ``D < 1`` is the ellipse inscribed in its body::

        risk = sum over cars and points of exp(-1.5 (D - 1)) + sum over obstacles and points of exp(-4 (D - 1)) / 2

    The indicator has no gradient, and the risk none in the shape of cars. The smooth indicator is the sum over cars,
    obstacles and points of ``0.3 max(1.6 - D, 0)^3``, which begins to rise before bodies touch.

    Args:
        scene: obstacles and sizes of bodies.
        own: motion of the car, arrays [*times].
        others: motion of the other cars, arrays [others, *times].
        smooth: whether the indicator is smooth.
    """
    risk, collision = jnp.zeros_like(own.x), jnp.zeros_like(own.x, dtype=own.x.dtype if smooth else bool)
    terms = jax.lax.optimization_barrier(_body_terms(scene))

    def add(bodies: Motion, size: Float[Array, "2"], sharpness: float, share: float) -> None:
        nonlocal risk, collision
        distances = _distance_polynomials(own, bodies, size)
        risk += share * unrolled_sum(_closeness(distances, terms, sharpness), axis=0)
        if smooth:
            depth = jnp.maximum(NEAR - _evaluate(distances, terms), 0.0)
            collision += CONTACT * unrolled_sum(unrolled_sum(depth**3), axis=0)
            return
        inside: Bool[jax.Array, "bodies *times 9"] = _evaluate(jax.lax.stop_gradient(distances), terms) < 0
        collision |= unrolled_reduce(jnp.logical_or, unrolled_reduce(jnp.logical_or, inside), axis=0)

    for first in range(0, len(others.x), CARS_AT_ONCE):
        pair = Motion(*(field[first : first + CARS_AT_ONCE] for field in others))
        add(pair, scene.car_size, CAR_SHARPNESS, 1.0)
    if len(scene.obstacles):
        add(obstacles_as_bodies(scene, own.x.ndim), scene.obstacle_size, OBSTACLE_SHARPNESS, OBSTACLE_SHARE)
    return risk, collision.astype(risk.dtype)


def obstacles_as_bodies(scene: Scene, times: int) -> Motion:
    """Return the obstacles as standing bodies along x, arrays [obstacles, *ones] with so many axes for times."""
    x, y = jnp.moveaxis(jnp.asarray(scene.obstacles), -1, 0).reshape(2, -1, *[1] * times)
    zero = jnp.zeros_like(x)
    return Motion(x, y, zero + 1, zero, zero)


def body_points(scene: Scene) -> tuple[Float[jax.Array, "9"], Float[jax.Array, "9"]]:
    """Return x and y of corners, middles of the edges and centre of a car in its own frame [m]."""
    shares = jnp.concatenate([scene.corner * CORNERS, MIDDLES])
    x, y = (shares * jnp.asarray(scene.car_size)).T
    return x, y


def _body_terms(scene: Scene) -> Float[jax.Array, "6 9"]:
    """Return the terms 1, x, y, x^2, xy, y^2 at the points of a car's body."""
    x, y = body_points(scene)
    return jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y])


def _distance_polynomials(own: Motion, others: Motion, size: Float[Array, "2"]) -> Float[jax.Array, "6 others *times"]:
    """Expand D - 1 to every other body of a size as a polynomial in the point p of the own body.

    With the own rotation R, the offset d of the centres and the ellipse's matrix ``A = Q^T diag(4 / size^2) Q`` in the
    road's axes, ``D - 1 = (d + R p)^T A (d + R p) - 1``. Returns the coefficients of the terms of `_body_terms`.
    """
    shape = jnp.broadcast_shapes(others.x.shape, (1, *own.x.shape))
    x, y, cosine, sine = (jnp.broadcast_to(field, shape) for field in (own.x, own.y, own.cosine, own.sine))
    dx, dy = x - others.x, y - others.y
    along, across = 4 / size[0] ** 2, 4 / size[1] ** 2
    xx = others.cosine**2 * along + others.sine**2 * across
    xy = others.cosine * others.sine * (along - across)
    yy = others.sine**2 * along + others.cosine**2 * across
    ax, ay = xx * dx + xy * dy, xy * dx + yy * dy
    coefficients = [
        dx * ax + dy * ay - 1,
        2 * (cosine * ax + sine * ay),
        2 * (cosine * ay - sine * ax),
        cosine**2 * xx + 2 * cosine * sine * xy + sine**2 * yy,
        2 * ((cosine**2 - sine**2) * xy + cosine * sine * (yy - xx)),
        sine**2 * xx - 2 * cosine * sine * xy + cosine**2 * yy,
    ]
    return jax.lax.optimization_barrier(jnp.stack(coefficients))


def _evaluate(
    polynomials: Float[jax.Array, "6 *bodies"], terms: Float[jax.Array, "6 9"]
) -> Float[jax.Array, "*bodies 9"]:
    """Evaluate polynomials with the terms of `_body_terms` at the points of a body."""
    _, x, y, *_ = terms
    one, along, across, xx, xy, yy = jnp.unstack(polynomials[..., None])
    return one + x * (along + xx * x + xy * y) + y * (across + yy * y)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _closeness(
    distances: Float[jax.Array, "6 *bodies"], terms: Float[jax.Array, "6 9"], sharpness: float
) -> Float[jax.Array, "*bodies"]:
    """Sum ``E = exp(-sharpness (D - 1))`` over the points of a body.

    The derivative in the coefficients is ``-sharpness sum E t``, with the terms t at a point: six sums per body, see
    `_moments`. The points are constants: nothing is differentiated in them.
    """
    return unrolled_sum(jnp.exp(-sharpness * _evaluate(distances, terms)))


@_closeness.defjvp
def _closeness_jvp(
    sharpness: float, primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    closeness = _closeness(*primals, sharpness)
    return closeness, -sharpness * unrolled_sum(_moments(*primals, sharpness) * tangents[0], axis=0)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _moments(
    distances: Float[jax.Array, "6 *bodies"], terms: Float[jax.Array, "6 9"], sharpness: float
) -> Float[jax.Array, "6 *bodies"]:
    """Sum ``E t`` over the points of a body; the derivative takes the same sums of the changes of E."""
    return _weighted_sums(jnp.exp(-sharpness * _evaluate(distances, terms)), terms)


@_moments.defjvp
def _moments_jvp(
    sharpness: float, primals: tuple[jax.Array, ...], tangents: tuple[jax.Array, ...]
) -> tuple[jax.Array, jax.Array]:
    distances, terms = primals
    changes = jnp.exp(-sharpness * _evaluate(distances, terms)) * _evaluate(tangents[0], terms)
    return _moments(distances, terms, sharpness), -sharpness * _weighted_sums(changes, terms)


def _weighted_sums(
    summands: Float[jax.Array, "*bodies 9"], terms: Float[jax.Array, "6 9"]
) -> Float[jax.Array, "6 *bodies"]:
    """Sum over the points of a body, weighted by each of the terms."""
    return jnp.sum(summands * terms.reshape(6, *[1] * (summands.ndim - 1), 9), axis=-1)
