"""Decision rules of one's own: how they are added, drive and are refused."""

from copy import deepcopy
from dataclasses import dataclass, field, make_dataclass, replace

import gymnasium as gym
import jax
import numpy as np
import pytest
from episodes import drive, make
from jax import numpy as jnp

import ms_highway
from ms_highway import always
from ms_highway.choice.choosers import Price
from ms_highway.choice.learned_value import load_values
from ms_highway.choice.rule import first_memory
from ms_highway.data.learned_reward import shipped
from ms_highway.envs import (
    ENVIRONMENTS,
    InteractionEnv,
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
from ms_highway.envs.registry import add_rule, controller_config
from ms_highway.envs.simulation import (
    FunctionalEnv,
    draw_start,
    shared_loop,
    stack_episodes,
)
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import make_environment
from ms_highway.loop.batch import simulate
from ms_highway.planning.ladders import MODELS

PAIR = "merger"
SEVERAL = "dense_merge"


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
    (info,) = drive(make(SEVERAL, "plain"), steps=1).infos
    assert info["models"] == ("naive", "naive")
    assert controller_config("plain+belief") == {"type": "plain", "belief": True}
    assert controller_config("dear:0.3") == {"type": "dear", "lambda": 0.3}
    priced = ["switching", "horizon", "learned", "dear", "cheapest"]
    assert registry.priced_types() == priced
    for price, model in ((0.3, "turn"), (0.7, "naive")):
        (info,) = drive(make(PAIR, f"cheapest:{price}"), steps=1).infos
        assert info["models"] == (model,)
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
        InteractionEnv,
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
def test_nobody_can_change_what_the_package_computes_with(monkeypatch):
    add_rule(Overwrites)
    monkeypatch.setitem(MODELS, "bribes", Bribes())
    with pytest.raises(
        ValueError,
        match="the rule Overwrites writes into an array that it was given; copy",
    ):
        drive(make("merger-v1", "overwrites"))
    costs = {"bribes": 0.1, "naive": 0.1, "turn": 0.2, "tom": 0.3}
    with pytest.raises(
        ValueError,
        match="the human model 'bribes' writes into an array that it was given; copy",
    ):
        drive(make("merger-v1", "bribes", costs=costs))
    env = make("merger-v1").unwrapped
    env.reset(seed=0)
    for array in (
        env.game.robot.weights,
        env.game.scene.lanes,
        env.weights,
        load_values("shipped").input_mean,
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
            settings = env.settings.controller
            rule = settings.rule(env.settings.start(2, np.random.default_rng()))
            playing = replace(shared_loop(env, [settings]), rule=rule)
            drawn = draw_start(env, playing, settings, np.random.default_rng(0))
            return simulate(playing, stack_episodes([drawn]))
        env = gym.make(environment_id("merger-v1"), config=config)
        return drive(env).infos[0]["model"]

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
def test_a_rule_unknown_to_jax_is_refused_with_the_remedy(monkeypatch):
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
    # What computes nothing is compiled in simulations only.
    for computes in (True, False):
        monkeypatch.setattr(Unknown, "computes", computes)
        for make_it in makes[not computes :]:
            with pytest.raises(ValueError, match=missing):
                make_it()


def test_a_rung_beyond_32_bits_is_no_other_rung():
    memory = first_memory(always(MODELS["naive"]), 1)
    for number in (2**32, -(2**32), 2**63 + 1):
        rungs = ms_highway.unestimated(memory, np.array([number])).memory.rungs
        assert not 0 <= rungs[0] < 2
