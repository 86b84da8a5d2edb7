"""A robot car that decides online which model of the human driver is worth its computation.

Importing the package registers its environments with Gymnasium, see `envs`, and those of highway-env; the names in
``__init__.pyi`` are loaded when they are first used. `ms_highway.cli` is the command.
"""

from ms_highway.runtime import forks, interrupt  # noqa: F401  # a hook is set when the first is imported

interrupt.watch()  # first of all, as what follows takes seconds

from importlib.metadata import version  # noqa: E402

import lazy_loader  # noqa: E402
from gymnasium.envs.registration import register as _register_environment  # noqa: E402
from gymnasium.envs.registration import registry as _registry  # noqa: E402

if not interrupt.is_command():  # which loads it when it needs it
    import highway_env  # noqa: F401  # whose own environments are expected beside ours

__version__ = version("ms-highway")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

_ENVIRONMENTS = {
    "stay-back": "StayBackEnv",
    "merger": "MergerEnv",
    "give-way": "GiveWayEnv",
    "dense-merge": "DenseMergeEnv",
    "crossing-crowd": "CrossingCrowdEnv",
    "demonstration": "DemonstrationEnv",
}

for _name, _environment in _ENVIRONMENTS.items():  # by string, also for workers that are spawned
    if f"ms-highway/{_name}-v0" not in _registry:
        _register_environment(f"ms-highway/{_name}-v0", entry_point=f"ms_highway.envs:{_environment}")
