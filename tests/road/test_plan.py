"""Plans of the robot on roads: proposals and answers of others together."""

from dataclasses import replace

import numpy as np
import pytest
from jax import numpy as jnp
from roads import PLANNING, WEIGHTS, coming, execute, scene_of

from ms_highway.perception.scene import KNOTS, TRAFFIC
from ms_highway.road.constants import LANE, MODELS
from ms_highway.road.driver import plan_of as planned
from ms_highway.road.plan import no_plan
from ms_highway.road.simulation import bodies


def plan_of(scene, name="idm"):
    """The best plan if one model predicts everybody."""
    return planned(scene, PLANNING, WEIGHTS, np.full(TRAFFIC, MODELS.index(name), np.int32), no_plan(PLANNING))


def between(scene, left, right):
    """The scene, on a road with these edges, in lanes."""
    return replace(scene, edges=np.tile(np.float32([[left * LANE], [right * LANE]]), KNOTS))


def asked(*cars):
    """A road on which the goal asks for the right lane."""
    return replace(scene_of(cars=cars), changes=np.float32([2.0, 1.0, 0.0]), room=np.float32(60.0))


SLOW, BESIDE = (25.0, 0, 12.0), [(place, lane, 14.0) for place in (0.0, 12.0) for lane in (-1, 1)]
CIRCLE = scene_of(bend=1 / 30, robot=(0.0, 0.3, 0.05, 11.0), cars=[(20.0, 0, 9.0), (-8.0, -1, 12.0)])
SCENES = {  # with the final lane of the robot, counted to the right, and its final speed
    "a free road": (scene_of(), 0, 29.2),
    "a slow car ahead": (scene_of(cars=[SLOW]), 1, 29.9),
    "a slow car ahead and cars on both sides": (scene_of(cars=[SLOW, *BESIDE]), 0, 14.3),
    "a slow car ahead, and an oncoming car": (
        between(coming(scene_of(cars=[SLOW, (120, -1, 20.0)]), 1), -1.5, 0.5),
        0,
        19.8,
    ),
    "a slow car ahead, and no oncoming car": (between(scene_of(cars=[SLOW]), -1.5, 0.5), -1, 29.9),
    "a goal to the right": (asked(), 1, 29.2),
    "a goal to the right among others": (asked(*((place, 1, 20.0) for place in (-12.0, 0.0, 12.0))), 0, 29.2),
    "standing cars in all lanes": (scene_of(cars=[(70.0, lane, 0.0) for lane in (-1, 0, 1)]), 0, 14.3),
    "a circle": (CIRCLE, None, None),
}


@pytest.mark.parametrize("name", SCENES)
def test_under_every_model_plans_reach_the_right_lane_within_the_limits_of_the_car(name):
    scene, lane, speed = SCENES[name]
    for model in MODELS:
        plan = plan_of(scene, model)
        assert np.isfinite(plan.path).all()
        assert np.isfinite(plan.predictions).all()
        assert not plan.broken
        states, held = execute(scene, PLANNING, plan.controls)
        np.testing.assert_allclose(plan.controls, held, atol=1e-3)
        np.testing.assert_allclose(plan.path, jnp.stack(bodies(scene, states), axis=-1), atol=0.05)
        if model == "idm":
            assert lane is None or plan.path[-1, 1] / LANE == pytest.approx(lane, abs=0.5)
            assert speed is None or states[-1, 3] == pytest.approx(speed, abs=0.5)


def test_before_a_wall_of_cars_the_best_plan_brakes_hardest_and_is_marked_as_broken():
    plan = plan_of(scene_of(cars=[(28.0, lane, 0.0) for lane in (-1, 0, 1)]))
    assert plan.broken
    assert plan.controls[0, 1] < -0.95 * PLANNING.grip


CUT_IN = scene_of(robot=(0.0, 2.5, 0.06, 20.0), cars=[(-14.0, 1, 26.0)])


def final_place(scene, name):
    """Where car 0 is expected at the end of the horizon."""
    return float(plan_of(scene, name).predictions[0, -1, 0])


def test_under_theory_of_mind_the_robot_expects_a_commuter_to_brake_as_it_cuts_in():
    kept = -14.0 + 26.0 * PLANNING.steps * PLANNING.time_step
    assert final_place(CUT_IN, "naive") == pytest.approx(kept, abs=0.05)
    observed = np.where(np.arange(TRAFFIC) == 0, -6.0, 0.0).astype(np.float32)  # as its model predicts
    braking = final_place(replace(CUT_IN, accelerations=observed), "tom")
    assert braking < kept - 1.0
    beside = scene_of(robot=(0.0, -4.0, 0.0, 20.0), cars=[(-14.0, 1, 26.0)])
    assert final_place(beside, "tom") > braking + 1.0
