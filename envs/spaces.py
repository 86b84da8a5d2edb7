"""What an agent sees and does: all cars in the order of their roles, and who drives the robot."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from highway_env.envs.common import action as actions
from highway_env.envs.common import observation as observations
from highway_env.envs.common.action import ActionType
from highway_env.envs.common.observation import ObservationType

from ms_highway.choice.rule import Order
from ms_highway.envs.configuration import LARGEST

SPEED_RANGE = (0.0, 40.0)  # m/s, the highest is highway-env's
SCALES = np.array([100.0, 10.0, 40.0, 40.0, 1.0, 1.0])  # m, m, m/s, m/s, 1, 1


class CarStates(ObservationType):
    """``x, y, vx, vy, cos_h, sin_h`` of robot, humans and scripted cars, [cars, 6], scaled to about [-1, 1].

    The robot's row is absolute, the others' positions and velocities are relative to it, as in highway-env's
    ``Kinematics``; positions are divided by 100 m and 10 m, velocities by 40 m/s. Nothing is clipped: who drives
    further than 100 m still sees where it is.
    """

    def space(self) -> spaces.Box:
        """Return the space."""
        high = np.tile(np.array([LARGEST] * 4 + [1, 1], np.float32), (self.env.cars, 1))
        return spaces.Box(-high, high, dtype=np.float32)

    def observe(self) -> np.ndarray:
        """Return what is observed now."""
        x, y, heading, speed = self.env.car_states.T
        cosine, sine = np.cos(heading), np.sin(heading)
        rows = np.array([x, y, speed * cosine, speed * sine, cosine, sine]).T
        rows[1:, :4] -= rows[0, :4]
        return (rows / SCALES).clip(-LARGEST, LARGEST).astype(np.float32, order="C")


class CarTracks(ObservationType):
    """``presence, x, y, heading, speed`` of the driver and of all others, [cars, 5], in SI units, not scaled.

    Always as many rows as there may be cars; rows of absent cars are zero. ``env.car_states`` may hold anything there,
    ``env.present`` says which cars are there.
    """

    BOUND = 1e4  # m, rad or m/s; never reached

    def space(self) -> spaces.Box:
        """Return the space."""
        high = np.tile(np.array([1, *[self.BOUND] * 4], np.float32), (self.env.cars, 1))
        return spaces.Box(high * np.array([0, -1, -1, -1, -1], np.float32), high, dtype=np.float32)

    def observe(self) -> np.ndarray:
        """Return what is observed now."""
        present = self.env.present
        tracks = np.concatenate([present[:, None], self.env.car_states], axis=-1) * present[:, None]
        return tracks.clip(-self.BOUND, self.BOUND).astype(np.float32)


class TupleObservation(observations.TupleObservation):
    """Several observations at once, of highway-env's types and of this package's."""

    def __init__(self, env: Any, observation_configs: Sequence[Any], **_: Any) -> None:
        super().__init__(env, [])
        self.observation_types = [env.type_of(observations.observation_factory, each) for each in observation_configs]


def finite(space: spaces.Space) -> spaces.Space:
    """Replace infinite bounds of a space, which some of highway-env's observations have, by the ends of its type.

    Raises:
        ValueError: for a space of nothing, which a ``TimeToCollision`` has before a car without target speeds.
    """
    if isinstance(space, spaces.Tuple):
        return spaces.Tuple([finite(part) for part in space])
    if type(space) is spaces.Space:
        raise ValueError("TimeToCollision needs a car with target speeds; give the action 'DiscreteMetaAction'")
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        return space
    end = np.finfo(space.dtype).max
    return spaces.Box(np.maximum(space.low, -end), np.minimum(space.high, end), dtype=space.dtype.type)


def limit_speed(kind: actions.ContinuousAction, speed_range: Sequence[float] | None) -> None:
    """Let a type of actions keep its car within a range of speeds [m/s]; None sets no limits.

    No subclass does, as highway-env's keyboard drives its own class only.
    """
    kind.speed_range = speed_range and tuple(speed_range)
    kind.get_action = partial(_within_speeds, kind)


def _within_speeds(kind: actions.ContinuousAction, action: np.ndarray) -> dict[str, float]:
    """Return the control of an action, less what would lead beyond the range of speeds."""
    control, vehicle = actions.ContinuousAction.get_action(kind, action), kind.controlled_vehicle
    if kind.speed_range is not None:
        changes = (np.array(kind.speed_range) - vehicle.speed) * kind.env.config["simulation_frequency"]
        friction = getattr(vehicle, "friction", 0.0)
        least, most = min(changes[0], 0.0) + friction, max(changes[1], 0.0) + friction
        control["acceleration"] = float(np.clip(control["acceleration"], least, most))
    return control


class Autopilot(ActionType):
    """The robot drives itself, as ``config["controller"]`` says; the only action, 0, lets it."""

    def space(self) -> spaces.Space:
        """Return the space."""
        return spaces.Discrete(1)

    def act(self, action: Any) -> None:
        """Nothing to do: the robot plans when the road asks all vehicles to act."""


class HumanModelAction(Autopilot):
    """The agent chooses every human's model by its place in ``config["ladder"]``; the robot plans with them.

    The environment's reward is then that of the paper's meta-MDP, ``r_R - lambda T(M)``, with ``lambda`` from this
    action's configuration and T from ``config["costs"]``.
    """

    def space(self) -> spaces.Space:
        """Return the space."""
        rungs, humans = len(self.env.settings.models), self.env.settings.humans
        return spaces.Discrete(rungs) if humans == 1 else spaces.MultiDiscrete([rungs] * humans)

    def act(self, action: Any) -> None:
        """Choose the models of the coming plan."""
        self.controlled_vehicle.controller.rule = Order(np.reshape(action, (1, -1)), self.env.settings.models)
