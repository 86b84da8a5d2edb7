"""Provide highway-env vehicles, importable from here, and their view of a road.

Imports `ms_highway.loop` and the packages below it.
"""

from ms_highway.vehicle.bicycle import BicycleVehicle, RoutedVehicle, ScriptedVehicle
from ms_highway.vehicle.planning import CommuterVehicle, HumanVehicle, PlanningVehicle, RobotVehicle
from ms_highway.vehicle.road_view import states_of

__all__ = [
    "BicycleVehicle",
    "CommuterVehicle",
    "HumanVehicle",
    "PlanningVehicle",
    "RobotVehicle",
    "RoutedVehicle",
    "ScriptedVehicle",
    "bicycle",
    "planning",
    "road_view",
    "states_of",
]
