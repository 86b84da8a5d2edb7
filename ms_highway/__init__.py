"""A robot car that decides online which model of the human driver is worth its computation.

Importing the package registers its environments with Gymnasium, see `ms_highway.envs`, and loads nothing else; the
names below are loaded when they are first used. `ms_highway.cli` is the command.
"""

from ms_highway.runtime import forks as forks
from ms_highway.runtime import interrupt

interrupt.watch()  # first of all, as what follows takes seconds

from importlib import import_module  # noqa: E402
from importlib.metadata import version  # noqa: E402
from typing import Any  # noqa: E402

from gymnasium.envs.registration import register as _register_environment  # noqa: E402
from gymnasium.envs.registration import registry as _registry  # noqa: E402

__version__ = version("ms-highway")

_HOMES = {
    "Autopilot": "envs.actions",
    "BicycleVehicle": "vehicle",
    "COMMON_WEIGHTS": "game.scenario",
    "CommuterVehicle": "vehicle",
    "FixedModel": "control.fixed",
    "Game": "game.game",
    "HumanModel": "planning.human_models",
    "HumanVehicle": "vehicle",
    "InteractionEnv": "envs.base",
    "ModelSwitching": "control.switching",
    "Naive": "planning.human_models",
    "PAPER_UNIT": "game.scenario",
    "PUBLISHED_COSTS": "metareasoning.switching",
    "PlanningVehicle": "vehicle",
    "RobotVehicle": "vehicle",
    "Scenario": "game.scenario",
    "Scene": "game.scene",
    "ScheduledModels": "control.fixed",
    "Switching": "metareasoning.switching",
    "TheoryOfMind": "planning.human_models",
    "Turn": "planning.human_models",
    "add_feature": "game.reward",
    "add_scenario": "envs",
    "build_game": "game.scenario",
    "decide": "metareasoning.switching",
    "driving_game": "game.scenario",
    "keep_compilations": "runtime.jax_settings",
    "ladder": "planning.human_models",
    "low_latency": "runtime.jax_settings",
    "plan": "planning.compiled",
    "register": "planning.human_models",
}
_PACKAGES = (
    "benchmarks",
    "cli",
    "control",
    "envs",
    "experiments",
    "game",
    "irl",
    "metareasoning",
    "optimization",
    "planning",
    "runtime",
    "simulation",
    "vehicle",
    "visualization",
)
_ENVIRONMENTS = {"stay-back": "StayBackEnv", "merger": "MergerEnv", "give-way": "GiveWayEnv"} | {
    "demonstration": "DemonstrationEnv"
}

__all__ = [*_HOMES, "__version__"]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """A name of the public interface, or a package, loaded when it is first asked for."""
    if name in _HOMES:
        return getattr(import_module(f"ms_highway.{_HOMES[name]}"), name)
    if name in _PACKAGES:
        return import_module(f"ms_highway.{name}")
    raise AttributeError(f"module 'ms_highway' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_PACKAGES])


for _name, _environment in _ENVIRONMENTS.items():  # by string, also for workers that are spawned
    if f"ms-highway/{_name}-v0" not in _registry:
        _register_environment(f"ms-highway/{_name}-v0", entry_point=f"ms_highway.envs:{_environment}")
