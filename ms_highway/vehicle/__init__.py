"""Provide highway-env vehicles, importable from here.

Imports `ms_highway.loop` and the packages below it.
"""

from ms_highway.vehicle.bicycle import (
    BicycleVehicle,
    RoutedVehicle,
    ScriptedVehicle,
    states_of,
)
from ms_highway.vehicle.commuter import CommuterVehicle, FollowingVehicle
from ms_highway.vehicle.planning import HumanVehicle, PlanningVehicle, RobotVehicle

__all__ = [
    "BicycleVehicle",
    "CommuterVehicle",
    "FollowingVehicle",
    "HumanVehicle",
    "PlanningVehicle",
    "RobotVehicle",
    "RoutedVehicle",
    "ScriptedVehicle",
    "bicycle",
    "commuter",
    "planning",
    "right_of_way",
    "states_of",
    "ways",
]
