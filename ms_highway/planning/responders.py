"""Say which humans respond to the robot's plan, and in how many steps of its ascent.

The joint ascent (`ms_highway.planning.joint`) has to know who responds, in how many
steps and with which step size. `KnownResponders` are known before JAX traces a plan, so
that its program holds only what these humans need. `AssignedResponders` follow from an
assignment of models that JAX traces, so that one program plans under all assignments.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias, TypeVar

import jax
from jax import numpy as jnp
from jaxtyping import Int

from ms_highway.game.game import Game
from ms_highway.numerics.solvers import Ascent, Solver
from ms_highway.runtime.arrays import Array, Index, PerHuman, Scalar, State

Carry = TypeVar("Carry")
HumanIndices: TypeAlias = Int[Array, "humans"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KnownResponders:
    """Humans who respond in every step, known before the call.

    Attributes:
        order: their indices (static).
    """

    order: tuple[int, ...] = field(metadata={"static": True})

    @property
    def surely_nobody(self) -> bool:
        """Whether it is known before JAX traces the plan that nobody responds."""
        return not self.order

    def most_steps(self, solver: Solver) -> Index:
        """Return the largest number of steps of the ascent."""
        return solver.most_steps(responds=not self.surely_nobody)

    def robot_step_size(self, solver: Ascent) -> Scalar:
        """Return the step size of the robot: length of a step per unit of gradient."""
        return solver.step_size

    def step_size(self, solver: Ascent, human: Index) -> Scalar:
        """Return the step size of a human, see `robot_step_size`."""
        return solver.step_size

    def count(self, iteration: Index) -> Index:
        """Return the number of humans who respond in a step of the ascent."""
        return len(self.order)

    def fold(
        self,
        count: Index,
        function: Callable[[Index, Carry], Carry],
        carry: Carry,
    ) -> Carry:
        """Apply a function to the index of every human who responds, one by one.

        Args:
            count: how many humans respond in the step, as `count` returns it; here, all
                humans of the order do.
            function: takes the index of a human and the result so far.
            carry: first result.
        """
        if not self.order:
            return carry
        if len(self.order) == 1:  # needs no loop, and its index is static
            return function(self.order[0], carry)
        return _fold(jnp.array(self.order), count, function, carry)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AssignedResponders:
    """Humans who respond under an assignment of models that JAX traces.

    Attributes:
        order: indices of all humans, sorted by their ``steps``, the largest first.
        steps: human i responds in the first ``steps[i]`` steps of the ascent; then its
            plan stays, and its influence drops out. 0 if it does not respond.
        robot_steps: largest number of the robot's steps.
        step_sizes: step size of each human; None for the planner's.
        robot_size: step size of the robot; None for the planner's.
        surely_nobody: False, as this is not known before JAX traces the plan.
    """

    order: HumanIndices
    steps: HumanIndices
    robot_steps: Index
    step_sizes: PerHuman | None = None
    robot_size: Scalar | None = None
    surely_nobody: ClassVar[bool] = False

    def most_steps(self, solver: Solver) -> Index:
        """See `KnownResponders.most_steps`."""
        return self.robot_steps

    def robot_step_size(self, solver: Ascent) -> Scalar:
        """See `KnownResponders.robot_step_size`."""
        return solver.step_size if self.robot_size is None else self.robot_size

    def step_size(self, solver: Ascent, human: Index) -> Scalar:
        """See `KnownResponders.step_size`."""
        return solver.step_size if self.step_sizes is None else self.step_sizes[human]

    def count(self, iteration: Index) -> Index:
        """See `KnownResponders.count`; they are the first ones in the order."""
        return jnp.sum(self.steps > iteration)

    def fold(
        self,
        count: Index,
        function: Callable[[Index, Carry], Carry],
        carry: Carry,
    ) -> Carry:
        """See `KnownResponders.fold`."""
        return _fold(self.order, count, function, carry)


Responders: TypeAlias = KnownResponders | AssignedResponders


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
    responders: Responders


def _fold(
    order: HumanIndices,
    count: Index,
    function: Callable[[Index, Carry], Carry],
    carry: Carry,
) -> Carry:
    """Apply a function to the first ``count`` indices of an order, one by one."""

    def apply_to_next(place: Index, carry: Carry) -> Carry:
        human = order[place]
        return function(human, carry)

    return jax.lax.fori_loop(0, count, apply_to_next, carry)
