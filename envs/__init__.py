"""The environments: scenarios of a robot with one human or several, and one to record
driving in.

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
from ms_highway.game.scenarios import (
    CROSSING_CROWD,
    CROSSING_CROWD_V1,
    DENSE_MERGE,
    DENSE_MERGE_V1,
    GIVE_WAY,
    GIVE_WAY_V1,
    MERGER,
    MERGER_V1,
    STAY_BACK,
    STAY_BACK_V1,
)
from ms_highway.planning.ladders import ladder
from ms_highway.runtime.definitions import note_definition
from ms_highway.runtime.names import SCENARIO_CLASSES, VERSIONED, check_name, versioned

__all__ = [
    "DEMONSTRATION_ID",
    "ENVIRONMENTS",
    "PAPER_SCENARIOS",
    "SCENARIOS",
    "CrossingCrowdEnv",
    "CrossingCrowdV1Env",
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


class StayBackEnv(InteractionEnv):
    """The robot on the left and the human on the right approach cones that only one car
    at a time can pass.
    """

    scenario = STAY_BACK


class MergerEnv(InteractionEnv):
    """The robot on the right wants into the left lane, between a scripted car and the
    human behind it.
    """

    scenario = MERGER


class GiveWayEnv(InteractionEnv):
    """The robot drives in the left lane between two scripted cars; the human beside it
    wants to merge.
    """

    scenario = GIVE_WAY


class StayBackV1Env(InteractionEnv):
    """Stay Back within what tyres hold: plans last two seconds, and the human starts
    ahead of the robot.
    """

    scenario = STAY_BACK_V1


class MergerV1Env(InteractionEnv):
    """Merger within what tyres hold: plans of a second."""

    scenario = MERGER_V1


class GiveWayV1Env(InteractionEnv):
    """Give Way within what tyres hold: plans of a second."""

    scenario = GIVE_WAY_V1


class DenseMergeEnv(InteractionEnv):
    """The robot's lane ends; it has to get into a stream of humans in the lane beside
    it.
    """

    scenario = DENSE_MERGE


class DenseMergeV1Env(InteractionEnv):
    """A careful robot merges into a dense stream of yielding humans; plans last a
    second, within tyre grip.
    """

    scenario = DENSE_MERGE_V1


class CrossingCrowdEnv(InteractionEnv):
    """The robot crosses one stream of humans to join another, so that other humans
    matter early and late.
    """

    scenario = CROSSING_CROWD


class CrossingCrowdV1Env(InteractionEnv):
    """A careful robot crosses a stream of yielding humans and joins another; plans last
    a second, within tyre grip.
    """

    scenario = CROSSING_CROWD_V1


ENVIRONMENTS: dict[str, type[InteractionEnv]] = {
    name: globals()[environment] for name, environment in SCENARIO_CLASSES.items()
}
"""The environments by the names of their scenarios."""

SCENARIOS: dict[str, Scenario] = {
    name: environment.scenario for name, environment in ENVIRONMENTS.items()
}
"""The scenarios by name."""

PACKAGE_SCENARIOS = tuple(SCENARIOS)
PAPER_SCENARIOS = ("stay_back", "merger", "give_way")
"""Names of the paper's scenarios."""

DEMONSTRATION_ID = "ms_highway:ms-highway/demonstration-v0"
"""The Gymnasium id of the `DemonstrationEnv`; its prefix lets spawned workers find it.
"""


def scenario_name(name: str) -> str:
    """Return the name of the scenario with a name or an id: ``merger`` for
    ``ms-highway/merger-v0``.

    Raises:
        ValueError: for an unknown scenario, and for an id without a version.
    """
    bare = name.rpartition("/")[2]
    known = bare.removesuffix("-v0").replace("-", "_") if bare.endswith("-v0") else bare
    if known in ENVIRONMENTS and (bare == name or VERSIONED.fullmatch(bare)):
        return known
    raise ValueError(
        f"unknown scenario {name!r}; the scenarios are {', '.join(ENVIRONMENTS)}"
    )


def environment_id(scenario: str) -> str:
    """Return the Gymnasium id of a scenario; the module prefix lets spawned workers
    find it.

    Raises:
        ValueError: for an unknown scenario.
    """
    return f"ms_highway:ms-highway/{versioned(scenario_name(scenario))}"


def add_scenario(environment: type[InteractionEnv]) -> str:
    """Add a scenario of one's own by its name, for Gymnasium and for comparisons and
    videos of this process.

    It replaces an added scenario of the same name. The specification of its
    environments can be written as JSON if its class can be imported from a module.

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
    check_name("a scenario", name, PACKAGE_SCENARIOS)
    scenario.check()
    place = f"scenario {name!r} has the ladder {scenario.ladder!r}"
    try:
        ladder(scenario.ladder)
    except ValueError as error:
        raise ValueError(
            f"{place}: {error}; register a model of your own before"
        ) from error
    ENVIRONMENTS[name], SCENARIOS[name] = environment, environment.scenario
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
