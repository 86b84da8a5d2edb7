"""Many episodes at a time, among one human or several: those of the environments."""

import numpy as np
import pandas as pd
import pytest

from ms_highway.experiments.analysis.summary import summary
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import MEASURED, STATES, columns
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.loop.fallback import STATUSES

CONTROLLERS = ["turn", "schedule:turn=5,naive"]
STEPS = 10
SHORT = {"humans": 2, "horizon": 5, "ladder": ["naive", "turn"], "costs": {"naive": 0.001, "turn": 0.005}}
COMPARISON = Comparison({"dense_merge": CONTROLLERS}, seeds=1, config=SHORT)


@pytest.fixture(scope="module")
def simulated():
    batch = make_batch(COMPARISON, "dense_merge")
    return batch, batch.simulate(batch.keys())


@pytest.mark.slow
def test_an_episode_agrees_with_the_environment_step_by_step(simulated):
    batch, records = simulated
    table = batch.steps_table(batch.keys(), records).set_index("controller")
    for controller in CONTROLLERS:
        env = make_environment("dense_merge", controller, **SHORT)
        expected = pd.DataFrame(step for step, _ in zip(episode(env, 0), range(STEPS), strict=False))
        found = table.loc[controller].iloc[:STEPS]
        np.testing.assert_allclose(found[STATES], expected[STATES], atol=1e-3)
        np.testing.assert_allclose(found["reward"], expected["reward"], atol=1e-2)
        for name in ("step", "model", "status", "collision", "counted_seconds", "humans_turn", "success"):
            assert found[name].tolist() == pytest.approx(expected[name].tolist()), name


@pytest.mark.slow
def test_rows_of_episodes_and_steps_say_what_the_records_hold(simulated):
    batch, records = simulated
    status = np.zeros_like(records.status)
    status[0, :3], status[1, :2] = STATUSES.index("way out"), STATUSES.index("previous plan")
    steps = batch.steps_table(batch.keys(), records._replace(status=status))
    episodes = batch.episodes_table(steps)
    assert set(steps) == set(columns((), ["turn"])) - set(MEASURED)
    groups = steps.groupby("controller", sort=False)
    means = ["reward", "counted_seconds", "humans_turn"]
    np.testing.assert_allclose(episodes[means], groups[means].mean(), rtol=1e-5)
    assert episodes["share_turn"].tolist() == (records.rungs == 1).any(axis=2).mean(axis=1).tolist()
    assert episodes["humans_turn"].tolist() == [2, 10 / batch.steps]
    assert episodes["success"].tolist() == groups["success"].last().astype(int).tolist()
    assert episodes["counted_seconds"].iloc[0] == pytest.approx(0.001 + 2 * 0.004)
    assert episodes["fallbacks"].tolist() == [0, 2]  # plans that failed, and not ways out
    kept = ["success", "humans_turn", "way_out"]
    assert summary(episodes)[kept].to_numpy().tolist() == episodes[kept].to_numpy().tolist()
