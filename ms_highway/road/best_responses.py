"""Predict how humans drive along their paths, as best responses.

Each optimises the learned reward of commuters, given all others. A human chooses only
its acceleration in each time step; its distance to its path decays. The motion of
others is in the coordinates of this path.
"""

from dataclasses import dataclass, replace
from functools import cache

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.data.learned_reward import commuter_weights
from ms_highway.game.car_following import TRAFFIC_LIMITS
from ms_highway.game.dynamics import Motion
from ms_highway.game.features import motion_reward
from ms_highway.game.reward import Reward, linear_reward
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.game.scene import FAR_AWAY, Scene
from ms_highway.numerics.damped_newton import DAMPED_STEPS, damped_solve
from ms_highway.numerics.objective import best_of
from ms_highway.numerics.second_derivatives import along_fields
from ms_highway.perception.scene import RoadScene, Steps, World
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.road.simulation import earlier
from ms_highway.runtime.arrays import Car, Index, Matrix, Numbers, Scalar, Vector


@dataclass(frozen=True)
class ResponseSettings:
    """Set how the best responses of humans are computed."""

    newton_steps: int = 3
    """Number of damped Newton steps."""
    acceleration_unit: float = 5.0
    """Unit of the optimised accelerations [m/s^2]."""
    first_accelerations: tuple[float, ...] = (0.0, -2.0, -4.0, -6.0)
    """Steady accelerations from which the optimisation starts [m/s^2]."""
    path_time: float = 0.8
    """Time constant of the distance to the path, as highway-env's cars steer [s]."""
    nearest_cars: int = 6
    """Number of cars that a driver heeds besides the robot."""
    along_per_aside: float = 5.0
    """Longitudinal distance that counts like a lateral distance of 1 m [m]."""
    features: tuple[str, ...] = (
        "speed",
        "collision_risk",
        "headway",
        "closing_speed",
        "induced_braking",
        "comfort_acceleration",
    )
    """Terms of the reward that depend on accelerations."""

    @property
    def range(self) -> tuple[float, float]:
        """Hardest braking and acceleration of humans [units of acceleration]."""
        unit = self.acceleration_unit
        return -TRAFFIC_LIMITS.braking / unit, TRAFFIC_LIMITS.acceleration / unit

    @property
    def starts(self) -> Float[np.ndarray, "starts 1"]:
        """Accelerations from which the optimisation starts [units of acceleration]."""
        first = np.array(self.first_accelerations, np.float32)
        return first[:, None] / self.acceleration_unit


RESPONSES = ResponseSettings()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Commuter:
    """A human on its path, and the motion of others in the path's coordinates.

    The reward is computed as on a straight road of one lane. Accelerations are in units
    of `ResponseSettings.acceleration_unit`.

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
        discomfort = self._comfort * jnp.sum(scaled**2) / 2
        rewards = self.rewards(self.move(scaled))
        return jnp.sum(rewards) - discomfort

    def rewards(self, motion: jax.Array) -> Steps:
        """Return the reward after each step.

        Args:
            motion: s and speed after each step, [2, steps].
        """
        s, speed = motion
        own = Motion(
            s, self.lateral_position, jnp.ones_like(s), jnp.zeros_like(s), speed
        )
        return motion_reward(self.road, self.reward, own, self.others)

    def expand(self, scaled: Vector) -> tuple[Vector, Matrix]:
        """Return gradient and Hessian of `earned`.

        The reward of a step depends only on s and speed, which are linear in the
        accelerations: the chain rule needs only second derivatives in these two
        numbers.
        """
        effects = self._effects  # [2, steps, accelerations]

        def slope(motion: jax.Array) -> Steps:
            return along_fields(self.rewards, motion)[1]

        # Slopes [2, steps] and second derivatives [2, 2, steps] in s and speed.
        slopes, seconds = along_fields(slope, self.move(scaled))
        by_effect = jnp.sum(seconds[..., None] * effects, axis=1)
        hessian = jnp.tensordot(effects, by_effect, ((0, 1), (0, 1)))
        gradient = jnp.tensordot(slopes, effects, 2)

        # The discomfort is quadratic in the accelerations.
        own_gradient = self._comfort * scaled
        own_hessian = self._comfort * jnp.eye(len(scaled))
        return gradient - own_gradient, hessian - own_hessian

    def best_response(self) -> Vector:
        """Return the best accelerations, by damped Newton steps from steady braking.

        There is an optimum before and behind each car ahead; starting from braking
        finds the one behind it.
        """

        def best(candidates: Steps) -> Vector:
            """Return the candidate that earns most within the limits."""
            possible = jax.vmap(self.limited)(candidates)
            earned = jnp.asarray(jax.vmap(self.earned)(possible))
            return best_of(possible, earned)

        def improve(_: Index, scaled: Vector) -> Vector:
            """Return the best point along a damped Newton step."""
            gradient, hessian = self.expand(scaled)
            newton_step = damped_solve(hessian, gradient)
            candidates = scaled + DAMPED_STEPS.shares[:, None] * newton_step
            return best(candidates)

        starts = RESPONSES.starts
        steady = jnp.broadcast_to(starts, (len(starts), self.planning.steps))
        first = best(steady)
        return jax.lax.fori_loop(0, RESPONSES.newton_steps, improve, first)

    def limited(self, scaled: Vector) -> Vector:
        """Limit accelerations to the range of humans and to speeds from 0.

        With unlimited speeds c_k, the speed that never falls below zero is ``c_k -
        min(0, c_1, ..., c_k)``.
        """
        within_range = jnp.clip(scaled, *RESPONSES.range)
        _, unlimited = self.move(within_range)
        lowest_so_far = jax.lax.cummin(unlimited)
        speed = unlimited - jnp.minimum(lowest_so_far, 0.0)
        change = speed - earlier(self.state[3], speed)
        return change / (self.planning.time_step * RESPONSES.acceleration_unit)

    def move(self, scaled: Vector) -> jax.Array:
        """Return s and speed after each step [2, steps]."""
        s, _, _, speed = self.state
        s_at_constant_speed = s + speed * self.planning.times
        constant_speed = jnp.full_like(scaled, speed)
        unaccelerated = jnp.stack([s_at_constant_speed, constant_speed])
        by_accelerations = jnp.sum(self._effects * scaled, axis=-1)
        return unaccelerated + by_accelerations

    @property
    def lateral_position(self) -> jax.Array:
        """Lateral position after each step."""
        decay = jnp.exp(-self.planning.times / RESPONSES.path_time)
        return jnp.multiply(self.state[1], decay)

    @property
    def _effects(self) -> Numbers:
        """Derivatives of s and speed in the accelerations, [2, steps, n]."""
        steps = np.arange(self.planning.steps)
        dt = self.planning.time_step
        age = steps[:, None] - steps  # of each acceleration at each step
        acts = jnp.asarray(age >= 0, jnp.float32)
        on_speed = acts * (dt * RESPONSES.acceleration_unit)
        on_s = on_speed * (age + 0.5) * dt
        return jnp.stack([on_s, on_speed])

    @property
    def _comfort(self) -> Scalar:
        """Weight of the squared accelerations, in units of acceleration."""
        unit = RESPONSES.acceleration_unit / PAPER_UNIT
        return self.reward.comfort[1] * unit**2


def commuter_among(
    scene: RoadScene,
    planning: RoadPlanning,
    path_index: Index,
    robot: World,
    others: World,
) -> Commuter:
    """Return another car as a commuter among the robot and the nearest others.

    Args:
        scene: the road.
        planning: time step and number of steps.
        path_index: of the other car.
        robot: trajectory of the robot's centre.
        others: predicted trajectories of all traffic; the car itself, its other paths
            and absent cars are ignored.
    """
    path, state, size, limit = jax.tree.map(
        lambda field: jnp.asarray(field)[path_index],
        (scene.paths, scene.states, scene.sizes, scene.limits),
    )

    # The robot and the others along the car's path; the robot comes first.
    trajectories = jnp.concatenate([robot[None], others])  # [cars, 4, steps]
    x, y, heading, speed = jnp.moveaxis(trajectories, 1, 0)
    s, d, relative_heading = path.project(x, y, heading)
    cosine = jnp.cos(relative_heading)
    sine = jnp.sin(relative_heading)

    # Cars that do not count are far behind.
    is_other = scene.present & (scene.owners != scene.owners[path_index])
    counts = jnp.append(True, is_other)
    counted_s = jnp.where(counts[:, None], s, s - FAR_AWAY)
    motion = Motion(counted_s, d, cosine, sine, speed * cosine)
    road = Scene(jnp.zeros(1), planning.lane_width, car_size=size)
    reward = replace(_reward(), speed_limit=limit)
    human = Commuter(planning, state, road, reward, motion)

    # The nearest cars, if the human keeps its speed; the robot is always among them.
    first_s, _, _, first_speed = state
    own_s = first_s + first_speed * planning.times
    squared_along = (s - own_s) ** 2 / RESPONSES.along_per_aside**2
    squared_aside = (d - human.lateral_position) ** 2
    squared_distance = (squared_along + squared_aside).min(axis=1)  # [cars]
    squared_distance = jnp.where(counts, squared_distance, jnp.inf)
    squared_distance = squared_distance.at[0].set(-1.0)
    _, nearest = jax.lax.top_k(-squared_distance, 1 + RESPONSES.nearest_cars)
    heeded = jax.tree.map(lambda field: field[nearest], motion)
    return replace(human, others=heeded)


@cache
def _reward() -> Reward:
    heeded = {}
    for name, weight in commuter_weights().items():
        if name in RESPONSES.features:
            heeded[name] = weight
    return linear_reward(heeded, 1.0)
