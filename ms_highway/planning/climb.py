"""Improve a plan that humans answer: theory of mind about one human or several.

Human i, under theory of mind, answers the robot's plan; all others keep to what is expected of them. So the humans'
response is block-diagonal, ``J_i = -H_i^-1 d2R_i / du_i du_R``, and the robot climbs along
``dR_R/du_R + sum_i J_i^T dR_R/du_i``, each human along ``dR_i/du_i``. J is never formed (adjoint method): one response
of the human to ``dR_R/du_i`` and one derivative of ``dR_i/du_i`` along it give ``J_i^T dR_R/du_i``.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import (
    Game,
    bounded,
    discomfort,
    move,
    move_all,
    others_of,
    swap_roles,
    trajectory_reward,
)
from ms_highway.optimization.convex_newton import Local, convex_newton_steps, expand, improve, share, until_still
from ms_highway.optimization.objective import Objective
from ms_highway.optimization.second_derivatives import response
from ms_highway.optimization.solvers import projected_ascent
from ms_highway.planning.plans import Plan, best_start, driving, within_limits
from ms_highway.runtime.arrays import (
    Controls,
    HumansControls,
    Index,
    Rungs,
    Scalar,
    State,
    Trajectories,
    Trajectory,
    Vector,
)

Carry = TypeVar("Carry")


class Answering(NamedTuple):
    """A situation, and the humans who answer the robot's plan in it.

    Attributes:
        game: that is played.
        state: all cars now.
        order: numbers of the humans, those who answer first; None where the only human answers.
        answering: how many answer.
    """

    game: Game
    state: State
    order: Rungs | None = None
    answering: Index = 1

    def fold(self, function: Callable[[Index, Carry], Carry], carry: Carry) -> Carry:
        """Apply a function to the number of every human who answers, one after the other."""
        order = self.order
        if order is None:
            return function(0, carry)
        return jax.lax.fori_loop(0, self.answering, lambda place, carry: function(order[place], carry), carry)


class _Path(NamedTuple):
    """A situation, and the trajectories of robot and humans in it."""

    game: Game
    state: State
    robot: Trajectory
    humans: Trajectories

    def around(self, human: Index, robot: Trajectory) -> Trajectories:
        """Return the trajectories of the others of a human, with the robot on another one."""
        if self.game.number == 1:
            return robot[None]
        return jnp.concatenate([robot[None], self.humans])[jnp.asarray(others_of(1 + self.game.number))[1 + human]]

    def objective(self, human: Index) -> Objective:
        """Return what a human maximises over its own controls."""
        game, car, others = swap_roles(self.game, human), self.state[1 + human], self.around(human, self.robot)
        return driving(game, car, self.state, others)

    def slope(self, human: Index, robot: Trajectory) -> Trajectory:
        """Return the derivative of a human's reward in its own trajectory, but for a part that no robot changes.

        The package's features add up over the other cars, so that these are left out; users' own need not. The paper's
        plans keep to the sum over all, and so to their last digits.
        """
        game, cars = swap_roles(self.game, human), self.state
        if game.robot.own or not game.planner.for_seconds:
            return jax.grad(partial(trajectory_reward, game, cars))(self.humans[human], self.around(human, robot))
        alone, two = replace(game, scene=game.scene.of_pair()), cars[:2]  # their number counts: none keeps its velocity
        return jax.grad(partial(trajectory_reward, alone, two))(self.humans[human], robot[None])

    def through(self, human: Index, jacobian: Float[Any, "fields steps n"], pushed: Vector) -> Trajectory:
        """Return ``J_i^T dR_R/du_i`` in the robot's trajectory, from ``-H_i^-1 dR_R/du_i``."""
        _, pull_back = jax.vjp(partial(self.slope, human), self.robot)
        return pull_back(jnp.sum(jacobian * pushed, axis=-1))[0]

    def change(self, human: Index, jacobian: Float[Any, "fields steps n"], moved: Trajectory) -> Vector:
        """Return how a human's gradient in its controls changes if the robot's trajectory does."""
        _, pushed = jax.jvp(partial(self.slope, human), (self.robot,), (moved,))
        return pushed.ravel() @ jacobian.reshape(pushed.size, -1)


def climb(who: Answering, start: Plan, steps: tuple[Index, Index] | None = None) -> Plan:
    """Improve the robot's controls and those of the humans who answer.

    * The planner's solver ``gradient`` (and ``newton``): the paper's joint gradient steps.
    * ``convex_newton`` holds over horizons of seconds: the robot takes the steps of
      `ms_highway.optimization.convex_newton` on its own reward, with the gradient above; their share looks at what the
      robot earns once the humans have answered, by their linear response ``J_i du_R`` and a step of their own.

    Args:
        who: the situation.
        start: scaled plan; humans who do not answer keep to it.
        steps: their number, at most, without answers and with; those of the planner by default.
    """
    planner, limit = who.game.planner, partial(within_limits, who.game, who.state)
    alone, answered = steps or planner.steps
    if not planner.for_seconds:
        return projected_ascent(planner, partial(_direction, who), start, limit, alone)
    return _newton_steps(who, limit(start), alone, answered)


def _put(values: HumansControls, human: Index, value: Controls) -> HumansControls:
    return value[None] if len(values) == 1 else values.at[human].set(value)


def _direction(who: Answering, plan: Plan) -> Plan:
    """Return the direction of a joint gradient step."""
    game, state = who.game, who.state
    robot, pull_robot = jax.vjp(partial(move, game, state[0]), plan.robot)
    humans, pull_humans = jax.vjp(partial(move_all, game, state[1 : 1 + game.number]), plan.humans)
    path = _Path(game, state, robot, humans)
    along_robot, along_humans = jax.grad(trajectory_reward, argnums=(2, 3))(game, state, robot, humans)
    pulled = pull_humans(along_humans)[0]

    def respond(human: Index, slopes: Plan) -> Plan:
        own = path.objective(human).expand(plan.humans[human])
        pushed = response(game.influence, own.hessian, pulled[human].ravel())
        through = path.through(human, own.jacobian, pushed)
        return Plan(slopes.robot + through, _put(slopes.humans, human, own.gradient.reshape(-1, 2)))

    along, humans = who.fold(respond, Plan(along_robot, jnp.zeros_like(plan.humans)))
    eased = pull_robot(along)[0] - jax.grad(partial(discomfort, game, state[0]))(plan.robot)
    return Plan(eased, humans)


class _Answers(NamedTuple):
    """What the loop over the humans who answer collects."""

    slope: Vector  # of the robot's reward in its controls, through the humans
    local: Local  # around the controls of each human
    humans: HumansControls  # improved


def _newton_steps(who: Answering, start: Plan, alone: Index, answered: Index) -> Plan:
    """Take steps of the robot and of the humans who answer it; if nobody does, of the robot alone.

    Humans who do not answer are moved only once.
    """
    game, state = who.game, who.state
    humans = move_all(game, state[1 : 1 + game.number], start.humans)
    begin = best_start(game, state, start.robot, humans)

    def among_answers() -> Plan:
        first = start._replace(robot=bounded(game, state[0], begin)), humans
        return until_still(lambda now: _newton_step(who, *now), first, answered, lambda now: now[0])[0]

    def among_predictions() -> Plan:
        return start._replace(robot=convex_newton_steps(driving(game, state[0], state, humans), begin, alone))

    if who.order is None:
        return among_answers()
    return jax.lax.cond(who.answering > 0, among_answers, among_predictions)


def _newton_step(who: Answering, plan: Plan, humans: Trajectories) -> tuple[Plan, Trajectories]:
    """Take a step from a plan, and from the humans' trajectories under it."""
    game, state, number = who.game, who.state, who.game.number
    path = _Path(game, state, move(game, state[0], plan.robot), humans)
    along = jax.grad(trajectory_reward, argnums=3)(game, state, path.robot, humans)
    robot = expand(driving(game, state[0], state, humans), plan.robot)

    def answer(human: Index, answers: _Answers) -> _Answers:
        wanted, now = path.objective(human), plan.humans[human]
        own = expand(wanted, now)
        pushed = own.solve(along[human].ravel() @ own.jacobian.reshape(-1, now.size))
        through = path.through(human, own.jacobian, pushed)
        return _Answers(
            answers.slope + through.ravel() @ robot.jacobian.reshape(through.size, -1),
            jax.tree.map(lambda all_of, one: all_of.at[human].set(one), answers.local, own),
            answers.humans.at[human].set(improve(wanted, now, own)),
        )

    nothing = jax.tree.map(lambda part: jnp.zeros((number, *part.shape)), robot)
    answers = who.fold(answer, _Answers(robot.gradient, nothing, plan.humans))
    step = robot.step(answers.slope)
    moved = robot.jacobian @ step

    def react(human: Index, reactions: HumansControls) -> HumansControls:
        own = jax.tree.map(lambda part: part[human], answers.local)
        return reactions.at[human].set(own.step(path.change(human, own.jacobian, moved)).reshape(-1, 2))

    reactions = who.fold(react, jnp.zeros_like(plan.humans))

    def after(part: Scalar) -> tuple[Plan, Trajectories]:
        def put(human: Index, sides: tuple[HumansControls, Trajectories]) -> tuple[HumansControls, Trajectories]:
            car = state[1 + human]
            own = bounded(game, car, answers.humans[human] + part * reactions[human])
            return sides[0].at[human].set(own), sides[1].at[human].set(move(game, car, own))

        sides, paths = who.fold(put, (plan.humans, humans))
        return Plan(bounded(game, state[0], plan.robot + part * step.reshape(-1, 2)), sides), paths

    def earned(robot: Controls, paths: Trajectories) -> Scalar:
        return driving(game, state[0], state, paths).earned(robot)

    (whole, reached), (none, held) = after(jnp.ones(())), after(jnp.zeros(()))
    gone = whole.robot - none.robot
    _, slope = jax.jvp(earned, (whole.robot, reached), (gone, reached - held))
    return after(share(answers.slope @ gone.ravel(), slope))
