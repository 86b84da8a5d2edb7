"""Improve the robot's plan jointly with the humans' responses: theory of mind about one human or several.

A human under theory of mind responds to the robot's plan; all others drive as predicted. So the derivative of the
humans' controls in the robot's is block-diagonal, ``J_i = -H_i^-1 d2R_i / du_i du_R``. The robot climbs along
``dR_R/du_R + sum_i J_i^T dR_R/du_i``, each human along ``dR_i/du_i``. J is never formed (adjoint method):
``J_i^T dR_R/du_i`` follows from one linear response of the human to ``dR_R/du_i`` and from the derivatives of its
reward in both trajectories.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeVar

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
    with_scripted,
)
from ms_highway.game.payoff import Bends
from ms_highway.numerics.convex_newton import Local, expand, improve, share, until_still
from ms_highway.numerics.second_derivatives import response, second_order_expansion
from ms_highway.numerics.solvers import projected_ascent
from ms_highway.planning.plans import Plan, best_start, driving, within_limits
from ms_highway.runtime.arrays import (
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


class Interaction(NamedTuple):
    """A situation, and the humans who respond to the robot's plan in it.

    Attributes:
        game: that is played.
        state: all cars now.
        order: numbers of the humans, those who respond first; None where the only human responds.
        responding: number of humans who respond.
    """

    game: Game
    state: State
    order: Rungs | None = None
    responding: Index = 1

    def fold(self, function: Callable[[Index, Carry], Carry], carry: Carry) -> Carry:
        """Apply a function to the number of every human who responds, one after the other."""
        order = self.order
        if order is None:
            return function(0, carry)
        return jax.lax.fori_loop(0, self.responding, lambda place, carry: function(order[place], carry), carry)

    def around(self, human: Index, robot: Trajectory, others: Trajectories) -> Trajectories:
        """Return the trajectories of all others from a human's side, the robot's first, from those around the robot."""
        if self.game.number == 1:
            return jnp.concatenate([robot[None], others[1:]])
        return jnp.concatenate([robot[None], others[jnp.asarray(others_of(len(others)))[human]]])


def joint_ascent(interaction: Interaction, start: Plan, steps: tuple[Index, Index] | None = None) -> Plan:
    """Improve the robot's controls and those of the humans who respond.

    * The planner's solver ``gradient`` (and ``newton``): the paper's joint gradient steps.
    * ``convex_newton``, for horizons of seconds: the robot takes the steps of `ms_highway.numerics.convex_newton` on
      its own reward, with the gradient above. The share of a step depends on the robot's reward once the humans have
      responded, by their linear response ``J_i du_R`` and a step of their own.

    Args:
        interaction: the situation, and the humans who respond.
        start: scaled plan; humans who do not respond keep to it.
        steps: their largest numbers, if nobody responds and if a human does; the planner's by default.
    """
    game, state = interaction.game, interaction.state
    limit = partial(within_limits, game, state)
    alone, joint = steps or game.planner.steps
    if game.planner.solver != "convex_newton":
        return projected_ascent(game.planner, partial(_direction, interaction), start, limit, alone)
    begin = limit(start)
    others = with_scripted(game, state, move_all(game, state[1 : 1 + game.number], begin.humans))
    robot = bounded(game, state[0], best_start(game, state[0], begin.robot, others))
    most = joint if interaction.order is None else jnp.where(interaction.responding > 0, joint, alone)
    first = begin._replace(robot=robot), others
    return until_still(lambda now: _newton_step(interaction, *now), first, most, lambda now: now[0])[0]


def _direction(interaction: Interaction, plan: Plan) -> Plan:
    """Return the direction of a joint gradient step."""
    game, state = interaction.game, interaction.state
    robot, pull_robot = jax.vjp(partial(move, game, state[0]), plan.robot)
    humans, pull_humans = jax.vjp(partial(move_all, game, state[1 : 1 + game.number]), plan.humans)
    others = with_scripted(game, state, humans)
    along_robot, along_others = game.payoff.slopes(robot, others)
    pulled = pull_humans(along_others[: game.number])[0]

    def respond(human: Index, slopes: Plan) -> Plan:
        own, car = swap_roles(game, human), state[1 + human]
        slope, bends, mixed = own.payoff.second_order(others[human], interaction.around(human, robot, others))
        cost = partial(discomfort, own, car)
        expansion = second_order_expansion(partial(move, own, car), plan.humans[human], slope, bends, cost)
        pushed = response(game.influence, expansion.hessian, pulled[human].ravel())
        climbs = slopes.humans.at[human].set(expansion.gradient.reshape(-1, 2))
        return Plan(slopes.robot + _mixed(expansion.jacobian @ pushed, mixed), climbs)

    along, humans_slopes = interaction.fold(respond, Plan(along_robot, jnp.zeros_like(plan.humans)))
    eased = pull_robot(along)[0] - jax.grad(partial(discomfort, game, state[0]))(plan.robot)
    return Plan(eased, humans_slopes)


def _mixed(moved: Trajectory, bends: Bends) -> Trajectory:
    """Return how the slope in one trajectory changes if another one moves, by mixed second derivatives."""
    return jnp.sum(bends * moved[:, None], axis=0)


class _Responses(NamedTuple):
    """What the loop over the responding humans collects."""

    slope: Vector  # of the robot's reward in its controls, through the humans
    local: Local  # around the controls of each human
    mixed: Float[jax.Array, "humans fields fields steps"]  # second derivatives in its trajectory, then the robot's
    humans: HumansControls  # improved


def _newton_step(interaction: Interaction, plan: Plan, others: Trajectories) -> tuple[Plan, Trajectories]:
    """Take a step of the robot and of the humans who respond, from a plan and the others' trajectories under it."""
    game, state = interaction.game, interaction.state
    path, driver = move(game, state[0], plan.robot), driving(game, state[0], others)
    along_robot, along_others = game.payoff.slopes(path, others)
    robot = expand(driver, plan.robot, along_robot)

    def respond(human: Index, responses: _Responses) -> _Responses:
        own, around, now = swap_roles(game, human), interaction.around(human, path, others), plan.humans[human]
        wanted = driving(own, state[1 + human], around)
        local, mixed = expand(wanted, now), mixed_bends(own, others[human], around)
        pushed = local.solve(along_others[human].ravel() @ local.jacobian.reshape(-1, now.size))
        through = _mixed(local.jacobian @ pushed, mixed)
        return _Responses(
            responses.slope + through.ravel() @ robot.jacobian.reshape(through.size, -1),
            jax.tree.map(lambda all_of, one: all_of.at[human].set(one), responses.local, local),
            responses.mixed.at[human].set(mixed),
            responses.humans.at[human].set(improve(wanted, now, local)),
        )

    nothing = jax.tree.map(lambda part: jnp.zeros((game.number, *part.shape)), robot)
    unmixed = jnp.zeros((game.number, len(path), *path.shape))
    responses = interaction.fold(respond, _Responses(robot.gradient, nothing, unmixed, plan.humans))
    step = robot.step(responses.slope)
    ahead = robot.jacobian @ step

    def react(human: Index, reactions: HumansControls) -> HumansControls:
        local, mixed = jax.tree.map(lambda each: each[human], (responses.local, responses.mixed))
        change = _mixed(ahead, jnp.swapaxes(mixed, 0, 1))
        wanted = local.step(change.ravel() @ local.jacobian.reshape(change.size, -1))
        return reactions.at[human].set(wanted.reshape(-1, 2))

    reactions = interaction.fold(react, jnp.zeros_like(plan.humans))

    def after(part: Scalar) -> tuple[Plan, Trajectories]:
        def put(human: Index, sides: tuple[HumansControls, Trajectories]) -> tuple[HumansControls, Trajectories]:
            car = state[1 + human]
            own = bounded(game, car, responses.humans[human] + part * reactions[human])
            return sides[0].at[human].set(own), sides[1].at[human].set(move(game, car, own))

        sides, paths = interaction.fold(put, (plan.humans, others))
        return Plan(bounded(game, state[0], plan.robot + part * step.reshape(-1, 2)), sides), paths

    (whole, reached), (none, held) = after(jnp.ones(())), after(jnp.zeros(()))
    gone = whole.robot - none.robot
    path, moved = jax.jvp(driver.path, (whole.robot,), (gone,))
    along_robot, along_others = game.payoff.slopes(path, reached)
    gain = jnp.sum(along_robot * moved) + jnp.sum(along_others * (reached - held))
    gain -= jnp.sum(jax.grad(driver.cost)(whole.robot) * gone)
    return after(share(responses.slope @ gone.ravel(), gain))


def mixed_bends(game: Game, own: Trajectory, others: Trajectories) -> Bends:
    """Return the second derivatives of a human's reward in its trajectory, then in the robot's.

    The package's features are sums over the other cars, so that all but the robot are left out; user-defined features
    need not be such sums.
    """
    if not game.robot.own:
        leader = 1 if game.scene.leader == 1 else None
        scene = replace(game.scene, obstacles=game.scene.obstacles[:0], leader=leader)
        game, others = replace(game, scene=scene), others[:1]
    return game.payoff.second_order(own, others).partner
