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

from ms_highway.game.learned_reward import commuter_traits
from ms_highway.game.road import Flags, Places, RoadScene, Traffic, Traits
from ms_highway.optimization.kalman import Gaussian, updated
from ms_highway.optimization.second_derivatives import by_fields
from ms_highway.planning.road.traffic import follow_all, on_route, ways_of
from ms_highway.runtime.arrays import Numbers, Scalar

SHARE_OF_LIMIT = 0.75  # that drivers desire at least, by the prior
LEARNED = commuter_traits()  # of how drivers differ, on US-101
HEADWAY = LEARNED.median[1]  # s, median of the prior
SPREAD = np.diag(np.square(LEARNED.deviations[:2]))[..., None]  # covariance of the logarithms of speed and headway
NOISE = 0.7  # m/s^2, of accelerations around the model
MOST_SURPRISING = 1.5  # m/s^2, up to which innovations count
DRIFT = np.diag([0.03**2, 0.02**2])[..., None]  # covariance of their changes in a step: drivers change
LOWEST, HIGHEST = np.array([[[0.0], [-1.2]], [[4.0], [1.4]]])  # logarithms of 1 m/s, 0.3 s and of 55 m/s, 4 s


class Observed(NamedTuple):
    """What a step has shown of the car on each path.

    Attributes:
        place: path that it had a step before.
        found: whether it had any.
        accelerations: in the step [m/s^2], NaN of obstacles.
    """

    place: Places
    found: Flags
    accelerations: Traffic


def observed_step(before: RoadScene, now: RoadScene, time_step: Scalar) -> Observed:
    """Find cars again, and what they have done."""
    same = (jnp.asarray(now.names)[:, None] == before.names) & (now.names[:, None] >= 0)
    place = jnp.argmax(same, axis=1)
    change = now.states[:, 3] - jnp.asarray(before.states)[place, 3]
    moving = jnp.asarray(before.moving)[place] & now.moving
    return Observed(place, same.any(axis=1), jnp.where(moving, change / time_step, jnp.nan))


def prior(scene: RoadScene) -> Gaussian:
    """Return what is assumed of cars that are seen for the first time: of the logarithms of speed and headway."""
    speed = jnp.maximum(scene.states[:, 3], SHARE_OF_LIMIT * scene.limits)
    mean = jnp.stack([jnp.log(speed), jnp.full_like(speed, np.log(HEADWAY))])
    return Gaussian(mean, jnp.broadcast_to(SPREAD, (2, 2, len(speed))))


def traits_of(mean: Numbers) -> Traits:
    """Return the medians of desired speeds and headways."""
    return Traits(*jnp.exp(mean))


def updated_traits(estimates: Gaussian, before: RoadScene, now: RoadScene, time_step: Scalar) -> Gaussian:
    """Return the estimates for the cars in sight now; new ones start at the prior, those out of sight are dropped.

    Args:
        estimates: for the cars in sight a step before.
        before: the road then.
        now: the road now.
        time_step: between the two [s].
    """
    place, found, observed = observed_step(before, now, time_step)

    def predict(mean: Numbers) -> Traffic:
        return jointly(before, followed(before, traits_of(mean)), time_step)

    slopes = by_fields(predict, estimates.mean)[:, place]  # the paths of a car share its state
    surprise = jnp.clip(observed - predict(estimates.mean)[place], -MOST_SURPRISING, MOST_SURPRISING)
    old = jax.tree.map(lambda field: field[..., place], estimates)
    (mean, covariance), _ = updated(old, slopes, surprise, NOISE**2)
    learned = Gaussian(mean, covariance + DRIFT)

    def known(learned: Numbers, old: Numbers, new: Numbers) -> Numbers:
        return jnp.where(found, jnp.where(jnp.isfinite(observed), learned, old), new)

    mean, covariance = jax.tree.map(known, learned, old, prior(now))
    return Gaussian(jnp.clip(mean, LOWEST, HIGHEST), covariance)


def followed(scene: RoadScene, traits: Traits, aside: Numbers | None = None) -> Traffic:
    """Return the accelerations of the Intelligent Driver Model now, on each path [m/s^2].

    Args:
        scene: the road.
        traits: of the drivers.
        aside: lateral positions of the robot for which others follow it as if it were there; by default its own [m].
    """
    s, d, _, speed = jnp.asarray(scene.robot)
    where = on_route(ways_of(scene), scene.states[:, 0], scene.states[:, 1])
    robot = s + scene.size[0] / 2, d[None] if aside is None else aside, speed
    return follow_all(scene, traits, where, jnp.asarray(scene.states)[:, 3], scene.gaps, robot)


def jointly(scene: RoadScene, each: Traffic, time_step: Scalar) -> Traffic:
    """Return the acceleration of the car on each path: the least on all of its paths, and never backwards."""
    same = scene.names[:, None] == scene.names
    return jnp.maximum(jnp.where(same, each, jnp.inf).min(axis=1), -scene.states[:, 3] / time_step)
