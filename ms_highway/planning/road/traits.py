"""Estimate what drivers are like from how they follow: desired speed and time headway, by an extended Kalman filter.

The state of each car is ``x = (log v0, log T)``, the parameters of its Intelligent Driver Model. In each step its
acceleration a is observed, with noise of standard deviation `NOISE`::

    K = P h / (h' P h + NOISE^2),    x += K clip(a - IDM(x)),    P -= K h' P,    h = dIDM/dx

Innovations are clipped at `MOST_SURPRISING`, as tails are heavy: cars change lanes, and paths are guessed.
"""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.learned_reward import commuter_traits
from ms_highway.game.road import RoadScene, Traits
from ms_highway.planning.road.traffic import FAR, ROOM, follow, gaps_to_robot, on_route, ways_of
from ms_highway.runtime.arrays import Array

__all__ = [
    "Estimates",
    "followed",
    "jointly",
    "matched",
    "observed_accelerations",
    "prior",
    "traits_of",
    "updated_traits",
]

SHARE_OF_LIMIT = 0.75  # that drivers desire at least, by the prior
LEARNED = commuter_traits()  # of how drivers differ, on US-101
HEADWAY = LEARNED.median[1]  # s, median of the prior
SPREAD = tuple(LEARNED.deviations[:2])  # standard deviations of the logarithms of speed and headway in the prior
NOISE = 0.7  # m/s^2, of accelerations around the model
MOST_SURPRISING = 1.5  # m/s^2, up to which innovations count
DRIFT = (0.03, 0.02)  # of the logarithms in a step, standard deviation: drivers change
LOWEST, HIGHEST = (0.0, -1.2), (4.0, 1.4)  # logarithms of 1 m/s, 0.3 s and of 55 m/s, 4 s


class Estimates(NamedTuple):
    """Logarithms of desired speed and headway of the car on each path, normally distributed.

    Attributes:
        names: of the cars, see `ms_highway.game.road.RoadScene`.
        mean: [log m/s, log s].
        covariance: of them.
    """

    names: Int[Array, "traffic"]
    mean: Float[Array, "traffic 2"]
    covariance: Float[Array, "traffic 2 2"]


def prior(scene: RoadScene) -> Estimates:
    """Return what is assumed of cars that are seen for the first time."""
    speed = jnp.maximum(jnp.asarray(scene.states)[:, 3], SHARE_OF_LIMIT * jnp.asarray(scene.limits))
    mean = jnp.stack([jnp.log(speed), jnp.full_like(speed, np.log(HEADWAY))], axis=-1)
    covariance = jnp.broadcast_to(jnp.diag(jnp.square(jnp.asarray(SPREAD))), (len(speed), 2, 2))
    return Estimates(jnp.asarray(scene.names), mean, covariance)


def traits_of(estimates: Estimates) -> Traits:
    """Return the medians of desired speeds and headways."""
    return Traits(*jnp.moveaxis(jnp.exp(estimates.mean), -1, 0))


def updated_traits(estimates: Estimates, before: RoadScene, now: RoadScene, time_step: float) -> Estimates:
    """Return the estimates for the cars in sight now; new ones start at the prior, those out of sight are dropped.

    Args:
        estimates: for the cars in sight a step before.
        before: the road then.
        now: the road now.
        time_step: between the two [s].
    """
    place, found = matched(before.names, now.names)
    observed = observed_accelerations(before, now, place, time_step)
    mean, covariance = _learned(estimates, before, time_step, place, observed)
    learns = found & jnp.isfinite(observed)
    new = prior(now)
    kept = jnp.where(found[:, None], estimates.mean[place], new.mean)
    kept_covariance = jnp.where(found[:, None, None], estimates.covariance[place], new.covariance)
    return Estimates(
        new.names,
        jnp.clip(jnp.where(learns[:, None], mean, kept), jnp.asarray(LOWEST), jnp.asarray(HIGHEST)),
        jnp.where(learns[:, None, None], covariance, kept_covariance),
    )


def matched(
    before: Int[Array, "traffic"], now: Int[Array, "traffic"]
) -> tuple[Int[jax.Array, "traffic"], Bool[jax.Array, "traffic"]]:
    """Return the place that the car on each path had before, and whether it had any."""
    same = (jnp.asarray(now)[:, None] == jnp.asarray(before)) & (jnp.asarray(now)[:, None] >= 0)
    return jnp.argmax(same, axis=1), same.any(axis=1)


def observed_accelerations(
    before: RoadScene, now: RoadScene, place: Int[jax.Array, "traffic"], time_step: float
) -> Float[jax.Array, "traffic"]:
    """Return the accelerations between two looks at the road [m/s^2], NaN of obstacles; cars by their place before."""
    change = jnp.asarray(now.states)[:, 3] - jnp.asarray(before.states)[place, 3]
    return jnp.where(jnp.asarray(before.moving)[place] & now.moving, change / time_step, jnp.nan)


def followed(
    scene: RoadScene, traits: Traits, aside: Float[jax.Array, "positions"] | None = None
) -> Float[jax.Array, "traffic"]:
    """Return the accelerations of the Intelligent Driver Model now, on each path [m/s^2].

    Args:
        scene: the road.
        traits: of the drivers.
        aside: lateral positions of the robot for which others follow it as if it were there; by default its own [m].
    """
    speeds, leaders = jnp.asarray(scene.states)[:, 3], jnp.asarray(scene.leaders)
    robot, speed, headway = (jnp.asarray(field) for field in (scene.robot, *traits))
    where = on_route(ways_of(scene), jnp.asarray(scene.states)[:, 0], jnp.asarray(scene.states)[:, 1])
    gap = jnp.where((leaders >= 0) & scene.present, jnp.asarray(scene.gaps), FAR)
    apart = (scene.size[1] + jnp.asarray(scene.sizes)[:, 1]) / 2 + ROOM
    seen = robot[1:2] if aside is None else aside
    behind = jax.vmap(lambda d: gaps_to_robot(robot[0] + scene.size[0] / 2, d, where, apart))(seen).min(axis=0)
    return jnp.minimum(
        follow(speeds, speed, gap, speeds[leaders], headway), follow(speeds, speed, behind, robot[3], headway)
    )


def jointly(scene: RoadScene, each: Float[jax.Array, "traffic"], time_step: float) -> Float[jax.Array, "traffic"]:
    """Return the acceleration of the car on each path: the least on all of its paths, and never backwards."""
    same = jnp.asarray(scene.names)[:, None] == jnp.asarray(scene.names)
    return jnp.maximum(jnp.where(same, each, jnp.inf).min(axis=1), -jnp.asarray(scene.states)[:, 3] / time_step)


def _learned(
    estimates: Estimates,
    scene: RoadScene,
    time_step: float,
    place: Int[jax.Array, "traffic"],
    observed: Float[jax.Array, "traffic"],
) -> tuple[Float[jax.Array, "traffic 2"], Float[jax.Array, "traffic 2 2"]]:
    """Return means and covariances after an observed acceleration, of cars by their place before."""

    def predict(mean: Float[jax.Array, "traffic 2"]) -> Float[jax.Array, "traffic"]:
        return jointly(scene, followed(scene, Traits(*jnp.moveaxis(jnp.exp(mean), -1, 0))), time_step)

    mean, covariance = jnp.asarray(estimates.mean), jnp.asarray(estimates.covariance)
    together = jnp.eye(2)[:, None] * jnp.ones_like(mean)  # the paths of a car share its state
    predicted, slopes = jax.vmap(lambda push: jax.jvp(predict, (mean,), (push,)), out_axes=(0, -1))(together)
    predicted, slopes, mean, covariance = predicted[0][place], slopes[place], mean[place], covariance[place]
    spread = jnp.einsum("cij,cj->ci", covariance, slopes)
    gain = spread / (jnp.sum(spread * slopes, axis=-1, keepdims=True) + NOISE**2)
    surprise = jnp.clip(observed - predicted, -MOST_SURPRISING, MOST_SURPRISING)
    after = covariance - gain[:, :, None] * spread[:, None, :] + jnp.diag(jnp.square(jnp.asarray(DRIFT)))
    return mean + gain * surprise[:, None], after
