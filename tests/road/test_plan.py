"""Plans of the robot on roads: proposals and answers of others together, and ways round
obstacles.
"""

from dataclasses import replace

import jax
import numpy as np
import pytest
from roads import LANE, ONE_LANE, PLANNING, WEIGHTS, coming, execute, scene_of, wrecked

from ms_highway.perception.scene import SHAPE
from ms_highway.road.driver import plan_of
from ms_highway.road.plan import no_plan
from ms_highway.road.traffic_models import TRAFFIC_MODELS

UNHURRIED = replace(PLANNING, desired_speed=10.0)


def planned(scene, model="idm", planning=PLANNING, last=None):
    """The best plan if one model predicts everybody."""
    models = np.full(SHAPE.paths, TRAFFIC_MODELS.index(model), np.int32)
    plan = plan_of(scene, planning, WEIGHTS, models, last or no_plan(PLANNING))
    return jax.tree.map(np.asarray, plan)


def between(scene, left, right):
    """The scene, on a road with these edges, in lanes."""
    edges = np.float32([[left * LANE], [right * LANE]])
    return replace(scene, edges=np.tile(edges, SHAPE.route_knots))


def asked(*cars):
    """A road on which the goal asks for the right lane."""
    return replace(
        scene_of(cars=cars), changes=np.float32([2.0, 1.0, 0.0]), room=np.float32(60.0)
    )


SLOW = (25.0, 0, 12.0)
BESIDE = [(place, lane, 14.0) for place in (0.0, 12.0) for lane in (-1, 1)]
CIRCLE = scene_of(
    bend=1 / 30, robot=(0.0, 0.3, 0.05, 11.0), cars=[(20.0, 0, 9.0), (-8.0, -1, 12.0)]
)
ONCOMING = coming(scene_of(cars=[SLOW, (120, -1, 20.0)]), 1)
# Each with the final lane of the robot, counted to the right, and its final speed.
SCENES = {
    "a free road": (scene_of(), 0, 29.2),
    "a slow car ahead": (scene_of(cars=[SLOW]), 1, 29.9),
    "a slow car ahead and cars on both sides": (
        scene_of(cars=[SLOW, *BESIDE]),
        0,
        14.3,
    ),
    "a slow car ahead, and an oncoming car": (between(ONCOMING, -1.5, 0.5), 0, 19.8),
    "a slow car ahead, and no oncoming car": (
        between(scene_of(cars=[SLOW]), -1.5, 0.5),
        -1,
        29.9,
    ),
    "a goal to the right": (asked(), 1, 29.2),
    "a goal to the right among others": (
        asked(*((place, 1, 20.0) for place in (-12.0, 0.0, 12.0))),
        0,
        29.2,
    ),
    "standing cars in all lanes": (
        scene_of(cars=[(70.0, lane, 0.0) for lane in (-1, 0, 1)]),
        0,
        14.3,
    ),
    "a circle": (CIRCLE, None, None),
}


@pytest.mark.parametrize("name", SCENES)
def test_plans_under_every_model_are_possible_and_reach_the_lane(
    name,
):
    scene, lane, speed = SCENES[name]
    for model in TRAFFIC_MODELS:
        plan = planned(scene, model)
        assert np.isfinite(plan.predictions).all()
        assert not plan.broken
        states, held, centres = execute(scene, PLANNING, plan.controls)
        np.testing.assert_allclose(plan.controls, held, atol=1e-3)
        np.testing.assert_allclose(plan.path, centres, atol=0.05)
        if model == "idm" and lane is not None:
            assert plan.path[-1, 1] / LANE == pytest.approx(lane, abs=0.5)
            assert np.asarray(states)[-1, 3] == pytest.approx(speed, abs=0.5)


def test_before_a_wall_of_cars_the_broken_plan_brakes_hardest():
    plan = planned(scene_of(cars=[(28.0, lane, 0.0) for lane in (-1, 0, 1)]))
    assert plan.broken
    assert plan.controls[0, 1] < -0.95 * PLANNING.grip


def final_place(scene, model):
    """Where car 0 is expected at the end of the horizon."""
    return planned(scene, model).predictions[0, -1, 0]


def test_theory_of_mind_expects_commuters_to_brake_for_the_robot():
    cut_in = scene_of(robot=(0.0, 2.5, 0.06, 20.0), cars=[(-14.0, 1, 26.0)])
    kept = -14.0 + 26.0 * PLANNING.steps * PLANNING.time_step
    assert final_place(cut_in, "naive") == pytest.approx(kept, abs=0.05)

    # The commuter brakes as its model predicts.
    observed = np.where(np.arange(SHAPE.paths) == 0, -6.0, 0.0).astype(np.float32)
    braking = final_place(replace(cut_in, accelerations=observed), "tom")
    assert braking < kept - 1.0
    beside = scene_of(robot=(0.0, -4.0, 0.0, 20.0), cars=[(-14.0, 1, 26.0)])
    assert final_place(beside, "tom") > braking + 1.0


@pytest.mark.parametrize("side", [-1, 1])
def test_obstacles_in_bends_are_passed_on_the_shorter_side(
    side,
):
    scene = wrecked(
        scene_of(
            bend=1 / 60,
            robot=(0.0, 0.0, 0.0, 8.0),
            cars=[(24.0, -0.5 * side, 0.0)],
            limit=10.0,
        ),
        0,
    )
    scene = replace(scene, open=ONE_LANE)
    driven = []
    last = None
    for _ in range(30):
        plan = planned(scene, "naive", UNHURRIED, last)
        assert not plan.broken
        driven.append(scene.robot)
        states, *_ = execute(scene, UNHURRIED, plan.controls)
        scene = replace(scene, robot=np.asarray(states)[0])
        last = plan.last().later()
    s, d, *_ = np.array(driven).T
    assert max(d, key=abs) == pytest.approx(side * 1.0, abs=0.2)
    assert s[-1] > 40.0
    assert abs(d[-1]) < 0.3


def country_road(*cars):
    """A road of one lane for each direction."""
    scene = scene_of(robot=(0.0, 0.0, 0.0, 8.0), cars=cars, limit=10.0)
    return replace(between(scene, -0.5, 0.5), open=ONE_LANE)


def test_a_plan_waits_behind_a_wreck_with_room_to_turn():
    scene = coming(wrecked(country_road((26.0, 0, 0.0), (48.0, -1, 8.0)), 0), 1)
    plan = planned(scene, "naive", UNHURRIED)
    x, y, _ = plan.path.T
    assert abs(y).max() < 1.0
    assert not plan.broken
    assert x[-1] + 2.5 < 26.0 - 2.5 - 4.0


def test_a_plan_does_not_leave_its_road_for_a_queue():
    plan = planned(country_road((20.0, 0, 0.0)), "naive", UNHURRIED)
    assert abs(plan.path[:, 1]).max() < 0.5
