"""Executed controls keep to the limits of each control and to the grip of tyres, whoever planned them."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest

from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.loop.driver import fixed
from ms_highway.planning.human_models import Naive
from ms_highway.planning.ladders import MODELS, register
from ms_highway.planning.plans import Plan

GRIP = 8.0  # m/s^2


@dataclass(frozen=True)
class Reckless(Naive):
    """A user-defined model whose plans exceed all limits."""

    name: ClassVar[str] = "reckless"
    excess: float = 1e9

    def plan(self, game, state, start=None):
        plan = super().plan(game, state, start)
        return Plan(plan.robot + self.excess, plan.humans)


@pytest.mark.parametrize("grip", [None, GRIP])
def test_a_plan_of_a_user_defined_model_is_executed_within_the_limits(played, grip):
    game, state = played("merger", control_limit=(0.05, 6.0), grip=grip)
    step = fixed(game, Reckless()).step(np.asarray(state))
    assert step.status == "planned"
    assert (abs(step.plan) <= np.array([0.05, 6.0]) * 1.0001).all()
    assert grip is None or held_by(step.control, float(state[0, 3])) <= GRIP * 1.0001
    assert grip is not None or step.control == pytest.approx([0.05, 6.0])


def held_by(control, speed):
    """The total acceleration under a control, with the paper's friction."""
    return np.hypot(speed**2 * control[0], control[1] - 0.2 * speed)


STATES = [f"{car}_{number}" for car in ("robot", "human") for number in ("x", "y", "heading", "speed")]


@pytest.fixture
def reckless():
    register(Reckless())
    yield "reckless"
    del MODELS["reckless"]


@pytest.mark.slow
def test_batches_keep_to_the_limits_as_environments_do(reckless):
    costs, controllers = {"naive": 0.1, "reckless": 0.1}, ["naive", "reckless"]
    config = {"costs": costs, "ladder": ["naive"], "control_limit": [0.05, 6.0], "grip": GRIP}
    comparison = Comparison({"merger": controllers}, seeds=2, config=config)
    envs = [make_environment("merger", name, **comparison.config) for name in controllers]
    expected = pd.DataFrame([record for env in envs for seed in range(2) for record in episode(env, seed)])
    found = simulated(comparison)
    np.testing.assert_allclose(found[STATES], expected[STATES], atol=0.05, rtol=0)
    assert (found["status"].to_numpy() == expected["status"].to_numpy()).all()
