"""The closed loop in pure JAX does what the environments and the released code do."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from ms_highway.envs import ENVIRONMENTS, SCENARIOS, InteractionEnv, add_scenario
from ms_highway.experiments.batch import make_batch, simulated
from ms_highway.experiments.comparison import MEASURED, Comparison
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.experiments.validation import read_reference
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.loop.batch import simulate

KEYS = ["controller", "seed", "step"]
CONTROLLERS = ["naive", "schedule:turn=5,naive=3,turn", "random:naive=0.25,turn=0.75"]
STATES = [
    f"{car}_{name}"
    for car in ("robot", "human")
    for name in ("x", "y", "heading", "speed")
]
COMPARISON = Comparison(
    {"merger": CONTROLLERS}, seeds=4, config={"ladder": ["naive", "turn"]}
)


def driven(comparison, scenario, controller):
    """The records of the environment."""
    env = make_environment(scenario, controller, **comparison.config)
    rows = [
        {"seed": seed, **record}
        for seed in range(comparison.seeds)
        for record in episode(env, seed)
    ]
    return pd.DataFrame(rows).assign(controller=controller).set_index(KEYS)


def agree(found, expected):
    np.testing.assert_allclose(
        found[STATES] / PAPER_UNIT, expected[STATES] / PAPER_UNIT, atol=1e-3, rtol=0
    )
    np.testing.assert_allclose(found["reward"], expected["reward"], atol=1e-3)
    for name in ("model", "status", "counted_seconds"):
        assert (found[name] == expected[name]).all()


def test_episodes_agree_with_the_environment_step_by_step():
    """They have the columns of an experiment, except measured times."""
    records = simulated(COMPARISON)
    agree(
        records.set_index(KEYS),
        pd.concat(
            driven(COMPARISON, "merger", controller) for controller in CONTROLLERS
        ),
    )
    assert list(records) == [
        name for name in COMPARISON.columns() if name not in MEASURED
    ]
    assert set(records["status"]) == {"planned"}


@pytest.mark.slow
def test_released_semantics_drive_the_logged_episodes_from_the_logged_starts(reference):
    config = {"semantics": "released", "ladder": ["naive", "turn"]}
    comparison = Comparison({"give_way": ["naive", "turn"]}, seeds=10, config=config)
    batch = make_batch(comparison, "give_way")
    units = np.array([PAPER_UNIT, PAPER_UNIT, 1, PAPER_UNIT])
    for controller in ("naive", "turn"):
        _, logged = read_reference(reference / f"give_way__{controller}.npz")
        given = batch.episodes([(controller, seed) for seed in range(10)])
        records = simulate(
            batch.loop,
            replace(given, starts=np.float32(logged["states"][:, 0] * units)),
        )
        np.testing.assert_allclose(
            records.states[:, :-1] / units, logged["states"][:, 1:], atol=1e-3
        )
        assert records.reward.mean() == pytest.approx(
            logged["rewards"].mean(), abs=0.01
        )


class NearsightedEnv(InteractionEnv):
    """Merger among drivers who plan 0.3 s ahead, from starts of its own."""

    scenario = replace(SCENARIOS["merger"], name="nearsighted")

    def configure(self, config):
        super().configure(config)
        self.game = replace(self.game, planner=replace(self.game.planner, horizon=3))

    def draw_episode(self, random):
        starts, weights = super().draw_episode(random)
        faster = starts + [[0, 0, 0, 1.0]] * 3
        return faster, 1.5 * weights  # weights that the robot does not know


@pytest.mark.slow
def test_a_batch_plays_the_game_of_a_subclass(monkeypatch):
    """It begins with the starts of the subclass, too."""
    nearsighted = NearsightedEnv.scenario.name
    for known in (ENVIRONMENTS, SCENARIOS):
        monkeypatch.setitem(known, nearsighted, None)
    monkeypatch.setitem(gym.registry, "ms-highway/nearsighted-v0", None)
    add_scenario(NearsightedEnv)
    comparison = Comparison(
        {nearsighted: ["naive"]}, seeds=2, config={"ladder": ["naive"]}
    )
    found = simulated(comparison).set_index(KEYS)
    agree(found, driven(comparison, nearsighted, "naive"))
    assert found.loc[("naive", 0, 0), "human_speed"] > 20.4
    monkeypatch.setattr(NearsightedEnv, "_is_terminated", lambda self: self.steps > 3)
    with pytest.raises(
        ValueError,
        match=(
            "NearsightedEnv has its own _is_terminated, which a simulation does not"
            " call"
        ),
    ):
        make_batch(comparison, nearsighted)


def test_a_batch_without_controllers_is_refused():
    with pytest.raises(ValueError, match="no controllers for 'give_way'"):
        make_batch(COMPARISON, "give_way")
