"""Provide highway-env vehicles and what they see of a road; all classes can be imported from here.

Imports `ms_highway.loop` and what stands below it.
"""

from ms_highway.vehicle.bicycle import BicycleVehicle, RoutedVehicle, ScriptedVehicle
from ms_highway.vehicle.human import CommuterVehicle, HumanVehicle
from ms_highway.vehicle.planning import PlanningVehicle, RobotVehicle
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
    "human",
    "planning",
    "road_view",
    "states_of",
]
