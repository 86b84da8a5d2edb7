"""The filter of which model a human follows."""

import numpy as np
import pytest

from ms_highway.choice.belief import MIN_PROBABILITY, STAY_PROBABILITY, updated_belief

CERTAIN = np.eye(4)[0]
PREDICTED = np.array([[0.0, 0.0], [0.0, -1.0], [0.0, -2.0], [0.0, -3.0]])


def test_a_human_who_brakes_as_a_model_predicts_is_believed_to_follow_it_and_no_model_is_excluded():
    belief = np.full(4, 1 / 4)
    for _ in range(50):
        belief = updated_belief(belief, PREDICTED, PREDICTED[2], 0.1)
    assert belief[2] == belief.max() > 0.6
    belief = updated_belief(CERTAIN, PREDICTED, np.array([0.0, 30.0]), 0.1)
    assert belief.min() == pytest.approx(MIN_PROBABILITY, rel=0.01)
    assert belief.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("steps", [1, 5])
def test_humans_without_an_observed_control_change_their_model_at_the_same_rate_for_all_lengths_of_steps(
    steps,
):
    belief = CERTAIN
    for _ in range(steps):
        belief = updated_belief(belief, PREDICTED, np.full(2, np.nan), 0.5 / steps)
    assert belief[0] == pytest.approx(1 / 4 + 3 / 4 * STAY_PROBABILITY**5)
