"""A robot car that decides online which model of the human driver is worth its computation.

Importing the package registers its environments with Gymnasium, see `envs`, and those of highway-env; the names below
are loaded when they are first used. `ms_highway.cli` is the command.
"""

from ms_highway.runtime import forks as forks
from ms_highway.runtime import interrupt

interrupt.watch()  # first of all, as what follows takes seconds

from importlib import import_module  # noqa: E402
from importlib.metadata import version  # noqa: E402
from pkgutil import iter_modules  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from gymnasium.envs.registration import register as _register_environment  # noqa: E402
from gymnasium.envs.registration import registry as _registry  # noqa: E402

if not interrupt.is_command():  # which loads it when it needs it
    import highway_env  # noqa: F401  # whose own environments are expected beside ours

if TYPE_CHECKING:
    from ms_highway.control.fixed import FixedModel as FixedModel
    from ms_highway.control.fixed import ScheduledModels as ScheduledModels
    from ms_highway.control.switching import ModelSwitching as ModelSwitching
    from ms_highway.envs import SCENARIOS as SCENARIOS
    from ms_highway.envs import add_scenario as add_scenario
    from ms_highway.envs.spaces import Autopilot as Autopilot
    from ms_highway.envs.base import InteractionEnv as InteractionEnv
    from ms_highway.envs.road import RoadPolicy as RoadPolicy
    from ms_highway.envs.road import drive as drive
    from ms_highway.game.game import Game as Game
    from ms_highway.game.reward import add_feature as add_feature
    from ms_highway.game.scenario import COMMON_WEIGHTS as COMMON_WEIGHTS
    from ms_highway.game.scenario import PAPER_UNIT as PAPER_UNIT
    from ms_highway.game.scenario import Scenario as Scenario
    from ms_highway.game.scenario import build_game as build_game
    from ms_highway.game.scenario import driving_game as driving_game
    from ms_highway.game.scene import Scene as Scene
    from ms_highway.metareasoning.horizon import WholeHorizon as WholeHorizon
    from ms_highway.metareasoning.rule import PUBLISHED_COSTS as PUBLISHED_COSTS
    from ms_highway.metareasoning.switching import Switching as Switching
    from ms_highway.metareasoning.switching import decide as decide
    from ms_highway.planning.compiled_plans import plan as plan
    from ms_highway.planning.human_models import HumanModel as HumanModel
    from ms_highway.planning.human_models import Naive as Naive
    from ms_highway.planning.human_models import TheoryOfMind as TheoryOfMind
    from ms_highway.planning.human_models import Turn as Turn
    from ms_highway.planning.human_models import ladder as ladder
    from ms_highway.planning.human_models import register as register
    from ms_highway.runtime.jax_settings import keep_compilations as keep_compilations
    from ms_highway.runtime.jax_settings import low_latency as low_latency
    from ms_highway.vehicle import BicycleVehicle as BicycleVehicle
    from ms_highway.vehicle import CommuterVehicle as CommuterVehicle
    from ms_highway.vehicle import HumanVehicle as HumanVehicle
    from ms_highway.vehicle import PlanningVehicle as PlanningVehicle
    from ms_highway.vehicle import RobotVehicle as RobotVehicle
    from ms_highway.vehicle.road_robot import RoadRobot as RoadRobot

__version__ = version("ms-highway")

_HOMES = {
    name: home
    for home, names in {
        "vehicle": ["BicycleVehicle", "CommuterVehicle", "HumanVehicle", "PlanningVehicle", "RobotVehicle"],
        "vehicle.road_robot": ["RoadRobot"],
        "control.fixed": ["FixedModel", "ScheduledModels"],
        "control.switching": ["ModelSwitching"],
        "envs": ["SCENARIOS", "add_scenario"],
        "envs.base": ["InteractionEnv"],
        "envs.spaces": ["Autopilot"],
        "envs.road": ["RoadPolicy", "drive"],
        "game.game": ["Game"],
        "game.scene": ["Scene"],
        "game.scenario": ["COMMON_WEIGHTS", "PAPER_UNIT", "Scenario", "build_game", "driving_game"],
        "game.reward": ["add_feature"],
        "planning.human_models": ["HumanModel", "Naive", "TheoryOfMind", "Turn", "ladder", "register"],
        "planning.compiled_plans": ["plan"],
        "metareasoning.rule": ["PUBLISHED_COSTS"],
        "metareasoning.horizon": ["WholeHorizon"],
        "metareasoning.switching": ["Switching", "decide"],
        "runtime.jax_settings": ["keep_compilations", "low_latency"],
    }.items()
    for name in names
}
_PACKAGES = [module.name for module in iter_modules(__path__) if module.ispkg]
_ENVIRONMENTS = {
    "stay-back": "StayBackEnv",
    "merger": "MergerEnv",
    "give-way": "GiveWayEnv",
    "dense-merge": "DenseMergeEnv",
    "crossing-crowd": "CrossingCrowdEnv",
    "demonstration": "DemonstrationEnv",
}


def __getattr__(name: str) -> Any:
    """Load a public name or a package when it is first asked for; whoever asks for ``__all__`` loads all of them."""
    if name == "__all__":
        return [each for each in (*_HOMES, *_PACKAGES) if __getattr__(each) is not None]
    if name in _HOMES:
        value = getattr(import_module(f"ms_highway.{_HOMES[name]}"), name)
    elif name in _PACKAGES:
        value = import_module(f"ms_highway.{name}")
    else:
        raise AttributeError(f"module 'ms_highway' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*_HOMES, *_PACKAGES, *(name for name in globals() if name.startswith("__"))})


for _name, _environment in _ENVIRONMENTS.items():  # by string, also for workers that are spawned
    if f"ms-highway/{_name}-v0" not in _registry:
        _register_environment(f"ms-highway/{_name}-v0", entry_point=f"ms_highway.envs:{_environment}")
