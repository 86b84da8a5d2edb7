"""Names of what users add: each means one thing, and is one new word."""

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import pytest
from jax import numpy as jnp

import ms_highway
from ms_highway.envs import (
    InteractionEnv,
    add_scenario,
    registry,
)
from ms_highway.envs.agents import AGENTS
from ms_highway.envs.keyboard import Keyboard
from ms_highway.envs.registry import add_rule
from ms_highway.envs.settings import YIELDING_DRIVERS
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.scenarios import MERGER
from ms_highway.loop.controller import HUMAN_DRIVERS
from ms_highway.planning.ladders import BEST, MODELS
from ms_highway.runtime.names import PACKAGE_NAMES


def add_own_scenario(name):
    scenario = replace(MERGER, name=name)
    add_scenario(type("OwnEnv", (InteractionEnv,), {"scenario": scenario}))


@dataclass(frozen=True)
class Coasts(ms_highway.PredictedHuman):
    name = "coasts"

    def predict(self, game, state, start=None):
        return jnp.zeros((game.planner.horizon, 2))


@dataclass(frozen=True)
class FirstRung(ms_highway.Chooser):
    """A rule without numbers."""

    def choose(self, memory, gains, costs, evidence):
        return 0 * memory.rungs


KINDS = {
    "a human model": lambda name: ms_highway.register(
        type("Model", (Coasts,), {"name": name})()
    ),
    "a rule": lambda name: add_rule(type("Rule", (FirstRung,), {}, tag=name)),
    "a human driver": lambda name: ms_highway.add_driver(name, keep_velocity),
    "an agent": lambda name: ms_highway.add_agent(name, np.zeros_like),
}


@pytest.fixture
def names(monkeypatch):
    """The names that are known, to which some may be added."""
    monkeypatch.setattr(registry, "CONTROLLERS", registry.CONTROLLERS.copy())
    kept = [registry.CONTROLLERS, MODELS, HUMAN_DRIVERS, AGENTS]
    before = [dict(each) for each in kept]
    yield
    for each, content in zip(kept, before, strict=True):
        each.clear()
        each.update(content)


@pytest.mark.usefixtures("names")
@pytest.mark.parametrize("first", KINDS)
@pytest.mark.parametrize("second", KINDS)
def test_a_name_means_one_thing_whatever_was_added_first(first, second):
    KINDS[first]("mine")
    if first == second:  # which is replaced
        KINDS[second]("mine")
        return
    with pytest.raises(
        ValueError,
        match=f"{second} cannot be called 'mine'; choose one word.* other than .*mine",
    ):
        KINDS[second]("mine")


@pytest.mark.usefixtures("names")
@pytest.mark.parametrize("what", KINDS)
def test_what_is_added_needs_a_new_name_of_one_word(what):
    taken = [
        *chain(*PACKAGE_NAMES.values()),
        "two words",
        *(["Upper"] if what != "a human model" else []),
    ]
    assert {
        *registry.CONTROLLERS,
        *MODELS,
        *HUMAN_DRIVERS,
        *AGENTS,
        BEST,
        Keyboard.name,
        *YIELDING_DRIVERS,
    } <= {*taken}
    for name in taken:
        with pytest.raises(
            ValueError, match=f"{what} cannot be called '{name}'; choose one word"
        ):
            KINDS[what](name)


def test_a_scenario_needs_a_new_name_of_one_word():
    for name in ("merger", "two words", "Upper"):
        with pytest.raises(
            ValueError,
            match=(
                f"a scenario cannot be called '{name}'; choose one word in lower case"
            ),
        ):
            add_own_scenario(name)


@pytest.mark.usefixtures("names")
def test_controllers_that_run_code_of_others_are_known():
    KINDS["a human model"]("mine")
    KINDS["a rule"]("plain")
    KINDS["a human driver"]("coasting")
    ours = [
        "tom@8+warm",
        "learned:1",
        "naive+belief",
        "schedule:tom=6,naive",
        "budget:20",
        "never",
    ]
    others = ["mine", "schedule:tom=6,mine", "plain", "coasting", "agent.zip"]
    assert [name for name in [*ours, *others] if registry.of_package(name)] == ours
