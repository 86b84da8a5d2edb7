"""Configurations: how they are read, changed and refused."""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import episodes
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import ms_highway
from ms_highway import always, drive
from ms_highway.envs import ENVIRONMENTS, SCENARIOS, MergerEnv, add_scenario, environment_id, registry
from ms_highway.envs.agents import AGENTS
from ms_highway.envs.controllers import ControllerSettings
from ms_highway.envs.registry import SwitchingSettings, add_rule, controller_config, controller_settings

PAIR, SEVERAL = "merger", "dense_merge"
NAIVE = {"type": "fixed", "model": "naive"}
WRONG = [
    ([], "the configuration is []; it must be a dictionary"),
    ({"semantic": "paper"}, "unknown key 'semantic' in config; did you mean 'semantics'"),
    ({"solver": None}, "config['solver'] is None; choose one of 'gradient', 'newton', 'convex_newton'"),
    ({"humans": 21}, "config['humans'] is 21; it must be a whole number from"),
    ({"controller": 3}, "config['controller'] is 3; its 'type' must be one of switching, horizon"),
    ({"controller": {"type": "horizon"}}, "config['controller']['lambda'] is None; it must be a number from 0"),
    ({"controller": {"type": "random", "shares": {"tom": 0.3, "naive": 0.6}}}, "['shares'] sum to 0.9; change one"),
    ({"ladder": ["tom", "naive"]}, "cheapest first"),
    ({"costs": {"naive": 0.1}}, "without seconds for tom, turn; say 'measured'"),
    ({"costs": np.array([0.1, 0.2, 0.3])}, "config['costs'] is [0.1, 0.2, 0.3]; say 'published', 'shipped'"),
    ({"human_reward": {"speed": 1e39}}, "config['human_reward'] is {'speed': 1e+39}; say 'learned'"),
    ({"policy_frequency": 5}, "must be 10"),
    ({"action": {"type": "HumanModelAction", "lamda": 1}}, "did you mean 'lambda'"),
    (
        {"action": {"type": "DiscreteAction", "acceleration_range": [5, -5]}},
        "config['action']['acceleration_range'] is [5, -5]; give the lowest value first",
    ),
    (
        {"observation": {"type": "TupleObservation", "observation_configs": [{"type": "CarState"}]}},
        "config['observation']['observation_configs'][0] is {'type': 'CarState'}; its 'type' must be one of CarStates",
    ),
    (
        {"ladder": ["tom@4", "tom"], "costs": "shipped", "controller": {"type": "nearest", "count": 1, "belief": True}},
        "the ladder begins with tom@4, which counts on a response",
    ),
    (
        {"controller": "never", "action": {"type": "HumanModelAction", "lambda": 1}},
        "config['controller'] is {'type': 'driver', 'name': 'never'}, with which no model is chosen",
    ),
]


PARALYSED = {"type": "ContinuousAction", "longitudinal": False, "lateral": False}
UNLEARNED = {"ladder": ["naive", "idm"], "costs": "shipped", "controller": {"type": "learned", "lambda": 1}}


def make(scenario=PAIR, **config):
    return gym.make(environment_id(scenario), config=config).unwrapped


@pytest.mark.parametrize(("config", "message"), WRONG)
def test_a_wrong_configuration_is_refused_with_key_value_and_remedy(config, message):
    for scenario in (PAIR, SEVERAL):
        with pytest.raises(ValueError, match=re.escape(message)):
            ENVIRONMENTS[scenario].checked_config(config)


def test_nested_configurations_merge_and_a_new_type_replaces():
    assert make(controller={"lambda": 3}).config["controller"] == {"type": "learned", "lambda": 3}
    assert make(controller=NAIVE).config["controller"] == NAIVE
    env = make(controller={"type": "fixed", "model": "tom", "belief": True})
    env.reset(options={"config": {"controller": "naive"}})  # a short name stands for the whole
    assert env.config["controller"] == NAIVE
    env = make(controller=NAIVE, human_reward={"speed": 2.0, "off_road": -100.0})
    env.reset(options={"config": {"human_reward": {"speed": 3.0}}})
    assert env.config["human_reward"] == {"speed": 3.0}


def test_all_changes_during_an_episode_act_from_the_next_reset_on():
    env, changes = make(controller=NAIVE, duration=0.3), {"controller": NAIVE | {"model": "turn"}, "duration": 0.2}
    env.reset(seed=0)
    before = dict(env.config)
    env.configure(changes)
    env.configure({"grip": 7.0})
    assert env.config == before

    def driven(steps):
        return [(info["model"], ends) for *_, ends, info in map(env.step, [0] * steps)]

    assert driven(3) == [("naive", False), ("naive", False), ("naive", True)]
    with pytest.raises(ValueError, match="'duration'"):
        env.reset(options={"config": {"duration": -1}})
    env.reset(seed=0)
    assert env.config == before | changes | {"grip": 7.0}
    assert driven(2) == [("turn", False), ("turn", True)]


def test_spaces_follow_a_configuration_at_once_when_no_episode_runs():
    env = gym.make(environment_id(PAIR), config={"controller": NAIVE, "duration": 0.1})
    inner = env.unwrapped
    models = {"type": "HumanModelAction", "lambda": 0.1}
    for action, actions in ((models, 3), ({"type": "Autopilot"}, 1)):  # before the first episode, and after its end
        with pytest.raises(ValueError, match="must be enabled"):
            inner.configure({"action": PARALYSED})
        inner.configure({"action": action, "observation": {"type": "Kinematics", "vehicles_count": 1 + actions}})
        assert env.action_space == gym.spaces.Discrete(actions)
        assert env.observation_space.shape == (1 + actions, 5)
        with pytest.raises(gym.error.ResetNeeded, match="the configuration has changed"):
            inner.step(0)
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space
        assert env.step(0)[3]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"config": UNLEARNED}, "were learned on the ladder"),
        ({"config": {"action": {"type": "ContinuousAction"}}, "initial_states": [[0]]}, "needs an array"),
        ({"config": {"action": PARALYSED}}, "must be enabled"),  # highway-env's own words
    ],
)
def test_a_reset_that_is_refused_leaves_the_episode_as_it_was(options, message):
    env = make(controller=NAIVE)
    env.reset(seed=0)
    env.step(0)
    cars, config = env.car_states, dict(env.config)
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    np.testing.assert_array_equal(env.car_states, cars)
    assert env.config == config
    assert (env.steps, env.step(0)[4]["model"]) == (1, "naive")


@pytest.mark.parametrize(
    ("text", "config"),
    [
        ("tom", {"type": "fixed", "model": "tom"}),
        ("tom@8+warm+belief", {"type": "fixed", "model": "tom@8+warm", "belief": True}),
        ("switching:0.1", {"type": "switching", "lambda": 0.1}),
        ("learned:1:", {"type": "learned", "lambda": 1.0}),
        ("budget:20:one_step", {"type": "budget", "milliseconds": 20.0, "values": "one_step"}),
        ("nearest:2", {"type": "nearest", "count": 2}),
        ("schedule:tom=2,naive", {"type": "schedule", "models": ["tom", "tom", "naive"]}),
        ("period:tom=1,naive=2", {"type": "period", "models": ["tom", "naive", "naive"]}),
        ("random:naive=0.7,tom=0.3", {"type": "random", "shares": {"naive": 0.7, "tom": 0.3}}),
    ],
)
def test_a_short_name_stands_for_a_configuration(text, config):
    assert controller_config(text) == config
    assert controller_settings(text).belief == ("belief" in config)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nobody+belief", "unknown controller 'nobody+belief'; name a model"),
        ("switching:0.1\n", "['lambda'] is '0.1\\n'; it must be a number from 0"),
        ("nearest:2:0.05", "controller 'nearest:2:0.05': unknown key 'values'"),
        ("schedule:tom=999999999,naive", "names 'tom=999999999'"),
        ("random:tom", "['shares'] is {'tom': ''}; give the share of each model"),
        ("AGENT.zip+belief", "['belief'] is True, and 'AGENT.zip' predicts no human; leave the belief out"),
    ],
)
def test_a_wrong_short_name_is_refused_with_value_and_remedy(text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        controller_config(text)


class ZipperEnv(MergerEnv):
    """A scenario of one's own."""

    scenario = replace(MergerEnv.scenario, name="zipper")


@pytest.fixture
def zipper(monkeypatch):
    """The id of a scenario that is known only for one test."""
    for known in (ENVIRONMENTS, SCENARIOS):
        monkeypatch.setitem(known, "zipper", None)
    monkeypatch.setitem(gym.registry, "ms-highway/zipper-v0", None)
    return add_scenario(ZipperEnv)


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:the values of computation")
def test_a_specification_in_json_makes_the_same_environment(zipper):
    limit = {"controller": NAIVE, "control_limit": np.array([0.2, 9.0]), "grip": np.float32(8)}
    ladder = {"driver": "priced", "ladder": np.array(["naive", "idm"])}
    pictures = {"type": "GrayscaleObservation", "observation_shape": [64, 32], "stack_size": 2}
    for env in (
        gym.make(zipper, config=limit),
        gym.make(zipper, config={"observation": pictures | {"weights": [0.3, 0.6, 0.1]}}),
        gym.make("ms-highway/recorded-v0", config={"recording": Path("us101")}),
        drive(gym.make("merge-v0"), ladder),
    ):
        again = gym.make(EnvSpec.from_json(env.spec.to_json()))
        assert type(again.unwrapped) is type(env.unwrapped)
        assert again.unwrapped.config == env.unwrapped.config
        assert getattr(again, "settings", None) == getattr(env, "settings", None)


@pytest.mark.parametrize(
    ("scenario", "action", "available"),
    [
        (PAIR, {"type": "Autopilot"}, [0]),
        (SEVERAL, {"type": "HumanModelAction", "lambda": 1}, list(product(range(3), repeat=2))),
        (PAIR, {"type": "DiscreteAction", "actions_per_axis": 2}, [0, 1, 2, 3]),
    ],
)
def test_planners_are_told_all_actions_of_a_discrete_space(scenario, action, available):
    env = make(scenario, action=action, humans=2 if scenario == SEVERAL else 1)
    assert [*env.get_available_actions()] == available
    assert all(env.action_space.contains(each) for each in available)


class Plain(ControllerSettings, tag="plain"):
    """A rule without numbers."""

    def rule(self, start):
        return always(start.ladder[0])


class Dear(SwitchingSettings, tag="dear"):
    """A rule at a lambda."""


@pytest.fixture
def rules(monkeypatch):
    """A table of rules to which some may be added."""
    monkeypatch.setattr(registry, "CONTROLLERS", registry.CONTROLLERS.copy())


@pytest.mark.usefixtures("rules")
@pytest.mark.parametrize("scenario", [PAIR, SEVERAL])
def test_a_rule_of_ones_own_drives_among_one_human_or_several(scenario):
    add_rule(Plain)
    env = episodes.make(scenario, "plain")
    assert {*episodes.drive(env, steps=2).infos[-1]["models"]} == {"naive"}


@pytest.mark.usefixtures("rules")
def test_a_rule_of_ones_own_has_a_short_name_with_its_number_if_it_has_one():
    for rule in (Plain, Dear, Dear):  # a rule may replace itself
        add_rule(rule)
    assert controller_config("plain+belief") == {"type": "plain", "belief": True}
    assert controller_config("dear:0.3") == {"type": "dear", "lambda": 0.3}
    assert registry.priced_types() == ["switching", "horizon", "learned", "dear"]
    for wrong in ("plain:1", "dear", "dear:x"):
        with pytest.raises(ValueError, match=f"controller '{wrong}': "):
            controller_config(wrong)


@pytest.mark.parametrize("kind", [ControllerSettings, ZipperEnv])
def test_a_class_that_makes_no_rule_is_refused(kind):
    with pytest.raises(ValueError, match=f"{kind.__name__} makes no rule; give a ControllerSettings with a"):
        add_rule(kind)


ADDED = {
    "a rule": lambda name: add_rule(type("Rule", (Plain,), {}, tag=name)),
    "a human driver": lambda name: ms_highway.add_driver(name, lambda game, state: state[0, :2]),
    "an agent": lambda name: ms_highway.add_agent(name, lambda observation: 0),
    "a scenario": lambda name: add_scenario(
        type("OwnEnv", (MergerEnv,), {"scenario": replace(MergerEnv.scenario, name=name)})
    ),
}


@pytest.mark.usefixtures("rules")
@pytest.mark.parametrize("what", ADDED)
def test_what_is_added_needs_an_unused_name_of_one_word(what, monkeypatch):
    monkeypatch.setitem(AGENTS, "coasts", None)
    taken = ["merger"] if what == "a scenario" else ["learned", "tom", "never", "coasts"]
    for name in [*taken, "two words", "Upper"]:
        if (what, name) != ("an agent", "coasts"):  # an agent may replace an agent
            with pytest.raises(ValueError, match=f"{what} cannot be called '{name}'; choose one word in lower case"):
                ADDED[what](name)


@pytest.mark.parametrize(
    ("scenario", "config", "told"),
    [
        ("merger-v1", {"horizon": 15}, "not in merger-v1, horizon 15.*values learn merger-v1 --set horizon=15"),
        ("merger", {"semantics": "released"}, "not in merger, semantics released"),
        ("dense_merge", {"controller": "budget:20", "solver": "newton"}, "solver newton"),
    ],
)
def test_learned_values_warn_where_they_were_not_learned(scenario, config, told):
    with pytest.warns(UserWarning, match=f"the values of computation were learned in .*{told}"):
        gym.make(environment_id(scenario), config=config)


@pytest.mark.parametrize("scenario", ["merger", "merger-v1", "crossing_crowd"])
def test_learned_values_do_not_warn_where_they_were_learned(scenario, recwarn):
    gym.make(environment_id(scenario), config={"controller": "learned:0.1"})
    assert not [warning for warning in recwarn if "values of computation" in str(warning.message)]
