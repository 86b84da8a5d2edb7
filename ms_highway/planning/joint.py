"""Improve the robot's plan jointly with the humans who respond to it: joint ascent.

Under theory of mind, human i responds to the robot's controls u_R: its controls u_i
maximise its own reward R_i. So the robot's reward R_R depends on u_R directly, and
through the humans::

    dR_R = (dR_R/du_R + sum_i J_i^T g_i) du_R
    g_i = dR_R/du_i,    J_i = du_i/du_R = -H_i^-1 M_i
    H_i = d2R_i/du_i2,  M_i = d2R_i/du_i du_R

Every step of the ascent moves the robot along this gradient, and each responding human
along dR_i/du_i. Humans do not respond to each other, and humans who do not respond
drive as predicted.

J_i is never formed (adjoint method). Rewards depend on controls through trajectories.
With S_R = ds_R/du_R and S_i = ds_i/du_i of the trajectories s_R and s_i, and with B_i =
d2R_i/ds_i ds_R, which couples only fields of the same step::

    g_i = S_i^T dR_R/ds_i,  M_i = S_i^T B_i S_R
    J_i^T g_i = S_R^T B_i^T S_i (-H_i^-1 g_i)

From the right: solve for the human's response to the robot's wish g_i, move the human
by it, and see how that changes the slope of R_i in the robot's trajectory. That is one
linear system per human, see `ms_highway.planning.responses`.
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
    response,
    second_order_expansion,
    trajectory_jacobian,
)
from ms_highway.numerics.solvers import Ascent
from ms_highway.planning.joint_newton import newton_step
from ms_highway.planning.plans import Plan, Solution, best_start, within_limits
from ms_highway.planning.responders import Interaction, KnownResponders
from ms_highway.planning.responses import (
    in_controls,
    slope_through,
    trajectories_around,
)
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
    return joint_ascent(Interaction(game, state, nobody), Plan(start.robot, humans))


@jax.jit  # traced once for the human and the robot
def joint_ascent(interaction: Interaction, start: Plan) -> Solution:
    """Improve the controls of the robot and of the humans who respond to it.

    The planner's solver says how:

    * ``Ascent``: the paper's gradient steps.
    * ``Newton``, for horizons of seconds: steps of
      `ms_highway.numerics.convex_newton`.

    Args:
        interaction: the situation, and the humans who respond.
        start: scaled plan; humans who do not respond keep to it.
    """
    game = interaction.game
    state = interaction.state
    solver = game.planner.solver
    responders = interaction.responders
    by_newton = not isinstance(solver, Ascent)

    # Newton steps begin within the limits, the robot's perhaps at a manoeuvre.
    if by_newton and not responders.nobody:
        start = within_limits(game, state, start)
    humans_paths = move_all(game, state[1 : 1 + game.number], start.humans)
    others = with_scripted(game, state, humans_paths)
    if by_newton:
        robot = best_start(game, state[0], start.robot, others)
        start = start._replace(robot=bounded(game, state[0], robot))

    # What a step moves: the robot's controls and, if somebody may respond, the humans.
    def step_alone(step: Index, robot: Controls) -> Controls:
        plan, _ = _take_step(interaction, step, Plan(robot, start.humans), others)
        return plan.robot

    def step_jointly(
        step: Index,
        now: tuple[Plan, Trajectories],
    ) -> tuple[Plan, Trajectories]:
        plan, others = now
        return _take_step(interaction, step, plan, others)

    most = responders.most_steps(solver)
    if responders.nobody:
        alone = solver.repeat(step_alone, start.robot, most, lambda robot: robot)
        return Solution(Plan(alone.point, start.humans), alone.steps, alone.converged)
    joint = solver.repeat(step_jointly, (start, others), most, lambda now: now[0])
    plan, _ = joint.point
    return Solution(plan, joint.steps, joint.converged)


def _take_step(
    interaction: Interaction,
    step: Index,
    plan: Plan,
    others: Trajectories,
) -> tuple[Plan, Trajectories]:
    """Take a step of the planner's solver.

    Args:
        interaction: the situation, and the humans who respond.
        step: its number.
        plan: before the step.
        others: trajectories of all others under it.

    Returns:
        The plan, and the trajectories of all others, after the step.
    """
    if isinstance(interaction.game.planner.solver, Ascent):
        return _gradient_step(interaction, step, plan, others)
    return newton_step(interaction, step, plan, others)


def _gradient_step(
    interaction: Interaction,
    step: Index,
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

    # The humans' own steps, and what the robot earns through their responses.
    def respond(
        human: Index,
        now: tuple[Trajectory, jax.Array, Trajectories],
    ) -> tuple[Trajectory, jax.Array, Trajectories]:
        slope, humans, paths = now
        around = trajectories_around(human, path, others)
        answer = _gradient_response(
            interaction, human, plan, others[human], around, slopes_in_others[human]
        )
        return (
            slope + answer.robot_slope,
            humans.at[human].set(answer.controls),
            paths.at[human].set(answer.path),
        )

    before = (slope_in_robot, jnp.asarray(plan.humans), others)
    slope, humans, paths = responders.fold(responders.count(step), respond, before)

    # The robot's step, along its reward and what it earns through the humans.
    jacobian = trajectory_jacobian(drive, plan.robot)
    uphill = in_controls(slope, jacobian).reshape(-1, 2)
    gradient = uphill - jax.grad(partial(discomfort, game, state[0]))(plan.robot)
    climbed = plan.robot + responders.robot_step_size(solver) * gradient
    return Plan(bounded(game, state[0], climbed), humans), paths


class _GradientResponse(NamedTuple):
    """A human's part in a gradient step.

    Attributes:
        robot_slope: of R_R in the robot's trajectory, through the human's response.
        controls: of the human, after its own step.
        path: trajectory of the human under them.
    """

    robot_slope: Trajectory
    controls: Controls
    path: Trajectory


def _gradient_response(
    interaction: Interaction,
    human: Index,
    plan: Plan,
    path: Trajectory,
    around: Trajectories,
    wish: Trajectory,
) -> _GradientResponse:
    """Take a human's own gradient step, and see what the robot earns through it.

    Args:
        interaction: the situation, and the humans who respond.
        human: its number.
        plan: before the step.
        path: trajectory of the human under it.
        around: trajectories of all others under it, the robot's first.
        wish: dR_R/ds_i, what the robot wishes of the human's trajectory.
    """
    solver = interaction.game.planner.solver
    assert isinstance(solver, Ascent)
    own_game = swap_roles(interaction.game, human)
    car = interaction.state[1 + human]
    drive = partial(move, own_game, car)
    controls = plan.humans[human]

    # The human's reward to second order in its controls.
    derivatives = own_game.payoff.second_order(path, around)
    cost = partial(discomfort, own_game, car)
    expansion = second_order_expansion(
        drive, controls, derivatives.gradient, derivatives.hessian, cost
    )

    # What the robot earns through the human's response to its plan.
    wanted = in_controls(wish, expansion.jacobian)
    answer = response(interaction.game.influence, expansion.hessian, wanted)
    robot_slope = slope_through(expansion.jacobian, answer, derivatives.partner)

    # The human's own step.
    step_size = interaction.responders.step_size(solver, human)
    climbed = controls + step_size * expansion.gradient.reshape(-1, 2)
    after = bounded(own_game, car, climbed)
    return _GradientResponse(robot_slope, after, drive(after))
