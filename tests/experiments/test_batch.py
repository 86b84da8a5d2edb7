"""Many episodes at a time, among one human or several: those of the environments."""

import numpy as np
import pandas as pd
import pytest

from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import STATES
from ms_highway.experiments.runner import episode, make_environment

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
