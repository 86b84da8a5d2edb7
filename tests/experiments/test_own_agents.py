"""Planners and agents of one's own are compared like the package's controllers."""

import numpy as np
import pytest
from episodes import drive
from gymnasium import spaces

import ms_highway
from ms_highway.envs.agents import AGENTS
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import make_environment, read, run
from ms_highway.experiments.summary import summary
from ms_highway.game.dynamics import keep_velocity
from ms_highway.loop.controller import HUMAN_DRIVERS
from ms_highway.visualization.tables import table

CHOOSING = {"action": {"type": "HumanModelAction", "lambda": 0.0}}


def stays(game, state):
    """Keep the lane and the speed."""
    return keep_velocity(game.world, state[0])


class Trained:
    """An agent with the method and the spaces of those that stable-baselines3 loads."""

    action_space, observation_space = spaces.Discrete(3), None

    def predict(self, observation, deterministic=False):
        assert deterministic
        return np.array(2), None


@pytest.fixture(autouse=True)
def added():
    ms_highway.add_driver("stays", stays)
    ms_highway.add_agent("coasts", lambda observation: [-1.0, 0.0])
    ms_highway.add_agent("trained", Trained())
    ms_highway.add_agent("wrong", lambda observation: 7, CHOOSING)
    yield
    del HUMAN_DRIVERS["stays"]
    AGENTS.clear()


def test_planners_agents_and_controllers_are_compared_in_one_table(tmp_path):
    controllers = ["stays", "coasts", "trained", "tom"]
    comparison = Comparison({"merger-v1": controllers}, seeds=1, config={"duration": 1.0})
    assert [*run(comparison, tmp_path)][-1] == 4
    steps = read(comparison, tmp_path)
    assert steps.groupby("controller")["model"].unique().map(list).to_dict() == {
        "stays": ["stays"],
        "coasts": ["coasts"],
        "trained": ["tom"],
        "tom": ["tom"],
    }
    found = summary(steps).set_index("controller")
    assert found.loc["trained", "reward"] == pytest.approx(found.loc["tom", "reward"], abs=1e-3)
    assert found.loc["trained", "counted_ms"] == found.loc["tom", "counted_ms"]
    assert found["reward"]["stays"] > found["reward"]["coasts"]  # which brakes
    assert (found["kind"] == ["driver", "agent", "agent", "fixed"]).all()
    shown = table(summary(steps), "merger-v1")
    assert [*shown.index] == controllers
    assert "T(M)" not in shown.attrs["title"]


def test_a_planner_sees_the_state_in_si_units_and_its_control_is_executed():
    _, states, _, (info,) = drive(make_environment("merger-v1", "stays"), steps=1)
    before, after = states[:, 0, 1:]
    np.testing.assert_allclose(after, before, atol=5e-3)
    assert info["model"] == "stays"
    assert info["timing"].planning_seconds > 0


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda: drive(make_environment("merger-v1", "wrong")), "'wrong' chose 7"),
        (lambda: simulated(Comparison({"merger-v1": ["coasts"]})), "'coasts' is not simulated; use `compare`"),
        (lambda: simulated(Comparison({"merger-v1": ["stays"]})), "not simulated; use `compare`"),
        (lambda: make_environment("merger-v1", "missing.zip"), "there is no agent missing.zip"),
        (lambda: ms_highway.add_agent("mine", Trained(), {"horizon": 3}), "unknown key 'horizon'"),
    ],
)
def test_impossible_agents_are_refused_with_the_reason_and_a_remedy(what, message):
    with pytest.raises(ValueError, match=message):
        what()
