"""Every human model plans among several humans as it does alone, in its own steps from
its own start.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pytest
from driving import Brakes, Brief, Eager

import ms_highway
from ms_highway.game.game import pair
from ms_highway.numerics.solvers import Newton
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import Naive, TheoryOfMind
from ms_highway.planning.ladders import MODELS, ladder
from ms_highway.planning.plans import Plan

FAR = 300.0  # m, at which nobody matters


OWN = (Brief(), Eager(), Brakes(3.0))
RUNGS = (
    *ladder(
        ["naive@2", "naive", "idm", "turn@3", "turn", "tom@2", "tom@3+warm", "tom"]
    ),
    *OWN,
)


def played_by(played, scenario, **options):
    """Return the game of three humans with different rewards, and its start."""
    game, state = played(scenario, humans=3, **options)
    weights = game.humans.weights * np.float32([[1.0], [1.5], [0.5]])
    return replace(game, humans=replace(game.humans, weights=weights)), np.array(state)


@pytest.fixture(scope="module", params=["merger", "dense_merge"])
def scene(request, played):
    """A game of three humans by gradient or by Newton steps, and a start."""
    limit = (0.2, 50.0) if request.param == "merger" else (0.2, 8.0)
    return played_by(played, request.param, control_limit=limit)


@pytest.fixture(scope="module")
def alone(scene):
    """The solution of every model for the robot and the first human alone."""
    game, state = scene
    own_game, own_state = pair(game, state, 0)
    away = checked_state(np.array(own_state))
    away[2:4, 0] -= FAR
    plans = CompiledPlans(own_game, RUNGS)
    return [plans.plan(away, [rung])[0] for rung in range(len(RUNGS))]


def same(found, expected):
    np.testing.assert_allclose(found.plan.robot, expected.plan.robot, atol=2e-5)
    np.testing.assert_allclose(found.plan.humans[0], expected.plan.humans[0], atol=2e-5)
    assert (found.steps, found.converged) == (expected.steps, expected.converged)


def test_a_model_plans_among_several_humans_as_it_does_alone(scene, alone):
    """The other humans are far away, and predicted by any model that takes no more
    steps.
    """
    game, state = scene
    away = checked_state(state)
    away[2:4, 0] -= FAR
    together = CompiledPlans(game, RUNGS)
    naive = [model.name for model in RUNGS].index("naive@2")
    for rung, expected in enumerate(alone):
        same(together.plan(away, [rung] * 3)[0], expected)
        same(together.plan(away, [rung, naive, naive])[0], expected)
    for rung, model in enumerate(RUNGS):  # known before the call
        same(CompiledPlans(game, [model]).plan(away, [0] * 3)[0], alone[rung])


def test_models_that_differ_alone_differ_among_several_humans(scene, alone):
    game, state = scene
    together = CompiledPlans(game, RUNGS)
    found = [
        together.plan(checked_state(state), [rung] * 3)[0].plan
        for rung in range(len(RUNGS))
    ]

    def differ(one, other):
        return max(
            abs(left - right).max() for left, right in zip(one, other, strict=True)
        )

    compared = 0
    for one, other in combinations(range(len(RUNGS)), 2):
        if differ(alone[one].plan, alone[other].plan) > 1e-3:
            compared += 1
            names = RUNGS[one].name, RUNGS[other].name
            assert differ(found[one], found[other]) > 1e-4, names
    assert compared > 30


def test_a_plan_says_its_steps_and_whether_they_converged(played):
    game, state = played_by(played, "dense_merge")
    names = ["naive@1", "naive@40", "tom@2"]
    plans = CompiledPlans(game, ladder(names))
    found = [
        plans.plan(checked_state(state), [rung] * 3)[0] for rung in range(len(names))
    ]
    assert [bool(solution.converged) for solution in found] == [False, True, False]
    one, many, two = (int(solution.steps) for solution in found)
    assert (one, two) == (1, 2)
    assert 2 < many < 40


def test_models_that_differ_only_in_name_plan_alike(played):
    """A start is a start of its own, not of another model's."""
    game, state = played_by(played, "merger")
    twin = dataclass(frozen=True)(type("Twin", (Eager,), {"name": "twin"}))
    plans = CompiledPlans(game, [Eager(), twin()])
    found = [
        plans.plan(checked_state(state), rungs)[0].plan
        for rungs in ([0] * 3, [1] * 3, [0, 1, 0])
    ]
    for plan in found[1:]:
        np.testing.assert_allclose(plan.robot, found[0].robot, atol=1e-6)
        np.testing.assert_allclose(plan.humans, found[0].humans, atol=1e-6)


@pytest.mark.parametrize(
    ("base", "own", "message"),
    [
        (
            TheoryOfMind,
            {"predict": lambda *_: None},
            "'own' responds, and defines `predict`; a human that responds",
        ),
        (
            Naive,
            {"start": lambda self, game, state, last: last},
            "'own' does not respond, and defines `start`",
        ),
    ],
)
def test_models_whose_methods_no_plan_would_obey_are_refused(base, own, message):
    model = dataclass(frozen=True)(type("Own", (base,), {"name": "own", **own}))
    with pytest.raises(ValueError, match=message):
        ms_highway.register(model())
    assert "own" not in MODELS


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (
            {"solver": lambda self, game: replace(game.planner.solver, ease=50.0)},
            "whose ease is 50.0, not the planner",
        ),
        (
            {"solver": lambda self, game: replace(game.planner.solver, joint_steps=0)},
            "'own' plans in 0 steps",
        ),
        (
            {"start": lambda self, game, state, last: last.robot},
            "'own' starts from .*; return a Plan",
        ),
        (
            {"start": lambda *cars: Plan(cars[3].robot[:2], cars[3].humans)},
            r"'own' starts from arrays \(2, 2\)",
        ),
    ],
)
def test_solvers_and_starts_that_plans_cannot_take_are_refused(played, own, message):
    game, state = played_by(played, "dense_merge")
    model = dataclass(frozen=True)(type("Own", (TheoryOfMind,), {"name": "own", **own}))
    with pytest.raises(ValueError, match=message):
        ms_highway.plan(game, np.array(state), model())


def test_own_plans_and_solvers_of_another_type_are_refused(played):
    own = dataclass(frozen=True)(
        type("Own", (TheoryOfMind,), {"name": "own", "plan": lambda *_: None})
    )
    with pytest.raises(
        ValueError, match=r"'own' defines `plan`, .* cannot obey; define .*`solver`"
    ):
        ms_highway.register(own())
    assert "own" not in MODELS
    other = type(
        "Other", (TheoryOfMind,), {"name": "other", "solver": lambda *_: Newton()}
    )
    game, state = played("merger")
    with pytest.raises(
        ValueError, match=r"'other' plans by Newton.*return game.planner.solver, a"
    ):
        ms_highway.plan(game, np.array(state), other())
