"""Choice of a model for each car on a road: bounds on gains, prices and budgets."""

from dataclasses import replace

import numpy as np
from roads import PLANNING, WEIGHTS, scene_of

from ms_highway.choice.rule import first_memory
from ms_highway.perception.scene import TRAFFIC
from ms_highway.planning.compiled_plans import Costs
from ms_highway.road.constants import MODELS
from ms_highway.road.driver import decided, proposed_for
from ms_highway.road.plan import no_plan
from ms_highway.road.settings import RoadSettings


def test_only_a_car_that_is_in_the_way_and_could_yield_may_be_worth_a_better_prediction():
    """The goal asks for the lane in which a car comes from behind."""
    scene = scene_of(robot=(0.0, 0.0, 0.0, 20.0), cars=[(0.0, 1, 21.0), (-200.0, -1, 15.0)])
    scene = replace(scene, changes=np.array([2.0, 1.0, 0.0], np.float32), room=np.float32(30.0))
    naive = np.zeros(TRAFFIC, np.int32)
    gains = proposed_for(scene, PLANNING, WEIGHTS, naive, no_plan(PLANNING)).worth
    assert gains[0] > 0
    np.testing.assert_array_equal(gains[1:], 0.0)


def chosen(driver, costs, gains, spent=0.0):
    """Numbers of the models that a driver's rule chooses."""
    rule = RoadSettings.read({"driver": driver}).rule(costs).deciding_in(lambda: spent)
    return np.asarray(decided(rule, None, first_memory(rule, len(gains)), gains.astype(np.float32)).memory.rungs)


def test_a_higher_price_never_buys_a_more_expensive_model():
    costs, gains = Costs(0.004, np.array([0.0, 0.0001, 0.003])), np.array([0.0, 5.0, 0.2, 30.0, 1e-3, 0.0, 2.0])
    found = np.array([chosen(f"priced:{price}", costs, gains) for price in np.geomspace(1, 1e6, 30)])
    assert (np.diff(found, axis=0) <= 0).all()
    assert len(np.unique(found[:, 3])) == len(MODELS)


def test_a_budget_is_never_exceeded_and_goes_to_the_highest_gains_first():
    random = np.random.default_rng(0)
    for _ in range(20):
        gains = np.maximum(random.normal(size=TRAFFIC), 0.0)
        costs = Costs(random.uniform(0, 0.004), np.cumsum([0.0, *random.uniform(0, 0.002, 2)]))
        milliseconds, spent = random.uniform(0, 20), random.uniform(0, 0.005)
        models = chosen(f"budget:{milliseconds}", costs, gains, spent)
        extra = costs.each[models].sum()
        assert extra == 0 or spent + costs.base + extra <= milliseconds / 1e3 + 1e-6
        assert (np.diff(models[np.argsort(-gains, kind="stable")]) <= 0).all()
        assert (models[gains == 0] == 0).all()
