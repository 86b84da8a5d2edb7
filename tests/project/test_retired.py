"""Names that version 2.0.0 retired are refused in one sentence that says what to use instead."""

import gymnasium as gym
import pytest

import ms_highway
from ms_highway.irl.prediction import predict_with
from ms_highway.runtime.retired import CONTROLLERS, DRIVERS, OPTIONS


@pytest.mark.parametrize(
    ("command", "gone"),
    [
        ("bench merger --peer casadi", "bench --peer"),
        ("bench road merge --traffic unyielding", "bench road --traffic unyielding"),
        ("bench road merge --drivers idm priced+traits", "traits"),
        ("sweep merger --processes=2 --out out", "sweep --processes"),
        ("sweep dense_merge --controllers risk:1+belief --out out", "risk"),
    ],
)
def test_a_command_with_a_retired_name_says_what_to_use_instead(command, gone, refused):
    instead = {**OPTIONS, **CONTROLLERS, **DRIVERS}[gone]
    assert refused(command) == f"ms-highway: {gone} is gone since 2.0.0: {instead}"


def test_python_with_a_retired_name_says_what_to_use_instead():
    with pytest.raises(AttributeError, match=r"RoadPolicy is gone since 2\.0\.0: use ms_highway\.drive"):
        _ = ms_highway.RoadPolicy
    with pytest.raises(ValueError, match=r"barrier is gone since 2\.0\.0: use nearest:K"):
        gym.make("ms-highway/dense-merge-v0", config={"controller": {"type": "barrier", "count": 1}})
    for config, gone in (({"belief": True}, "belief"), ({"ladder": ("naive", "turn", "tom")}, "turn")):
        with pytest.raises(ValueError, match=f"{gone} is gone since"):
            ms_highway.drive(gym.make("highway-fast-v0"), config)
    with pytest.raises(ValueError, match="lane_modes is gone since"):
        predict_with("lane_modes", None, None)
