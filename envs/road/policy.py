"""Drive a stock environment from outside, as a policy of stable-baselines3 would: by continuous actions."""

from collections.abc import Mapping
from math import asin, atan, sin, tan
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.envs.common.action import ContinuousAction, DiscreteAction
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Bool, Float

from ms_highway.control.road import RoadDriver, RoadStep
from ms_highway.envs.road.driven import check_drivable, normalised
from ms_highway.envs.road.goals import desired_speed_of, destination_of
from ms_highway.envs.road.settings import RoadSettings
from ms_highway.vehicle.road_robot import MARGIN, PERIOD, Motion, held
from ms_highway.vehicle.road_scene import observe_road

__all__ = ["RoadPolicy"]

SLOWEST = 4.0  # Hz, of actions
