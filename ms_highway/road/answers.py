"""Predict how humans drive along their paths: each optimises the learned reward of commuters, given all others.

A human decides on its acceleration only, held for each time step; its distance to its path decays. Others enter in
the coordinates of its path.
"""

from dataclasses import dataclass, replace
from functools import cache

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.collision_risk import CAR_SHARPNESS
from ms_highway.game.features import ATTENTION, OWN_LANE, SMALLEST_GAP, STANDSTILL_GAP
from ms_highway.game.learned_reward import commuter_weights
from ms_highway.game.neighbours import FAR_AWAY
from ms_highway.game.reward import Reward, linear_reward
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.geometry.bodies import body_points, ellipse_distance
from ms_highway.geometry.curve import Curve
from ms_highway.numerics.damped_newton import SHARES, damped_factor, damped_solve
from ms_highway.numerics.objective import best_of
from ms_highway.numerics.second_derivatives import along_fields
from ms_highway.road.arrays import Steps, World
from ms_highway.road.constants import LANE, RoadPlanning
from ms_highway.road.motion import earlier
from ms_highway.road.scene import RoadScene, Sizes
from ms_highway.runtime.arrays import Car, Index, Matrix, Numbers, Scalar, Vector

STEPS = 3  # of Newton
UNIT = 5.0
"""Unit of the accelerations that are optimised [m/s^2]."""

HARDEST, FASTEST = -6.0 / UNIT, 3.0 / UNIT  # accelerations of humans at most
BRAKES = np.array([0.0, -2.0, -4.0, -6.0], np.float32)[:, None] / UNIT  # steady ones that answers may start from
SETTLING = 0.8  # s, in which the distance to the path falls to 1 / e, as under highway-env's steering
NEAREST = 6  # other cars that a driver heeds besides the robot
FAR_ALONG = 5.0  # m along the path that count like one aside


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Commuter:
    """A human on its path, and the motion of others in the path's coordinates.

    Its reward is that of `ms_highway.game.game.trajectory_reward` on a straight road of one lane, less what does not
    depend on its accelerations. Accelerations are scaled, in units of `UNIT`.

    Attributes:
        planning: time step and number of steps.
        path: of the human.
        state: of the human on it.
        size: length and width of all cars [m].
        reward: the commuters', with the speed limit of this human.
        others: fields of their `ms_highway.game.dynamics.Motion` after each step, None before it looks.
    """

    planning: RoadPlanning
    path: Curve
    state: Car
    size: Sizes
    reward: Reward
    others: Steps | None = None

    def earned(self, scaled: Vector) -> Scalar:
        """Return the reward less the discomfort of accelerations."""
        return jnp.sum(self._along(self.move(scaled))) - self._comfort * jnp.sum(scaled**2) / 2

    def expand(self, scaled: Vector) -> tuple[Vector, Matrix]:
        """Return gradient and Hessian of `earned`.

        The reward at a step depends on s and speed there, and both are linear in the accelerations: second derivatives
        in two numbers at each step are all that is needed.
        """
        motion, effects, comfort = self.move(scaled), self._effects, self._comfort
        bent = jnp.sum(along_fields(self._slopes, motion)[1][..., None] * effects, axis=1)
        hessian = jnp.tensordot(effects, bent, ((0, 1), (0, 1)))
        gradient = jnp.tensordot(self._slopes(motion), effects, 2)
        return gradient - comfort * scaled, hessian - comfort * jnp.eye(len(scaled))

    def answer(self) -> Vector:
        """Return the best accelerations, by damped Newton steps from steady braking.

        What is earned has an optimum on either side of each car ahead: braking finds the one behind it.
        """
        first = self._best_of(jnp.broadcast_to(BRAKES, (len(BRAKES), self.planning.steps)))
        return jax.lax.fori_loop(0, STEPS, lambda _, scaled: self.improved(scaled), first)

    def improved(self, scaled: Vector) -> Vector:
        """Return accelerations after the share of a damped Newton step that earns most."""
        gradient, hessian = self.expand(scaled)
        return self._best_of(scaled + SHARES[:, None] * damped_solve(damped_factor(hessian), gradient))

    def _best_of(self, candidates: Steps) -> Vector:
        held = self.held(candidates)
        return best_of(held, jax.vmap(self.earned)(held))

    def held(self, scaled: Steps) -> Steps:
        """Limit accelerations to what humans do and to a stop, never backwards.

        With unlimited speeds c_k, the speed that never falls below zero is ``c_k - min(0, c_1, ..., c_k)``.
        """
        speed, per_step, steps = self.state[3], self.planning.time_step * UNIT, scaled.shape[-1]
        limited = jnp.clip(scaled, HARDEST, FASTEST)[..., None, :]
        free = speed + jnp.sum(np.tri(steps, dtype=np.float32) * limited, axis=-1) * per_step  # XLA fuses such sums
        kept = free - jnp.minimum(jax.lax.cummin(free, axis=free.ndim - 1), 0.0)
        return (kept - earlier(speed, kept)) / per_step

    def move(self, scaled: Vector) -> Steps:
        """Return s and speed after each step [2, steps]."""
        s, _, _, speed = self.state
        kept = jnp.stack([s + speed * self.planning.times, jnp.full_like(scaled, speed)])
        return kept + jnp.sum(self._effects * scaled, axis=-1)

    def see(self, trajectories: World) -> Steps:
        """Return the motions [5, cars, steps] of trajectories [4, cars, steps] in the coordinates of the path."""
        x, y, heading, speed = trajectories
        s, d, relative = self.path.project(x, y, heading)
        cosine, sine = jnp.cos(relative), jnp.sin(relative)
        return jnp.stack([s, d, cosine, sine, speed * cosine])

    @property
    def aside(self) -> Steps:
        """Lateral position after each step."""
        return self.state[1] * jnp.exp(-self.planning.times / SETTLING)

    @property
    def _effects(self) -> Numbers:
        """Derivatives of s and speed after each step in the accelerations [2, steps, n]."""
        steps, dt = np.arange(self.planning.steps), self.planning.time_step
        age = steps[:, None] - steps
        by_speed = jnp.asarray(age >= 0, jnp.float32) * (dt * UNIT)
        return jnp.stack([by_speed * (age + 0.5) * dt, by_speed])

    @property
    def _comfort(self) -> Scalar:
        return self.reward.comfort[1] * (UNIT / PAPER_UNIT) ** 2

    def _slopes(self, motion: Steps) -> Steps:
        """Return the derivatives of the reward after each step in s and speed there."""
        return along_fields(self._along, motion)[1]

    def _along(self, motion: Steps) -> Steps:
        """Compute the reward after each step: the formulas of `ms_highway.game.features`, on one straight lane."""
        (s, speed), (length, width) = motion, self.size
        assert self.others is not None  # it has looked
        x, y, cosine, sine, pace = self.others
        weights = dict(zip(self.reward.names, jnp.unstack(self.reward.weights), strict=True))
        forward = speed / self.reward.speed_limit
        ahead, aside = x - s, y - self.aside
        gap = jnp.maximum(jnp.abs(ahead) - length, 0.0) / PAPER_UNIT
        attention = jnp.exp(-gap / ATTENTION - (aside / (OWN_LANE * LANE)) ** 2 / 2)
        headway = (gap - STANDSTILL_GAP - self.reward.headway * speed / PAPER_UNIT) ** 2
        closing = ((speed - pace) / self.reward.speed_limit) ** 2
        faster = jnp.maximum(pace - speed, 0.0) / PAPER_UNIT
        braking = (faster**2 / (2 * jnp.maximum(gap, SMALLEST_GAP))) ** 2
        before = weights["headway"] * headway + weights["closing_speed"] * closing
        crowding = attention * jnp.where(ahead > 0, before, weights["induced_braking"] * braking)
        own, points = (s, self.aside, 1.0, 0.0), body_points(self.size)
        distance = ellipse_distance(own, points, (x, y, cosine, sine), length, width)
        risk = jnp.sum(jnp.exp(-CAR_SHARPNESS * distance), axis=1)
        among = jnp.sum(weights["collision_risk"] * risk - crowding, axis=0)
        return among - weights["speed"] * forward * (forward - 2)


def commuter_of(scene: RoadScene, planning: RoadPlanning, i: Index) -> Commuter:
    """Return other car i as a commuter that has not looked at others yet."""
    path, state, size = jax.tree.map(lambda field: field[i], (scene.paths, scene.states, scene.sizes))
    reward = replace(_reward(), speed_limit=scene.limits[i])
    return Commuter(planning, path, state, size, reward)


def commuter_among(scene: RoadScene, planning: RoadPlanning, i: Index, robot: World, others: World) -> Commuter:
    """Return other car i as a commuter among the robot and the `NEAREST` others.

    Args:
        scene: the road.
        planning: time step and number of steps.
        i: number of the other car's path.
        robot: trajectory of the robot's centre.
        others: predicted trajectories of all traffic; the car itself, other ways of its owner and absent cars are
            left out.
    """
    human = commuter_of(scene, planning, i)
    motions = human.see(jnp.moveaxis(others, 1, 0))
    kept = human.state[0] + human.state[3] * planning.times
    far = (motions[0] - kept) ** 2 / FAR_ALONG**2 + (motions[1] - human.aside) ** 2
    matters = scene.present & (scene.owners != scene.owners[i])
    _, nearest = jax.lax.top_k(-jnp.where(matters, far.min(axis=1), jnp.inf), NEAREST)
    motions = motions[:, nearest].at[0].add(jnp.where(matters[nearest], 0.0, -FAR_AWAY)[:, None])
    return replace(human, others=jnp.concatenate([human.see(robot[:, None]), motions], axis=1))


@cache
def _reward() -> Reward:
    return linear_reward(commuter_weights(), 1.0)
