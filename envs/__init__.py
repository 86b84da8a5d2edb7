"""The environments: three scenarios of human and robot, and one to record driving in, as highway-env environments.

Importing this package registers the ids ``ms-highway/stay-back-v0``, ``ms-highway/merger-v0``,
``ms-highway/give-way-v0`` and ``ms-highway/demonstration-v0`` with Gymnasium.
"""

from gymnasium.envs.registration import register, registry

from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.demonstration import DemonstrationEnv
from ms_highway.envs.give_way import GiveWayEnv
from ms_highway.envs.merger import MergerEnv
from ms_highway.envs.stay_back import StayBackEnv
from ms_highway.scenario import Scenario

__all__ = [
    "DEMONSTRATION_ID",
    "ENVIRONMENTS",
    "SCENARIOS",
    "DemonstrationEnv",
    "GiveWayEnv",
    "MergerEnv",
    "StayBackEnv",
    "actions",
    "base",
    "configuration",
    "demonstration",
    "environment_id",
    "give_way",
    "graphics",
    "merger",
    "observations",
    "stage",
    "stay_back",
]

ENVIRONMENTS: dict[str, type[InteractionEnv]] = {
    environment.scenario.name: environment for environment in (StayBackEnv, MergerEnv, GiveWayEnv)
}
"""The environments by name of their scenario."""

SCENARIOS: dict[str, Scenario] = {name: environment.scenario for name, environment in ENVIRONMENTS.items()}
"""The scenarios by name."""

DEMONSTRATION_ID = "ms_highway:ms-highway/demonstration-v0"
"""The Gymnasium id of the `DemonstrationEnv`, with the prefix that lets spawned workers find it."""


def environment_id(scenario: str) -> str:
    """The Gymnasium id of a scenario; the module prefix lets spawned workers find it.

    Raises:
        ValueError: for an unknown scenario.
    """
    if scenario not in SCENARIOS:
        raise ValueError(f"unknown scenario {scenario!r}; the scenarios are {', '.join(SCENARIOS)}")
    return f"ms_highway:ms-highway/{scenario.replace('_', '-')}-v0"


def _register() -> None:
    """Register every id once, however often this runs."""
    classes = {environment_id(name): environment for name, environment in ENVIRONMENTS.items()}
    for identity, environment in {**classes, DEMONSTRATION_ID: DemonstrationEnv}.items():
        bare_id = identity.removeprefix("ms_highway:")
        if bare_id not in registry:
            register(bare_id, entry_point=f"{environment.__module__}:{environment.__name__}")


_register()
