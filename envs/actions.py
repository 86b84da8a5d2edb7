"""Who drives the robot: its own controller, or an agent that chooses the human model."""

from typing import Any

from gymnasium import spaces
from highway_env.envs.common.action import ActionType

from ms_highway.vehicle import RobotVehicle

__all__ = ["Autopilot", "HumanModelAction"]


class Autopilot(ActionType):
    """The robot drives itself, as ``config["controller"]`` says; the only action, 0, lets it."""

    def space(self) -> spaces.Discrete:
        return spaces.Discrete(1)

    @property
    def vehicle_class(self) -> type[RobotVehicle]:
        return RobotVehicle

    def act(self, action: int) -> None:
        """Nothing to do: the robot plans when the road asks all vehicles to act.

        Raises:
            ValueError: if the action is not 0.
        """
        if not self.space().contains(action):
            raise ValueError(f"action {action!r} is not 0, the only action of the autopilot")


class HumanModelAction(ActionType):
    """The agent chooses the human model by its place in ``config["ladder"]``; the robot plans with it.

    The environment's reward is then that of the paper's meta-MDP, ``r_R - lambda T(M)``, with ``lambda`` from this
    action's configuration and T from ``config["costs"]``.

    Args:
        env: the environment.
        price: ``lambda``, reward per second of planning.
    """

    def __init__(self, env: Any, price: float) -> None:
        super().__init__(env)
        self.price = price

    def space(self) -> spaces.Discrete:
        return spaces.Discrete(len(self.env.config["ladder"]))

    @property
    def vehicle_class(self) -> type[RobotVehicle]:
        return RobotVehicle

    def act(self, action: int) -> None:
        """Choose the model of the coming plan.

        Raises:
            ValueError: if the action is no place in the ladder.
        """
        if not self.space().contains(action):
            raise ValueError(f"action {action!r} is no place in the ladder {self.env.config['ladder']}")
        self.controlled_vehicle.controller.model = self.env.models[int(action)]
