"""What an interrupted run finds when it is resumed."""

import pandas as pd
import pytest

from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.results import read_results
from ms_highway.experiments.runner import read, run

COMPARISON = Comparison({"merger": ["naive"]}, seeds=1)


def test_a_comparison_that_was_stopped_in_its_first_episode_can_be_resumed(tmp_path):
    assert next(run(COMPARISON, tmp_path)) == 0
    with pytest.raises(ValueError, match="holds no episodes yet"):
        read_results(tmp_path)
    runs = run(COMPARISON, tmp_path)
    assert [next(runs), next(runs)] == [0, 1]
    stopped = read_results(tmp_path).records
    assert list(run(COMPARISON, tmp_path)) == [1]
    pd.testing.assert_frame_equal(read_results(tmp_path).records, stopped)
    pd.testing.assert_frame_equal(read(COMPARISON, tmp_path), stopped)
    assert len(stopped) == 40
