"""Names that version 2.0.0 retired are refused in one sentence that says what to use instead."""

import gymnasium as gym
import pytest

import ms_highway
from ms_highway.irl.prediction import predict_with
from ms_highway.runtime.retired import CONTROLLERS, DRIVERS, OPTIONS

GONE = {f"{option} x": option for option in OPTIONS}
GONE["sweep merger --processes=2 --out out"] = "sweep --processes"
GONE["bench road merge --drivers idm priced+traits"] = "traits"
GONE["sweep dense_merge --controllers risk:1+belief --out out"] = "risk"


@pytest.mark.parametrize("command", GONE)
def test_a_command_with_a_retired_name_says_what_to_use_instead(command, refused):
    gone = GONE[command]
    instead = {**OPTIONS, **CONTROLLERS, **DRIVERS}[gone]
    assert refused(command) == f"ms-highway: {gone} is gone since 2.0.0: {instead}"


def test_python_with_a_retired_name_says_what_to_use_instead():
    with pytest.raises(AttributeError, match=r"RoadPolicy is gone since 2\.0\.0: use ms_highway\.drive"):
        _ = ms_highway.RoadPolicy
    with pytest.raises(ValueError, match=r"barrier is gone since 2\.0\.0: use nearest:K"):
        gym.make("ms-highway/dense-merge-v0", config={"controller": {"type": "barrier", "count": 1}})
    with pytest.raises(ValueError, match="turn is gone since"):
        ms_highway.drive(gym.make("highway-fast-v0"), {"ladder": ("naive", "turn", "tom")})
    with pytest.raises(ValueError, match="lane_modes is gone since"):
        predict_with("lane_modes", None, None)
