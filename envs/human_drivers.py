"""Draw what drives each human of an environment, and make its controller.

A number stands for each driver: `ms_highway.loop.records.HUMAN_PLANS` for a human who
plans for its own reward, and the next ones for the drivers that
``config["human_driver"]`` or ``config["yielding"]`` names.
"""

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Int

from ms_highway.envs.keyboard import Keyboard
from ms_highway.game.game import Game
from ms_highway.game.starts import Random
from ms_highway.loop.controller import (
    HUMAN_DRIVERS,
    Controller,
    FunctionDriver,
    draw_key,
    is_vehicle,
)
from ms_highway.loop.driver import fixed
from ms_highway.loop.records import HUMAN_PLANS
from ms_highway.runtime.arrays import Array
from ms_highway.vehicle import HumanVehicle


def draw_drivers(
    names: tuple[str, ...],
    humans: int,
    random: Random,
) -> Int[Array, "humans"]:
    """Return the number of every human's driver.

    Args:
        names: of the drivers in use, see `ms_highway.envs.settings.Settings.drivers`.
        humans: their number.
        random: source of the draws.
    """
    first = HUMAN_PLANS + 1  # number of the first name

    # One of two drivers is drawn for each human.
    if len(names) > 1:
        return first + (random.uniform(size=humans) < 0.5)

    # The only name drives all of them, but the keyboard the first one alone; without a
    # name, they plan.
    only = HUMAN_PLANS + len(names)
    plans = (np.arange(humans) > 0) & (names == (Keyboard.name,))
    return np.where(plans, HUMAN_PLANS, only)


def vehicle_class(name: str | None) -> type[Vehicle]:
    """Return the class of the humans' vehicles.

    It is the driver of this name, if that is a class of highway-env vehicles, which
    drive by themselves.
    """
    driver = HUMAN_DRIVERS.get(name or "")
    if isinstance(driver, type) and issubclass(driver, Vehicle):
        return driver
    return HumanVehicle


def human_controller(
    game: Game,
    name: str | None,
    random: np.random.Generator,
) -> Controller | None:
    """Return what drives a human; None for a vehicle that drives by itself.

    Args:
        game: of the human.
        name: of its driver; None if it plans for its reward.
        random: source of the seed of a driver that draws random numbers.
    """
    if name is None:
        return fixed(game)
    driver = HUMAN_DRIVERS.get(name, Keyboard)
    if is_vehicle(driver):
        return None
    return FunctionDriver(game, name, driver, draw_key(driver, random))
