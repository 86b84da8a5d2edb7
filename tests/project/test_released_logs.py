"""A few logged steps of the paper's released code are replayed, without its files.

`tests/project/test_fences.py` replays all of its logs, where they are at hand.
"""

import numpy as np
import pytest

from ms_highway.experiments.validation import validate_file

MERGER = {  # lambda 0.1, first episode, from its sixth step on
    "states": [  # x, y, heading and speed of robot, human and scripted car
        [
            [0.1820967, -0.01303789, -0.06251709, 0.56075811],
            [0.08885629, -0.10541203, -0.03298502, 0.55901968],
            [0.34982708, -0.10014568, -0.00086526, 0.60103279],
        ],
        [
            [0.23800869, -0.0165379, -0.0568345, 0.55967051],
            [0.14448999, -0.10724777, -0.03097479, 0.5542599],
            [0.40993035, -0.10019769, -0.00086526, 0.60103279],
        ],
        [
            [0.29382187, -0.01971344, -0.09832029, 0.55839843],
            [0.19972847, -0.10895932, -0.02756505, 0.55103999],
            [0.47003362, -0.10024969, -0.00086526, 0.60103279],
        ],
        [
            [0.34974703, -0.0252298, -0.0715913, 0.56553268],
            [0.25296491, -0.11042716, -0.02889828, 0.5140937],
            [0.53013688, -0.1003017, -0.00086526, 0.60103279],
        ],
    ],
    "robot_controls": [  # yaw rate and acceleration
        [0.05682639, 0.05201397],
        [-0.41485822, 0.04992514],
        [0.26728931, 0.13370447],
        [-0.55122417, 0.00331262],
    ],
    "human_controls": [
        [0.02010226, 0.01490272],
        [0.03409743, 0.02924178],
        [-0.01333237, -0.30873395],
    ],
    "rewards": [1.48781943, 1.5602634, 1.56707621, 1.66067147],
    "models": [0, 2, 1, 2],  # naive, theory of mind, turn, theory of mind
}

GIVE_WAY = {  # lambda 0.01, first episode, from its third step on
    "states": [  # robot, human and two scripted cars
        [
            [-0.15708436, -0.1010026, -0.01911954, 0.58502406],
            [-0.14772625, -0.00035598, -0.02700834, 0.59376538],
            [0.16951729, -0.09998967, -0.00086526, 0.60103279],
            [-0.4803018, -0.09869007, 0.0012321, 0.59972805],
        ],
        [
            [-0.09883325, -0.10211647, -0.02307717, 0.58021122],
            [-0.08842612, -0.00195797, -0.03399829, 0.59266996],
            [0.22962055, -0.10004167, -0.00086526, 0.60103279],
            [-0.42032903, -0.09861618, 0.0012321, 0.59972805],
        ],
        [
            [-0.04263568, -0.10341358, -0.05455129, 0.54403955],
            [-0.02921849, -0.00397171, -0.03645794, 0.59216726],
            [0.28972381, -0.10009368, -0.00086526, 0.60103279],
            [-0.36035627, -0.09854228, 0.0012321, 0.59972805],
        ],
        [
            [0.01173621, -0.10638259, -0.03691511, 0.54501814],
            [0.03004511, -0.00613329, -0.05618589, 0.59389305],
            [0.34982708, -0.10014568, -0.00086526, 0.60103279],
            [-0.30038351, -0.09846839, 0.0012321, 0.59972805],
        ],
    ],
    "robot_controls": [
        [-0.03957614, 0.02032204],
        [-0.31474134, -0.29438785],
        [0.17636196, 0.06898154],
        [0.00013166, -0.42009366],
    ],
    "human_controls": [
        [-0.06989956, 0.05955732],
        [-0.02459645, 0.06522448],
        [-0.19727945, 0.08739034],
    ],
    "rewards": [-0.71422327, -0.607274, -0.48275191, -0.3552562],
    "models": [0, 2, 1, 2],
}

LOGGED = {
    "merger__switching_lambda_0.1": MERGER,
    "give_way__switching_lambda_0.01": GIVE_WAY,
}
"""Logged steps by the names that the released files have here, in the logs' units."""


@pytest.mark.parametrize("name", LOGGED)
def test_logged_steps_of_the_released_code_are_replayed(name, tmp_path):
    """Plans, the human's controls, rewards and the choices of Algorithm 1."""
    file = tmp_path / f"{name}.npz"
    episode = {array: np.array(steps)[None] for array, steps in LOGGED[name].items()}
    np.savez(file, **episode, ladder=np.arange(3))

    replay = validate_file(file)
    assert replay["action_error"]["max"] < 1e-4
    assert replay["human_error"]["max"] < 1e-4
    assert replay["reward_error"]["max"] < 1e-5
    assert replay["decisions"] == {"agree": 3, "all": 3}
