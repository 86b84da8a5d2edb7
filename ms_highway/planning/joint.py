"""Improve the robot's plan jointly with the humans who respond to it: joint ascent.

Under theory of mind, human i responds to the robot's controls u_R: its controls u_i
maximise its own reward R_i. This is a Stackelberg game (bilevel optimisation) with the
robot as its leader. The leader's total gradient has a direct part, and an indirect part
through the best responses of the humans, by the implicit function theorem::

    gradient = dR_R/du_R + sum_i J_i^T g_i
    g_i = dR_R/du_i,    J_i = du_i/du_R = -H_i^-1 M_i
    H_i = d2R_i/du_i2,  M_i = d2R_i/du_i du_R

The theorem holds where u_i is the optimum. Like the paper, the ascent applies it on the
way there, with a damped H_i unless `ms_highway.game.game.Game.influence` is "exact".

Every iteration moves the robot along its gradient, and each responding human along
dR_i/du_i: its *own step*. All of them see the plans before the iteration, the humans
those of each other, too; only the gradient neglects how humans respond to each other
(du_i/du_j = 0). Humans who do not respond drive as predicted.

J_i is never formed (adjoint method). Rewards depend on controls through trajectories.
With S_R = ds_R/du_R and S_i = ds_i/du_i of the trajectories s_R and s_i, and with B_i =
d2R_i/ds_i ds_R, which couples only fields of the same step::

    g_i = S_i^T dR_R/ds_i,  M_i = S_i^T B_i S_R
    J_i^T g_i = S_R^T B_i^T S_i (-H_i^-1 g_i)

From the right, without moving anybody: solve one linear system for the adjoint vector
-H_i^-1 g_i, and push it to the trajectory of the human by S_i. B_i^T turns it into a
derivative in the robot's trajectory: the human's *influence*. S_R^T pulls the sum of
all influences back to the robot's controls. See `ms_highway.planning.influence`; the
*slope in* a variable stands for the derivative in it.
"""

from functools import partial
from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.game import (
    Game,
    bounded,
    discomfort,
    move,
    move_all,
    swap_roles,
    with_scripted,
)
from ms_highway.numerics.second_derivatives import (
    minus_inverse_times,
    second_order_expansion,
    trajectory_jacobian,
)
from ms_highway.numerics.solvers import Ascent
from ms_highway.planning.influence import (
    influence_of,
    pulled_back,
    trajectories_around,
)
from ms_highway.planning.joint_newton import newton_step
from ms_highway.planning.plans import Plan, Solution, best_start, within_limits
from ms_highway.planning.responders import Interaction, KnownResponders
from ms_highway.runtime.arrays import (
    Controls,
    HumansControls,
    Index,
    State,
    Trajectories,
    Trajectory,
)


def plan_against(
    game: Game,
    state: State,
    humans: HumansControls,
    start: Plan,
) -> Solution:
    """Optimise the robot's controls, from a start, against fixed controls of humans."""
    nobody = KnownResponders(())
    interaction = Interaction(game, state, nobody)
    return joint_ascent(interaction, Plan(start.robot, humans))


@jax.jit  # one trace serves the plans of the robot and of humans under `turn`
def joint_ascent(interaction: Interaction, start: Plan) -> Solution:
    """Improve the controls of the robot and of the humans who respond to it.

    The planner's solver says how:

    * ``Ascent``: the paper's gradient steps.
    * ``Newton``, for horizons of seconds: steps of
      `ms_highway.numerics.convex_newton`.

    Args:
        interaction: the situation, and the humans who respond.
        start: scaled plan; humans who do not respond keep to it, under ``Newton`` cut
            to their limits if others may respond.
    """
    game = interaction.game
    state = interaction.state
    solver = game.planner.solver
    responders = interaction.responders
    by_newton = not isinstance(solver, Ascent)

    # Under Newton steps, humans who may respond start within their limits.
    if by_newton and not responders.surely_nobody:
        start = within_limits(game, state, start)
    humans_now = state[1 : 1 + game.number]
    humans_paths = move_all(game, humans_now, start.humans)
    start_paths = with_scripted(game, state, humans_paths)

    # The robot starts at the last plan or a much better manoeuvre, compared while the
    # humans drive as in the start.
    if by_newton:
        robot = best_start(game, state[0], start.robot, start_paths)
        start = start._replace(robot=bounded(game, state[0], robot))

    # The iterate: the robot's controls and, if somebody may respond, also the humans'
    # and the trajectories of all others.
    def iterate_alone(iteration: Index, robot: Controls) -> Controls:
        plan = Plan(robot, start.humans)
        plan, _ = _take_step(interaction, iteration, plan, start_paths)
        return plan.robot

    def iterate_jointly(
        iteration: Index,
        now: tuple[Plan, Trajectories],
    ) -> tuple[Plan, Trajectories]:
        plan, paths = now
        return _take_step(interaction, iteration, plan, paths)

    most = responders.most_steps(solver)
    if responders.surely_nobody:
        alone = solver.repeat(iterate_alone, start.robot, most, lambda robot: robot)
        plan = Plan(alone.point, start.humans)
        return Solution(plan, alone.steps, alone.converged)

    iterate = (start, start_paths)
    joint = solver.repeat(iterate_jointly, iterate, most, lambda now: now[0])
    plan, _ = joint.point
    return Solution(plan, joint.steps, joint.converged)


def _take_step(
    interaction: Interaction,
    iteration: Index,
    plan: Plan,
    others: Trajectories,
) -> tuple[Plan, Trajectories]:
    """Take a step of the planner's solver.

    Args:
        interaction: the situation, and the humans who respond.
        iteration: index of the step.
        plan: before the step.
        others: trajectories of all others under it.

    Returns:
        The plan, and the trajectories of all others, after the step.
    """
    if isinstance(interaction.game.planner.solver, Ascent):
        return _gradient_step(interaction, iteration, plan, others)
    return newton_step(interaction, iteration, plan, others)


def _gradient_step(
    interaction: Interaction,
    iteration: Index,
    plan: Plan,
    others: Trajectories,
) -> tuple[Plan, Trajectories]:
    """Take a gradient step of the robot and of the humans who respond."""
    game = interaction.game
    state = interaction.state
    responders = interaction.responders
    solver = game.planner.solver
    assert isinstance(solver, Ascent)
    drive = partial(move, game, state[0])
    path = drive(plan.robot)
    slope_in_robot, slopes_in_others = game.payoff.slopes(path, others)

    # The humans' own steps and influences. All see the trajectories before the step.
    def add_human(human: Index, so_far: _HumansSoFar) -> _HumansSoFar:
        around = trajectories_around(human, path, others)
        step = _human_gradient_step(
            interaction, human, plan, others[human], around, slopes_in_others[human]
        )
        return _HumansSoFar(
            so_far.robot_slope + step.influence,
            so_far.controls.at[human].set(step.controls),
            so_far.paths.at[human].set(step.path),
        )

    nobody_yet = _HumansSoFar(slope_in_robot, jnp.asarray(plan.humans), others)
    count = responders.count(iteration)
    humans = responders.fold(count, add_human, nobody_yet)

    # The robot's total gradient, less that of the cost of its controls.
    jacobian = trajectory_jacobian(drive, plan.robot)
    uphill = pulled_back(humans.robot_slope, jacobian).reshape(-1, 2)
    cost = partial(discomfort, game, state[0])
    gradient = uphill - jax.grad(cost)(plan.robot)

    # The robot's step along it.
    step_size = responders.robot_step_size(solver)
    climbed = plan.robot + step_size * gradient
    robot = bounded(game, state[0], climbed)
    return Plan(robot, humans.controls), humans.paths


class _HumansSoFar(NamedTuple):
    """What a gradient step collects from the responding humans, one by one.

    Attributes:
        robot_slope: slope of R_R in the robot's trajectory, with the influences of the
            humans so far.
        controls: of all humans, after the own steps so far.
        paths: trajectories of all others under them.
    """

    robot_slope: Trajectory
    controls: jax.Array
    paths: Trajectories


class _HumanStep(NamedTuple):
    """A human's part in a gradient step.

    Attributes:
        influence: slope of R_R in the robot's trajectory, through the human.
        controls: of the human, after its own step.
        path: trajectory of the human under them.
    """

    influence: Trajectory
    controls: Controls
    path: Trajectory


def _human_gradient_step(
    interaction: Interaction,
    human: Index,
    plan: Plan,
    path: Trajectory,
    around: Trajectories,
    robot_slope: Trajectory,
) -> _HumanStep:
    """Take a human's own gradient step, and compute its influence on the robot.

    Args:
        interaction: the situation, and the humans who respond.
        human: index of the human.
        plan: before the step.
        path: trajectory of the human under it.
        around: trajectories of all others under it, the robot's first.
        robot_slope: dR_R/ds_i, of the robot's reward in the human's trajectory.
    """
    solver = interaction.game.planner.solver
    assert isinstance(solver, Ascent)
    own_game = swap_roles(interaction.game, human)
    car = interaction.state[1 + human]
    drive = partial(move, own_game, car)
    controls = plan.humans[human]

    # The human's reward, less the cost of its controls, to second order in them.
    derivatives = own_game.payoff.second_order(path, around)
    cost = partial(discomfort, own_game, car)
    expansion = second_order_expansion(
        drive, controls, derivatives.gradient, derivatives.hessian, cost
    )

    # The human's influence B_i^T S_i (-H_i^-1 g_i).
    robot_gradient = pulled_back(robot_slope, expansion.jacobian)  # g_i
    adjoint = minus_inverse_times(
        interaction.game.influence, expansion.hessian, robot_gradient
    )
    influence = influence_of(expansion.jacobian, adjoint, derivatives.mixed_hessian)

    # The human's own step.
    step_size = interaction.responders.step_size(solver, human)
    gradient = expansion.gradient.reshape(-1, 2)
    climbed = controls + step_size * gradient
    after = bounded(own_game, car, climbed)
    return _HumanStep(influence, after, drive(after))
