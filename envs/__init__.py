"""The environments: scenarios of a robot with one human or several, and one to record driving in.

``import ms_highway`` registers these ids with Gymnasium: ``ms-highway/stay-back-v1``, ``merger-v1``, ``give-way-v1``
and ``dense-merge-v1``, in which cars keep to what tyres hold; the same scenes at version 0; ``crossing-crowd-v0`` and
``demonstration-v0``; and those of other packages. Imports `ms_highway.vehicle` and the packages below it.
"""

import re
import sys
from typing import cast

import gymnasium
from gymnasium.envs.registration import EnvCreator

from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import check_name
from ms_highway.envs.demonstration import DemonstrationEnv
from ms_highway.envs.scenes import (
    CrossingCrowdEnv,
    DenseMergeEnv,
    DenseMergeV1Env,
    GiveWayEnv,
    GiveWayV1Env,
    MergerEnv,
    MergerV1Env,
    StayBackEnv,
    StayBackV1Env,
)
from ms_highway.game.scenario import Scenario

__all__ = [
    "DEMONSTRATION_ID",
    "ENVIRONMENTS",
    "PAPER_SCENARIOS",
    "SCENARIOS",
    "CrossingCrowdEnv",
    "DemonstrationEnv",
    "DenseMergeEnv",
    "DenseMergeV1Env",
    "GiveWayEnv",
    "GiveWayV1Env",
    "InteractionEnv",
    "MergerEnv",
    "MergerV1Env",
    "StayBackEnv",
    "StayBackV1Env",
    "add_scenario",
    "environment_id",
    "scenario_name",
]

ENVIRONMENTS: dict[str, type[InteractionEnv]] = {
    environment.scenario.name: environment
    for environment in (
        StayBackEnv,
        MergerEnv,
        GiveWayEnv,
        DenseMergeEnv,
        CrossingCrowdEnv,
        StayBackV1Env,
        MergerV1Env,
        GiveWayV1Env,
        DenseMergeV1Env,
    )
}
"""The environments by the names of their scenarios."""

SCENARIOS: dict[str, Scenario] = {name: environment.scenario for name, environment in ENVIRONMENTS.items()}
"""The scenarios by name."""

PACKAGE_SCENARIOS = tuple(SCENARIOS)
PAPER_SCENARIOS = ("stay_back", "merger", "give_way")
"""Names of the paper's scenarios."""

VERSIONED = re.compile(r".*-v\d+")
"""Names of scenarios that end in a version; the other scenarios are at version 0."""

DEMONSTRATION_ID = "ms_highway:ms-highway/demonstration-v0"
"""The Gymnasium id of the `DemonstrationEnv`; its prefix lets spawned workers find it."""


def scenario_name(name: str) -> str:
    """Return the name of the scenario with a name or an id: ``merger`` for ``ms-highway/merger-v0``.

    Raises:
        ValueError: for an unknown scenario, and for an id without a version.
    """
    bare = name.rpartition("/")[2]
    known = bare.removesuffix("-v0").replace("-", "_") if bare.endswith("-v0") else bare
    if known in ENVIRONMENTS and (bare == name or VERSIONED.fullmatch(bare)):
        return known
    raise ValueError(f"unknown scenario {name!r}; the scenarios are {', '.join(ENVIRONMENTS)}")


def _versioned(scenario: str) -> str:
    """Return the last part of a scenario's id: ``merger-v0`` for ``merger``."""
    return scenario if VERSIONED.fullmatch(scenario) else f"{scenario.replace('_', '-')}-v0"


def environment_id(scenario: str) -> str:
    """Return the Gymnasium id of a scenario; the module prefix lets spawned workers find it.

    Raises:
        ValueError: for an unknown scenario.
    """
    return f"ms_highway:ms-highway/{_versioned(scenario_name(scenario))}"


def add_scenario(environment: type[InteractionEnv]) -> str:
    """Add a scenario of one's own by its name, for Gymnasium and for comparisons and videos of this process.

    It replaces an added scenario of the same name. The specification of its environments can be written as JSON if its
    class can be imported from a module.

    Args:
        environment: class of its environments, with a `Scenario` whose name is one word in lower case.

    Returns:
        The Gymnasium id.

    Raises:
        ValueError: if the package has a scenario of this name, or if it is not such a word.
    """
    name = environment.scenario.name
    check_name("a scenario", name, PACKAGE_SCENARIOS)
    ENVIRONMENTS[name], SCENARIOS[name] = environment, environment.scenario
    bare_id = environment_id(name).removeprefix("ms_highway:")
    gymnasium.registry.pop(bare_id, None)
    module, word = environment.__module__, environment.__qualname__
    importable = getattr(sys.modules.get(module), word, None) is environment
    entry_point = f"{module}:{word}" if importable else cast(EnvCreator, environment)
    vector = f"ms_highway.envs.vector:{_versioned(name)}"
    gymnasium.register(bare_id, entry_point=entry_point, vector_entry_point=vector)
    return environment_id(name)
