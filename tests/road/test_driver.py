"""The robot's driver on roads: late plans, compilation, and plans that fail."""

from dataclasses import replace

import jax
import numpy as np
from roads import PLANNING, scene_of

from ms_highway.perception.scene import TRAFFIC
from ms_highway.road.constants import MODELS, RoadWeights
from ms_highway.road.settings import RoadSettings

SCENE = scene_of(robot=(0.0, 0.0, 0.0, 18.0), cars=[(45.0, 0, 12.0), (-12.0, 1, 22.0), (30.0, -1, 15.0)])
BLIND = replace(SCENE, robot=np.full(4, np.nan, np.float32))


def driver(name="fixed:naive", planning=PLANNING):
    return RoadSettings.read({"driver": name, "costs": {"idm": 0.1, "tom": 3.0}}).build(planning)


def test_a_plan_beyond_its_budget_is_followed_a_step_later():
    late, usual = driver("budget:0"), driver()
    steps = [late.step(SCENE) for _ in range(3)]
    first, second = (usual.step(SCENE) for _ in range(2))
    assert [step.status for step in steps] == ["late"] * 3
    assert [step.source for step in steps] == ["braking", "last plan", "last plan"]
    assert not any(step.failed for step in steps)
    np.testing.assert_array_equal(steps[0].control, [0.0, -PLANNING.grip])
    np.testing.assert_array_equal(steps[1].control, first.plan[1])
    np.testing.assert_array_equal(steps[2].control, second.plan[1])


def test_nothing_compiles_after_the_first_step(caplog):
    for name in ("priced:1", "budget:20"):
        driver(name).step(SCENE)
    caplog.clear()
    with jax.log_compiles():
        for name in (*(f"fixed:{model}" for model in MODELS), "priced:0.5", "budget:5"):
            other = driver(name, replace(PLANNING, desired_speed=22.0, grip=4.0))
            other.weights = RoadWeights(speed=2.0)
            other.step(scene_of(cars=[(20.0, 0, 10.0)]))
            other.step(scene_of(bend=1 / 50, robot=(0.0, 0.0, 0.0, 10.0)))
    assert not [record for record in caplog.records if "compilation" in record.getMessage()]


def test_if_plans_are_not_finite_the_robot_follows_the_rest_of_the_last_plan_and_then_brakes():
    unknown = np.where(np.arange(TRAFFIC)[:, None] == 0, np.float32(np.nan), SCENE.states)
    robot = driver()
    assert robot.step(BLIND).source == "braking"
    first = robot.step(SCENE)
    steps = [robot.step(blind) for blind in (*[BLIND] * PLANNING.steps, *[replace(SCENE, states=unknown)] * 2)]
    assert [step.source for step in steps] == ["last plan"] * (PLANNING.steps - 1) + ["braking"] * 3
    assert not first.failed
    assert all(step.failed and not any(step.models) and len(step.path) == 0 for step in steps)
    for step, control in zip(steps, first.plan[1:], strict=False):
        np.testing.assert_allclose(step.control, control, atol=1e-6)
    np.testing.assert_array_equal(steps[-1].control, [0.0, -PLANNING.grip])
    assert robot.step(SCENE).source in ("proposal", "last plan")
