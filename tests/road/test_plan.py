"""Plans of the robot on roads: proposals and answers of others together."""

from dataclasses import replace

import numpy as np
import pytest
from jax import numpy as jnp
from roads import PLANNING, WEIGHTS, crossing, execute, proposals_of, scene_of

from ms_highway.geometry.curve import BEHIND, SPACING
from ms_highway.road.constants import LANE, MODELS
from ms_highway.road.driver import answered_by, proposed_for
from ms_highway.road.driver import plan_of as planned
from ms_highway.road.plan import no_plan
from ms_highway.road.scene import KNOTS, TRAFFIC
from ms_highway.road.simulation import bodies

STEPS = PLANNING.steps
MEMORY = no_plan(PLANNING)
ZERO = round(BEHIND / SPACING)  # knot of paths at s = 0


def everybody(name):
    return np.full(TRAFFIC, MODELS.index(name), np.int32)


def plan_of(scene, name="naive", memory=MEMORY):
    return planned(scene, PLANNING, WEIGHTS, everybody(name), memory)


def busy(seed):
    """Random traffic on three lanes, nobody within 12 m of another in its lane at first."""
    random = np.random.default_rng(seed)
    cars = []
    for lane in (-1, 0, 1):
        places = np.cumsum(random.uniform(12, 50, 5)) - 60
        cars += [(place, lane, random.uniform(12, 26)) for place in places if lane or not -14 < place < 20]
    return scene_of(robot=(0.0, random.uniform(-0.5, 0.5), 0.0, random.uniform(12, 28)), cars=cars)


SCENES = {
    "free": scene_of(),
    "standing car ahead": scene_of(cars=[(45.0, 0, 0.0)]),
    "circle": scene_of(bend=1 / 30, robot=(0.0, 0.3, 0.05, 11.0), cars=[(20.0, 0, 9.0), (-8.0, -1, 12.0)]),
    "busy": busy(0),
}


@pytest.mark.parametrize("name", SCENES)
def test_under_every_model_a_plan_is_finite_and_within_limits(name):
    scene = SCENES[name]
    for rung in MODELS:
        plan = plan_of(scene, rung)
        assert np.isfinite(plan.path).all()
        assert np.isfinite(plan.predictions).all()
        states, held = execute(scene, PLANNING, plan.controls)
        np.testing.assert_allclose(plan.controls, held, atol=1e-3)
        np.testing.assert_allclose(plan.path, jnp.stack(bodies(scene, states), axis=-1), atol=0.05)
        before = np.concatenate([scene.robot[None, 3], states[:-1, 3]])
        assert np.hypot(before**2 * plan.controls[:, 0], plan.controls[:, 1]).max() <= PLANNING.grip + 1e-3
        assert np.abs(plan.controls[:, 0]).max() <= PLANNING.curvature


def test_where_nobody_optimises_the_best_proposal_drives_before_and_after_answers():
    for scene in (*SCENES.values(), busy(1), busy(2), busy(3)):
        rungs = everybody("idm")
        proposals = proposals_of(scene, PLANNING, rungs, MEMORY)
        found = proposed_for(scene, PLANNING, WEIGHTS, rungs, MEMORY)
        best = int(np.argmax(proposals.scores.preference))
        for plan in (found.plan, answered_by(found, rungs)):
            assert plan.chosen == best
            np.testing.assert_allclose(plan.controls, proposals.driven.controls[best], atol=1e-4)


CUT_IN = scene_of(robot=(0.0, 2.5, 0.06, 20.0), cars=[(-14.0, 1, 26.0)])


def final_place(scene, name):
    """Where car 0 is expected at the end of the horizon."""
    return float(plan_of(scene, name).predictions[0, -1, 0])


def test_under_theory_of_mind_the_robot_expects_a_commuter_to_brake_as_it_cuts_in():
    kept = -14.0 + 26.0 * STEPS * PLANNING.time_step
    assert final_place(CUT_IN, "naive") == pytest.approx(kept, abs=0.05)
    braking = final_place(accelerating(CUT_IN, -6.0), "tom")  # as its model says
    assert braking < kept - 1.0
    beside = scene_of(robot=(0.0, -4.0, 0.0, 20.0), cars=[(-14.0, 1, 26.0)])
    assert final_place(beside, "tom") > braking + 1.0


def accelerating(scene, *accelerations):
    """The scene, with accelerations of others since the last look."""
    return replace(scene, accelerations=np.pad(np.float32(accelerations), (0, TRAFFIC - len(accelerations))))


def test_who_brakes_hard_ahead_is_expected_to_stop_and_nobody_else():
    ahead, behind, far_aside = (scene_of(cars=[(s, lane, 10.0)]) for s, lane in ((30.0, 1), (-15.0, 1), (30.0, 2)))

    def covered(scene, acceleration, seconds=3.0):
        plan = plan_of(accelerating(scene, acceleration), "idm")
        return float(plan.predictions[0, round(seconds / PLANNING.time_step) - 1, 0] - scene.paths.x[0, ZERO])

    assert covered(ahead, -6.0) == pytest.approx(10.0**2 / 12, abs=1.5)
    assert covered(ahead, -6.0) == pytest.approx(covered(ahead, -6.0, 2.0), abs=0.01), "it stands"
    assert covered(ahead, -6.0, 4.0) > covered(ahead, -6.0) + 0.5, "later, it goes on"
    assert covered(ahead, -2.0) > 22.0
    assert covered(behind, -6.0) > 12.0
    assert covered(far_aside, -6.0) > 12.0


def test_where_the_cars_ahead_here_and_in_the_next_lane_brake_too_hard_a_plan_goes_to_the_free_lane_beyond():
    edges = np.tile(np.float32([[-2.5 * LANE], [0.5 * LANE]]), KNOTS)
    scene = scene_of(robot=(0.0, 0.0, 0.0, 24.0), cars=[(20.0, 0, 22.0), (33.0, -1, 17.0)])
    scene = replace(accelerating(scene, -6.0, -6.0), edges=edges)
    plan = plan_of(scene, "idm")
    assert not plan.broken
    assert plan.path[-1, 1] < -1.5 * LANE


def test_who_may_cross_is_expected_to_keep_its_speed_and_not_to_follow_a_car_on_one_of_its_ways():
    led = crossing(0.0, 60.0)
    led.leaders[0], led.gaps[0], led.present[1], led.moving[1] = 1, 12.0, True, True
    for field in ("x", "y", "heading", "curvature"):
        getattr(led.paths, field)[1] = getattr(led.paths, field)[0]
    led.states[1] = 12.0, 0.0, 0.0, 0.0
    kept = -60.0 + 10.0 * STEPS * PLANNING.time_step
    assert float(plan_of(led, "idm").predictions[0, -1, 1]) == pytest.approx(kept, abs=0.05)
