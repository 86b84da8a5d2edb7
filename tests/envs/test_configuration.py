"""Configurations: how they are read, changed and refused."""

import re
from copy import deepcopy
from dataclasses import dataclass, field, make_dataclass, replace
from itertools import chain, product
from pathlib import Path

import gymnasium as gym
import jax
import numpy as np
import pytest
from episodes import drive, make
from gymnasium.envs.registration import EnvSpec
from jax import numpy as jnp

import ms_highway
from ms_highway import always
from ms_highway.choice.choosers import Price
from ms_highway.choice.learned_value import load_values
from ms_highway.choice.rule import first_memory
from ms_highway.cli.main import parse
from ms_highway.cli.options import configuration
from ms_highway.data.learned_reward import save, shipped
from ms_highway.envs import (
    ENVIRONMENTS,
    SCENARIOS,
    InteractionEnv,
    add_scenario,
    environment_id,
    registry,
)
from ms_highway.envs.agents import AGENTS, AddedAgent
from ms_highway.envs.controllers import (
    DrivenByAgent,
    DrivenByFunction,
    Fixed,
    RandomModels,
    Schedule,
)
from ms_highway.envs.keyboard import Keyboard
from ms_highway.envs.registry import add_rule, controller_config, controller_settings
from ms_highway.envs.settings import YIELDING_DRIVERS
from ms_highway.envs.simulation import (
    FunctionalEnv,
    draw_start,
    shared_loop,
    stack_episodes,
)
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import make_environment
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.scenarios import MERGER
from ms_highway.loop.batch import simulate
from ms_highway.loop.controller import HUMAN_DRIVERS
from ms_highway.planning.ladders import BEST, MODELS
from ms_highway.runtime.names import PACKAGE_NAMES

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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plain(ms_highway.Chooser, tag="plain"):
    """A rule without numbers."""

    def choose(self, memory, gains, costs, evidence):
        return 0 * memory.rungs


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Dear(Price, tag="dear"):
    """A rule at a lambda."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Says(ms_highway.Chooser, tag="says"):
    """Choose a given number for so many humans."""

    number: float
    humans: int = field(default=1, metadata={"static": True})
    dtype: str = field(default="int32", metadata={"static": True})

    def choose(self, memory, gains, costs, evidence):
        return jnp.full(self.humans, self.number).astype(self.dtype)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SaysAtOnce(Says, tag="says_at_once"):
    """The same without a compilation."""

    computes = False


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Gains(ms_highway.Estimator, tag="gains"):
    """Say that every rung gains a given number, for so many rungs."""

    number: float = 1.0
    rungs: int = field(default=2, metadata={"static": True})

    def estimate(self, memory, evidence):
        return ms_highway.Estimate(
            jnp.full((len(memory.rungs), self.rungs), self.number), False
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cheapest(ms_highway.Priced, tag="cheapest"):
    """A rule at a lambda, which inherits its field."""

    def choose(self, memory, gains, costs, evidence):
        return jnp.where(self.price > 0.5, 0, 1) + 0 * memory.rungs


@pytest.fixture
def rules(monkeypatch):
    """A table of rules to which some may be added."""
    monkeypatch.setattr(registry, "CONTROLLERS", registry.CONTROLLERS.copy())


@pytest.mark.usefixtures("rules")
def test_a_rule_of_ones_own_drives_by_its_short_name():
    for rule in (Plain, Dear, Dear, Cheapest):  # a rule may replace itself
        add_rule(rule)
    assert drive(make(SEVERAL, "plain"), steps=1).infos[0]["models"] == (
        "naive",
        "naive",
    )
    assert controller_config("plain+belief") == {"type": "plain", "belief": True}
    assert controller_config("dear:0.3") == {"type": "dear", "lambda": 0.3}
    assert registry.priced_types() == [
        "switching",
        "horizon",
        "learned",
        "dear",
        "cheapest",
    ]
    for price, model in ((0.3, "turn"), (0.7, "naive")):
        assert drive(make(PAIR, f"cheapest:{price}"), steps=1).infos[0]["models"] == (
            model,
        )
    for wrong in ("plain:1", "dear", "dear:x"):
        with pytest.raises(ValueError, match=f"controller '{wrong}': "):
            controller_config(wrong)


def test_a_class_that_makes_no_rule_is_refused_with_bases():
    remedy = (
        "; derive it from ms_highway.Chooser and define `choose`, or from"
        " ms_highway.Estimator and define"
    )
    for kind in (
        ms_highway.ControllerSettings,
        ms_highway.Chooser,
        ms_highway.Estimator,
        ZipperEnv,
    ):
        with pytest.raises(ValueError, match=f"{kind.__name__} makes no rule{remedy}"):
            add_rule(kind)
    for base, options in (
        (ms_highway.Rule, {}),
        (ms_highway.ControllerSettings, {"frozen": True, "tag": "old"}),
    ):
        with pytest.raises(
            ValueError, match=f"the rule Old derives from {base.__name__}{remedy}"
        ):
            type("Old", (base,), {}, **options)
    with pytest.raises(
        ValueError, match=r"Plain is no estimator; derive it from ms_highway\.Estimator"
    ):
        add_rule(Plain, Plain)


def with_fields(base, *names, **options):
    """Return a class of a rule's part with these fields, which are numbers."""
    return make_dataclass(
        "Own", [(name, float) for name in names], bases=(base,), frozen=True, **options
    )


def test_fields_with_the_key_of_another_one_are_refused():
    """They would be read from the same entry of the configuration."""
    wrong = [
        (
            (with_fields(Plain, "reach"), with_fields(Gains, "reach", kw_only=True)),
            "Own and Own have a field 'reach' each",
        ),
        (
            (with_fields(Gains, "price", kw_only=True),),
            "Own has the field 'price', which is the chooser's lambda",
        ),
        (
            (Plain, with_fields(Gains, "price", kw_only=True)),
            "Own has the field 'price', which is the chooser's lambda",
        ),
        (
            (with_fields(Plain, "price"),),
            r"'price', which is lambda; derive it from ms_highway\.Priced, or rename",
        ),
        *(
            (
                (with_fields(Plain, key),),
                f"Own has the field '{key}', a key of all controllers",
            )
            for key in ("type", "belief")
        ),
        *(
            ((with_fields(Gains, key, kw_only=True),), f"Own has the field '{key}'")
            for key in ("type", "belief")
        ),
    ]
    before = dict(registry.CONTROLLERS)
    for parts, message in wrong:
        with pytest.raises(ValueError, match=message):
            add_rule(*parts)
    assert before == registry.CONTROLLERS


@pytest.mark.parametrize(
    "base", [Fixed, Schedule, RandomModels, DrivenByFunction, DrivenByAgent]
)
def test_what_takes_no_choices_is_no_base_of_a_rule(base):
    own = type("Own", (base,), {"choose": Plain.choose}, tag="own")
    with pytest.raises(
        ValueError,
        match=r"Own makes no rule; derive it from ms_highway\.Chooser and define",
    ):
        add_rule(own)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Overwrites(ms_highway.Chooser, tag="overwrites"):
    computes = False

    def choose(self, memory, gains, costs, evidence):
        evidence.game.robot.weights[0] = memory.rungs[0] = 1
        return memory.rungs


@dataclass(frozen=True)
class Bribes(ms_highway.PredictedHuman):
    name = "bribes"

    def predict(self, game, state, start=None):
        game.robot.weights[0] = 1e6
        return jnp.zeros((game.planner.horizon, 2))


@pytest.mark.usefixtures("rules")
def test_nobody_can_change_what_the_package_computes_with(
    monkeypatch,
):
    add_rule(Overwrites)
    monkeypatch.setitem(MODELS, "bribes", Bribes())
    with pytest.raises(
        ValueError,
        match="the rule Overwrites writes into an array that it was given; copy",
    ):
        drive(make("merger-v1", "overwrites"))
    with pytest.raises(
        ValueError,
        match="the human model 'bribes' writes into an array that it was given; copy",
    ):
        drive(
            make(
                "merger-v1",
                "bribes",
                costs={"bribes": 0.1, "naive": 0.1, "turn": 0.2, "tom": 0.3},
            )
        )
    env = make("merger-v1").unwrapped
    env.reset(seed=0)
    for array in (
        env.game.robot.weights,
        env.game.scene.lanes,
        env.weights,
        load_values("shipped").centre,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0.0
    scenario = ms_highway.SCENARIOS["merger"]
    learned = shipped("demonstrations").weights
    for weights in (
        ms_highway.COMMON_WEIGHTS,
        ms_highway.PUBLISHED_COSTS,
        scenario.robot_weights,
        learned,
    ):
        with pytest.raises(
            TypeError, match=r"these numbers belong to ms_highway: .*; change a copy"
        ):
            weights["speed"] = 0.0
        copied = deepcopy(weights)
        copied["speed"] = 0.0


def test_an_agent_that_changes_its_observation_changes_nobody_elses(monkeypatch):
    def erases(observation):
        observation[:] = 0.0
        return [0.0, 0.0]

    monkeypatch.setitem(AGENTS, "erases", AddedAgent(erases, {}))
    env = make_environment("merger-v1", "erases")
    seen, _ = env.reset(seed=0)
    env.step(0)
    assert seen.any()


RUNGS = "return one whole number for each human, 1 in all: 0 for naive, 1 for turn"


@pytest.mark.usefixtures("rules")
@pytest.mark.parametrize(
    "loop", ["live", "live, not compiled", "batch", "vector", "functional"]
)
def test_a_rule_that_returns_no_rung_is_refused(loop):
    for rule in (Says, SaysAtOnce, Gains):
        add_rule(rule)

    def episode(
        number,
        kind="says_at_once" if loop == "live, not compiled" else "says",
        **numbers,
    ):
        controller = {"type": kind, "number": number, **numbers}
        config = {
            "controller": controller,
            "ladder": ["naive", "turn"],
            "duration": 0.2,
        }
        if loop == "vector":
            envs = gym.make_vec(environment_id("merger-v1"), num_envs=2, config=config)
            envs.reset(seed=0)
            return envs.step(np.zeros(2, int))[4]["model"][0]
        if loop == "functional":
            env = FunctionalEnv("merger-v1", config)
            state, _ = env.reset(jax.random.key(0))
            if number == 7.0:  # a traced step cannot raise an error
                assert np.isnan(jax.jit(env.step)(state, 0)[2])
            return env.step(state, 0)
        if loop == "batch":
            env = ENVIRONMENTS["merger-v1"](config)
            start = env.settings.start(2, np.random.default_rng())
            playing = replace(
                shared_loop(env, [env.settings.controller]),
                rule=env.settings.controller.rule(start),
            )
            drawn = draw_start(
                env, playing, env.settings.controller, np.random.default_rng(0)
            )
            return simulate(playing, stack_episodes([drawn]))
        return drive(gym.make(environment_id("merger-v1"), config=config)).infos[0][
            "model"
        ]

    episode(1.0)
    for number in (-1.0, 7.0):
        with pytest.raises(
            ValueError,
            match=rf"the rule Says\w* returned the rungs \[{number:.0f}\]; {RUNGS}",
        ):
            episode(number)
    with pytest.raises(
        ValueError,
        match=rf"the rule Says\w* returned (the rungs \[nan\]|float32 .*); {RUNGS}",
    ):
        episode(np.nan, dtype="float32")
    with pytest.raises(
        ValueError,
        match=rf"the rule Says\w* returned .*(\(5,\)|\[1, 1, 1, 1, 1\]); {RUNGS}",
    ):
        episode(1.0, humans=5)
    episode(1.0, "gains", **{"lambda": 0.0})
    with pytest.raises(
        ValueError,
        match=(
            "the estimator Gains returned gains that are NaN or infinite; return -inf"
        ),
    ):
        episode(np.nan, "gains", **{"lambda": 0.0})
    with pytest.raises(
        ValueError,
        match=(
            r"the estimator Gains returned gains of shape \(1, 3\); return one for each"
        ),
    ):
        episode(1.0, "gains", rungs=3, **{"lambda": 0.0})


@dataclass(frozen=True)
class Unknown(ms_highway.Chooser, tag="unknown"):
    """A rule whose author has forgotten to tell JAX its fields."""

    def choose(self, memory, gains, costs, evidence):
        return memory.rungs


@pytest.mark.usefixtures("rules")
def test_a_rule_unknown_to_jax_is_refused_with_the_remedy(
    monkeypatch,
):
    add_rule(Unknown)
    config = {"controller": "unknown"}
    makes = [
        lambda: gym.make(environment_id("merger-v1"), config=config).reset(seed=0),
        lambda: gym.make_vec(environment_id("merger-v1"), num_envs=2, config=config),
        lambda: FunctionalEnv("merger-v1", config),
        lambda: make_batch(
            Comparison({"merger-v1": ["unknown"]}, seeds=1), "merger-v1"
        ),
    ]
    missing = r"the rule Unknown, .*; write @jax\.tree_util\.register_dataclass above"
    for computes in (
        True,
        False,
    ):  # what computes nothing is compiled in simulations only
        monkeypatch.setattr(Unknown, "computes", computes)
        for make_it in makes[not computes :]:
            with pytest.raises(ValueError, match=missing):
                make_it()


def test_a_rung_beyond_32_bits_is_no_other_rung():
    memory = first_memory(always(MODELS["naive"]), 1)
    for number in (2**32, -(2**32), 2**63 + 1):
        rungs = ms_highway.unestimated(memory, np.array([number])).memory.rungs
        assert not 0 <= rungs[0] < 2


def add_own_scenario(name):
    scenario = replace(MERGER, name=name)
    add_scenario(type("OwnEnv", (InteractionEnv,), {"scenario": scenario}))


@dataclass(frozen=True)
class Coasts(ms_highway.PredictedHuman):
    name = "coasts"

    def predict(self, game, state, start=None):
        return jnp.zeros((game.planner.horizon, 2))


KINDS = {
    "a human model": lambda name: ms_highway.register(
        type("Model", (Coasts,), {"name": name})()
    ),
    "a rule": lambda name: add_rule(type("Rule", (Plain,), {}, tag=name)),
    "a human driver": lambda name: ms_highway.add_driver(name, keep_velocity),
    "an agent": lambda name: ms_highway.add_agent(name, np.zeros_like),
}


@pytest.fixture
def names(rules):
    """The names that are known, to which some may be added."""
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


def test_learned_values_warn_among_other_humans(
    monkeypatch,
):
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
        config = configuration(
            parse(
                ["compare", "merger-v1", "--set", f"human_reward={name}", "--out", "x"]
            )
        )
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
