"""Predict how humans drive along their paths: each optimises the learned reward of
commuters, given all others.

A human chooses only its acceleration in each time step; its distance to its path
decays. The motion of others is in the coordinates of this path.
"""

from dataclasses import dataclass, replace
from functools import cache

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.data.learned_reward import commuter_weights
from ms_highway.game.dynamics import Motion
from ms_highway.game.features import motion_reward
from ms_highway.game.reward import Reward, linear_reward
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.game.scene import FAR_AWAY, Scene
from ms_highway.numerics.newton import DAMPED_SHARES, best_of, damped_solve
from ms_highway.numerics.second_derivatives import along_fields
from ms_highway.perception.scene import RoadScene, Steps, World
from ms_highway.road.constants import LANE, RoadPlanning
from ms_highway.road.simulation import earlier
from ms_highway.runtime.arrays import Car, Index, Matrix, Numbers, Scalar, Vector

NEWTON_STEPS = 3
ACCELERATION_UNIT = 5.0
"""Unit of the optimised accelerations [m/s^2]."""

MIN_ACCELERATION = -6.0 / ACCELERATION_UNIT
MAX_ACCELERATION = 3.0 / ACCELERATION_UNIT
FIRST_ACCELERATIONS = (
    np.array([0.0, -2.0, -4.0, -6.0], np.float32)[:, None] / ACCELERATION_UNIT
)  # steady braking
PATH_TIME = (
    0.8  # s, time constant of the distance to the path, as under highway-env's steering
)
NEAREST_CARS = 6  # cars that a driver heeds besides the robot
ALONG_PER_ASIDE = (
    5.0  # longitudinal distance that counts like a lateral distance of 1 m [m]
)
HEEDED = (
    "speed",
    "collision_risk",
    "headway",
    "closing_speed",
    "induced_braking",
    "comfort_acceleration",
)
"""Terms of the reward that depend on accelerations."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Commuter:
    """A human on its path, and the motion of others in the path's coordinates.

    The reward is computed as on a straight road of one lane. Accelerations are in units
    of `ACCELERATION_UNIT`.

    Attributes:
        planning: time step and number of steps.
        state: of the human on its path.
        road: straight, with the size of all cars.
        reward: of commuters, with the speed limit of this human.
        others: motion of the others after each step.
    """

    planning: RoadPlanning
    state: Car
    road: Scene
    reward: Reward
    others: Motion

    def earned(self, scaled: Vector) -> Scalar:
        """Return the sum of rewards, less the discomfort of accelerations."""
        return (
            jnp.sum(self.rewards(self.move(scaled)))
            - self._comfort * jnp.sum(scaled**2) / 2
        )

    def rewards(self, motion: Steps) -> Steps:
        """Return the reward after each step, given s and speed after each step [2,
        steps].
        """
        s, speed = motion
        own = Motion(s, self.aside, jnp.ones_like(s), jnp.zeros_like(s), speed)
        return motion_reward(self.road, self.reward, own, self.others)

    def expand(self, scaled: Vector) -> tuple[Vector, Matrix]:
        """Return gradient and Hessian of `earned`.

        The reward of a step depends only on s and speed, which are linear in the
        accelerations: the chain rule needs only second derivatives in these two
        numbers.
        """
        effects = self._effects
        slopes, bends = along_fields(
            lambda motion: along_fields(self.rewards, motion)[1], self.move(scaled)
        )
        hessian = jnp.tensordot(
            effects, jnp.sum(bends[..., None] * effects, axis=1), ((0, 1), (0, 1))
        )
        gradient = jnp.tensordot(slopes, effects, 2)
        return gradient - self._comfort * scaled, hessian - self._comfort * jnp.eye(
            len(scaled)
        )

    def best_response(self) -> Vector:
        """Return the best accelerations, by damped Newton steps from steady braking.

        There is an optimum before and behind each car ahead; starting from braking
        finds the one behind it.
        """

        def best(candidates: Steps) -> Vector:
            held = jax.vmap(self.held)(candidates)
            return best_of(held, jax.vmap(self.earned)(held))

        def improve(_: Index, scaled: Vector) -> Vector:
            gradient, hessian = self.expand(scaled)
            return best(
                scaled + DAMPED_SHARES[:, None] * damped_solve(hessian, gradient)
            )

        first = best(
            jnp.broadcast_to(
                FIRST_ACCELERATIONS, (len(FIRST_ACCELERATIONS), self.planning.steps)
            )
        )
        return jax.lax.fori_loop(0, NEWTON_STEPS, improve, first)

    def held(self, scaled: Vector) -> Vector:
        """Limit accelerations to the range of humans and to speeds from 0.

        With unlimited speeds c_k, the speed that never falls below zero is ``c_k -
        min(0, c_1, ..., c_k)``.
        """
        _, free = self.move(jnp.clip(scaled, MIN_ACCELERATION, MAX_ACCELERATION))
        kept = free - jnp.minimum(jax.lax.cummin(free), 0.0)
        return (kept - earlier(self.state[3], kept)) / (
            self.planning.time_step * ACCELERATION_UNIT
        )

    def move(self, scaled: Vector) -> Steps:
        """Return s and speed after each step [2, steps]."""
        s, _, _, speed = self.state
        kept = jnp.stack(
            [s + speed * self.planning.times, jnp.full_like(scaled, speed)]
        )
        return kept + jnp.sum(self._effects * scaled, axis=-1)

    @property
    def aside(self) -> Steps:
        """Lateral position after each step."""
        return self.state[1] * jnp.exp(-self.planning.times / PATH_TIME)

    @property
    def _effects(self) -> Numbers:
        """Derivatives of s and speed after each step in the accelerations [2, steps,
        n].
        """
        steps = np.arange(self.planning.steps)
        dt = self.planning.time_step
        age = steps[:, None] - steps
        by_speed = jnp.asarray(age >= 0, jnp.float32) * (dt * ACCELERATION_UNIT)
        return jnp.stack([by_speed * (age + 0.5) * dt, by_speed])

    @property
    def _comfort(self) -> Scalar:
        return self.reward.comfort[1] * (ACCELERATION_UNIT / PAPER_UNIT) ** 2


def commuter_among(
    scene: RoadScene, planning: RoadPlanning, i: Index, robot: World, others: World
) -> Commuter:
    """Return other car i as a commuter among the robot and the `NEAREST_CARS` others.

    Args:
        scene: the road.
        planning: time step and number of steps.
        i: number of the other car's path.
        robot: trajectory of the robot's centre.
        others: predicted trajectories of all traffic; the car itself, its other paths
            and absent cars are ignored.
    """
    path, state, size, limit = jax.tree.map(
        lambda field: jnp.asarray(field)[i],
        (scene.paths, scene.states, scene.sizes, scene.limits),
    )
    x, y, heading, speed = jnp.moveaxis(jnp.concatenate([robot[None], others]), 1, 0)
    s, d, relative = path.project(x, y, heading)
    cosine = jnp.cos(relative)
    road = Scene(jnp.zeros(1), LANE, car_size=size)
    counts = jnp.append(True, scene.present & (scene.owners != scene.owners[i]))
    seen = Motion(
        jnp.where(counts[:, None], s, s - FAR_AWAY),
        d,
        cosine,
        jnp.sin(relative),
        speed * cosine,
    )
    human = Commuter(planning, state, road, replace(_reward(), speed_limit=limit), seen)
    kept = state[0] + state[3] * planning.times
    apart = ((s - kept) ** 2 / ALONG_PER_ASIDE**2 + (d - human.aside) ** 2).min(axis=1)
    apart = jnp.where(counts, apart, jnp.inf).at[0].set(-1.0)  # the robot always counts
    _, heeded = jax.lax.top_k(-apart, 1 + NEAREST_CARS)
    return replace(human, others=Motion(*(field[heeded] for field in seen)))


@cache
def _reward() -> Reward:
    return linear_reward(
        {name: weight for name, weight in commuter_weights().items() if name in HEEDED},
        1.0,
    )
