"""Learned rewards as files."""

import json
from functools import reduce
from operator import getitem

import numpy as np
import pytest
from msgspec import structs

from ms_highway.game.learned_reward import SHIPPED, load, save, shipped
from ms_highway.game.scenario import COMMON_WEIGHTS


@pytest.mark.parametrize("name", SHIPPED)
def test_a_learned_reward_is_read_as_it_was_written(name, tmp_path):
    save(shipped(name), tmp_path / "theta.json")
    assert load(tmp_path / "theta.json") == shipped(name)
    assert [path.name for path in tmp_path.iterdir()] == ["theta.json"]


def test_the_shipped_rewards_have_converged_and_say_what_they_are_worth():
    simulated, real = (shipped(name) for name in SHIPPED)
    for learned in (simulated, real):
        assert learned.converged
        assert 0 <= learned.log_likelihood["train"] - learned.log_likelihood["held_out"] < 0.5
    for name in simulated.learned:
        assert 1 / 1.05 < simulated.weights[name] / COMMON_WEIGHTS[name] < 1.05
    assert set(real.learned) > {"headway", "closing_speed", "comfort_steering"}


@pytest.mark.parametrize(
    ("name", "part", "value", "message"),
    [
        ("demonstrations", ("version",), 2, "of version 2, not 3"),
        ("demonstrations", ("weights", "speed"), float("nan"), "the weight of speed is nan"),
        ("demonstrations", ("covariance",), (-np.eye(4)).tolist(), "covariance"),
        ("demonstrations", ("surprise",), 1, "unknown field `surprise`"),
        ("us101", ("drivers", "weights", "headway"), None, "weights of drivers lack .* headway"),
        ("us101", ("drivers", "spread", "tails"), [-1.0, 1.0], r"spread.tails\[0\] is -1.0"),
    ],
)
def test_a_damaged_file_or_one_of_another_version_is_refused_with_a_remedy(name, part, value, message, tmp_path):
    path = tmp_path / "theta.json"
    save(shipped(name), path)
    content = json.loads(path.read_text())
    *outer, last = part
    place = reduce(getitem, outer, content)
    place[last] = value
    if value is None:
        del place[last]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"theta\.json .*{message}.*ms-highway irl fit"):
        load(path)


def test_missing_and_unknown_rewards_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere\.json cannot be read"):
        load(tmp_path / "nowhere.json")
    with pytest.raises(ValueError, match="no learned reward 'us102' comes with ms_highway"):
        shipped("us102")


def test_an_interval_is_as_wide_as_its_covariance_says():
    learned = shipped("demonstrations")
    wide = structs.replace(learned, covariance=(4 * np.array(learned.covariance)).tolist())
    narrow_low, narrow_high = learned.interval("speed")
    wide_low, wide_high = wide.interval("speed")
    assert np.log(wide_high / wide_low) == pytest.approx(2 * np.log(narrow_high / narrow_low))
