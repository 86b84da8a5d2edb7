"""Take a Newton step of the joint ascent, for horizons of several seconds.

The gradient and its symbols are those of `ms_highway.planning.joint`, the steps those
of `ms_highway.numerics.convex_newton`. The convex curvature C_i of a local model takes
the place of -H_i, also in J_i: the robot anticipates the response of a human with this
curvature, whatever `ms_highway.game.game.Game.influence` is.

Beside their own steps, the humans react to the robot's step du_R, by J_i du_R. Robot
and humans move together, so that the line search judges the end of the robot's step
with the own steps and the reactions of the humans included.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game, bounded, move, swap_roles
from ms_highway.numerics.convex_newton import LocalModel, best_share, expand, improve
from ms_highway.numerics.objective import Objective
from ms_highway.planning.influence import (
    influence_of,
    mixed_hessian,
    pulled_back,
    slope_change,
    trajectories_around,
)
from ms_highway.planning.plans import Plan, plan_objective
from ms_highway.planning.responders import Interaction
from ms_highway.runtime.arrays import (
    Controls,
    HumansControls,
    Index,
    Scalar,
    Trajectories,
    Trajectory,
    Vector,
)


class StepStart(NamedTuple):
    """Where a Newton step starts.

    Attributes:
        plan: of the robot and the humans.
        path: trajectory s_R of the robot.
        others: trajectories of all others, the humans' s_i first.
        robot_slopes: dR_R/ds of the others: the slope of the robot's reward in each of
            their trajectories.
        model: of R_R around the robot's controls.
    """

    plan: Plan
    path: Trajectory
    others: Trajectories
    robot_slopes: Trajectories
    model: LocalModel


class HumansSoFar(NamedTuple):
    """What a Newton step collects from the responding humans, one by one.

    Attributes:
        gradient: of R_R in the robot's ravelled controls, with the influences of the
            humans so far.
        models: of R_i around each human's controls; every array has a first axis of
            humans.
        mixed_hessians: B_i of each human.
        controls: after the own steps of the humans so far.
    """

    gradient: Vector
    models: LocalModel
    mixed_hessians: Float[jax.Array, "humans fields fields steps"]
    controls: Float[jax.Array, "humans steps 2"]


class WholeStep(NamedTuple):
    """A whole step of the robot, and how the humans change with it.

    Attributes:
        robot: step of the robot's ravelled controls, du_R.
        humans: controls of the humans after their own steps.
        reactions: J_i du_R, by which the humans react to the robot's step.
    """

    robot: Vector
    humans: HumansControls
    reactions: HumansControls


def newton_step(
    interaction: Interaction,
    iteration: Index,
    plan: Plan,
    others: Trajectories,
) -> tuple[Plan, Trajectories]:
    """Take a Newton step of the robot and of the humans who respond.

    1. Each human takes a step of its own, as if the robot kept to its plan.
    2. The robot's whole step follows from its total gradient. Each human reacts to this
       step linearly.
    3. The robot takes a share of its step, and the humans the same share of their
       reactions.
    """
    game = interaction.game
    state = interaction.state
    responders = interaction.responders
    path = move(game, state[0], plan.robot)
    objective = plan_objective(game, state[0], others)
    slope_in_robot, slopes_in_others = game.payoff.slopes(path, others)
    model = expand(objective, plan.robot, path, slope_in_robot)

    # If nobody responds, take the usual step up the robot's own objective.
    if responders.surely_nobody:
        robot = improve(objective, plan.robot, model)
        return Plan(robot, plan.humans), others
    start = StepStart(plan, path, others, slopes_in_others, model)

    # The humans' own steps and influences.
    def add_human(human: Index, so_far: HumansSoFar) -> HumansSoFar:
        return _with_human(interaction, start, human, so_far)

    count = responders.count(iteration)
    nobody_yet = _no_humans(game, start)
    humans = responders.fold(count, add_human, nobody_yet)

    # The robot's whole step, and the reactions of the humans to it. Limits cut neither
    # of them, only the controls that a share of them leads to.
    robot_step = model.step(humans.gradient)
    path_change = model.jacobian @ robot_step  # to first order

    def react(human: Index, reactions: jax.Array) -> jax.Array:
        reaction = _reaction(human, humans, path_change)
        return reactions.at[human].set(reaction)

    no_reactions = jnp.zeros_like(plan.humans)
    reactions = responders.fold(count, react, no_reactions)
    whole = WholeStep(robot_step, humans.controls, reactions)

    # The share of it that they take.
    def robot_after(share: Scalar) -> Controls:
        climbed = plan.robot + share * whole.robot.reshape(-1, 2)
        return bounded(game, state[0], climbed)

    def humans_after(share: Scalar) -> tuple[HumansControls, Trajectories]:
        return _humans_after(interaction, count, start, whole, share)

    share = _share_of_step(
        game, start, objective, humans.gradient, robot_after, humans_after
    )
    humans_controls, paths = humans_after(share)
    return Plan(robot_after(share), humans_controls), paths


def _no_humans(game: Game, start: StepStart) -> HumansSoFar:
    """Return what a Newton step has collected before the first human."""

    def zeros_of_humans(array: jax.Array) -> jax.Array:
        return jnp.zeros((game.number, *array.shape))

    models = jax.tree.map(zeros_of_humans, start.model)
    fields, steps = start.path.shape
    mixed_hessians = jnp.zeros((game.number, fields, fields, steps))
    controls = jnp.asarray(start.plan.humans)
    return HumansSoFar(start.model.gradient, models, mixed_hessians, controls)


def _with_human(
    interaction: Interaction,
    start: StepStart,
    human: Index,
    so_far: HumansSoFar,
) -> HumansSoFar:
    """Add a human: its own step, and its influence on the robot's gradient.

    Args:
        interaction: the situation.
        start: where the step starts.
        human: index of the human.
        so_far: of the humans before this one.
    """
    own_game = swap_roles(interaction.game, human)
    around = trajectories_around(human, start.path, start.others)
    controls = start.plan.humans[human]
    path = start.others[human]
    car = interaction.state[1 + human]
    objective = plan_objective(own_game, car, around)
    model = expand(objective, controls, path)
    mixed = mixed_hessian(own_game, path, around)

    # The influence S_R^T B_i^T S_i C_i^-1 g_i.
    robot_gradient = pulled_back(start.robot_slopes[human], model.jacobian)  # g_i
    adjoint = model.solve(robot_gradient)
    influence = influence_of(model.jacobian, adjoint, mixed)
    gradient = so_far.gradient + pulled_back(influence, start.model.jacobian)

    # Keep the model for the reaction, and take the own step.
    def put(of_humans: jax.Array, own: jax.Array) -> jax.Array:
        return of_humans.at[human].set(own)

    models = jax.tree.map(put, so_far.models, model)
    mixed_hessians = so_far.mixed_hessians.at[human].set(mixed)
    after = improve(objective, controls, model)
    all_controls = so_far.controls.at[human].set(after)
    return HumansSoFar(gradient, models, mixed_hessians, all_controls)


def _reaction(human: Index, humans: HumansSoFar, path_change: Trajectory) -> Controls:
    """Return ``J_i du_R = C_i^-1 S_i^T B_i S_R du_R``, cut to the longest Newton step.

    Args:
        human: index of the human.
        humans: what the step has collected from all of them.
        path_change: ``S_R du_R``, the change of the robot's trajectory.
    """
    model = jax.tree.map(lambda of_humans: of_humans[human], humans.models)

    # The robot's trajectory moves, so that its fields have to come first in B_i.
    robot_first = jnp.swapaxes(humans.mixed_hessians[human], 0, 1)
    slope = slope_change(robot_first, path_change)
    gradient = pulled_back(slope, model.jacobian)
    return model.step(gradient).reshape(-1, 2)


def _humans_after(
    interaction: Interaction,
    count: Index,
    start: StepStart,
    whole: WholeStep,
    share: Scalar,
) -> tuple[HumansControls, Trajectories]:
    """Return the humans' controls and all others' trajectories after a share of a step.

    The humans have taken their own steps, and the share of their reactions.

    Args:
        interaction: the situation, and the humans who respond.
        count: number of humans who respond in this step.
        start: where the step starts.
        whole: the whole step.
        share: of the reactions.
    """
    game = interaction.game

    def move_human(
        human: Index,
        now: tuple[jax.Array, Trajectories],
    ) -> tuple[jax.Array, Trajectories]:
        humans, paths = now
        car = interaction.state[1 + human]

        # Limits and dynamics are the same from the robot's and the human's side.
        reacted = whole.humans[human] + share * whole.reactions[human]
        controls = bounded(game, car, reacted)
        path = move(game, car, controls)
        humans = humans.at[human].set(controls)
        paths = paths.at[human].set(path)
        return humans, paths

    before = (jnp.asarray(start.plan.humans), start.others)
    return interaction.responders.fold(count, move_human, before)


def _share_of_step(
    game: Game,
    start: StepStart,
    objective: Objective,
    gradient: Vector,
    robot_after: Callable[[Scalar], Controls],
    humans_after: Callable[[Scalar], tuple[HumansControls, Trajectories]],
) -> Scalar:
    """Return the share of a whole step to take, see `best_share`.

    It follows from the derivatives of R_R along the step at both ends of the step. Both
    count what the humans' reactions change: at the start by the influences in the
    gradient, at the end by the trajectories with and without reactions. At the end, the
    humans have taken their own steps, too.

    Args:
        game: that is played.
        start: where the step starts.
        objective: of the robot.
        gradient: total gradient of the robot at the start.
        robot_after: returns the robot's controls after a share of the step.
        humans_after: returns the humans' controls and all others' trajectories then.
    """
    # The change of the robot, and where all are at the end of the step.
    full_step = robot_after(jnp.ones(()))
    change = full_step - start.plan.robot
    _, paths_with_reactions = humans_after(jnp.ones(()))
    path, path_change = jax.jvp(objective.path, (full_step,), (change,))
    slope_in_robot, slopes_in_others = game.payoff.slopes(path, paths_with_reactions)

    # The slope along the step at its end: of the reward in the robot's trajectory, of
    # the cost of its controls, and of the reward in the trajectories of those reacting.
    slope_at_end = jnp.sum(slope_in_robot * path_change)
    cost_slope = jax.grad(objective.cost)(full_step)
    slope_at_end -= jnp.sum(cost_slope * change)
    _, paths_without_reactions = humans_after(jnp.zeros(()))
    path_reactions = paths_with_reactions - paths_without_reactions
    slope_at_end += jnp.sum(slopes_in_others * path_reactions)

    slope_at_start = gradient @ change.ravel()
    return best_share(slope_at_start, slope_at_end)
