"""The filter of which model a human follows."""

import numpy as np
import pytest

from ms_highway.choice.belief import INFERENCE, updated_probabilities

CERTAIN = np.eye(4)[0]
PREDICTED = np.array([[0.0, 0.0], [0.0, -1.0], [0.0, -2.0], [0.0, -3.0]])


def test_the_model_that_predicted_a_human_gets_likely():
    """No model is excluded, whatever a human does."""
    found = np.full(4, 1 / 4)
    for _ in range(50):
        found = updated_probabilities(found, PREDICTED, PREDICTED[2], 0.1)
    assert found[2] == found.max() > 0.6
    found = updated_probabilities(CERTAIN, PREDICTED, np.array([0.0, 30.0]), 0.1)
    assert found.min() == pytest.approx(INFERENCE.min_probability, rel=0.01)
    assert found.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("steps", [1, 5])
def test_unobserved_humans_change_models_at_a_rate_per_second(steps):
    """The rate does not depend on the length of steps."""
    found = CERTAIN
    for _ in range(steps):
        found = updated_probabilities(found, PREDICTED, np.full(2, np.nan), 0.5 / steps)
    assert found[0] == pytest.approx(1 / 4 + 3 / 4 * INFERENCE.stay_probability**5)
