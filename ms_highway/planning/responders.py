"""Say which humans respond to the robot's plan, and in how many steps of its ascent.

The joint ascent (`ms_highway.planning.joint`) asks for the same numbers in two cases.
`KnownResponders` are known before JAX traces a plan, so that its program holds only
what these humans need. `AssignedResponders` follow from an assignment of models that
JAX traces, so that one program plans under all assignments.
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
HumanNumbers: TypeAlias = Int[Array, "humans"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KnownResponders:
    """Humans who respond in every step, known before the call.

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
        """Return the number of humans who respond in a step."""
        return len(self.order)

    def fold(
        self,
        count: Index,
        function: Callable[[Index, Carry], Carry],
        carry: Carry,
    ) -> Carry:
        """Apply a function to the number of every human who responds, one by one.

        Args:
            count: number of humans who respond in the step, of `count`.
            function: takes the number of a human and the result so far.
            carry: first result.
        """
        if not self.order:
            return carry
        if len(self.order) == 1:  # needs no loop, and its number is static
            return function(self.order[0], carry)
        return _fold(jnp.array(self.order), count, function, carry)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AssignedResponders:
    """Humans who respond under an assignment of models that JAX traces.

    Attributes:
        order: numbers of all humans, those who respond in most steps first.
        steps: number of the first steps in which each human responds, by its own
            number; 0 if it does not respond.
        robot_steps: number of the robot's steps at most.
        step_sizes: length of each human's gradient steps, by its own number; None for
            the planner's.
        robot_size: length of the robot's; None for the planner's.
    """

    order: HumanNumbers
    steps: HumanNumbers
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
        """See `KnownResponders.count`; they are the first ones in the order."""
        return jnp.sum(self.steps > step)

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
    order: HumanNumbers,
    count: Index,
    function: Callable[[Index, Carry], Carry],
    carry: Carry,
) -> Carry:
    """Apply a function to the first ``count`` numbers of an order, one by one."""

    def respond(place: Index, carry: Carry) -> Carry:
        return function(order[place], carry)

    return jax.lax.fori_loop(0, count, respond, carry)
