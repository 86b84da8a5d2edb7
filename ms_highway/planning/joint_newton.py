"""Take a Newton step of the joint ascent, for horizons of seconds.

The gradient and its symbols are those of `ms_highway.planning.joint`, the steps those
of `ms_highway.numerics.convex_newton`: the convex curvature C_i of an expansion takes
the place of -H_i. The robot and the humans take their steps together, so that the share
of the step has to be judged once the humans have taken theirs.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game, bounded, move, swap_roles
from ms_highway.numerics.convex_newton import Local, expand, improve, share
from ms_highway.numerics.objective import Objective
from ms_highway.planning.plans import Plan, driving
from ms_highway.planning.responders import Interaction
from ms_highway.planning.responses import (
    in_controls,
    mixed_bends,
    slope_change,
    slope_through,
    trajectories_around,
)
from ms_highway.runtime.arrays import (
    Controls,
    HumansControls,
    Index,
    Scalar,
    Trajectories,
    Trajectory,
    Vector,
)


class Point(NamedTuple):
    """Where a Newton step starts.

    Attributes:
        plan: of the robot and the humans.
        path: trajectory s_R of the robot.
        others: trajectories of all others, the humans' s_i first.
        wishes: dR_R/ds of the others, what the robot wishes of each trajectory.
        reward: R_R, expanded around the robot's controls.
    """

    plan: Plan
    path: Trajectory
    others: Trajectories
    wishes: Trajectories
    reward: Local


class Responses(NamedTuple):
    """What a Newton step collects from the responding humans, one by one.

    Attributes:
        gradient: of R_R in the robot's ravelled controls, with what it earns through
            the humans so far.
        reward: R_i of each human, expanded around its controls.
        coupling: B_i of each human.
        humans: controls, after the own steps of the humans so far.
    """

    gradient: Vector
    reward: Local
    coupling: Float[jax.Array, "humans fields fields steps"]
    humans: Float[jax.Array, "humans steps 2"]


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
    step: Index,
    plan: Plan,
    others: Trajectories,
) -> tuple[Plan, Trajectories]:
    """Take a Newton step of the robot and of the humans who respond.

    1. Each human takes a step of its own, as if the robot kept to its plan.
    2. The robot's whole step follows from its gradient, with what it earns through the
       humans. Each human reacts to this step linearly.
    3. The robot takes a share of its step, and the humans the same share of their
       reactions.
    """
    game = interaction.game
    state = interaction.state
    responders = interaction.responders
    path = move(game, state[0], plan.robot)
    objective = driving(game, state[0], others)
    slope_in_robot, slopes_in_others = game.payoff.slopes(path, others)
    reward = expand(objective, plan.robot, path, slope_in_robot)
    if responders.nobody:  # so that the robot climbs its own reward
        return Plan(improve(objective, plan.robot, reward), plan.humans), others
    point = Point(plan, path, others, slopes_in_others, reward)

    # The humans' own steps, and what the robot earns through their responses.
    def respond(human: Index, responses: Responses) -> Responses:
        return _respond(interaction, point, human, responses)

    count = responders.count(step)
    responses = responders.fold(count, respond, _no_responses(game, point))

    # The robot's whole step, and the reactions of the humans to it.
    robot_step = reward.step(responses.gradient)
    path_change = reward.jacobian @ robot_step  # to first order

    def react(human: Index, reactions: jax.Array) -> jax.Array:
        reaction = _reaction(human, responses, path_change)
        return reactions.at[human].set(reaction)

    reactions = responders.fold(count, react, jnp.zeros_like(plan.humans))
    whole = WholeStep(robot_step, responses.humans, reactions)

    # The share of it that they take.
    def robot_after(part: Scalar) -> Controls:
        climbed = plan.robot + part * whole.robot.reshape(-1, 2)
        return bounded(game, state[0], climbed)

    def humans_after(part: Scalar) -> tuple[HumansControls, Trajectories]:
        return _humans_after(interaction, count, point, whole, part)

    gradient = responses.gradient
    part = _share_of_step(game, point, objective, gradient, robot_after, humans_after)
    humans, paths = humans_after(part)
    return Plan(robot_after(part), humans), paths


def _no_responses(game: Game, point: Point) -> Responses:
    """Return what a Newton step has collected before any human has responded."""
    rewards = jax.tree.map(
        lambda part: jnp.zeros((game.number, *part.shape)), point.reward
    )
    couplings = jnp.zeros((game.number, len(point.path), *point.path.shape))
    return Responses(
        point.reward.gradient, rewards, couplings, jnp.asarray(point.plan.humans)
    )


def _respond(
    interaction: Interaction,
    point: Point,
    human: Index,
    responses: Responses,
) -> Responses:
    """Take a human's own step, and add what the robot earns through its response.

    Args:
        interaction: the situation.
        point: where the step starts.
        human: its number.
        responses: of the humans before this one.
    """
    own_game = swap_roles(interaction.game, human)
    around = trajectories_around(human, point.path, point.others)
    controls = point.plan.humans[human]
    path = point.others[human]
    objective = driving(own_game, interaction.state[1 + human], around)
    reward = expand(objective, controls, path)
    coupling = mixed_bends(own_game, path, around)

    wish = in_controls(point.wishes[human], reward.jacobian)
    answer = reward.solve(wish)
    through = slope_through(reward.jacobian, answer, coupling)
    gradient = responses.gradient + in_controls(through, point.reward.jacobian)

    rewards = jax.tree.map(
        lambda humans, one: humans.at[human].set(one), responses.reward, reward
    )
    return Responses(
        gradient,
        rewards,
        responses.coupling.at[human].set(coupling),
        responses.humans.at[human].set(improve(objective, controls, reward)),
    )


def _reaction(human: Index, responses: Responses, path_change: Trajectory) -> Controls:
    """Return ``J_i du_R = -H_i^-1 S_i^T B_i S_R du_R``, shortened like a Newton step.

    Args:
        human: number of the human.
        responses: of all humans.
        path_change: ``S_R du_R``, the change of the robot's trajectory.
    """
    reward = jax.tree.map(lambda part: part[human], responses.reward)
    coupling = jnp.swapaxes(responses.coupling[human], 0, 1)  # the robot's fields first
    slope = slope_change(coupling, path_change)
    return reward.step(in_controls(slope, reward.jacobian)).reshape(-1, 2)


def _humans_after(
    interaction: Interaction,
    count: Index,
    point: Point,
    whole: WholeStep,
    part: Scalar,
) -> tuple[HumansControls, Trajectories]:
    """Return the humans' controls and all others' trajectories after a share of a step.

    The humans have taken their own steps, and a part of their reactions.

    Args:
        interaction: the situation, and the humans who respond.
        count: number of humans who respond in this step.
        point: where the step starts.
        whole: the whole step.
        part: share of the reactions.
    """
    game = interaction.game

    def put(
        human: Index,
        now: tuple[jax.Array, Trajectories],
    ) -> tuple[jax.Array, Trajectories]:
        humans, paths = now
        car = interaction.state[1 + human]
        reacted = whole.humans[human] + part * whole.reactions[human]
        controls = bounded(game, car, reacted)
        path = move(game, car, controls)
        return humans.at[human].set(controls), paths.at[human].set(path)

    before = (jnp.asarray(point.plan.humans), point.others)
    return interaction.responders.fold(count, put, before)


def _share_of_step(
    game: Game,
    point: Point,
    objective: Objective,
    gradient: Vector,
    robot_after: Callable[[Scalar], Controls],
    humans_after: Callable[[Scalar], tuple[HumansControls, Trajectories]],
) -> Scalar:
    """Return the share of a whole step to take, by the robot's slopes at both its ends.

    See `ms_highway.numerics.convex_newton.share`. At the end of the step, the humans
    have taken their steps and reacted to the robot's.

    Args:
        game: that is played.
        point: where the step starts.
        objective: of the robot.
        gradient: of the robot at the start, with what it earns through the humans.
        robot_after: returns the robot's controls after a share of the step.
        humans_after: returns the humans' controls and all others' trajectories then.
    """
    full_step = robot_after(jnp.ones(()))
    change = full_step - point.plan.robot
    _, paths_with_reactions = humans_after(jnp.ones(()))
    path, path_change = jax.jvp(objective.path, (full_step,), (change,))
    slope_in_robot, slopes_in_others = game.payoff.slopes(path, paths_with_reactions)

    # The slope along the step at its end: of the reward in the robot's trajectory, of
    # the cost of its controls, and of the reward in the trajectories of those reacting.
    slope = jnp.sum(slope_in_robot * path_change)
    slope -= jnp.sum(jax.grad(objective.cost)(full_step) * change)
    _, paths_without_reactions = humans_after(jnp.zeros(()))
    reactions = paths_with_reactions - paths_without_reactions
    slope += jnp.sum(slopes_in_others * reactions)
    return share(gradient @ change.ravel(), slope)
