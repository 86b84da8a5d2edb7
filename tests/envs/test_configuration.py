"""Configurations: how they are read, changed and refused."""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from episodes import drive, make
from gymnasium.envs.registration import EnvSpec

import ms_highway
from ms_highway.cli.main import parse
from ms_highway.cli.options import configuration
from ms_highway.data.learned_reward import save, shipped
from ms_highway.envs import (
    ENVIRONMENTS,
    SCENARIOS,
    InteractionEnv,
    add_scenario,
    environment_id,
)
from ms_highway.envs.registry import controller_config, controller_settings
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.scenarios import MERGER
from ms_highway.loop.controller import HUMAN_DRIVERS

PAIR = "merger"
SEVERAL = "dense_merge"
NAIVE = {"type": "fixed", "model": "naive"}
WRONG = [
    ([], "the configuration is []; it must be a dictionary"),
    (
        {"semantic": "paper"},
        "unknown key 'semantic' in config; did you mean 'semantics'",
    ),
    (
        {"solver": None},
        "config['solver'] is None; choose one of 'gradient', 'convex_newton'",
    ),
    ({"humans": 2.5}, "config['humans'] is 2.5; it must be a whole number"),
    ({"humans": 21}, "config['humans'] is 21; merger has one human; leave it out"),
    (
        {"controller": 3},
        "config['controller'] is 3; its 'type' must be one of switching, horizon",
    ),
    (
        {"controller": "nobody+belief"},
        "unknown controller 'nobody+belief'; name a model",
    ),
    (
        {"controller": "switching:0.1\n"},
        "['lambda'] is '0.1\\n'; it must be a number from 0",
    ),
    ({"controller": "schedule:tom=999999999,naive"}, "names 'tom=999999999'"),
    (
        {"controller": "schedule:tom/naive=2,tom"},
        "names 'tom/naive'; models per human are gone since 3.0.0; name one",
    ),
    (
        {"controller": "period:tom=1,naive=3"},
        "period is gone since 3.0.0: write the steps as schedule:",
    ),
    (
        {"controller": {"type": "period", "models": ["tom"]}},
        "period is gone since 3.0.0: write the steps",
    ),
    (
        {"controller": "budget:20:one_step"},
        "one_step is gone since 3.0.0: leave it out, to have the gains of learned",
    ),
    ({"controller": "learned:1:period"}, "period cannot be read as learned values"),
    ({"controller": "learned:1:one_step"}, "one_step cannot be read as learned values"),
    ({"controller": "one_step"}, "unknown controller 'one_step'; name a model"),
    (
        {"beliefs": "true"},
        (
            "config['beliefs'] is gone since 3.0.0; leave it out, as the robot assumes"
            " of several"
        ),
    ),
    (
        {"controller": "random:tom"},
        "['shares'] is {'tom': ''}; give the share of each model",
    ),
    (
        {"controller": "AGENT.zip+belief"},
        "'AGENT.zip' predicts no human; leave the belief out",
    ),
    (
        {"controller": {"type": "random", "shares": {"tom": 0.3, "naive": 0.6}}},
        "['shares'] sum to 0.9; change one",
    ),
    ({"ladder": ["tom", "naive"]}, "cheapest first"),
    ({"costs": {"naive": 0.1}}, "without seconds for tom, turn; say 'measured'"),
    ({"policy_frequency": 5}, "must be 10"),
    ({"action": {"type": "HumanModelAction", "lamda": 1}}, "did you mean 'lambda'"),
    (
        {"action": {"type": "DiscreteAction", "acceleration_range": [5, -5]}},
        (
            "config['action']['acceleration_range'] is [5, -5]; give the lowest value"
            " first"
        ),
    ),
    (
        {
            "observation": {
                "type": "TupleObservation",
                "observation_configs": [{"type": "CarState"}],
            }
        },
        (
            "config['observation']['observation_configs'][0] is {'type': 'CarState'};"
            " its 'type' must be one of CarStates"
        ),
    ),
    (
        {
            "ladder": ["tom@4", "tom"],
            "costs": "shipped",
            "controller": "nearest:1+belief",
        },
        "the ladder begins with tom@4, which counts on a response",
    ),
    (
        {"controller": "never", "action": {"type": "HumanModelAction", "lambda": 1}},
        (
            "config['controller'] is {'type': 'driver', 'name': 'never'}, with which no"
            " model is chosen"
        ),
    ),
]
PARALYSED = {"type": "ContinuousAction", "longitudinal": False, "lateral": False}


@pytest.mark.parametrize(("config", "message"), WRONG)
def test_a_wrong_configuration_is_refused_with_key_value_and_remedy(config, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        ENVIRONMENTS["merger"].checked_config(config)


def test_nested_configurations_merge_and_a_new_type_replaces():
    env = gym.make(environment_id(PAIR), config={"controller": {"lambda": 3}}).unwrapped
    assert env.config["controller"] == {"type": "learned", "lambda": 3}
    env.configure(
        {
            "controller": NAIVE | {"belief": True},
            "human_reward": {"speed": 2.0, "off_road": -100.0},
        }
    )
    assert env.config["controller"] == NAIVE | {"belief": True}
    env.reset(
        options={"config": {"controller": "naive", "human_reward": {"speed": 3.0}}}
    )
    assert env.config["controller"] == NAIVE  # a short name stands for the whole
    assert env.config["human_reward"] == {"speed": 3.0}


def test_changes_during_an_episode_act_from_the_next_reset():
    changes = {"controller": NAIVE | {"model": "turn"}, "duration": 0.2}
    env = make(PAIR, duration=0.3).unwrapped
    env.reset()
    before = dict(env.config)
    env.configure(changes)
    env.configure({"terminate_on_collision": True})
    assert env.config == before

    driven = [env.step(0) for _ in range(3)]
    assert [(info["model"], ends) for *_, ends, info in driven] == [
        ("naive", False),
        ("naive", False),
        ("naive", True),
    ]
    with pytest.raises(ValueError, match="'duration'"):
        env.reset(options={"config": {"duration": -1}})
    assert [info["model"] for info in drive(env).infos] == ["turn", "turn"]
    assert env.config == before | changes | {"terminate_on_collision": True}


def test_spaces_follow_a_configuration_at_once_when_no_episode_runs():
    env = make(PAIR, duration=0.1)
    inner = env.unwrapped
    models = {"type": "HumanModelAction", "lambda": 0.1}
    for action, actions in (
        (models, 3),
        ({"type": "Autopilot"}, 1),
    ):  # before the first episode, and after its end
        with pytest.raises(ValueError, match="must be enabled"):
            inner.configure({"action": PARALYSED})
        inner.configure(
            {
                "action": action,
                "observation": {"type": "Kinematics", "vehicles_count": 1 + actions},
            }
        )
        assert env.action_space == gym.spaces.Discrete(actions)
        assert env.observation_space.shape == (1 + actions, 5)
        with pytest.raises(
            gym.error.ResetNeeded, match="the configuration has changed"
        ):
            inner.step(0)
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space
        assert env.step(0)[3]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {
                "config": {"action": {"type": "ContinuousAction"}},
                "initial_states": [[0]],
            },
            "needs an array",
        ),
        (
            {"config": {"action": PARALYSED}},
            "must be enabled",
        ),  # highway-env's own words
    ],
)
def test_a_refused_reset_leaves_the_episode_as_it_was(options, message):
    env = make(PAIR).unwrapped
    env.reset()
    env.step(0)
    cars = env.car_states
    config = dict(env.config)
    with pytest.raises(ValueError, match=message):
        env.reset(options=options)
    np.testing.assert_array_equal(env.car_states, cars)
    assert env.config == config
    assert (env.steps, env.step(0)[4]["model"]) == (1, "naive")


@pytest.mark.parametrize(
    ("text", "config"),
    [
        ("tom@8+warm+belief", {"type": "fixed", "model": "tom@8+warm", "belief": True}),
        ("learned:1:", {"type": "learned", "lambda": 1.0}),
        ("budget:20", {"type": "budget", "milliseconds": 20.0}),
        (
            "schedule:tom=2,naive",
            {"type": "schedule", "models": ["tom", "tom", "naive"]},
        ),
        (
            "random:naive=0.7,tom=0.3",
            {"type": "random", "shares": {"naive": 0.7, "tom": 0.3}},
        ),
    ],
)
def test_a_short_name_stands_for_a_configuration(text, config):
    assert controller_config(text) == config
    assert controller_settings(text).belief == ("belief" in config)


class ZipperEnv(InteractionEnv):
    """A scenario of one's own."""

    scenario = replace(MERGER, name="zipper")


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:the values of computation")
def test_a_specification_in_json_makes_the_same_environment(monkeypatch):
    for known, name in (
        (ENVIRONMENTS, "zipper"),
        (SCENARIOS, "zipper"),
        (gym.registry, "ms-highway/zipper-v0"),
    ):
        monkeypatch.setitem(known, name, None)
    pictures = {
        "type": "GrayscaleObservation",
        "observation_shape": [64, 32],
        "weights": [0.3, 0.6, 0.1],
    }
    numbers = {"control_limit": np.array([0.2, 9.0]), "grip": np.float32(8)}
    for env in (
        gym.make(
            add_scenario(ZipperEnv),
            config={"observation": pictures | {"stack_size": 2}, **numbers},
        ),
        gym.make("ms-highway/recorded-v0", config={"recording": Path("us101")}),
        ms_highway.drive(
            gym.make("merge-v0"),
            {"driver": "priced", "ladder": np.array(["naive", "idm"])},
        ),
    ):
        again = gym.make(EnvSpec.from_json(env.spec.to_json()))
        assert type(again.unwrapped) is type(env.unwrapped)
        assert again.unwrapped.config == env.unwrapped.config
        assert getattr(again, "settings", None) == getattr(env, "settings", None)


def test_planners_are_told_all_actions_of_a_discrete_space():
    choosing = make(SEVERAL, action={"type": "HumanModelAction", "lambda": 1}).unwrapped
    assert choosing.get_available_actions() == list(product(range(3), repeat=2))
    driving = make(
        PAIR, action={"type": "DiscreteAction", "actions_per_axis": 2}
    ).unwrapped
    assert driving.get_available_actions() == range(4)
    for env in (choosing, driving):
        assert all(
            env.action_space.contains(action) for action in env.get_available_actions()
        )


def test_learned_values_warn_only_where_they_were_not_learned():
    for scenario in ("merger", "merger-v1", "crossing_crowd", "crossing-crowd-v1"):
        make(scenario, "learned:0.1")  # a warning would be an error
    told = (
        "not in merger-v1, horizon 15.*`ms-highway values learn merger-v1 --set"
        " horizon=15"
    )
    with pytest.warns(
        UserWarning, match=f"the values of computation were learned in .*{told}"
    ):
        make("merger-v1", "learned:1", horizon=15)
    with pytest.warns(UserWarning, match="not in dense_merge, solver gradient"):
        make(SEVERAL, "budget:20", solver="gradient")
    make("merger-v1", "learned:1+belief", yielding="never")  # measured, see the guide


def test_learned_values_warn_among_other_humans(monkeypatch):
    learn = "`ms-highway values learn merger-v1 --set {} --out values.npz`"
    for reward, text in (
        ("published", "human_reward=published"),
        ({"speed": 2.0}, "'human_reward={\"speed\": 2.0}'"),
    ):
        with pytest.warns(
            UserWarning,
            match=(
                "human_reward learned, not in merger-v1, human_reward"
                f" .*{learn.format(text)}"
            ),
        ):
            make("merger-v1", "learned:1", human_reward=reward)
    make("merger-v1", "learned:1", human_reward="learned")
    monkeypatch.setitem(HUMAN_DRIVERS, "coasts", keep_velocity)
    with pytest.warns(
        UserWarning,
        match=(
            "not in merger-v1, where 'coasts' drives the humans; choose another"
            " controller"
        ),
    ):
        make("merger-v1", "learned:1", human_driver="coasts")
    make("merger-v1", "tom", human_driver="coasts", human_reward="published")


def test_the_reward_of_us101_has_a_name_and_a_file(tmp_path):
    file = tmp_path / "mine.json"
    save(shipped("us101"), file)
    games = []
    for name in ("us101", str(file)):
        words = ["compare", "merger-v1", "--set", f"human_reward={name}", "--out", "x"]
        config = configuration(parse(words))
        games.append(make("merger-v1", **config).unwrapped.game.humans)
    assert games[0].names == games[1].names
    np.testing.assert_array_equal(games[0].weights, games[1].weights)
    weights = dict(zip(games[0].names, games[0].weights[0], strict=True))
    assert weights["closing_speed"] == pytest.approx(
        shipped("us101").weights["closing_speed"]
    )
    _, states, *_ = drive(make("merger-v1", human_reward="us101"), steps=10)
    usual = drive(make("merger-v1"), steps=10).states
    assert np.abs(states[-1, 1] - usual[-1, 1]).max() > 0.1
    with pytest.raises(
        ValueError, match="'learned', 'published', 'us101', or give finite weights"
    ):
        make("merger-v1", human_reward="us102")
