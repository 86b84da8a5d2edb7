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
from typing import Any  # noqa: E402

from gymnasium.envs.registration import register as _register_environment  # noqa: E402
from gymnasium.envs.registration import registry as _registry  # noqa: E402

if not interrupt.is_command():  # which loads it when it needs it
    import highway_env  # noqa: F401  # whose own environments are expected beside ours

__version__ = version("ms-highway")

_HOMES = {
    name: home
    for home, names in {
        "vehicle": ["BicycleVehicle", "CommuterVehicle", "HumanVehicle", "PlanningVehicle", "RobotVehicle"],
        "control.fixed": ["FixedModel", "ScheduledModels"],
        "control.switching": ["ModelSwitching"],
        "envs": ["SCENARIOS", "add_scenario"],
        "envs.base": ["InteractionEnv"],
        "envs.actions": ["Autopilot"],
        "game.game": ["Game"],
        "game.scene": ["Scene"],
        "game.scenario": ["COMMON_WEIGHTS", "PAPER_UNIT", "Scenario", "build_game", "driving_game"],
        "game.reward": ["add_feature"],
        "planning.human_models": ["HumanModel", "Naive", "TheoryOfMind", "Turn", "ladder", "register"],
        "planning.compiled": ["plan"],
        "metareasoning.switching": ["PUBLISHED_COSTS", "Switching", "decide"],
        "runtime.jax_settings": ["keep_compilations", "low_latency"],
    }.items()
    for name in names
}
_PACKAGES = [module.name for module in iter_modules(__path__) if module.ispkg]
_ENVIRONMENTS = {
    "stay-back": "StayBackEnv",
    "merger": "MergerEnv",
    "give-way": "GiveWayEnv",
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
    return [*globals(), *_HOMES, *_PACKAGES]


for _name, _environment in _ENVIRONMENTS.items():  # by string, also for workers that are spawned
    if f"ms-highway/{_name}-v0" not in _registry:
        _register_environment(f"ms-highway/{_name}-v0", entry_point=f"ms_highway.envs:{_environment}")
