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


class Trained:
    """An agent with the method and the spaces of those that stable-baselines3 loads."""

    action_space = spaces.Discrete(2)
    observation_space = None

    def predict(self, observation, deterministic=False):
        assert deterministic
        return np.array(1), None


@pytest.fixture(autouse=True)
def added():
    ms_highway.add_driver(
        "stays", lambda game, state: keep_velocity(game.world, state[0])
    )
    ms_highway.add_agent("coasts", lambda observation: [-1.0, 0.0])
    ms_highway.add_agent("trained", Trained())
    ms_highway.add_agent(
        "wrong",
        lambda observation: 7,
        {"action": {"type": "HumanModelAction", "lambda": 0.0}},
    )
    yield
    del HUMAN_DRIVERS["stays"]
    AGENTS.clear()


def test_planners_agents_and_controllers_are_compared_in_one_table(tmp_path):
    config = {"duration": 1.0, "ladder": ["naive", "turn"]}
    comparison = Comparison(
        {"merger-v1": ["stays", "coasts", "trained", "turn"]}, seeds=1, config=config
    )
    assert [*run(comparison, tmp_path)][-1] == 4
    steps = read(comparison, tmp_path)
    models = steps.groupby("controller")["model"].unique().map(list).to_dict()
    assert models == {
        "stays": ["stays"],
        "coasts": ["coasts"],
        "trained": ["turn"],
        "turn": ["turn"],
    }
    found = summary(steps).set_index("controller")
    reward = found["reward"]
    assert reward["trained"] == pytest.approx(reward["turn"], abs=1e-3)
    assert found.loc["trained", "counted_ms"] == found.loc["turn", "counted_ms"]
    # The agent coasts brakes.
    assert reward["stays"] > reward["coasts"]
    assert (found["kind"] == ["driver", "agent", "agent", "fixed"]).all()
    assert "T(M)" not in table(summary(steps), "merger-v1").attrs["title"]

    # The planner stays sees the state in SI units.
    planner = steps.query("controller == 'stays'")
    speed = planner["robot_speed"]
    np.testing.assert_allclose(speed, speed.iloc[0], atol=5e-3)
    assert (planner["planning_seconds"] > 0).all()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda: drive(make_environment("merger-v1", "wrong")), "'wrong' chose 7"),
        (
            lambda: simulated(Comparison({"merger-v1": ["coasts"]})),
            "'coasts' is not simulated; use `compare`",
        ),
        (
            lambda: simulated(Comparison({"merger-v1": ["stays"]})),
            "not simulated; use `compare`",
        ),
        (
            lambda: ms_highway.add_agent("mine", Trained(), {"horizon": 3}),
            "unknown key 'horizon'",
        ),
    ],
)
def test_impossible_agents_are_refused_with_the_reason_and_a_remedy(what, message):
    with pytest.raises(ValueError, match=message):
        what()
