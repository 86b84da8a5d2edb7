"""Predict how humans drive along their paths: each optimises the learned reward of commuters, given all others.

A human decides on its acceleration only, held for each time step; its distance to its path decays. Others enter in
the coordinates of its path.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.collision_risk import CAR_SHARPNESS
from ms_highway.game.features import ATTENTION, OWN_LANE, SMALLEST_GAP, STANDSTILL_GAP
from ms_highway.game.learned_reward import commuter_weights
from ms_highway.game.neighbours import FAR_AWAY
from ms_highway.game.reward import TIME_HEADWAY, Reward, linear_reward
from ms_highway.game.road import RoadScene, interpolate, place, project
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.optimization.damped_newton import SHARES, best_of, damped_factor, damped_solve
from ms_highway.planning.road.settings import RoadPlanning

__all__ = [
    "UNIT",
    "Accelerations",
    "Driver",
    "World",
    "along_path",
    "answer",
    "cruise",
    "driver_of",
    "follow",
    "onward",
    "pull",
    "push",
    "within_reach",
]

STEPS = 3  # of Newton
BRAKING, ACCELERATION = -6.0, 3.0  # m/s^2, what humans do at most
SETTLING = 0.8  # s, in which the distance to the path falls to 1 / e, as under highway-env's steering
BRAKES = np.array([0.0, -2.0, -4.0, -6.0], np.float32)  # m/s^2, steady accelerations that answers may start from
LANE_WIDTH = 4.0  # m
UNIT = 5.0  # m/s^2, of the accelerations that are optimised
NEAREST = 6  # other cars that a driver heeds besides the robot
FAR_ALONG = 5.0  # m along the path that count like one aside

World = Float[jax.Array, "4 steps"]
"""Trajectory in world coordinates: x, y, heading and speed after each step."""

Accelerations = Float[jax.Array, "steps"]


class Expansion(NamedTuple):
    """Reward less discomfort to second order in n accelerations."""

    gradient: Float[jax.Array, "n"]
    hessian: Float[jax.Array, "n n"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Driver:
    """A human on its path, and the motion of others in the path's coordinates.

    Its reward is that of `ms_highway.game.crowd.along_others` on a straight road of one lane, less what does not depend
    on its accelerations. Accelerations are scaled: in units of `UNIT`.

    Attributes:
        planning: time step and number of steps.
        reward: the commuters'; its speed limit is the speed that the human desires.
        size: length and width of all cars [m].
        state: of the human.
        others: fields of their `ms_highway.game.dynamics.Motion` after each step.
        headway: time gap between bumpers that it desires [s].
    """

    planning: RoadPlanning
    reward: Reward
    size: Float[jax.Array, "2"]
    state: Float[jax.Array, "4"]
    others: Float[jax.Array, "5 others steps"]
    headway: float | Float[jax.Array, ""] = TIME_HEADWAY

    def earned(self, scaled: Accelerations) -> Float[jax.Array, ""]:
        """Return the reward less the discomfort of accelerations."""
        return jnp.sum(self._along(*self.move(scaled))) - self._comfort * jnp.sum(scaled**2) / 2

    def expand(self, scaled: Accelerations) -> Expansion:
        """Expand `earned` to second order.

        The reward at a step depends on s and speed there, and both are linear in the accelerations: second derivatives
        in two numbers at each step are all that is needed.
        """
        s, speed = self.move(scaled)
        one, zero = jnp.ones_like(s), jnp.zeros_like(s)
        (along_s, along_speed), (twice_s, mixed) = jax.jvp(self._slopes, (s, speed), (one, zero))
        _, twice_speed = jax.jvp(partial(self._slopes, s), (speed,), (one,))[1]
        by_s, by_speed = _weights(self.planning)
        cross = by_s.T @ (mixed[:, None] * by_speed)
        hessian = by_s.T @ (twice_s[:, None] * by_s) + cross + cross.T + by_speed.T @ (twice_speed[:, None] * by_speed)
        gradient = pull(self.planning, jnp.stack([along_s, along_speed])) - self._comfort * scaled
        return Expansion(gradient, hessian - self._comfort * jnp.eye(len(s)))

    def influence(
        self, scaled: Accelerations, robot: Callable[[World], Float[jax.Array, "5 steps"]], at: World
    ) -> Float[jax.Array, "4 2 steps"]:
        """Return how the robot's trajectory changes the slopes of the reward in s and speed, field by field and step.

        Args:
            scaled: accelerations of the human.
            robot: the robot's motion in the path's coordinates.
            at: the robot's trajectory in the world.
        """
        moved = self.move(scaled)

        def slopes(trajectory: World) -> Float[jax.Array, "2 steps"]:
            alone = replace(self, others=robot(trajectory)[:, None])
            return jnp.stack(alone._slopes(*moved))

        directions = jnp.broadcast_to(jnp.eye(len(at))[..., None], (len(at), *at.shape))
        return jax.vmap(lambda direction: jax.jvp(slopes, (at,), (direction,))[1])(directions)

    def toward(self, scaled: Accelerations, step: Accelerations) -> Accelerations:
        """Return accelerations after the share of a step that earns most."""
        return self._best_of(scaled + SHARES[:, None] * step)

    def best(self, start: Accelerations) -> Accelerations:
        """Improve accelerations by damped Newton steps, from the best of them and of steady braking.

        What is earned has an optimum on either side of each car ahead: braking finds the one behind it.
        """
        braking = jnp.broadcast_to(BRAKES[:, None] / UNIT, (len(BRAKES), len(start)))

        def improve(_: int, scaled: Accelerations) -> Accelerations:
            expansion = self.expand(scaled)
            return self.toward(scaled, damped_solve(damped_factor(expansion.hessian), expansion.gradient))

        return jax.lax.fori_loop(0, STEPS, improve, self._best_of(jnp.concatenate([start[None], braking])))

    def _best_of(self, candidates: Float[jax.Array, "n steps"]) -> Accelerations:
        held = within_reach(self.planning, self.state[3], candidates * UNIT) / UNIT
        return best_of(held, jax.vmap(self.earned)(held))

    @property
    def _comfort(self) -> Float[jax.Array, ""]:
        return jnp.asarray(self.reward.comfort)[1] * (UNIT / PAPER_UNIT) ** 2

    def move(self, scaled: Accelerations) -> Float[jax.Array, "2 steps"]:
        """Return s and speed after each step."""
        kept = jnp.stack([self.state[0] + self.state[3] * _times(self.planning), jnp.full_like(scaled, self.state[3])])
        return kept + push(self.planning, scaled)

    def _slopes(
        self, s: Float[jax.Array, "steps"], speed: Float[jax.Array, "steps"]
    ) -> tuple[Float[jax.Array, "steps"], Float[jax.Array, "steps"]]:
        """Return the derivatives of the reward after each step in s and speed there."""
        one, zero = jnp.ones_like(s), jnp.zeros_like(s)
        along = partial(jax.jvp, self._along, (s, speed))
        return along((one, zero))[1], along((zero, one))[1]

    def _along(self, s: Float[jax.Array, "steps"], speed: Float[jax.Array, "steps"]) -> Float[jax.Array, "steps"]:
        """Compute the reward after each step: the formulas of `ms_highway.game.features`, on one straight lane."""
        weights = dict(zip(self.reward.names, jnp.unstack(jnp.asarray(self.reward.weights)), strict=True))
        forward = speed / self.reward.speed_limit
        x, y, cosine, sine, pace = self.others
        ahead, aside = x - s, y - _settled(self.planning, self.state[1])
        gap = jnp.maximum(jnp.abs(ahead) - self.size[0], 0.0) / PAPER_UNIT
        attention = jnp.exp(-gap / ATTENTION - (aside / (OWN_LANE * LANE_WIDTH)) ** 2 / 2)
        headway = (gap - STANDSTILL_GAP - self.headway * speed / PAPER_UNIT) ** 2
        closing = ((speed - pace) / self.reward.speed_limit) ** 2
        faster = jnp.maximum(pace - speed, 0.0) / PAPER_UNIT
        braking = (faster**2 / (2 * jnp.maximum(gap, SMALLEST_GAP))) ** 2
        before = weights["headway"] * headway + weights["closing_speed"] * closing
        crowding = attention * jnp.where(ahead > 0, before, weights["induced_braking"] * braking)
        along, across = 4 / self.size[0] ** 2, 4 / self.size[1] ** 2
        xx, yy = cosine**2 * along + sine**2 * across, sine**2 * along + cosine**2 * across
        xy = cosine * sine * (along - across)
        shares = np.array([-0.5, 0.0, 0.5], np.float32)[:, None, None]
        at_x, at_y = (shares * self.size[0] - ahead)[:, None], shares * self.size[1] - aside
        distance = xx * at_x**2 + 2 * xy * at_x * at_y + yy * at_y**2
        risk = jnp.sum(jnp.exp(-CAR_SHARPNESS * (distance - 1)), axis=(0, 1))
        among = jnp.sum(weights["collision_risk"] * risk - crowding, axis=0)
        return among - weights["speed"] * forward * (forward - 2)


def answer(
    scene: RoadScene,
    planning: RoadPlanning,
    i: int | Int[jax.Array, ""],
    robot: World,
    others: Float[jax.Array, "traffic 4 steps"],
    start: Accelerations,
) -> Accelerations:
    """Return the accelerations with which other car i answers a trajectory of the robot's centre.

    With that of `cruise`, the robot keeps its velocity, which is what the rung turn assumes.

    Args:
        scene: the road.
        planning: time step and number of steps.
        i: number of the other car's path.
        robot: trajectory of the robot's centre.
        others: predicted trajectories of all traffic; the car itself, other ways of its owner and absent cars are
            left out.
        start: accelerations to improve [m/s^2].
    """
    return driver_of(scene, planning, i, robot, others).best(start / UNIT) * UNIT


def driver_of(
    scene: RoadScene,
    planning: RoadPlanning,
    i: int | Int[jax.Array, ""],
    robot: World,
    others: Float[jax.Array, "traffic 4 steps"],
) -> Driver:
    """Return other car i as a driver among the robot and the `NEAREST` others, see `answer`."""
    state, owner = jnp.asarray(scene.states)[i], jnp.asarray(scene.owners)[i]
    motions = along_path(scene, i, jnp.moveaxis(others, 1, 0))
    kept = state[0] + state[3] * _times(planning)
    far = (motions[0] - kept) ** 2 / FAR_ALONG**2 + (motions[1] - _settled(planning, state[1])) ** 2
    matters = scene.present & (scene.owners != owner)
    _, nearest = jax.lax.top_k(-jnp.where(matters, far.min(axis=1), jnp.inf), NEAREST)
    motions = motions[:, nearest].at[0].add(jnp.where(matters[nearest], 0.0, -FAR_AWAY)[:, None])
    near = jnp.concatenate([along_path(scene, i, robot[:, None]), motions], axis=1)
    traits = scene.traits
    desired, headway = (scene.limits, None) if traits is None else traits
    reward = replace(_commuter(), speed_limit=jnp.asarray(desired)[i])
    kept_gap = TIME_HEADWAY if headway is None else jnp.asarray(headway)[i]
    return Driver(planning, reward, jnp.asarray(scene.sizes)[i], state, near, kept_gap)


def along_path(
    scene: RoadScene, i: int | Int[jax.Array, ""], trajectories: Float[jax.Array, "4 cars steps"]
) -> Float[jax.Array, "5 cars steps"]:
    """Convert world trajectories to motions in the coordinates of path i; speeds are those along it."""
    x, y, heading, speed = trajectories
    s, d, relative = project(jax.tree.map(lambda field: jnp.asarray(field)[i], scene.paths), x, y, heading)
    cosine, sine = jnp.cos(relative), jnp.sin(relative)
    return jnp.stack([s, d, cosine, sine, speed * cosine])


def follow(
    scene: RoadScene, planning: RoadPlanning, i: int | Int[jax.Array, ""], accelerations: Accelerations
) -> World:
    """Return the trajectory of other car i along its path under accelerations."""
    s, _, _, speed = jnp.asarray(scene.states)[i]
    kept = jnp.stack([s + speed * _times(planning), jnp.full_like(accelerations, speed)])
    return onward(scene, planning, i, kept + push(planning, within_reach(planning, speed, accelerations) / UNIT))


def onward(
    scene: RoadScene, planning: RoadPlanning, i: int | Int[jax.Array, ""], motion: Float[jax.Array, "2 steps"]
) -> World:
    """Return the trajectory of other car i from s and speed after each step."""
    path = jax.tree.map(lambda field: jnp.asarray(field)[i], scene.paths)
    return jnp.stack([*place(path, motion[0], _settled(planning, jnp.asarray(scene.states)[i, 1])), motion[1]])


def cruise(scene: RoadScene, planning: RoadPlanning) -> World:
    """Return the trajectory of the robot's centre if it keeps its speed and lateral position along its route."""
    s, d, _, speed = jnp.asarray(scene.robot)
    pace = speed / jnp.maximum(1 - d * interpolate(scene.route.curvature, s), 0.2)
    s = s + scene.size[0] / 2 + pace * _times(planning)
    d, speed = (jnp.broadcast_to(number, s.shape) for number in (d, speed))
    return jnp.stack([*place(scene.route, s, d), speed])


def within_reach(
    planning: RoadPlanning, speed: Float[jax.Array, ""], accelerations: Float[jax.Array, "*batch steps"]
) -> Float[jax.Array, "*batch steps"]:
    """Limit accelerations to what humans do and to a stop, never backwards.

    With unlimited speeds c_k, the speed that never falls below zero is ``c_k - min(0, c_1, ..., c_k)``.
    """
    dt = planning.time_step
    limited = jnp.clip(accelerations, BRAKING, ACCELERATION)
    free = speed + _sums(limited) * dt
    held = free - jnp.minimum(jax.lax.cummin(free, axis=free.ndim - 1), 0.0)
    before = jnp.concatenate([jnp.broadcast_to(speed, (*held.shape[:-1], 1)), held[..., :-1]], axis=-1)
    return (held - before) / dt


def push(planning: RoadPlanning, scaled: Accelerations) -> Float[jax.Array, "2 steps"]:
    """Return the changes of s and speed after each step by a change of scaled accelerations."""
    return jnp.stack([jnp.sum(weights * scaled, axis=-1) for weights in _weights(planning)])


def pull(planning: RoadPlanning, slopes: Float[jax.Array, "2 steps"]) -> Accelerations:
    """Return a slope in scaled accelerations from those in s and speed after each step: the transpose of `push`."""
    by_s, by_speed = _weights(planning)
    return slopes[0] @ by_s + slopes[1] @ by_speed


@cache
def _commuter() -> Reward:
    """Return the commuters' reward; its speed limit is that of the road."""
    return linear_reward(commuter_weights(), 1.0)


def _weights(planning: RoadPlanning) -> tuple[Float[jax.Array, "steps n"], Float[jax.Array, "steps n"]]:
    """Return the derivatives of s and speed after each step in the scaled accelerations."""
    age, dt = np.arange(planning.steps)[:, None] - np.arange(planning.steps), planning.time_step
    by_speed = jnp.asarray(age >= 0, jnp.float32) * (dt * UNIT)
    return by_speed * (age + 0.5) * dt, by_speed


def _sums(values: Float[jax.Array, "*batch steps"]) -> Float[jax.Array, "*batch steps"]:
    """Return cumulative sums; XLA fuses weighted sums."""
    steps = values.shape[-1]
    return jnp.sum(np.tri(steps, dtype=np.float32) * values[..., None, :], axis=-1)


def _times(planning: RoadPlanning) -> Float[jax.Array, "steps"]:
    return jnp.arange(1, planning.steps + 1) * planning.time_step


def _settled(planning: RoadPlanning, d: Float[jax.Array, ""]) -> Float[jax.Array, "steps"]:
    """Return the lateral position after each step."""
    return d * jnp.exp(-_times(planning) / SETTLING)
