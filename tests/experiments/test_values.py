"""Learning values of computation with one human and several, by `ms-highway values learn`."""

from dataclasses import replace
from itertools import islice

import jax
import numpy as np
import pytest
from commands import run

from ms_highway.choice.learned_value import load_values
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.learning import learn
from ms_highway.experiments.rollouts import Course, Learning
from ms_highway.runtime.compilation import device_mesh, use_devices

LEARNING = Learning({"naive": 0.09, "turn": 0.17}, rounds=2, states=(8, 5), seed=3)
QUICK = {
    "merger": ("--set ladder=naive,turn", "--states 8 --rounds 2"),
    "dense_merge": ("--set humans=2 --set horizon=5", "--states 6 --rounds 2 --horizon-steps 5"),
}


@pytest.fixture(scope="module")
def course():
    batch = make_batch(Comparison({"merger": ["naive"]}, config={"ladder": ["naive", "turn"]}), "merger")
    return Course(batch, (0, 1))


@pytest.mark.slow
def test_killed_learning_resumes_and_gives_the_same_values_on_any_devices(course, tmp_path):
    done = list(learn(LEARNING, [course], tmp_path / "whole", device_mesh(jax.local_devices()[:1])))
    assert [said for said, _ in done][1:3] == ["round 1 of 2: fitted", "round 2 of 2: merger"]
    assert [values.provenance["examples"] for _, values in done[1::2]] == [8, 13]
    kept = tmp_path / "kept"
    list(islice(learn(LEARNING, [course], kept, use_devices()), 1))
    before = (kept / "1-0.npz").read_bytes()
    *_, (_, last) = learn(LEARNING, [course], kept, use_devices())
    assert (kept / "1-0.npz").read_bytes() == before
    jax.tree.map(np.testing.assert_array_equal, last.network, done[-1][1].network)
    with pytest.raises(ValueError, match=r"seed \d instead of 9"):
        next(learn(replace(LEARNING, seed=9), [course], kept, device_mesh()))
    (kept / "1-0.npz").write_bytes(before[:100])
    with pytest.raises(ValueError, match=r"1-0\.npz cannot be read"):
        next(learn(LEARNING, [course], kept, device_mesh()))


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "examples"), [("merger", 13), ("dense_merge", 24)])  # 2 examples per state
def test_the_command_learns_values_that_drive(scenario, examples, tmp_path):
    file, (config, quick) = tmp_path / "values.npz", QUICK[scenario]
    run(f"values learn {scenario} {config} {quick} --out {file}")
    assert list(tmp_path.iterdir()) == [file]
    values = load_values(file)
    assert (values.provenance["scenarios"], values.provenance["examples"]) == ([scenario], examples)
    run(f"compare {scenario} {config} --controllers learned:0.1:{file} --seeds 1 --out {tmp_path / 'out'}")
