"""Controllers: their records, fallbacks, beliefs, limits and compilations."""

import pickle
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from driving import COSTS, LADDER, move

import ms_highway
from ms_highway.choice.choosers import Nearest
from ms_highway.choice.learned_value import load_values
from ms_highway.choice.quadratic import Switching
from ms_highway.choice.rule import Rule, always, at_price, in_order
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.loop.controller import FunctionDriver
from ms_highway.loop.driver import Driver, fixed
from ms_highway.planning.costs import UNKNOWN, Costs
from ms_highway.planning.human_models import PredictedHuman
from ms_highway.planning.ladders import MODELS, ladder

SWITCHING = Switching(COSTS, 0.0, LADDER)


@pytest.mark.usefixtures("stopped_by_nans")
def test_a_step_records_the_models_and_controls_of_every_human(played):
    game, state = played("dense_merge")
    step = Driver(game, Rule(LADDER, COSTS, Nearest(1))).step(np.asarray(state))
    assert step.models == ("naive", "tom")
    assert step.plan.shape == (5, 2)
    assert step.humans.shape == (2, 5, 2)
    np.testing.assert_array_equal(step.control, step.plan[0])
    # The control of a naive human only makes up for friction.
    friction = 0.2 * float(state[1, 3])
    assert step.humans[0, 0] == pytest.approx([0.0, friction], rel=1e-4)
    assert np.isnan(step.gains).all()


@pytest.fixture
def moments(played):
    """A game, and six states in which all cars keep their velocity."""
    game, state = played("merger")
    return game, [
        np.asarray(state.at[:, 0].add(state[:, 3] * 0.1 * count)) for count in range(6)
    ]


@pytest.mark.parametrize("kind", ["switching with a belief", "learned", "function"])
def test_whole_turns_of_headings_change_nothing_that_a_driver_does(moments, kind):
    """In each of three steps, each car has turned another number of times."""
    game, states = moments
    seen = []

    def steer(own, state):
        seen.append(state)
        return [-0.1 * state[0, 2], 0.0]

    learned = load_values("shipped").rule(LADDER, COSTS, 0.1)
    make = {
        "switching with a belief": lambda: Driver(game, SWITCHING, belief=True),
        "learned": lambda: Driver(game, learned),
        "function": lambda: FunctionDriver(game, "steers", steer),
    }
    turns = 2 * np.pi * np.array([[1, -2, 3], [-1, 0, 2], [4, 1, -3]])
    told = []
    for shifts in (0 * turns, turns):
        driver = make[kind]()
        for state, shift in zip(states, shifts, strict=False):
            turned = np.array(state, dtype=float)
            turned[:, 2] += shift - 0.01
            told.append(driver.step(turned))
    for straight, turned in zip(told[:3], told[3:], strict=True):
        assert (straight.models, straight.status) == (turned.models, turned.status)
        np.testing.assert_allclose(
            turned.control, straight.control, rtol=1e-5, atol=1e-6
        )
        for name in ("gains", "belief"):
            found = [
                np.array(getattr(step, name), dtype=float)
                for step in (turned, straight)
            ]
            np.testing.assert_allclose(*found, rtol=1e-3, atol=1e-4, err_msg=name)


@pytest.mark.slow
def test_switching_compiles_nothing_after_its_first_control(moments):
    """Nor does another driver, whose game and rule have other numbers."""
    game, states = moments
    other = replace(game, robot=replace(game.robot, weights=game.robot.weights * 1.5))
    controllers = Driver(game, SWITCHING), Driver(other, at_price(SWITCHING, 3.0))
    steps = [controller.step(state) for controller in controllers for state in states]
    assert not any(step.compile_seconds for step in steps[1:])
    assert len({step.model for step in steps}) > 1


def test_a_late_step_has_the_models_of_the_followed_plan(moments):
    """The rule continues from these models."""
    game, states = moments
    controller = Driver(game, SWITCHING)
    steps = []
    for state, budget in zip(states, [None, 0.0, None], strict=False):
        controller.budget = budget
        steps.append(controller.step(state))
    assert [step.status for step in steps] == ["planned", "late", "planned"]
    assert [step.models for step in steps] == [("naive",), ("naive",), ("tom",)]
    assert [step.planned for step in steps] == [("naive",), ("tom",), ("tom",)]
    np.testing.assert_array_equal(steps[1].plan, steps[0].plan[1:])
    # The gain of going up once more, as the robot has not gone up yet.
    assert np.isfinite(steps[2].gains[0, 2])


def test_without_plans_a_driver_ends_the_last_and_brakes(played):
    game, state = played("merger")
    controller = fixed(game)
    first = controller.step(np.asarray(state))
    controller.game = unrewarded(game)
    steps = [controller.step(np.asarray(state)) for _ in range(6)]
    assert [step.status for step in steps] == ["previous plan"] * 4 + ["braking"] * 2
    np.testing.assert_array_equal(steps[0].plan, first.plan[1:])
    np.testing.assert_array_equal(steps[3].control, first.plan[4])
    np.testing.assert_allclose(steps[4].control, [0.0, -8.0], atol=0.01)


def unrewarded(game):
    """Return the game with rewards that are not finite, so that plans fail."""
    return replace(game, robot=replace(game.robot, weights=game.robot.weights * np.nan))


@dataclass(frozen=True)
class Reckless(PredictedHuman):
    """A user-defined model whose predictions exceed all limits."""

    name: ClassVar[str] = "reckless"

    def predict(self, game, state, start=None):
        return np.full((game.planner.horizon, 2), 1e9, np.float32)


@pytest.mark.filterwarnings("ignore:human model 'reckless' predicts:UserWarning")
def test_plans_under_a_users_model_keep_to_all_limits(played):
    """These are the limits of controls and the grip of tyres."""
    limit = np.array([0.05, 6.0])
    grip = 8.0
    game, state = played("merger", control_limit=tuple(limit), grip=grip)
    controller = fixed(game, Reckless())
    start = np.array(state)
    for speed in (1.0, 20.0):
        start[0, 3] = speed
        step = controller.step(start)
        sideways = speed**2 * step.control[0]
        forward = step.control[1] - 0.2 * speed  # less the paper's friction
        assert step.status == "planned"
        assert (abs(step.plan) <= limit * 1.0001).all()
        assert np.hypot(sideways, forward) <= grip * 1.0001
        assert (abs(step.humans[0]) <= limit * 1.0001).all()


def test_rules_with_impossible_ladders_costs_or_prices_are_refused(played):
    game, _ = played("merger")
    message = "'naive', which is no human model; make one of names with `ladder`"
    with pytest.raises(ValueError, match=message):
        Driver(game, replace(SWITCHING, ladder=("naive", "turn", "tom")))
    one_cost = Costs(0.0, np.array([0.1]), SWITCHING.costs.names)
    with pytest.raises(ValueError, match="give one for each of naive, turn, tom"):
        Driver(game, replace(SWITCHING, costs=one_cost))
    with pytest.raises(ValueError, match="the price is nan"):
        Driver(game, at_price(SWITCHING, np.nan))
    names = ["tom@4", "tom@8", "tom"]
    responding = Switching(UNKNOWN.select(names), 0.0, ladder(names))
    with pytest.raises(
        ValueError,
        match="with a belief, begin it with a model that does not, such as naive",
    ):
        Driver(game, responding, belief=True)


def test_what_is_no_rule_is_refused_with_a_remedy(played):
    game, _ = played("merger")
    remedy = (
        r"which is no Rule; make one with ms_highway\.in_order\(rungs, ladder\) or"
        r" ms_highway\.always\(model\)"
    )
    rule = ms_highway.in_order(np.zeros((1, 1), int), LADDER)
    for wrong in (rule.chooser, LADDER[0], "naive", None):
        with pytest.raises(ValueError, match=f"a driver is given .*{remedy}"):
            Driver(game, wrong)
    driver = Driver(game, rule)
    with pytest.raises(ValueError, match=remedy):
        driver.rule = rule.chooser


def test_costs_of_other_models_than_the_ladder_are_refused(played):
    """Two models in another order would else have each other's price."""
    game, _ = played("merger")
    models = ladder(["naive", "tom"])
    swapped = Costs.of({"tom": 0.1, "naive": 0.2}, 1)
    message = (
        r"the costs are \[0.1, 0.2\] for tom, naive; give one for each of naive, tom,"
        r" in this order, as costs.sel"
    )
    with pytest.raises(ValueError, match=message):
        Driver(game, Switching(swapped, 0.0, models))
    Driver(game, Switching(swapped.select(["naive", "tom"]), 0.0, models))
    with pytest.raises(
        ValueError,
        match=(
            r"the costs are \[0.1, 0.2\]; make them of seconds by name with"
            r" ms_highway\.C"
        ),
    ):
        Driver(game, Switching([0.1, 0.2], 0.0, models))
    with pytest.raises(
        ValueError,
        match=r"Costs\.of is given \[0.1, 0.2\]; give seconds by name, such as",
    ):
        Costs.of([0.1, 0.2], 1)


def test_an_order_with_a_belief_also_has_naive(played):
    """The driver can be pickled, and its order can be replaced."""
    game, state = played("merger")
    models = ladder(("turn", "tom"))
    original = Driver(game, in_order(np.array([[1]]), models), belief=True)
    driver = pickle.loads(pickle.dumps(original))
    assert [model.name for model in driver.rule.ladder] == ["turn", "tom", "naive"]
    assert driver.step(np.asarray(state)).models == ("tom",)
    driver.rule = in_order(np.array([[0]]), models)
    assert driver.step(np.asarray(state)).models == ("turn",)  # at once
    with pytest.raises(
        ValueError,
        match="the rule is on the ladder naive, and the driver on turn tom naive",
    ):
        driver.rule = always(MODELS["naive"])
    config = {"ladder": ["turn", "tom"], "yielding": "never"}
    comparison = Comparison({"merger": ["tom+belief"]}, config=config)
    assert "naive" in make_batch(comparison, "merger").models


def test_an_escape_is_followed_if_the_next_plan_fails(played):
    """A faster human comes from behind; another car is beside the robot."""
    game, state = played("merger")
    (model,) = ladder(("naive+warm",))
    lane = float(game.scene.target_lane)
    x = float(state[0, 0])
    start = np.array(
        [state[0], [x - 15.0, state[0, 1], 0.0, 30.0], [x, lane, 0.0, 20.0]]
    )
    driver, failing = (Driver(game, always(model), way_out=True) for _ in range(2))
    _, step = (each.step(start) for each in (driver, failing))
    assert step.status == "way out"
    np.testing.assert_array_equal(step.control, step.plan[0])
    now = move(game, start, [step.control, step.humans[0, 0]])
    failing.game = unrewarded(game)
    fallback = failing.step(now)
    assert fallback.status == "previous plan"
    np.testing.assert_array_equal(fallback.plan, step.plan[1:])
    driver.way_out = False
    bold = fixed(game, model)
    assert bold.step(start).status == "planned"
    goes_on = driver.step(now).plan
    np.testing.assert_array_equal(goes_on, bold.step(now).plan)
    assert np.abs(goes_on - fixed(game, model).step(now).plan).max() > 1e-3
