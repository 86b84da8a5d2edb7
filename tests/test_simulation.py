"""The closed loop in pure JAX does what the environments do."""

import numpy as np
import pandas as pd
import pytest

from ms_highway.envs import SCENARIOS
from ms_highway.episodes import columns_simulated, make_batch, run_episodes, simulated, start
from ms_highway.experiment import Comparison, episode, make_environment
from ms_highway.report import interval
from ms_highway.scenario import PAPER_UNIT

KEYS = ["controller", "seed", "step"]
CONTROLLERS = ["naive", "turn", "schedule:turn=5,naive=3,turn", "tom", "switching:0.1"]
STATES = [f"{car}_{name}" for car in ("robot", "human") for name in ("x", "y", "heading", "speed")]
COMPARISON = Comparison({"merger": CONTROLLERS}, seeds=6)


def driven(comparison, scenario, controller):
    """The records of the environment."""
    env = make_environment(scenario, controller, costs=comparison.costs, **comparison.common_config())
    seeds = range(comparison.first_seed, comparison.first_seed + comparison.seeds)
    rows = [{"controller": controller, "seed": seed, **record} for seed in seeds for record in episode(env, seed)]
    return pd.DataFrame(rows).set_index(KEYS)


@pytest.fixture(scope="module")
def records():
    return simulated(COMPARISON)


def test_records_are_those_of_an_experiment_without_measured_times(records):
    assert list(records) == columns_simulated()
    assert len(records) == len(CONTROLLERS) * 6 * 40
    assert records["controller"].drop_duplicates().tolist() == CONTROLLERS
    assert set(records["status"]) == {"planned"}


@pytest.mark.parametrize("controller", CONTROLLERS[:3])
def test_whole_episodes_agree_with_the_environment_step_by_step(records, controller):
    expected = driven(COMPARISON, "merger", controller)
    found = records.set_index(KEYS).loc[expected.index]
    np.testing.assert_allclose(found[STATES] / PAPER_UNIT, expected[STATES] / PAPER_UNIT, atol=1e-3, rtol=0)
    np.testing.assert_allclose(found["reward"], expected["reward"], atol=1e-3)
    assert (found[["model", "status"]] == expected[["model", "status"]]).all(axis=None)
    assert (found["counted_seconds"] == expected["counted_seconds"]).all()


@pytest.mark.parametrize("controller", CONTROLLERS[3:])
def test_means_of_theory_of_mind_and_switching_lie_in_the_intervals_of_the_environment(records, controller):
    expected = driven(COMPARISON, "merger", controller)
    found = records.set_index(KEYS).loc[expected.index]
    low, high = interval(expected["reward"].groupby("seed").mean())
    assert low <= found["reward"].mean() <= high
    assert abs(found["counted_seconds"].mean() - expected["counted_seconds"].mean()) < 0.01
    for seed in range(6):  # gains are estimated at the same steps, until a decision differs
        same = (found["model"] == expected["model"]).loc[(controller, seed)].cumprod().astype(bool).to_numpy()
        for name in expected.filter(like="gain_"):
            gains = (table.loc[(controller, seed), name].to_numpy(float)[same] for table in (found, expected))
            np.testing.assert_array_equal(*map(np.isnan, gains))


def test_what_becomes_of_an_episode_does_not_depend_on_its_company():
    batch = make_batch(COMPARISON, "merger")
    keys = batch.keys()
    shuffled = [keys[place] for place in np.random.default_rng(0).permutation(len(keys))]
    first, second = (run_episodes(batch, some) for some in (keys, shuffled))
    order = [shuffled.index(key) for key in keys]
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other[order])


def test_starts_are_those_of_the_environment(scenario):
    env = make_environment(scenario, "naive")
    env.reset(seed=3)
    np.testing.assert_array_equal(start(SCENARIOS[scenario], 3), env.unwrapped.car_states)


def test_a_batch_without_controllers_episodes_or_known_costs_is_refused():
    with pytest.raises(ValueError, match="no controllers for 'give_way'"):
        make_batch(COMPARISON, "give_way")
    with pytest.raises(ValueError, match="no episodes to simulate"):
        run_episodes(make_batch(COMPARISON, "merger"), [])
    with pytest.raises(ValueError, match="cannot measure plans"):
        make_batch(Comparison({"merger": ["naive"]}, costs="measured"), "merger")
    with pytest.raises(ValueError, match="the seed is -1"):
        start(SCENARIOS["merger"], -1)
