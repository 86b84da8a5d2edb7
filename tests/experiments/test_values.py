"""Learning values of computation: `ms-highway values learn`."""

from dataclasses import replace
from itertools import islice

import jax
import numpy as np
import pytest
from commands import run
from episodes import make

from ms_highway.choice.learned_value import load_values
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.learning import learn, prepare


def test_values_know_the_horizons_of_all_their_scenes():
    asked = Comparison({name: ["tom"] for name in ("stay-back-v1", "merger-v1")})
    learning, _ = prepare(asked, rounds=1, states=1, horizon=None, seed=0)
    assert learning.settings["planning_horizon"] == [10, 20]


@pytest.mark.parametrize(
    "name",
    ["merger-v1", "stay-back-v1", "give-way-v1", "dense-merge-v1", "crossing-crowd-v1"],
)
def test_the_shipped_values_suit_every_scene_of_version_1(name, recwarn):
    make(name, "learned:1").reset(seed=0)
    messages = [str(warning.message) for warning in recwarn]
    assert not any("values of computation" in message for message in messages)


@pytest.mark.slow
def test_killed_learning_resumes_to_the_same_values(tmp_path):
    """It resumes only with the same settings, and refuses damaged rollouts."""
    asked = Comparison(
        {"merger": ["switching:1"]}, config={"ladder": ["naive", "turn"]}
    )
    learning, batches = prepare(asked, rounds=2, states=8, horizon=None, seed=3)
    done = list(learn(learning, batches, tmp_path / "whole"))
    assert [said for said, _ in done][1:3] == [
        "round 1 of 2: fitted",
        "round 2 of 2: merger",
    ]
    assert [values.provenance["examples"] for _, values in done[1::2]] == [8, 13]

    kept = tmp_path / "kept"
    list(islice(learn(learning, batches, kept), 1))
    before = (kept / "1-0.npz").read_bytes()
    with pytest.raises(ValueError, match="seed 3 instead of 9"):
        next(learn(replace(learning, seed=9), batches, kept))
    *_, (_, last) = learn(learning, batches, kept)
    assert (kept / "1-0.npz").read_bytes() == before
    jax.tree.map(np.testing.assert_array_equal, last.network, done[-1][1].network)

    (kept / "1-0.npz").write_bytes(before[:100])
    with pytest.raises(ValueError, match=r"1-0\.npz cannot be read"):
        next(learn(learning, batches, kept))


@pytest.mark.slow
def test_the_command_learns_values_among_several_humans_that_drive(tmp_path):
    file = tmp_path / "values.npz"
    config = "dense_merge --set humans=2 --set horizon=5"
    run(f"values learn {config} --states 6 --rounds 2 --horizon-steps 5 --out {file}")
    assert list(tmp_path.iterdir()) == [file]
    values = load_values(file)
    assert values.provenance["scenarios"] == ["dense_merge"]
    # Two for each state.
    assert values.provenance["examples"] == 24
    controllers = f"--controllers learned:0.1:{file}"
    run(f"compare {config} {controllers} --seeds 1 --out {tmp_path / 'out'}")
