"""Define what an agent observes, and which actions it has.

Observations have all cars in the order of their roles.
"""

from collections.abc import Sequence
from functools import partial
from typing import ClassVar, TypeAlias

import numpy as np
from gymnasium import spaces
from highway_env.envs.common import action as actions
from highway_env.envs.common import observation as observations
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.observation import ObservationType
from jaxtyping import Float

from ms_highway.choice.rule import in_order
from ms_highway.envs.configuration import Config
from ms_highway.game.dynamics import Dynamics, facing, keep_velocity
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Array, Numbers, Vector
from ms_highway.vehicle import BicycleVehicle

States: TypeAlias = Float[Array, "*batch cars 4"]

# Observations


class CarStates(ObservationType):
    """``x, y, vx, vy, cos_h, sin_h`` of robot, humans and scripted cars, [cars, 6],
    scaled to about [-1, 1].

    The robot's row is absolute, the others' positions and velocities are relative to
    it, as in highway-env's ``Kinematics``; positions are divided by 100 m and 10 m,
    velocities by 40 m/s. Positions beyond 100 m are not clipped.
    """

    scales: ClassVar[Vector] = np.array([100.0, 10.0, 40.0, 40.0, 1.0, 1.0])
    """What the columns are divided by [m, m, m/s, m/s, 1, 1]."""
    extremes: ClassVar[tuple[float, float]] = (400.0, 1000.0)
    """Speed and distance to the side that 50 m/s^2 does not exceed [m/s, m]."""

    def __init__(self, env: AbstractEnv, **_: object) -> None:
        super().__init__(env)
        speed, y = self.extremes
        x = 100.0 + speed * env.config["duration"]
        largest = np.array([x, y, speed, speed, 1.0, 1.0]) / self.scales
        low, high = self.ends(largest)
        self.low = np.tile(np.float32(low), (env.cars, 1))
        self.high = np.tile(np.float32(high), (env.cars, 1))

    def ends(self, largest: Vector) -> tuple[Numbers, Numbers]:
        """Return the lowest and the highest value of each column.

        They follow from the largest scaled values that states have.
        """
        return -largest, largest

    def columns(self, states: States, time_left: Numbers) -> list[Numbers]:
        """Return the columns [..., cars] of states [..., cars, 4].

        ``time_left`` is the share of the episode's time that is left.
        """
        xp = states.__array_namespace__()
        x, y, heading, speed = xp.moveaxis(states, -1, 0)
        cosine = xp.cos(heading)
        sine = xp.sin(heading)

        # Positions and velocities of the others are relative to the robot.
        is_other = np.arange(states.shape[-2]) > 0
        columns = []
        for absolute in (x, y, speed * cosine, speed * sine):
            robot = absolute[..., :1]
            columns.append(absolute - is_other * robot)

        columns += [cosine, sine]
        scaled = zip(columns, self.scales, strict=True)
        return [column / scale for column, scale in scaled]

    def space(self) -> spaces.Box:
        """Return the space."""
        return spaces.Box(self.low, self.high, dtype=np.float32)

    def observe(self) -> np.ndarray:
        """Return the observation of the present state."""
        time_left = 1 - self.env.steps / self.env.episode_steps
        observation = self.of(self.env.car_states, np.array(time_left))
        return np.asarray(observation)

    def of(self, states: States, time_left: Numbers) -> Numbers:
        """Return the observations of states [..., cars, 4], in NumPy or JAX.

        They are clipped to the bounds of the space.
        """
        xp = states.__array_namespace__()
        rows = xp.stack(self.columns(states, time_left), axis=-1)
        return xp.clip(rows, self.low, self.high).astype(np.float32)


class SceneStates(CarStates):
    """Everything that an agent needs to know of a scene, [cars, 9]: robot, humans and
    scripted cars.

    ``presence``, 1, or 0 for an absent car; ``x, y, vx, vy, cos_h, sin_h`` as in
    `CarStates`; ``cone_distance``, from the car's front to the first cone ahead in its
    lane, divided by 100 m and at most 1; and ``time_left``, the share of the episode's
    time that is left, the same in all rows.
    """

    extremes = (80.0, 100.0)

    def ends(self, largest: Vector) -> tuple[Numbers, Numbers]:
        """See `CarStates`."""
        low = np.array([0.0, *-largest, 0.0, 0.0])
        high = np.array([1.0, *largest, 1.0, 1.0])
        return low, high

    def columns(self, states: States, time_left: Numbers) -> list[Numbers]:
        """See `CarStates`."""
        xp = states.__array_namespace__()
        presence = xp.ones_like(states[..., 0])
        motion = super().columns(states, time_left)
        distances = cone_distances(self.env.game.scene, states)
        scaled_distances = distances / self.scales[0]
        time_left_of_all = presence * xp.asarray(time_left)[..., None]
        return [presence, *motion, scaled_distances, time_left_of_all]


def cone_distances(scene: Scene, states: States) -> Float[Array, "*batch cars"]:
    """Return every car's distance to the first cone ahead in its lane [m].

    It counts from the car's front, and is infinite without a cone.
    """
    xp = states.__array_namespace__()
    cones = np.asarray(scene.obstacles, dtype=float)

    # From every car to every cone, [..., cars, cones].
    along = cones[:, 0] - states[..., 0, None]
    across = cones[:, 1] - states[..., 1, None]
    in_lane = xp.abs(across) < float(scene.lane_width) / 2
    counts = (along > 0) & in_lane
    nearest = xp.min(xp.where(counts, along, xp.inf), axis=-1, initial=xp.inf)

    # From front to front, instead of from centre to centre.
    lengths = float(scene.obstacle_size[0] + scene.car_size[0])
    return nearest - lengths / 2


class CarTracks(CarStates):
    """``presence, x, y, heading, speed`` of the driver and of all other cars, [cars,
    5], in SI units, not scaled.

    There is a row for every car that there may be; rows of absent cars are zero.
    ``env.present`` says which are there.
    """

    bound = 1e4
    """Bound of all numbers, which none reaches [m, rad, m/s]."""

    def ends(self, largest: Vector) -> tuple[Numbers, Numbers]:
        """See `CarStates`."""
        bounds = [self.bound] * 4
        high = np.array([1.0, *bounds])
        low = np.array([0.0, *np.negative(bounds)])
        return low, high

    def columns(self, states: States, time_left: Numbers) -> list[Numbers]:
        """See `CarStates`."""
        present = self.env.present
        # x, y, heading and speed of all cars: [4, cars].
        motion = facing(states).T * present
        return [present, *motion]


class TupleObservation(observations.TupleObservation):
    """Several observations at once, of types of highway-env and of this package."""

    def __init__(
        self,
        env: AbstractEnv,
        observation_configs: Sequence[Config],
        **_: object,
    ) -> None:
        super().__init__(env, [])
        self.observation_types = [
            env.type_of(observations.observation_factory, each)
            for each in observation_configs
        ]


def finite(space: spaces.Space) -> spaces.Space:
    """Replace infinite bounds of a space by the limits of its dtype.

    Some of highway-env's observations have such bounds.

    Raises:
        ValueError: for the space of a ``TimeToCollision`` without shape, which a car
            without target speeds causes.
    """
    if isinstance(space, spaces.Tuple):
        return spaces.Tuple([finite(part) for part in space])
    if type(space) is spaces.Space:
        raise ValueError(
            "TimeToCollision needs a car with target speeds; give the action"
            " 'DiscreteMetaAction'"
        )
    if isinstance(space, spaces.Box):
        low = np.nan_to_num(space.low)
        high = np.nan_to_num(space.high)
        return spaces.Box(low, high, dtype=space.dtype.type)
    return space


# Actions


def is_possible(space: spaces.Space, action: object) -> bool:
    """Return whether an environment can take an action.

    It is one of its space, or of finite numbers beyond a box's ends. highway-env clips
    these to the ends.
    """
    if not isinstance(space, spaces.Box):
        return bool(space.contains(action))
    try:
        numbers = np.asarray(action)
    except ValueError:
        # NumPy refuses lists of different lengths.
        return False
    if numbers.shape != space.shape or numbers.dtype.kind not in "biuf":
        return False
    return bool(np.isfinite(numbers).all())


def limit_speed(
    kind: actions.ContinuousAction,
    speed_range: Sequence[float] | None,
) -> None:
    """Let a type of actions keep its car within a range of speeds [m/s].

    None sets no limits. This changes the object instead of its class, as highway-env's
    keyboard drives no subclass.
    """
    kind.speed_range = speed_range
    kind.get_action = partial(_limited_action, kind)


def _limited_action(
    kind: actions.ContinuousAction,
    action: np.ndarray,
) -> dict[str, float]:
    """Return the control of an action, within the range of speeds.

    The acceleration is limited for it.
    """
    control = actions.ContinuousAction.get_action(kind, action)
    vehicle = kind.controlled_vehicle
    friction = vehicle.friction if isinstance(vehicle, BicycleVehicle) else 0.0
    acceleration = np.array(control["acceleration"])
    speed = np.array(vehicle.speed)
    limited = _within_speeds(kind, acceleration, speed, friction)
    return control | {"acceleration": float(limited)}


def _within_speeds(
    kind: actions.ContinuousAction,
    acceleration: Numbers,
    speed: Numbers,
    friction: float | Numbers,
) -> Numbers:
    """Limit accelerations that would leave the range of speeds within a step.

    Args:
        kind: of actions, which has the range.
        acceleration: that is asked for, before friction [m/s^2].
        speed: of the cars now [m/s].
        friction: acceleration that keeps the speed [m/s^2].
    """
    if kind.speed_range is None:
        return acceleration
    xp = speed.__array_namespace__()
    frequency = kind.env.config["simulation_frequency"]
    slowest, fastest = kind.speed_range
    lowest = xp.minimum((slowest - speed) * frequency, 0.0)
    highest = xp.maximum((fastest - speed) * frequency, 0.0)
    return xp.clip(acceleration, lowest + friction, highest + friction)


def executed_controls(
    kind: actions.ContinuousAction,
    dynamics: Dynamics,
    action: Float[Array, "*batch 2"],
    cars: Float[Array, "*batch 4"],
) -> Float[Array, "*batch 2"]:
    """Return the controls (omega, acceleration) that cars execute for actions."""
    xp = cars.__array_namespace__()
    speed = cars[..., 3]

    # The shares of the ranges, from 0 to 1.
    clipped = xp.clip(action, -1, 1) if kind.clip else action
    shares = (clipped + 1) / 2
    lowest, highest = kind.acceleration_range
    acceleration = lowest + shares[..., 0] * (highest - lowest)
    left, right = kind.steering_range
    steering = left + shares[..., 1] * (right - left)

    # Keep within the range of speeds.
    friction = keep_velocity(dynamics, cars)[..., 1]
    acceleration = _within_speeds(kind, acceleration, speed, friction)

    # Steering is the angle of the front wheels: curvature = tan(angle) / length.
    curvature = xp.tan(steering) / BicycleVehicle.LENGTH
    omega = curvature if dynamics.steering == "curvature" else curvature * speed
    return xp.stack([omega, acceleration], axis=-1)


class Autopilot(ActionType):
    """Lets the robot's controller drive; the only action is 0."""

    def space(self) -> spaces.Space:
        """Return the space."""
        return spaces.Discrete(1)

    def act(self, action: object) -> None:
        """Do nothing: the robot plans when the road lets all vehicles act."""


class HumanModelAction(Autopilot):
    """Lets the agent choose every human's model, with which the robot plans.

    A model is its place in ``config["ladder"]``. The reward is that of the paper's
    meta-MDP, ``r_R - lambda T(M)``, with ``lambda`` from the configuration of this
    action and T from ``config["costs"]``.
    """

    def space(self) -> spaces.Space:
        """Return the space."""
        rungs = len(self.env.settings.models)
        humans = self.env.settings.humans
        if humans == 1:
            return spaces.Discrete(rungs)
        return spaces.MultiDiscrete([rungs] * humans)

    def act(self, action: object) -> None:
        """Choose the models of the coming plan."""
        order = np.asarray(action).reshape(1, -1)  # [steps = 1, humans]
        rule = in_order(order, self.env.settings.models)
        self.controlled_vehicle.controller.rule = rule
