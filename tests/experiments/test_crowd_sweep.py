"""Very many simulated episodes among several humans: `ms-highway sweep dense_merge`."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from ms_highway.cli.main import main
from ms_highway.control.fallback import STATUSES
from ms_highway.envs import ENVIRONMENTS, add_scenario
from ms_highway.envs.crowd.scenes import DenseMergeEnv
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import CARS, columns, state_columns
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.experiments.simulated import any_batch, columns_simulated, run_episodes, summarised, tabulated
from ms_highway.experiments.simulated_crowd import OUTCOMES
from ms_highway.experiments.sweep import sweep_summary
from ms_highway.planning.crowd import NAIVE, RUNGS, TOM

COSTS = {"naive": 0.001, "turn": 0.002, "tom": 0.005}
CONTROLLERS = ["nearest:2", "nearest:1", "random:naive=0.7,tom=0.3"]  # theory of mind about both, one, some
STEPS = 10
SHORT = {"humans": 2, "horizon": 5}
COMPARISON = Comparison({"dense_merge": CONTROLLERS}, seeds=1, costs=COSTS, planning=SHORT)
STATES = [name for car in CARS for name in state_columns(car)]


@pytest.fixture(scope="module")
def batch():
    return any_batch(COMPARISON, "dense_merge")


@pytest.fixture(scope="module")
def records(batch):
    return run_episodes(batch, batch.keys())


@pytest.mark.slow
def test_an_episode_agrees_with_the_environment_step_by_step(batch, records):
    table = tabulated(batch, batch.keys(), records).set_index("controller")
    for place, controller in enumerate(CONTROLLERS):
        env = make_environment("dense_merge", controller, costs=COSTS, **COMPARISON.common_config())
        rungs, states, rows = [], [], []
        for row, _ in zip(episode(env, 0), range(STEPS), strict=False):
            rows.append(row)
            rungs.append([RUNGS.index(name) for name in env.unwrapped.robot.last_step.rungs])
            states.append(env.unwrapped.car_states)
        expected, found = pd.DataFrame(rows), table.loc[controller].iloc[:STEPS]
        np.testing.assert_array_equal(records.rungs[place, :STEPS], rungs)
        np.testing.assert_allclose(records.states[place, :STEPS], states, atol=1e-3)
        np.testing.assert_allclose(found[STATES], expected[STATES], atol=1e-3)
        np.testing.assert_allclose(found["reward"], expected["reward"], atol=1e-2)
        np.testing.assert_allclose(found["counted_seconds"], expected["counted_seconds"], atol=1e-9)
        for name in ("step", "model", "status", "collision", "humans_turn", "humans_tom", "success"):
            assert found[name].tolist() == expected[name].tolist()


def test_episodes_are_drawn_as_the_environment_draws_them(batch):
    env = make_environment("dense_merge", CONTROLLERS[2], costs=COSTS, **COMPARISON.common_config()).unwrapped
    env.reset(seed=3)
    drawn = batch.episodes([(CONTROLLERS[2], 3), ("tom", 3)])
    np.testing.assert_array_equal(drawn.starts[0], env.car_states.astype(np.float32))
    np.testing.assert_array_equal(drawn.weights[1], env.weights)
    assert drawn.seeds.tolist() == [env.robot.controller.seed] * 2


@pytest.mark.slow
def test_rows_of_episodes_and_steps_say_what_the_records_hold(batch, records):
    keys = batch.keys()
    steps, episodes = tabulated(batch, keys, records), summarised(batch, keys, records)
    assert list(steps) == columns_simulated(crowd=True)
    assert set(columns(crowd=True)) - set(steps) == {"planning_seconds", "decision_seconds", "compile_seconds"}
    assert len(steps) == len(keys) * batch.steps
    means = steps.groupby("controller", sort=False)[["reward", "counted_seconds", "humans_turn", "humans_tom"]].mean()
    np.testing.assert_allclose(episodes[list(means)], means, rtol=1e-5)
    assert episodes["share_tom"].tolist() == (records.rungs == TOM).any(axis=2).mean(axis=1).tolist()
    assert episodes["humans_tom"].tolist()[:2] == [2, 1]
    assert (
        episodes["success"].tolist() == steps.groupby("controller", sort=False)["success"].last().astype(int).tolist()
    )
    assert episodes["counted_seconds"].iloc[0] == pytest.approx(0.001 + 2 * 0.004)
    assert sweep_summary(episodes)[list(OUTCOMES)].to_numpy().tolist() == episodes[list(OUTCOMES)].to_numpy().tolist()


@pytest.mark.slow
def test_a_robot_that_collided_does_not_succeed_though_it_ends_in_its_lane(batch, records):
    target = float(batch.loop.crowd.game.scene.target_lane)
    states, collision = np.array(records.states), np.zeros_like(records.collision)
    states[:, :, 0, 1], collision[0, 3] = target, True
    table = tabulated(batch, batch.keys(), records._replace(states=states, collision=collision))
    success = table["success"].to_numpy(bool).reshape(len(CONTROLLERS), -1)
    assert success[0].tolist() == [True] * 3 + [False] * (batch.steps - 3)
    assert success[1:].all()


@pytest.mark.slow
def test_fallbacks_are_plans_that_failed_and_not_ways_out(batch, records):
    status = np.zeros_like(records.status)
    status[0, :3] = STATUSES.index("way out")
    status[1, :2] = STATUSES.index("previous plan")
    episodes = summarised(batch, batch.keys(), records._replace(status=status))
    assert episodes["fallbacks"].tolist() == [0, 2, 0]
    np.testing.assert_allclose(episodes["way_out"], [3 / batch.steps, 0, 0])


def test_budgets_count_the_seconds_that_are_given(batch):
    rule = batch.rule("budget:10")
    assert (rule.seconds, rule.deciding) == (0.01, 0.0)
    assert rule.costs.base == COSTS["naive"]
    np.testing.assert_allclose(rule.costs.each[[NAIVE, TOM]], [0, 0.004])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "costs are 'measured', and a simulation cannot measure plans; give seconds by model"),
        (["--costs", "naive=0.1"], "no seconds for 'turn'"),
        (["--costs", "published", "--humans", "1"], "config['humans'] is 1"),
        (["--costs", "published", "--controllers", "horizon:1"], "unknown controller 'horizon:1'"),
        (["--costs", "published", "--ladder", "naive"], "ladder"),
    ],
)
def test_a_wrong_sweep_says_so_in_one_line_and_writes_nothing(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", "dense_merge", *arguments, "--out", "out"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())


class KnowingEnv(DenseMergeEnv):
    """Dense Merge with a robot that knows every human's reward."""

    scenario = replace(DenseMergeEnv.scenario, name="knowing")

    @classmethod
    def default_config(cls):
        return super().default_config() | {"beliefs": "true"}


def test_an_environment_whose_robot_knows_the_true_rewards_is_left_to_compare():
    add_scenario(KnowingEnv)
    try:
        with pytest.raises(ValueError, match="beliefs 'true'"):
            any_batch(replace(COMPARISON, controllers={"knowing": ["naive"]}), "knowing")
    finally:
        del ENVIRONMENTS["knowing"]
