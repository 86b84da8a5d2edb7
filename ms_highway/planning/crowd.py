"""Plan among several humans, each of whom is predicted by a model of its own.

A rung is the number of a model in `RUNGS`. Human i under theory of mind answers the robot's plan, and all others keep
to the paths that are predicted for them: the humans' response is block-diagonal, ``J_i = -H_i^-1 d2R_i / du_i du_R``,
and the robot climbs along ``dR_R/du_R + sum_i J_i^T dR_R/du_i``.
"""

from functools import partial
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.collision_risk import collision_risk
from ms_highway.game.crowd import Crowd, along_others, coasting, human_game, others_of
from ms_highway.game.dynamics import Motion
from ms_highway.game.game import Game, bounded, constant_velocity, discomfort, move
from ms_highway.optimization.damped_newton import SHARES, STEPS, best_of, damped_factor, damped_solve
from ms_highway.optimization.second_derivatives import Expansion, Trajectory, response, second_order_expansion
from ms_highway.optimization.solvers import optimize_controls, projected_ascent
from ms_highway.planning.human_models import PAPER_MODELS
from ms_highway.planning.manoeuvres import manoeuvres

__all__ = ["NAIVE", "RUNGS", "TOM", "TURN", "CrowdPlan", "cold_crowd_start", "plan_crowd", "predict_human"]

RUNGS = PAPER_MODELS
"""Names of the models that humans of a crowd are predicted by, cheapest first."""

NAIVE, TURN, TOM = range(len(RUNGS))

State = Float[jax.Array, "cars 4"]
Rungs = Int[jax.Array, "humans"]
Humans = Float[jax.Array, "humans steps 2"]


class CrowdPlan(NamedTuple):
    """The robot's controls, and those that they expect of every human; scaled, see `ms_highway.game.game`."""

    robot: Float[jax.Array, "steps 2"]
    humans: Humans


def plan_crowd(crowd: Crowd, state: State, rungs: Rungs, start: CrowdPlan | None = None) -> CrowdPlan:
    """Plan with a model for each human.

    A loop over the humans under ToM, and one over those under turn, take as many rounds as there are: the time of a
    plan is additive in the models, and one compiled function plans under all assignments.

    * The planner's solver ``gradient`` climbs as `ms_highway.planning.human_models.TheoryOfMind` does: with one human,
      plans are the same.
    * ``damped_newton`` holds over horizons of seconds: the robot takes Newton steps on its own reward, with the
      gradient above; the line search looks at what the robot earns once the humans have answered the step, by their
      linear response ``J_i du_R``, and a Newton step of their own. Where the plan
      runs into an obstacle, a simple manoeuvre (`ms_highway.planning.manoeuvres`) takes its place.

    Args:
        crowd: the game, with the humans' rewards as the robot believes them.
        state: all cars now.
        rungs: of every human, numbers of `RUNGS`.
        start: scaled plan to improve; by default, all controls are zero (``gradient``) or keep the velocity.
    """
    game, humans = crowd.game, crowd.humans
    kept = jax.vmap(partial(constant_velocity, game))(state[1 : 1 + humans])
    paper = game.planner.solver == "gradient"
    start = cold_crowd_start(crowd, state) if start is None else start
    ranks = jnp.argsort(-rungs, stable=True)  # humans, those under theory of mind first
    responding, turning = jnp.sum(rungs == TOM), jnp.sum(rungs == TURN)

    def predict(place: Int[jax.Array, ""], predicted: Humans) -> Humans:
        human = ranks[responding + place]
        return predicted.at[human].set(predict_human(crowd, state, human, start.humans[human] if paper else None))

    predicted = jax.lax.fori_loop(0, turning, predict, kept)
    first = CrowdPlan(start.robot, jnp.where((rungs == TOM)[:, None, None], start.humans, predicted))
    climb = _Climb(crowd, state, rungs, ranks, responding)
    return _climb_by_gradients(climb, first) if paper else _or_manoeuvre(climb, _climb_by_newton_steps(climb, first))


def cold_crowd_start(crowd: Crowd, state: State) -> CrowdPlan:
    """Return the plan that plans start from without a last one: zero (``gradient``), or what keeps the velocity."""
    kept = jax.vmap(partial(constant_velocity, crowd.game))(state[: 1 + crowd.humans])
    controls = jnp.zeros_like(kept) if crowd.game.planner.solver == "gradient" else kept
    return CrowdPlan(controls[0], controls[1:])


def predict_human(
    crowd: Crowd,
    state: State,
    human: Int[jax.Array, ""],
    start: Float[jax.Array, "steps 2"] | None = None,
    robot: Trajectory | None = None,
) -> Float[jax.Array, "steps 2"]:
    """Return a human's plan for its own reward among all others, who keep their velocity: how humans drive, and turn.

    Args:
        crowd: the game.
        state: all cars now.
        human: number of the human.
        start: scaled controls to improve; by default, zero (``gradient``) or those that keep the velocity.
        robot: trajectory that the human answers; by default, the robot keeps its velocity, too.
    """
    game, car = human_game(crowd, human), state[1 + human]
    if start is None:
        start = constant_velocity(game, car)
        start = jnp.zeros_like(start) if game.planner.solver == "gradient" else start
    paths = coasting(game, state) if robot is None else coasting(game, state).at[0].set(robot)
    around = paths[jnp.asarray(others_of(len(state)))[1 + human]]
    return optimize_controls(
        game.planner,
        partial(move, game, car),
        lambda own: along_others(game.scene, game.robot, own, around),
        partial(discomfort, game, car),
        start,
        partial(bounded, game, car),
    )


class _Climb(NamedTuple):
    """What both solvers share: the situation, and the humans under theory of mind, the first ``responding`` ones."""

    crowd: Crowd
    state: State
    rungs: Rungs
    ranks: Int[jax.Array, "humans"]
    responding: Int[jax.Array, ""]

    @property
    def game(self) -> Game:
        return self.crowd.game

    def paths(self, plan: CrowdPlan) -> Float[jax.Array, "cars fields steps"]:
        """Return the trajectories of all cars; naively predicted humans keep their velocity."""
        last = 1 + self.crowd.humans
        coasted = coasting(self.game, self.state)
        moved = jax.vmap(partial(move, self.game))(self.state[1:last], plan.humans)
        keeps = (self.rungs == NAIVE)[:, None, None]
        own = move(self.game, self.state[0], plan.robot)[None]
        return jnp.concatenate([own, jnp.where(keeps, coasted[1:last], moved), coasted[last:]])

    def robot_reward(self, own: Trajectory, others: Float[jax.Array, "others fields steps"]) -> Float[jax.Array, ""]:
        return along_others(self.game.scene, self.game.robot, own, others)

    def others(
        self, paths: Float[jax.Array, "cars fields steps"], human: Int[jax.Array, ""]
    ) -> Float[jax.Array, "others fields steps"]:
        return paths[jnp.asarray(others_of(len(self.state)))[1 + human]]

    def human_slope(
        self, paths: Float[jax.Array, "cars fields steps"], human: Int[jax.Array, ""], robot: Trajectory
    ) -> Trajectory:
        """Return the derivative of a human's reward in its own trajectory, with the robot on another one."""
        game, around = human_game(self.crowd, human), paths.at[0].set(robot)
        others = self.others(around, human)
        return jax.grad(lambda own: along_others(game.scene, game.robot, own, others))(paths[1 + human])

    def expand_human(
        self, paths: Float[jax.Array, "cars fields steps"], human: Int[jax.Array, ""], controls: Float[jax.Array, "k 2"]
    ) -> Expansion:
        """Expand a human's reward in its own controls."""
        game, car, others = human_game(self.crowd, human), self.state[1 + human], self.others(paths, human)
        return second_order_expansion(
            partial(move, game, car),
            lambda own: along_others(game.scene, game.robot, own, others),
            controls,
            partial(discomfort, game, car),
        )

    def through_human(
        self,
        paths: Float[jax.Array, "cars fields steps"],
        human: Int[jax.Array, ""],
        jacobian: Float[jax.Array, "fields steps n"],
        pushed: Float[jax.Array, "n"],
    ) -> Trajectory:
        """Return ``J_i^T dR_R/du_i`` in the robot's trajectory, by the adjoint method from ``-H_i^-1 dR_R/du_i``."""
        _, pull_back = jax.vjp(partial(self.human_slope, paths, human), paths[0])
        return pull_back(jnp.sum(jacobian * pushed, axis=-1))[0]


def _climb_by_gradients(climb: _Climb, start: CrowdPlan) -> CrowdPlan:
    """Improve a plan by the paper's joint gradient steps."""
    game, state = climb.game, climb.state

    def direction(plan: CrowdPlan) -> CrowdPlan:
        paths = climb.paths(plan)
        along_robot, along_others_ = jax.grad(climb.robot_reward, argnums=(0, 1))(paths[0], paths[1:])

        def respond(place: Int[jax.Array, ""], slopes: tuple[Trajectory, Humans]) -> tuple[Trajectory, Humans]:
            human = climb.ranks[place]
            expansion = climb.expand_human(paths, human, plan.humans[human])
            along = jnp.sum(expansion.jacobian * along_others_[human][..., None], axis=(0, 1))
            pushed = response(game.influence, expansion.hessian, along)
            through = climb.through_human(paths, human, expansion.jacobian, pushed)
            return slopes[0] + through, slopes[1].at[human].set(expansion.gradient.reshape(-1, 2))

        none = along_robot, jnp.zeros_like(plan.humans)
        along, humans = jax.lax.fori_loop(0, climb.responding, respond, none)
        _, pull_back = jax.vjp(partial(move, game, state[0]), plan.robot)
        eased = pull_back(along)[0] - jax.grad(partial(discomfort, game, state[0]))(plan.robot)
        return CrowdPlan(eased, humans)

    return projected_ascent(game.planner, direction, start, partial(_within_limits, climb))


def _or_manoeuvre(climb: _Climb, plan: CrowdPlan) -> CrowdPlan:
    """Replace a plan that runs into an obstacle by the manoeuvre that earns most of those that do not, if any.

    Newton steps do not leave the local optimum of driving through the cones; the next plan starts from the manoeuvre.
    Humans may still answer, so that a plan that counts on them is left as it is.
    """
    game, car = climb.game, climb.state[0]
    others = climb.paths(plan)[1:]
    controls, _ = manoeuvres(game, car, game.planner.horizon)
    candidates = jnp.concatenate([plan.robot[None], bounded(game, car, controls)])

    def look(controls: Float[jax.Array, "steps 2"]) -> tuple[Bool[jax.Array, ""], Float[jax.Array, ""]]:
        own = move(game, car, controls)
        nobody = Motion(*jnp.zeros((len(own), 0, game.planner.horizon)))
        _, collision = collision_risk(game.scene, Motion(*own), nobody)
        return (collision > 0).any(), climb.robot_reward(own, others) - discomfort(game, car, controls)

    hits, earned = jax.vmap(look)(candidates)
    best = best_of(candidates, jnp.where(hits, -jnp.inf, earned))
    return plan._replace(robot=jnp.where(hits[0] & ~hits.all(), best, plan.robot))


def _within_limits(climb: _Climb, plan: CrowdPlan) -> CrowdPlan:
    """Limit the controls of the robot and of the humans under theory of mind."""
    game, state, humans = climb.game, climb.state, climb.crowd.humans
    limited = jax.vmap(partial(bounded, game))(state[1 : 1 + humans], plan.humans)
    answers = (climb.rungs == TOM)[:, None, None]
    return CrowdPlan(bounded(game, state[0], plan.robot), jnp.where(answers, limited, plan.humans))


class _Answers(NamedTuple):
    """What the loop over the humans under theory of mind collects."""

    slope: Float[jax.Array, "n"]  # of the robot's reward in its controls, through the humans
    factors: Float[jax.Array, "humans n n"]  # of each human's damped Hessian
    jacobians: Float[jax.Array, "humans fields steps n"]
    humans: Humans  # improved


def _climb_by_newton_steps(climb: _Climb, start: CrowdPlan) -> CrowdPlan:
    """Improve a plan by damped Newton steps of the robot, with the humans' answers in the line search."""
    game, state, number = climb.game, climb.state, climb.crowd.humans
    path, cost = partial(move, game, state[0]), partial(discomfort, game, state[0])
    size = start.robot.size

    def improve(_: int, plan: CrowdPlan) -> CrowdPlan:
        paths = climb.paths(plan)
        along = jax.grad(climb.robot_reward, argnums=1)(paths[0], paths[1:])
        expansion = second_order_expansion(path, lambda own: climb.robot_reward(own, paths[1:]), plan.robot, cost)

        def answer(place: Int[jax.Array, ""], answers: _Answers) -> _Answers:
            human = climb.ranks[place]
            own = climb.expand_human(paths, human, plan.humans[human])
            factor = damped_factor(own.hessian)
            pushed = damped_solve(factor, jnp.sum(own.jacobian * along[human][..., None], axis=(0, 1)))
            through = climb.through_human(paths, human, own.jacobian, pushed)
            improved = _improved_human(climb, paths, human, plan.humans[human], damped_solve(factor, own.gradient))
            return _Answers(
                answers.slope + jnp.sum(expansion.jacobian * through[..., None], axis=(0, 1)),
                answers.factors.at[human].set(factor),
                answers.jacobians.at[human].set(own.jacobian),
                answers.humans.at[human].set(improved),
            )

        none = _Answers(
            expansion.gradient,
            jnp.zeros((number, size, size)),
            jnp.zeros((number, *expansion.jacobian.shape)),
            plan.humans,
        )
        answers = jax.lax.fori_loop(0, climb.responding, answer, none)
        step = damped_solve(damped_factor(expansion.hessian), answers.slope)
        moved = expansion.jacobian @ step

        def react(place: Int[jax.Array, ""], reactions: Humans) -> Humans:
            human = climb.ranks[place]
            _, pushed = jax.jvp(partial(climb.human_slope, paths, human), (paths[0],), (moved,))
            along_controls = jnp.sum(answers.jacobians[human] * pushed[..., None], axis=(0, 1))
            return reactions.at[human].set(damped_solve(answers.factors[human], along_controls).reshape(-1, 2))

        reactions = jax.lax.fori_loop(0, climb.responding, react, jnp.zeros_like(plan.humans))

        def after(share: Float[jax.Array, ""]) -> tuple[CrowdPlan, Float[jax.Array, ""]]:
            tried = CrowdPlan(plan.robot + share * step.reshape(-1, 2), answers.humans + share * reactions)
            tried = _within_limits(climb, tried)
            paths = climb.paths(tried)
            return tried, climb.robot_reward(paths[0], paths[1:]) - cost(tried.robot)

        candidates, earned = jax.vmap(after)(jnp.asarray(SHARES))
        return jax.tree.map(lambda tried: best_of(tried, earned), candidates)

    return jax.lax.fori_loop(0, STEPS, improve, _within_limits(climb, start))


def _improved_human(
    climb: _Climb,
    paths: Float[jax.Array, "cars fields steps"],
    human: Int[jax.Array, ""],
    controls: Float[jax.Array, "steps 2"],
    step: Float[jax.Array, "n"],
) -> Float[jax.Array, "steps 2"]:
    """Return a human's controls after the share of its Newton step that earns it most."""
    game, car, others = human_game(climb.crowd, human), climb.state[1 + human], climb.others(paths, human)
    tried = bounded(game, car, controls + SHARES[:, None, None] * step.reshape(controls.shape))

    def earned(controls: Float[jax.Array, "steps 2"]) -> Float[jax.Array, ""]:
        own = along_others(game.scene, game.robot, move(game, car, controls), others)
        return own - discomfort(game, car, controls)

    return best_of(tried, jax.vmap(earned)(tried))
