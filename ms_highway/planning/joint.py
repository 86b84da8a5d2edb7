"""Improve the robot's plan jointly with the responses of any number of humans, or of
none.

Under theory of mind, a human responds to the robot's plan: every step of the ascent
also improves the human's controls. All others drive as predicted. So the derivative of
the humans' controls in the robot's is block-diagonal, ``J_i = -H_i^-1 d2R_i / du_i
du_R``. The robot climbs along ``dR_R/du_R + sum_i J_i^T dR_R/du_i``, each responding
human along ``dR_i/du_i``. J is never formed (adjoint method): ``J_i^T dR_R/du_i``
follows from one linear response of the human to ``dR_R/du_i`` and from the derivatives
of its reward in both trajectories.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, NamedTuple, TypeVar

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
from ms_highway.numerics.convex_newton import Local, expand, improve, share
from ms_highway.numerics.second_derivatives import (
    response,
    second_order_expansion,
    trajectory_jacobian,
)
from ms_highway.numerics.solvers import Ascent, Solver
from ms_highway.planning.plans import Plan, Solution, best_start, driving, within_limits
from ms_highway.runtime.arrays import (
    Controls,
    HumansControls,
    Index,
    PerHuman,
    Rungs,
    Scalar,
    State,
    Trajectories,
    Trajectory,
    Vector,
)

Carry = TypeVar("Carry")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KnownResponders:
    """Humans that respond in every step, known before the call.

    Attributes:
        order: their numbers (static).
    """

    order: tuple[int, ...] = field(metadata={"static": True})

    @property
    def nobody(self) -> bool:
        """Whether no human responds."""
        return not self.order

    def most_steps(self, solver: Solver) -> Index:
        """Return the number of steps of the ascent at most."""
        return solver.most_steps(responds=not self.nobody)

    def robot_step_size(self, solver: Ascent) -> Scalar:
        """Return the length of the robot's gradient steps."""
        return solver.step_size

    def step_size(self, solver: Ascent, human: Index) -> Scalar:
        """Return the length of a human's gradient steps."""
        return solver.step_size

    def count(self, step: Index) -> Index:
        """Return the number of responding humans in a step."""
        return len(self.order)

    def fold(
        self, count: Index, function: Callable[[Index, Carry], Carry], carry: Carry
    ) -> Carry:
        """Apply a function to the number of every human who responds in a step, one by
        one.

        Args:
            count: number of humans who respond in the step, of `count`.
            function: takes the number of a human and the result so far.
            carry: first result.
        """
        if len(self.order) < 2:  # which needs no loop
            return function(self.order[0], carry) if self.order else carry
        return _fold(jnp.array(self.order), count, function, carry)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AssignedResponders:
    """The humans who respond under an assignment of models that JAX traces.

    Attributes:
        order: numbers of all humans, those who respond in most steps first.
        steps: number of the first steps in which each human responds, by its own
            number.
        robot_steps: number of the robot's steps at most.
        step_sizes: length of each human's gradient steps, by its own number; None for
            the planner's.
        robot_size: length of the robot's; None for the planner's.
    """

    order: Rungs
    steps: Rungs
    robot_steps: Index
    step_sizes: PerHuman | None = None
    robot_size: Scalar | None = None
    nobody: ClassVar[bool] = False

    def most_steps(self, solver: Solver) -> Index:
        """See `KnownResponders.most_steps`."""
        return self.robot_steps

    def robot_step_size(self, solver: Ascent) -> Scalar:
        """See `KnownResponders.robot_step_size`."""
        return solver.step_size if self.robot_size is None else self.robot_size

    def step_size(self, solver: Ascent, human: Index) -> Scalar:
        """See `KnownResponders.step_size`."""
        return solver.step_size if self.step_sizes is None else self.step_sizes[human]

    def count(self, step: Index) -> Index:
        """See `KnownResponders.count`."""
        return jnp.sum(self.steps > step)

    def fold(
        self, count: Index, function: Callable[[Index, Carry], Carry], carry: Carry
    ) -> Carry:
        """See `KnownResponders.fold`."""
        return _fold(self.order, count, function, carry)


def _fold(
    order: Rungs, count: Index, function: Callable[[Index, Carry], Carry], carry: Carry
) -> Carry:
    """Apply a function to the first ``count`` numbers of an order, one by one."""

    def respond(place: Index, carry: Carry) -> Carry:
        return function(order[place], carry)

    return jax.lax.fori_loop(0, count, respond, carry)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Interaction:
    """A situation, and the humans who respond to the robot's plan in it.

    Attributes:
        game: that is played.
        state: all cars now.
        responders: humans who respond.
    """

    game: Game
    state: State
    responders: KnownResponders | AssignedResponders


@jax.jit  # traced once for the human and the robot
def ascend(interaction: Interaction, start: Plan) -> Solution:
    """Improve the robot's controls and those of the humans who respond, by the
    planner's solver.

    * ``Ascent``: the paper's joint gradient steps.
    * ``Newton``, for horizons of seconds: the robot takes the steps of
      `ms_highway.numerics.convex_newton` on its own reward, with the gradient above.
      The share of a step depends on the robot's reward once the humans have responded,
      by their linear response ``J_i du_R`` and a step of their own.

    Args:
        interaction: the situation, and the humans who respond.
        start: scaled plan; humans who do not respond keep to it.
    """
    game = interaction.game
    state = interaction.state
    solver = game.planner.solver
    responders = interaction.responders
    take_step = _gradient_step if isinstance(solver, Ascent) else _newton_step

    # Newton steps begin within the limits, the robot's perhaps at a manoeuvre.
    humans = state[1 : 1 + game.number]
    if not isinstance(solver, Ascent) and not responders.nobody:
        start = within_limits(game, state, start)
    others = with_scripted(game, state, move_all(game, humans, start.humans))
    if not isinstance(solver, Ascent):
        begin = best_start(game, state[0], start.robot, others)
        start = start._replace(robot=bounded(game, state[0], begin))

    # What a step moves: the robot's controls and, if somebody may respond, the humans.
    def step_alone(step: Index, robot: Controls) -> Controls:
        plan, _ = take_step(interaction, step, Plan(robot, start.humans), others)
        return plan.robot

    def joint_step(
        step: Index, now: tuple[Plan, Trajectories]
    ) -> tuple[Plan, Trajectories]:
        return take_step(interaction, step, *now)

    most = responders.most_steps(solver)
    if responders.nobody:
        alone = solver.repeat(step_alone, start.robot, most, lambda robot: robot)
        return Solution(Plan(alone.point, start.humans), alone.steps, alone.converged)
    joint = solver.repeat(joint_step, (start, others), most, lambda now: now[0])
    plan, _ = joint.point
    return Solution(plan, joint.steps, joint.converged)


def plan_against(
    game: Game, state: State, humans: HumansControls, start: Plan
) -> Solution:
    """Optimise the robot's controls against fixed controls of the humans, from a start."""
    nobody = KnownResponders(())
    return ascend(Interaction(game, state, nobody), Plan(start.robot, humans))


def trajectories_around(
    human: Index, robot: Trajectory, others: Trajectories
) -> Trajectories:
    """Return the trajectories of all others from a human's side, the robot's first.

    Args:
        human: its number.
        robot: trajectory of the robot.
        others: trajectories of all cars around the robot.
    """
    if isinstance(human, int):
        rest = jnp.delete(others, human, axis=0)
    else:
        rest = others[jnp.asarray(others_of(len(others)))[human]]
    return jnp.concatenate([robot[None], rest])


def _gradient_step(
    interaction: Interaction, step: Index, plan: Plan, others: Trajectories
) -> tuple[Plan, Trajectories]:
    """Take a gradient step of the robot and of the humans who respond."""
    game = interaction.game
    state = interaction.state
    responders = interaction.responders
    count = responders.count(step)
    solver = game.planner.solver
    assert isinstance(solver, Ascent)
    drive = partial(move, game, state[0])
    robot = drive(plan.robot)
    along_robot, along_others = game.payoff.slopes(robot, others)

    def respond(
        human: Index, now: tuple[Trajectory, jax.Array, Trajectories]
    ) -> tuple[Trajectory, jax.Array, Trajectories]:
        slope, humans, paths = now
        own = swap_roles(game, human)
        car = state[1 + human]
        path = partial(move, own, car)

        # The human's reward to second order in its controls.
        around = trajectories_around(human, robot, others)
        derivatives = own.payoff.second_order(others[human], around)
        cost = partial(discomfort, own, car)
        expansion = second_order_expansion(
            path, plan.humans[human], derivatives.slope, derivatives.own, cost
        )

        # What the robot earns through the human's response to its plan.
        jacobian = expansion.jacobian.reshape(-1, plan.robot.size)
        pulled = along_others[human].ravel() @ jacobian
        pushed = response(game.influence, expansion.hessian, pulled)
        slope = slope + _mixed(expansion.jacobian @ pushed, derivatives.partner)

        # The human's own step.
        size = responders.step_size(solver, human)
        climbed = plan.humans[human] + size * expansion.gradient.reshape(-1, 2)
        controls = bounded(own, car, climbed)
        return (
            slope,
            humans.at[human].set(controls),
            paths.at[human].set(path(controls)),
        )

    start = (along_robot, jnp.asarray(plan.humans), others)
    slope, humans, paths = responders.fold(count, respond, start)

    # The robot's step, along its reward and what it earns through the humans.
    jacobian = trajectory_jacobian(drive, plan.robot).reshape(slope.size, -1)
    uphill = (slope.ravel() @ jacobian).reshape(-1, 2)
    gradient = uphill - jax.grad(partial(discomfort, game, state[0]))(plan.robot)
    climbed = plan.robot + responders.robot_step_size(solver) * gradient
    return Plan(bounded(game, state[0], climbed), humans), paths


def _mixed(moved: Trajectory, bends: Bends) -> Trajectory:
    """Return how the slope in one trajectory changes if another one moves, by mixed
    second derivatives.
    """
    return jnp.sum(bends * moved[:, None], axis=0)


class _Responses(NamedTuple):
    """What the loop over the responding humans collects."""

    slope: Vector  # of the robot's reward in its controls, through the humans
    local: Local  # around the controls of each human
    mixed: Float[
        jax.Array, "humans fields fields steps"
    ]  # second derivatives in its trajectory, then the robot's
    humans: Float[jax.Array, "humans steps 2"]  # improved


def _newton_step(
    interaction: Interaction, step: Index, plan: Plan, others: Trajectories
) -> tuple[Plan, Trajectories]:
    """Take a Newton step of the robot and of the humans who respond.

    Args:
        interaction: the situation, and the humans who respond.
        step: its number.
        plan: before the step.
        others: trajectories of all others under it.
    """
    game = interaction.game
    state = interaction.state
    path = move(game, state[0], plan.robot)
    driver = driving(game, state[0], others)
    along_robot, along_others = game.payoff.slopes(path, others)
    robot = expand(driver, plan.robot, path, along_robot)
    responders = interaction.responders
    if responders.nobody:  # so that the robot climbs its own reward
        return Plan(improve(driver, plan.robot, robot), plan.humans), others

    # Each human's step, and what the robot earns through its response.
    count = responders.count(step)

    def respond(human: Index, responses: _Responses) -> _Responses:
        own = swap_roles(game, human)
        around = trajectories_around(human, path, others)
        now = plan.humans[human]
        own_path = others[human]
        wanted = driving(own, state[1 + human], around)
        local = expand(wanted, now, own_path)
        mixed = mixed_bends(own, own_path, around)
        pulled = along_others[human].ravel() @ local.jacobian.reshape(-1, now.size)
        pushed = local.solve(pulled)
        through = _mixed(local.jacobian @ pushed, mixed)
        slope = through.ravel() @ robot.jacobian.reshape(through.size, -1)
        return _Responses(
            responses.slope + slope,
            jax.tree.map(
                lambda all_of, one: all_of.at[human].set(one), responses.local, local
            ),
            responses.mixed.at[human].set(mixed),
            responses.humans.at[human].set(improve(wanted, now, local)),
        )

    nothing = jax.tree.map(lambda part: jnp.zeros((game.number, *part.shape)), robot)
    unmixed = jnp.zeros((game.number, len(path), *path.shape))
    none = _Responses(robot.gradient, nothing, unmixed, jnp.asarray(plan.humans))
    responses = responders.fold(count, respond, none)

    # The robot's whole step, and each human's linear reaction to it.
    whole_step = robot.step(responses.slope)
    ahead = robot.jacobian @ whole_step

    def react(human: Index, reactions: jax.Array) -> jax.Array:
        local = jax.tree.map(lambda part: part[human], responses.local)
        change = _mixed(ahead, jnp.swapaxes(responses.mixed[human], 0, 1))
        wanted = local.step(change.ravel() @ local.jacobian.reshape(change.size, -1))
        return reactions.at[human].set(wanted.reshape(-1, 2))

    reactions = responders.fold(count, react, jnp.zeros_like(plan.humans))

    def paths_after(part: Scalar) -> tuple[HumansControls, Trajectories]:
        """Return the humans' controls and trajectories after their steps and a part of
        the reactions.
        """

        def put(
            human: Index, now: tuple[jax.Array, Trajectories]
        ) -> tuple[jax.Array, Trajectories]:
            humans, paths = now
            car = state[1 + human]
            own = bounded(game, car, responses.humans[human] + part * reactions[human])
            return humans.at[human].set(own), paths.at[human].set(move(game, car, own))

        return responders.fold(count, put, (jnp.asarray(plan.humans), others))

    def robot_after(part: Scalar) -> Controls:
        return bounded(game, state[0], plan.robot + part * whole_step.reshape(-1, 2))

    # How much of the step to take, by the robot's gain along it at its end.
    tried = robot_after(jnp.ones(()))
    change = tried - plan.robot
    _, full_paths = paths_after(jnp.ones(()))
    path, moved = jax.jvp(driver.path, (tried,), (change,))
    along_robot, along_others = game.payoff.slopes(path, full_paths)
    gain = jnp.sum(along_robot * moved)
    gain -= jnp.sum(jax.grad(driver.cost)(tried) * change)
    _, still_paths = paths_after(jnp.zeros(()))
    gain += jnp.sum(along_others * (full_paths - still_paths))
    part = share(responses.slope @ change.ravel(), gain)
    humans, paths = paths_after(part)
    return Plan(robot_after(part), humans), paths


def mixed_bends(game: Game, own: Trajectory, others: Trajectories) -> Bends:
    """Return the second derivatives of a human's reward in its trajectory, then in the
    robot's.

    The package's features are sums over the other cars, so that all but the robot are
    left out; user-defined features need not be such sums.
    """
    if not game.robot.own:
        leader = 1 if game.scene.leader == 1 else None
        scene = replace(game.scene, obstacles=game.scene.obstacles[:0], leader=leader)
        game = replace(game, scene=scene)
        others = others[:1]
    return game.payoff.second_order(own, others).partner
