"""Register the environments: scenarios, and one to record driving in.

``import ms_highway`` registers these ids with Gymnasium: ``ms-highway/stay-back-v1``,
``merger-v1``, ``give-way-v1``, ``dense-merge-v1`` and ``crossing-crowd-v1``, in which
cars keep to what tyres hold; version 0 of each; ``demonstration-v0``; and those of
other packages. Imports `ms_highway.vehicle` and the packages below it.
"""

import sys
from typing import cast

import gymnasium
from gymnasium.envs.registration import EnvCreator

from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.demonstration import DemonstrationEnv
from ms_highway.game.scenario import Scenario
from ms_highway.game.scenarios import PACKAGE_SCENARIOS
from ms_highway.planning.ladders import ladder
from ms_highway.runtime.definitions import note_definition
from ms_highway.runtime.names import (
    check_name,
    environment_class_name,
    has_version,
    versioned,
)

__all__ = [
    "DEMONSTRATION_ID",
    "ENVIRONMENTS",
    "PAPER_SCENARIOS",
    "SCENARIOS",
    "DemonstrationEnv",
    "InteractionEnv",
    "add_scenario",
    "environment_id",
    "scenario_name",
]


def _environment_class(scenario: Scenario) -> type[InteractionEnv]:
    """Return a class of environments of a scenario, which `__getattr__` finds."""
    name = environment_class_name(scenario.name)
    members = {
        "__doc__": f"Environments of the scenario ``{scenario.name}``.",
        "__module__": __name__,
        "scenario": scenario,
    }
    return type(name, (InteractionEnv,), members)


_PACKAGE_ENVIRONMENTS = {
    name: _environment_class(scenario) for name, scenario in PACKAGE_SCENARIOS.items()
}

ENVIRONMENTS: dict[str, type[InteractionEnv]] = dict(_PACKAGE_ENVIRONMENTS)
"""The classes of environments by the names of their scenarios, with those added."""

SCENARIOS: dict[str, Scenario] = dict(PACKAGE_SCENARIOS)
"""The scenarios by name, with those added."""

PAPER_SCENARIOS = ("stay_back", "merger", "give_way")
"""Names of the paper's scenarios."""

DEMONSTRATION_ID = "ms_highway:ms-highway/demonstration-v0"
"""The Gymnasium id of the `DemonstrationEnv`; its prefix lets spawned workers find it.
"""


def __getattr__(name: str) -> type[InteractionEnv]:
    """Return the class of a scenario's environments by its name.

    The name is ``MergerV1Env`` for ``merger-v1``. Gymnasium's entry points and pickles
    find the classes so.
    """
    for environment in _PACKAGE_ENVIRONMENTS.values():
        if environment.__name__ == name:
            return environment
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def scenario_name(name: str) -> str:
    """Return the name of a scenario: ``merger`` for ``ms-highway/merger-v0``.

    Raises:
        ValueError: for an unknown scenario, and for an id without a version.
    """
    bare = name.rpartition("/")[2]
    known = bare.removesuffix("-v0").replace("-", "_") if bare.endswith("-v0") else bare
    if known in ENVIRONMENTS and (bare == name or has_version(bare)):
        return known
    raise ValueError(
        f"unknown scenario {name!r}; the scenarios are {', '.join(ENVIRONMENTS)}"
    )


def environment_id(scenario: str) -> str:
    """Return the Gymnasium id of a scenario.

    Its module prefix lets spawned workers find it.

    Raises:
        ValueError: for an unknown scenario.
    """
    return f"ms_highway:ms-highway/{versioned(scenario_name(scenario))}"


def add_scenario(environment: type[InteractionEnv]) -> str:
    """Add a scenario of one's own by its name, for this process.

    It is then known to Gymnasium, comparisons and videos. It replaces an added scenario
    of the same name. The specification of its environments can be written as JSON if
    its class can be imported from a module.

    Args:
        environment: class of its environments, with a `Scenario` whose name is one word
            in lower case.

    Returns:
        The Gymnasium id.

    Raises:
        ValueError: if the class is none of such environments; if the package has a
            scenario of this name, or it is not such a word; and for a scenario that
            cannot be driven, see `ms_highway.game.scenario.Scenario.check`.
    """
    scenario = getattr(environment, "scenario", None)
    if not (isinstance(environment, type) and issubclass(environment, InteractionEnv)):
        remedy = (
            "give a class derived from ms_highway.InteractionEnv, with an attribute"
            " `scenario`"
        )
        raise ValueError(f"{environment!r} is no class of environments; {remedy}")
    if not isinstance(scenario, Scenario):
        remedy = "make it a ms_highway.Scenario"
        raise ValueError(
            f"the attribute `scenario` of {environment.__name__} is {scenario!r};"
            f" {remedy}"
        )
    name = scenario.name
    check_name("a scenario", name, tuple(PACKAGE_SCENARIOS))
    scenario.check()
    place = f"scenario {name!r} has the ladder {scenario.ladder!r}"
    try:
        ladder(scenario.ladder)
    except ValueError as error:
        raise ValueError(
            f"{place}: {error}; register a model of your own before"
        ) from error
    ENVIRONMENTS[name] = environment
    SCENARIOS[name] = scenario
    note_definition(name, environment)
    bare_id = environment_id(name).removeprefix("ms_highway:")
    gymnasium.registry.pop(bare_id, None)
    module = environment.__module__
    word = environment.__qualname__
    importable = getattr(sys.modules.get(module), word, None) is environment
    entry_point = f"{module}:{word}" if importable else cast(EnvCreator, environment)
    vector = f"ms_highway.envs.vector:{versioned(name)}"
    gymnasium.register(bare_id, entry_point=entry_point, vector_entry_point=vector)
    return environment_id(name)
