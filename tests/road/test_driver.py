"""The robot's driver on roads: choice of models by price and budget, late plans,
compilation, and plans that fail.
"""

from dataclasses import replace

import jax
import numpy as np
from roads import PLANNING, WEIGHTS, scene_of

from ms_highway.choice.budget import deciding_in
from ms_highway.choice.rule import first_memory
from ms_highway.perception.scene import SHAPE
from ms_highway.planning.costs import Costs
from ms_highway.road.driver import decided, proposed_for
from ms_highway.road.plan import no_plan
from ms_highway.road.road_weights import RoadWeights
from ms_highway.road.settings import RoadSettings
from ms_highway.road.traffic_models import TRAFFIC_MODELS

SCENE = scene_of(
    robot=(0.0, 0.0, 0.0, 18.0),
    cars=[(45.0, 0, 12.0), (-12.0, 1, 22.0), (30.0, -1, 15.0)],
)
BLIND = replace(SCENE, robot=np.full(4, np.nan, np.float32))


def test_only_a_car_that_could_yield_is_worth_a_prediction():
    """The goal asks for the lane in which a car comes from behind."""
    scene = scene_of(
        robot=(0.0, 0.0, 0.0, 20.0), cars=[(0.0, 1, 21.0), (-200.0, -1, 15.0)]
    )
    scene = replace(
        scene, changes=np.array([2.0, 1.0, 0.0], np.float32), room=np.float32(30.0)
    )
    proposed = proposed_for(
        scene, PLANNING, WEIGHTS, np.zeros(SHAPE.paths, np.int32), no_plan(PLANNING)
    )
    first, *others = np.asarray(proposed.worth)
    assert first > 0
    assert not any(others)


def chosen(driver, costs, gains, spent=0.0):
    """Numbers of the models that a driver's rule chooses."""
    rule = deciding_in(RoadSettings.read({"driver": driver}).rule(costs), lambda: spent)
    rungs = decided(
        rule, first_memory(rule, SHAPE.paths), gains.astype(np.float32)
    ).memory.rungs
    return np.array([TRAFFIC_MODELS.index(rule.ladder[rung].name) for rung in rungs])


def test_a_higher_price_never_buys_a_more_expensive_model():
    costs = Costs(0.004, np.array([0.0, 0.0001, 0.003]), TRAFFIC_MODELS)
    gains = np.geomspace(1e-3, 30.0, SHAPE.paths)
    found = np.array(
        [chosen(f"priced:{price}", costs, gains) for price in np.geomspace(1, 1e6, 30)]
    )
    assert (np.diff(found, axis=0) <= 0).all()
    assert len(np.unique(found[:, -1])) == len(TRAFFIC_MODELS)


def test_models_at_a_price_ignore_those_in_use():
    settings = RoadSettings.read(
        {"driver": "priced:1", "costs": {"idm": 0.1, "tom": 0.2}}
    )
    rule = settings.rule(Costs(0.0, np.array([0.0, 0.0001, 0.0002]), TRAFFIC_MODELS))
    memory = first_memory(rule, SHAPE.paths)
    bounds = np.full(SHAPE.paths, 5.0, np.float32)
    for _ in range(3):
        memory = decided(rule, memory, bounds).memory
        names = [rule.ladder[rung].name for rung in memory.rungs]
        assert names == ["tom"] * SHAPE.paths


def test_a_budget_is_kept_and_goes_to_the_highest_gains():
    random = np.random.default_rng(0)
    for _ in range(20):
        gains = np.maximum(random.normal(size=SHAPE.paths), 0.0)
        each = np.cumsum([0.0, *random.uniform(0, 0.002, 2)])
        costs = Costs(random.uniform(0, 0.004), each, TRAFFIC_MODELS)
        milliseconds = random.uniform(0, 20)
        spent = random.uniform(0, 0.005)
        models = chosen(f"budget:{milliseconds}", costs, gains, spent)
        extra = costs.each[models].sum()
        assert extra == 0 or spent + costs.base + extra <= milliseconds / 1e3 + 1e-6
        assert (np.diff(models[np.argsort(gains)]) >= 0).all()
        assert (models[gains == 0] == 0).all()


def driver(name="fixed:naive", planning=PLANNING):
    return RoadSettings.read({"driver": name, "costs": {"idm": 0.1, "tom": 3.0}}).build(
        planning
    )


def test_a_plan_beyond_its_budget_is_followed_a_step_later():
    late = driver("budget:0")
    usual = driver()
    steps = [late.step(SCENE) for _ in range(3)]
    first = usual.step(SCENE)
    second = usual.step(SCENE)
    assert [(step.status, step.source) for step in steps] == [
        ("late", source) for source in ("braking", "last plan", "last plan")
    ]
    assert not any(step.failed for step in steps)
    executed = [step.control for step in steps]
    np.testing.assert_array_equal(
        executed, [[0.0, -PLANNING.grip], first.plan[1], second.plan[1]]
    )


def test_nothing_compiles_after_the_first_step(caplog):
    for name in ("priced:1", "budget:20"):
        driver(name).step(SCENE)
    caplog.clear()
    with jax.log_compiles():
        for name in (
            *(f"fixed:{model}" for model in TRAFFIC_MODELS),
            "priced:0.5",
            "budget:5",
        ):
            other = driver(name, replace(PLANNING, desired_speed=22.0, grip=4.0))
            other.weights = RoadWeights(speed=2.0)
            other.step(scene_of(cars=[(20.0, 0, 10.0)]))
            other.step(scene_of(bend=1 / 50, robot=(0.0, 0.0, 0.0, 10.0)))
    assert not [
        record for record in caplog.records if "compilation" in record.getMessage()
    ]


def test_without_finite_plans_the_robot_follows_its_last_and_brakes():
    unknown = np.where(
        np.arange(SHAPE.paths)[:, None] == 0, np.float32(np.nan), SCENE.states
    )
    robot = driver()
    assert robot.step(BLIND).source == "braking"
    first = robot.step(SCENE)
    steps = [
        robot.step(blind)
        for blind in (*[BLIND] * PLANNING.steps, *[replace(SCENE, states=unknown)] * 2)
    ]
    assert [step.source for step in steps] == ["last plan"] * (PLANNING.steps - 1) + [
        "braking"
    ] * 3
    assert not first.failed
    assert all(
        step.failed and not any(step.models) and len(step.path) == 0 for step in steps
    )
    braking = [[0.0, -PLANNING.grip]] * 3
    np.testing.assert_allclose(
        [step.control for step in steps], [*first.plan[1:], *braking], atol=1e-6
    )
    assert robot.step(SCENE).source in ("proposal", "last plan")
