"""A robot car that decides online which model of the human is worth its computation.

The method is that of Sripathy, Bobu, Brown and Dragan (ICRA 2021), the roads are
highway-env's, and what computes is JAX. To start::

    import gymnasium as gym
    import ms_highway  # registers the environments

    controller = {"type": "learned", "lambda": 1.0}
    env = gym.make("ms-highway/merger-v1", config={"controller": controller})
    observation, info = env.reset(seed=0)
    # The robot drives itself; 0 is the only action.
    observation, reward, terminated, truncated, info = env.step(0)

or in a shell, ``ms-highway compare`` and ``ms-highway --help``.

* Environments: ``ms-highway/stay-back-v1``, ``merger-v1`` and ``give-way-v1``, with one
  human, and ``dense-merge-v1`` and ``crossing-crowd-v1``, with several, all within what
  tyres hold. Version 0 with one human is the paper's scene; version 0 with several is
  easier. Further, ``demonstration-v0``, traffic to record driving
  in, see `ms_highway.envs.DemonstrationEnv`; and ``recorded-v0``, recorded traffic with
  its planning problems, see `ms_highway.recorded.RecordedEnv`. `drive` lets the robot
  drive that and highway-env's own.
* One's own: `register` adds a human model, `add_rule` a decision rule, `add_scenario` a
  scenario, `add_feature` a feature of rewards, `add_driver` a driver of humans or of
  the robot, and `add_agent` an agent.
* Parts: `plan`, one plan; `Driver`, what drives a car by any rule; `RobotVehicle` and
  `HumanVehicle`, for roads of one's own.

The names in ``__init__.pyi`` are loaded when they are first used.
"""

from ms_highway.runtime import process

# First of all, as what follows takes seconds.
process.watch()

import warnings as _warnings  # noqa: E402
from importlib.metadata import version  # noqa: E402
from importlib.util import find_spec as _find_spec  # noqa: E402
from pathlib import Path as _Path  # noqa: E402

import lazy_loader  # noqa: E402
from gymnasium.envs.registration import register as _register_environment  # noqa: E402
from gymnasium.envs.registration import registry as _registry  # noqa: E402

from ms_highway.runtime import names as _names  # noqa: E402

if getattr(_find_spec("pygame"), "origin", None) is None:
    raise ImportError(
        "pygame is not whole: pygame and pygame-ce share a folder, and uninstalling one"
        " breaks the other; run `pip install --force-reinstall pygame-ce`"
    )
if not process.is_command():
    # Users expect highway-env's environments beside ours. The command loads them when
    # it needs them.
    import highway_env  # noqa: F401

_directory = _Path(__file__).parent
if not (_directory / "envs").is_dir():
    # In a checkout without symbolic links, envs/ lies beside this directory.
    __path__.append(str(_directory.parent))

__version__ = version("ms-highway")
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Entry points are strings, so that nothing is loaded before an environment is made.
_ENTRY_POINTS: dict[str, tuple[str, str | None]] = {
    "demonstration-v0": ("ms_highway.envs:DemonstrationEnv", None),
    "recorded-v0": ("ms_highway.recorded:RecordedEnv", None),
}
for _scenario in _names.SCENARIO_NAMES:
    _id = _names.versioned(_scenario)
    _ENTRY_POINTS[_id] = (
        f"ms_highway.envs:{_names.environment_class_name(_scenario)}",
        f"ms_highway.envs.vector:{_id}",
    )

for _id, (_single, _vector) in _ENTRY_POINTS.items():
    if f"ms-highway/{_id}" not in _registry:
        _register_environment(f"ms-highway/{_id}", _single, vector_entry_point=_vector)

# Version 0 is the paper's physics, not an older version of the same: Gymnasium's advice
# to upgrade is wrong there.
_warnings.filterwarnings(
    "ignore", ".*ms-highway/[a-z-]*-v0 is out of date", DeprecationWarning
)
