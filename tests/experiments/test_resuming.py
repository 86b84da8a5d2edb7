"""What an interrupted run finds when it is resumed."""

import pytest

from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.results import read_results
from ms_highway.experiments.resuming import missing
from ms_highway.experiments.runner import run

COMPARISON = Comparison({"merger": ["naive"]}, seeds=1)


def test_a_comparison_that_was_stopped_in_its_first_episode_can_be_resumed(tmp_path):
    assert next(run(COMPARISON, tmp_path)) == 0
    with pytest.raises(ValueError, match="holds no episodes yet"):
        read_results(tmp_path)
    assert list(run(COMPARISON, tmp_path)) == [0, 1]
    assert len(read_results(tmp_path).records) == 40


def test_settings_that_were_given_as_other_sequences_agree(tmp_path):
    for limit in ((0.2, 9.0), [0.2, 9.0]):
        comparison = Comparison({"merger": ["naive"]}, seeds=1, planning={"control_limit": limit})
        assert next(run(comparison, tmp_path)) == 0


def test_what_is_missing_is_wanted_once_and_in_order():
    assert missing([3, 1, 2, 3], {2}) == [3, 1]
