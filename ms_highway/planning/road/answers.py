"""Predict how humans drive along their paths: each optimises the learned reward of commuters, given all others.

A human decides on its acceleration only, held for each time step; its distance to its path decays. Others enter in
the coordinates of its path.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.collision_risk import CAR_SHARPNESS
from ms_highway.game.features import ATTENTION, OWN_LANE, SMALLEST_GAP, STANDSTILL_GAP
from ms_highway.game.learned_reward import commuter_weights
from ms_highway.game.neighbours import FAR_AWAY
from ms_highway.game.reward import Reward, linear_reward
from ms_highway.game.road import Car, Flags, Number, Numbers, Path, RoadScene, place, project
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.optimization.damped_newton import SHARES, best_of, damped_factor, damped_solve
from ms_highway.planning.road.arrays import Matrix, Scalar, Steps, Trajectories, Trajectory
from ms_highway.planning.road.motion import earlier
from ms_highway.planning.road.settings import RoadPlanning

STEPS = 3  # of Newton
BRAKING, ACCELERATION = -6.0, 3.0  # m/s^2, what humans do at most
SETTLING = 0.8  # s, in which the distance to the path falls to 1 / e, as under highway-env's steering
BRAKES = np.array([0.0, -2.0, -4.0, -6.0], np.float32)  # m/s^2, steady accelerations that answers may start from
LANE_WIDTH = 4.0  # m
UNIT = 5.0  # m/s^2, of the accelerations that are optimised
NEAREST = 6  # other cars that a driver heeds besides the robot
FAR_ALONG = 5.0  # m along the path that count like one aside


class Expansion(NamedTuple):
    """Reward less discomfort to second order in n accelerations."""

    gradient: Steps
    hessian: Matrix


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Driver:
    """A human on its path, and the motion of others in the path's coordinates.

    Its reward is that of `ms_highway.game.game.trajectory_reward` on a straight road of one lane, less what does not
    depend on its accelerations. Accelerations are scaled, in units of `UNIT`, but where they are stated in m/s^2.

    Attributes:
        planning: time step and number of steps.
        path: of the human.
        state: of the human on it.
        size: length and width of all cars [m].
        reward: the commuters', with the speed and the headway that this human desires.
        others: fields of their `ms_highway.game.dynamics.Motion` after each step, None before it looks.
    """

    planning: RoadPlanning
    path: Path
    state: Car
    size: Number
    reward: Reward
    others: Steps | None = None

    def earned(self, scaled: Steps) -> Scalar:
        """Return the reward less the discomfort of accelerations."""
        return jnp.sum(self._along(self.move(scaled))) - self._comfort * jnp.sum(scaled**2) / 2

    def expand(self, scaled: Steps) -> Expansion:
        """Expand `earned` to second order.

        The reward at a step depends on s and speed there, and both are linear in the accelerations: second derivatives
        in two numbers at each step are all that is needed.
        """
        motion, (by_s, by_speed) = self.move(scaled), self._effects
        (twice_s, mixed), (_, twice_speed) = by_fields(self._slopes, motion)
        cross = by_s.T @ (mixed[:, None] * by_speed)
        hessian = by_s.T @ (twice_s[:, None] * by_s) + cross + cross.T + by_speed.T @ (twice_speed[:, None] * by_speed)
        gradient = self.pull(self._slopes(motion)) - self._comfort * scaled
        return Expansion(gradient, hessian - self._comfort * jnp.eye(len(scaled)))

    def influence(self, scaled: Steps, robot: Trajectory) -> Steps:
        """Return how the robot's trajectory changes the slopes of the reward in s and speed, by field and step."""
        moved = self.move(scaled)
        return by_fields(lambda robot: replace(self, others=self.see(robot[:, None]))._slopes(moved), robot)

    def answer(self, start: Steps) -> Steps:
        """Improve accelerations by damped Newton steps, from the best of them and of steady braking [m/s^2].

        What is earned has an optimum on either side of each car ahead: braking finds the one behind it.
        """

        def improve(_: int, scaled: Steps) -> Steps:
            expansion = self.expand(scaled)
            return self.toward(scaled, damped_solve(damped_factor(expansion.hessian), expansion.gradient))

        braking = jnp.broadcast_to(BRAKES[:, None], (len(BRAKES), len(start)))
        first = self._best_of(jnp.concatenate([start[None], braking]) / UNIT)
        return jax.lax.fori_loop(0, STEPS, improve, first) * UNIT

    def toward(self, scaled: Steps, step: Steps) -> Steps:
        """Return accelerations after the share of a step that earns most."""
        return self._best_of(scaled + SHARES[:, None] * step)

    def _best_of(self, candidates: Steps) -> Steps:
        held = self.held(candidates * UNIT) / UNIT
        return best_of(held, jax.vmap(self.earned)(held))

    def held(self, accelerations: Steps) -> Steps:
        """Limit accelerations to what humans do and to a stop, never backwards [m/s^2].

        With unlimited speeds c_k, the speed that never falls below zero is ``c_k - min(0, c_1, ..., c_k)``.
        """
        dt, speed = self.planning.time_step, self.state[3]
        limited = jnp.clip(accelerations, BRAKING, ACCELERATION)
        sums = jnp.sum(np.tri(limited.shape[-1], dtype=np.float32) * limited[..., None, :], axis=-1)  # XLA fuses these
        free = speed + sums * dt
        kept = free - jnp.minimum(jax.lax.cummin(free, axis=free.ndim - 1), 0.0)
        return (kept - earlier(speed, kept)) / dt

    def drive(self, accelerations: Steps) -> Trajectory:
        """Return the trajectory under accelerations [m/s^2]."""
        return self.place(self.move(self.held(accelerations) / UNIT))

    def move(self, scaled: Steps) -> Steps:
        """Return s and speed after each step [2, steps]."""
        s, _, _, speed = self.state
        return jnp.stack([s + speed * self.planning.times, jnp.full_like(scaled, speed)]) + self.push(scaled)

    def place(self, motion: Steps) -> Trajectory:
        """Return the trajectory with s and speed after each step."""
        return jnp.stack([*place(self.path, motion[0], self.aside), motion[1]])

    def see(self, trajectories: Trajectories) -> Steps:
        """Convert trajectories [4, cars, steps] to motions in the path's coordinates; speeds are along it."""
        x, y, heading, speed = trajectories
        s, d, relative = project(self.path, x, y, heading)
        cosine, sine = jnp.cos(relative), jnp.sin(relative)
        return jnp.stack([s, d, cosine, sine, speed * cosine])

    def push(self, scaled: Steps) -> Steps:
        """Return the changes of s and speed after each step by a change of accelerations."""
        return jnp.stack([jnp.sum(weights * scaled, axis=-1) for weights in self._effects])

    def pull(self, slopes: Steps) -> Steps:
        """Return a slope in accelerations from those in s and speed after each step: the transpose of `push`."""
        by_s, by_speed = self._effects
        return slopes[0] @ by_s + slopes[1] @ by_speed

    @property
    def aside(self) -> Steps:
        """Lateral position after each step."""
        return self.state[1] * jnp.exp(-self.planning.times / SETTLING)

    @property
    def _effects(self) -> tuple[Matrix, Matrix]:
        """Derivatives of s and speed after each step in the accelerations."""
        steps, dt = np.arange(self.planning.steps), self.planning.time_step
        age = steps[:, None] - steps
        by_speed = jnp.asarray(age >= 0, jnp.float32) * (dt * UNIT)
        return by_speed * (age + 0.5) * dt, by_speed

    @property
    def _comfort(self) -> Scalar:
        return jnp.asarray(self.reward.comfort)[1] * (UNIT / PAPER_UNIT) ** 2

    def _slopes(self, motion: Steps) -> Steps:
        """Return the derivatives of the reward after each step in s and speed there."""
        return by_fields(self._along, motion)

    def _along(self, motion: Steps) -> Steps:
        """Compute the reward after each step: the formulas of `ms_highway.game.features`, on one straight lane."""
        (s, speed), (length, width) = motion, self.size
        assert self.others is not None  # it has looked
        x, y, cosine, sine, pace = self.others
        weights = dict(zip(self.reward.names, jnp.unstack(jnp.asarray(self.reward.weights)), strict=True))
        forward = speed / self.reward.speed_limit
        ahead, aside = x - s, y - self.aside
        gap = jnp.maximum(jnp.abs(ahead) - length, 0.0) / PAPER_UNIT
        attention = jnp.exp(-gap / ATTENTION - (aside / (OWN_LANE * LANE_WIDTH)) ** 2 / 2)
        headway = (gap - STANDSTILL_GAP - self.reward.headway * speed / PAPER_UNIT) ** 2
        closing = ((speed - pace) / self.reward.speed_limit) ** 2
        faster = jnp.maximum(pace - speed, 0.0) / PAPER_UNIT
        braking = (faster**2 / (2 * jnp.maximum(gap, SMALLEST_GAP))) ** 2
        before = weights["headway"] * headway + weights["closing_speed"] * closing
        crowding = attention * jnp.where(ahead > 0, before, weights["induced_braking"] * braking)
        along, across = 4 / self.size**2
        xx, yy = cosine**2 * along + sine**2 * across, sine**2 * along + cosine**2 * across
        xy = cosine * sine * (along - across)
        shares = np.array([-0.5, 0.0, 0.5], np.float32)[:, None, None]
        at_x, at_y = (shares * length - ahead)[:, None], shares * width - aside
        distance = xx * at_x**2 + 2 * xy * at_x * at_y + yy * at_y**2
        risk = jnp.sum(jnp.exp(-CAR_SHARPNESS * (distance - 1)), axis=(0, 1))
        among = jnp.sum(weights["collision_risk"] * risk - crowding, axis=0)
        return among - weights["speed"] * forward * (forward - 2)


def driver_of(scene: RoadScene, planning: RoadPlanning, i: Scalar) -> Driver:
    """Return other car i as a driver that has not looked at others yet."""
    path, state, size = jax.tree.map(lambda field: jnp.asarray(field)[i], (scene.paths, scene.states, scene.sizes))
    reward = replace(_commuter(), speed_limit=jnp.asarray(scene.limits)[i])
    if scene.traits is not None:
        speed, headway = (jnp.asarray(trait)[i] for trait in scene.traits)
        reward = replace(reward, speed_limit=speed, headway=headway)
    return Driver(planning, path, state, size, reward)


def driver_among(
    scene: RoadScene, planning: RoadPlanning, i: Scalar, robot: Trajectory, others: Trajectories
) -> Driver:
    """Return other car i as a driver among the robot and the `NEAREST` others.

    With the trajectory of `ms_highway.planning.road.motion.cruise`, the robot keeps its velocity, which is what the
    model turn assumes.

    Args:
        scene: the road.
        planning: time step and number of steps.
        i: number of the other car's path.
        robot: trajectory of the robot's centre.
        others: predicted trajectories of all traffic; the car itself, other ways of its owner and absent cars are
            left out.
    """
    driver = driver_of(scene, planning, i)
    motions = driver.see(jnp.moveaxis(others, 1, 0))
    kept = driver.state[0] + driver.state[3] * planning.times
    far = (motions[0] - kept) ** 2 / FAR_ALONG**2 + (motions[1] - driver.aside) ** 2
    matters = scene.present & (scene.owners != jnp.asarray(scene.owners)[i])
    _, nearest = jax.lax.top_k(-jnp.where(matters, far.min(axis=1), jnp.inf), NEAREST)
    motions = motions[:, nearest].at[0].add(jnp.where(matters[nearest], 0.0, -FAR_AWAY)[:, None])
    return replace(driver, others=jnp.concatenate([driver.see(robot[:, None]), motions], axis=1))


@cache
def _commuter() -> Reward:
    return linear_reward(commuter_weights(), 1.0)


def by_fields(function: Callable[[Steps], Number], at: Steps) -> Number:
    """Differentiate what depends at each step only on the fields there, in each field [fields, *value]."""
    directions = jnp.broadcast_to(jnp.eye(len(at))[..., None], (len(at), *at.shape))
    return jax.vmap(lambda direction: jax.jvp(function, (at,), (direction,))[1])(directions)


def for_each(cars: Flags, function: Callable[[Numbers, Any], Any], start: Any) -> Any:
    """Loop over the cars that count, in as many rounds as there are such cars, so that time is additive in them."""
    ranks = jnp.argsort(~cars, stable=True)
    return jax.lax.fori_loop(0, cars.sum(), lambda place, found: function(ranks[place], found), start)
