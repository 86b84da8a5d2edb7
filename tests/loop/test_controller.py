"""Controllers: their records, fallbacks, beliefs and compilations."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from driving import move as move_all
from jax import numpy as jnp

from ms_highway.choice.quadratic import Switching
from ms_highway.choice.rule import PUBLISHED_COSTS, Nearest, Order, always
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.loop.driver import Driver, fixed
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.ladders import MODELS, ladder


def switching(*models):
    return Switching(Costs(0.0, np.array([PUBLISHED_COSTS[name] for name in models])), 0.0, ladder(models))


@pytest.mark.usefixtures("stopped_by_nans")
def test_a_step_records_the_models_and_controls_of_every_human(played):
    game, state = played("merger", humans=2)
    step = Driver(game, Nearest(1, ladder(("naive", "turn", "tom")))).step(np.asarray(state))
    assert step.models == ("tom", "naive")
    assert step.status == "planned"
    assert step.plan.shape == (5, 2)
    assert step.humans.shape == (2, 5, 2)
    np.testing.assert_array_equal(step.control, step.plan[0])
    assert step.humans[1, 0] == pytest.approx([0.0, 0.2 * float(state[2, 3])], rel=1e-4)  # only makes up for friction
    assert 0 < step.planning_seconds < 1
    assert 0 < step.decision_seconds < 1
    assert np.isnan(step.gains).all()


@pytest.mark.slow
def test_switching_compiles_all_rungs_before_its_first_control_and_nothing_later(played):
    """Another driver, whose game and rule have other numbers, compiles nothing either."""
    game, state = played("merger")
    rule, models = switching("naive", "turn", "tom"), set()
    other = replace(game, robot=replace(game.robot, weights=game.robot.weights * 1.5))
    for number, controller in enumerate([Driver(game, rule), Driver(other, replace(rule, price=3.0))]):
        for count in range(6):
            step = controller.step(np.asarray(state.at[:, 0].add(state[:, 3] * 0.1 * count)))
            assert step.compile_seconds == 0 or (number, count) == (0, 0)
            models |= {*step.models}
    assert len(models) > 1


@pytest.mark.parametrize("solver", ["gradient", "newton"])
def test_a_driver_whose_plans_fail_follows_the_rest_of_the_last_one_and_then_brakes(played, solver):
    game, state = played("merger", solver=solver)
    controller = fixed(game)
    first = controller.step(np.asarray(state))
    controller.game = replace(game, robot=replace(game.robot, weights=game.robot.weights * jnp.nan))
    steps = [controller.step(np.asarray(state)) for _ in range(6)]
    assert [step.status for step in steps] == ["previous plan"] * 4 + ["braking"] * 2
    np.testing.assert_array_equal(steps[0].plan, first.plan[1:])
    np.testing.assert_array_equal(steps[3].control, first.plan[4])
    np.testing.assert_allclose(steps[4].control, [0.0, -8.0], atol=0.01)


def test_a_late_step_reports_the_models_of_the_followed_plan_and_the_rule_continues_from_them(played):
    game, state = played("merger")
    controller, steps = Driver(game, switching("naive", "turn")), []
    for count, budget in enumerate([None, 0.0, None]):
        controller.budget = budget
        steps.append(controller.step(np.asarray(state.at[:, 0].add(state[:, 3] * 0.1 * count))))
    assert [step.status for step in steps] == ["planned", "late", "planned"]
    assert [step.models for step in steps] == [("naive",), ("naive",), ("turn",)]
    assert [step.planned for step in steps] == [("naive",), ("turn",), ("turn",)]
    np.testing.assert_array_equal(steps[1].plan, steps[0].plan[1:])
    assert np.isfinite(steps[2].gains[0, 1])  # of going up once more, as the robot has not gone up yet


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"price": np.nan}, "the price is nan"),
        ({"costs": Costs(0.0, np.array([0.1, -0.1]))}, "neither may be negative"),
        ({"costs": Costs(0.0, np.array([0.1]))}, "give one for each of naive, tom"),
        ({"ladder": ("naive", "tom")}, "'naive', which is no human model; make one of names with `ladder`"),
    ],
)
def test_switching_with_impossible_numbers_or_rungs_is_refused(played, changes, message):
    game, _ = played("merger")
    with pytest.raises(ValueError, match=message):
        Driver(game, replace(switching("naive", "tom"), **changes))


def test_the_first_rung_must_not_respond_with_a_belief(played):
    with pytest.raises(ValueError, match="with a belief, begin it with a model that does not, such as naive"):
        Driver(played("merger")[0], replace(switching("naive", "tom"), ladder=ladder(("tom@4", "tom"))), belief=True)


def test_a_driver_follows_another_rule_at_once_if_it_is_on_the_same_ladder(played):
    game, state = played("merger")
    models = ladder(("naive", "turn"))
    driver, followed = Driver(game, Order(np.array([[0]]), models), belief=True), []
    for rung in (0, 1, 0):
        driver.rule = Order(np.array([[rung]]), models)
        followed.append(driver.step(np.asarray(state)).models[0])
    assert followed == ["naive", "turn", "naive"]
    with pytest.raises(ValueError, match="the rule is on the ladder naive, and the driver on naive turn"):
        driver.rule = always(models[0])


def test_an_order_with_a_belief_adds_naive_to_its_ladder_and_is_pickled(played):
    game, state = played("merger")
    order = Order(np.array([[1]]), ladder(("turn", "tom")))
    controller = pickle.loads(pickle.dumps(Driver(game, order, belief=True)))
    assert [model.name for model in controller.rule.ladder] == ["turn", "tom", "naive"]
    assert controller.step(np.asarray(state)).models == ("tom",)
    config = {"ladder": ["turn", "tom"], "yielding": "never"}
    assert "naive" in make_batch(Comparison({"merger": ["tom+belief"]}, config=config), "merger").models


def test_an_escape_is_followed_if_the_next_plan_fails_and_later_plans_start_from_the_plan_it_replaced(played):
    """A faster human comes from behind; another one is beside the robot."""
    game, state = played("dense_merge")
    game = replace(game, planner=replace(game.planner, newton_steps=1))  # so that it matters where plans start from
    lane, x = float(game.scene.target_lane), float(state[0, 0])
    start = np.array([state[0], [x - 12.0, state[0, 1], 0.0, 30.0], [x, lane, 0.0, 20.0], *state[3:]])
    driver, failing = (Driver(game, always(MODELS["naive"]), way_out=True) for _ in range(2))
    _, step = (each.step(start) for each in (driver, failing))
    assert step.status == "way out"
    np.testing.assert_array_equal(step.control, step.plan[0])
    now = move_all(game, start, [step.control, *(human[0] for human in step.humans)])
    failing.game = replace(game, robot=replace(game.robot, weights=game.robot.weights * np.nan))
    fallback = failing.step(now)
    assert fallback.status == "previous plan"
    np.testing.assert_array_equal(fallback.plan, step.plan[1:])
    driver.way_out, bold = False, fixed(game)
    assert bold.step(start).status == "planned"
    goes_on = driver.step(now).plan
    np.testing.assert_array_equal(goes_on, bold.step(now).plan)
    assert np.abs(goes_on - fixed(game).step(now).plan).max() > 1e-3
