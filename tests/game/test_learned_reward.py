"""Learned rewards as files."""

import json
from dataclasses import replace
from functools import reduce
from operator import getitem

import numpy as np
import pytest

from ms_highway.game.learned_drivers import LearnedDrivers
from ms_highway.game.learned_reward import SHIPPED, load, save, shipped
from ms_highway.game.scenario import COMMON_WEIGHTS


@pytest.mark.parametrize("name", SHIPPED)
def test_a_learned_reward_is_read_as_it_was_written(name, tmp_path):
    save(shipped(name), tmp_path / "theta.json")
    assert load(tmp_path / "theta.json") == shipped(name)
    assert [path.name for path in tmp_path.iterdir()] == ["theta.json"]


def test_a_file_of_version_2_has_neither_tails_nor_drivers(tmp_path):
    save(shipped("demonstrations"), tmp_path / "theta.json")
    content = json.loads((tmp_path / "theta.json").read_text())
    del content["tails"], content["drivers"]
    (tmp_path / "theta.json").write_text(json.dumps({**content, "version": 2}))
    assert load(tmp_path / "theta.json") == shipped("demonstrations")


def test_the_shipped_rewards_have_converged_and_say_what_they_are_worth():
    simulated, real = (shipped(name) for name in SHIPPED)
    for learned in (simulated, real):
        assert learned.converged
        assert 0 <= learned.log_likelihood["train"] - learned.log_likelihood["held_out"] < 0.5
    for name in simulated.learned:
        assert 1 / 1.05 < simulated.weights[name] / COMMON_WEIGHTS[name] < 1.05
        low, high = simulated.interval(name)
        assert abs(low) < abs(simulated.weights[name]) < abs(high)
    assert set(real.learned) > {"headway", "closing_speed", "comfort_steering"}
    assert real.sharp_weights["comfort_acceleration"] == pytest.approx(0.1 / real.temperature)


def broken(tmp_path, **changes):
    path = tmp_path / "theta.json"
    save(shipped("demonstrations"), path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 0}, "of version 0, not 3"),
        ({"version": None}, "of version None"),
        ({"weights": {"sped": 1.0}}, "unknown reward features"),
        ({"weights": {"speed": float("nan")}}, "the weight of speed is nan"),
        ({"weights": ["speed"]}, "must be given by name"),
        ({"temperature": -1.0}, "the temperature is -1"),
        ({"horizon": "5"}, "the horizon is '5'"),
        ({"feature_counts": {}}, "feature counts"),
        ({"covariance": (-np.eye(4)).tolist()}, "covariance"),
        ({"covariance": [[1.0]]}, "covariance"),
        ({"learned": ["gap"]}, "damaged"),
        ({"drivers": {}}, "drivers lacks changing"),
        ({"surprise": 1}, "damaged"),
    ],
)
def test_a_damaged_file_or_one_of_another_version_is_refused_with_a_remedy(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message) as error:
        load(broken(tmp_path, **changes))
    assert "theta.json" in str(error.value)
    assert "ms-highway irl fit" in str(error.value)


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        (("prior",), None, "drivers lacks prior"),
        (("prior", "noise"), None, "prior lacks noise"),
        (("prior", "noise"), -1.0, "must be positive"),
        (("weights", "headway"), None, "weights lacks headway"),
        (("weights", "sped"), 1.0, "weights has unknown sped"),
        (("weights", "headway"), 0.0, "weights is .* must be positive"),
        (("changing", "typical headway"), None, "changing lacks typical headway"),
        (("changing",), ["speed"], "changing is .* by name"),
        (("intention",), {"weights": [0.0, 0.0], "biases": [0.0] * 6}, "weights is .* 6 finite numbers"),
        (("spread", "along"), [0.0, float("nan"), 0.0], "spread.along is .* 3 finite numbers"),
        (("spread", "tails"), [-1.0, 1.0], "degrees of freedom must be positive"),
        (("deviations", "speed"), "much", "deviations.speed is 'much'"),
        (("peers",), [], "peers is .* by name"),
        (("peers", "idm", "spread"), None, "peers.idm lacks spread"),
        (("peers", "fitted_idm", "parameters", "gap"), True, "peers.fitted_idm.parameters.gap is True"),
    ],
)
def test_damaged_drivers_are_refused_with_a_remedy(part, value, message, tmp_path):
    path = tmp_path / "theta.json"
    save(shipped("us101"), path)
    content = json.loads(path.read_text())
    *outer, last = ("drivers", *part)
    place = reduce(getitem, outer, content)
    place[last] = value
    if value is None:
        del place[last]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"theta\.json is damaged: .*{message}.*ms-highway irl fit"):
        load(path)


def test_drivers_are_read_as_they_were_written_in_any_order():
    drivers = shipped("us101").drivers
    written = drivers.written()
    assert LearnedDrivers.read(written) == drivers
    turned = {name: dict(reversed(part.items())) for name, part in reversed(written.items())}
    assert LearnedDrivers.read(turned) == drivers


def test_a_file_of_version_1_which_named_a_key_otherwise_is_read(tmp_path):
    path = broken(tmp_path, version=1)
    path.write_text(path.read_text().replace('"learned"', '"learnt"'))
    assert load(path) == shipped("demonstrations")


def test_what_is_no_file_or_no_json_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"nowhere\.json cannot be read"):
        load(tmp_path / "nowhere.json")
    (tmp_path / "half.json").write_text('{"version": 2, "wei')
    with pytest.raises(ValueError, match=r"half\.json cannot be read"):
        load(tmp_path / "half.json")
    with pytest.raises(ValueError, match="no learned reward 'us102' comes with ms_highway"):
        shipped("us102")


def test_an_interval_is_as_wide_as_its_covariance_says():
    learned = shipped("demonstrations")
    wide = replace(learned, covariance=(4 * np.array(learned.covariance)).tolist())
    narrow_low, narrow_high = learned.interval("speed")
    wide_low, wide_high = wide.interval("speed")
    assert np.log(wide_high / wide_low) == pytest.approx(2 * np.log(narrow_high / narrow_low))
