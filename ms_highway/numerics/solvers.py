"""Solvers of plans, and the number and size of gradient steps.

A solver says how many steps an ascent takes; the step itself is that of
`ms_highway.planning.joint`. It holds its own settings.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import ClassVar, Generic, Literal, NamedTuple, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import PyTree

from ms_highway.numerics.convex_newton import NEWTON_STEPS, Iterate, until_still
from ms_highway.runtime.arrays import Control, Flag, Index, Scalar

SolverName: TypeAlias = Literal["gradient", "convex_newton"]
"""Names of `Ascent` and `Newton` in configurations."""


@dataclass(frozen=True)
class GradientSteps:
    """Set the number and the size of gradient steps; the scenes are the paper's."""

    paper_number: int = 20
    """Number of steps of a plan in the paper."""
    paper_size: float = 0.03
    """Length of these steps per unit of gradient."""
    counted_size: float = 0.1
    """Length of the steps of a model with its own number of them. The reward of a plan
    depends on the summed length of its steps: 6 of them earn as much as the paper's 20,
    and more of them earn more. At the paper's horizon, some plans overshoot and collide
    from 0.15 on.
    """
    share_of_longest: float = 0.6
    """Share of the `longest_step` that plans take where the wanted step is longer."""
    steepest_weight: float = 1000.0
    """Largest weight on a squared lateral distance [1 / length unit^2]."""
    paper_speed: float = 0.6
    """The paper's speed limit [length units per second]."""
    max_number: int = 5000
    """Largest number of steps of a plan: more take seconds."""


GRADIENT_STEPS = GradientSteps()


class Repeated(NamedTuple, Generic[Iterate]):
    """Result of a repeated step.

    Attributes:
        point: the iterate after the last step.
        steps: number of steps that were computed.
        converged: whether the last one hardly moved the controls.
    """

    point: Iterate
    steps: Index
    converged: Flag


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ascent:
    """Take a fixed number of gradient steps, as the paper does.

    Attributes:
        step_size: length of a step per unit of gradient.
        iterations: number of steps (static).
        continues: whether plans start from the rest of the last plan, a warm start
            (static).
        smooth: whether plans climb a reward without jumps, see `ms_highway.game.payoff`
            (static).
    """

    step_size: Scalar = 0.03
    iterations: int = field(default=20, metadata={"static": True})
    continues: bool = field(default=False, metadata={"static": True})
    smooth: bool = field(default=False, metadata={"static": True})

    def most_steps(self, responds: bool) -> int:
        """Return the number of steps of a plan, whether or not humans respond to it."""
        return self.iterations

    def with_steps(self, number: int, longest: Scalar) -> "Ascent":
        """Return the solver with its own number of steps, as long as is safe.

        A step has the counted size of `GradientSteps` or, if that is shorter, its
        share of the longest step.

        Args:
            number: of steps.
            longest: step that does not overshoot, see `longest_step`.
        """
        most = GRADIENT_STEPS.share_of_longest * longest
        length = jnp.minimum(GRADIENT_STEPS.counted_size, most)
        return replace(self, iterations=number, step_size=length)

    def of_human(self) -> "Ascent":
        """Return the solver for humans, without continuing the last plan."""
        return replace(self, continues=False)

    def repeat(
        self,
        step: Callable[[Index, Iterate], Iterate],
        start: Iterate,
        most: Index,
        controls_of: Callable[[Iterate], PyTree],
    ) -> Repeated[Iterate]:
        """Repeat a step a number of times.

        Args:
            step: takes the index of the step and an iterate, and returns the next one.
            start: first iterate.
            most: number of steps.
            controls_of: returns those of an iterate; the norm of their change tells
                whether the last step moved them.
        """

        def iterate(
            index: Index,
            now: tuple[Iterate, Scalar],
        ) -> tuple[Iterate, Scalar]:
            before, _ = now
            after = step(index, before)

            # The squared norm of the change of all controls.
            change = jax.tree.map(jnp.subtract, controls_of(after), controls_of(before))
            squared = sum(jnp.sum(array**2) for array in jax.tree.leaves(change))
            return after, squared

        first = (start, jnp.float32(jnp.inf))
        point, squared = jax.lax.fori_loop(0, most, iterate, first)

        # Converged as Newton steps are, by the same tolerance.
        return Repeated(point, most, squared < NEWTON_STEPS.tolerance**2)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Newton:
    """Take a few Newton steps up a smooth reward, for horizons of several seconds.

    Similar starts lead to similar plans, see `ms_highway.numerics.convex_newton`.

    Attributes:
        ease: weight on the control effort, a cost beside the reward per squared scaled
            control that changes the velocity, so that plans do not follow every bump of
            the reward at once; less for steering at low speed, see
            `ms_highway.game.game.discomfort`.
        steps: largest number of steps where no human responds to them (static).
        joint_steps: largest number of steps to which humans respond (static).
        continues: whether plans start from the rest of the last plan (warm start) or
            from a simple manoeuvre that earns much more, see
            `ms_highway.planning.plans.best_start` (static).
    """

    ease: Scalar = 0.0
    steps: int = field(default=NEWTON_STEPS.steps, metadata={"static": True})
    joint_steps: int = field(
        default=NEWTON_STEPS.joint_steps, metadata={"static": True}
    )
    continues: bool = field(default=False, metadata={"static": True})
    smooth: ClassVar[bool] = True

    def most_steps(self, responds: bool) -> int:
        """Return the largest number of steps, with humans who respond or without."""
        return self.joint_steps if responds else self.steps

    def with_steps(self, number: int, longest: Scalar) -> "Newton":
        """Return the solver with its own number of steps, see `Ascent.with_steps`."""
        return replace(self, steps=number, joint_steps=number)

    def of_human(self) -> "Newton":
        """Return the solver for humans, which neither eases nor continues plans."""
        return replace(self, continues=False, ease=0.0)

    def repeat(
        self,
        step: Callable[[Index, Iterate], Iterate],
        start: Iterate,
        most: Index,
        controls_of: Callable[[Iterate], PyTree],
    ) -> Repeated[Iterate]:
        """Repeat a step until it hardly moves the controls, see `Ascent.repeat`."""
        return Repeated(*until_still(step, start, most, controls_of))


Solver: TypeAlias = Ascent | Newton


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Planner:
    """Horizon, limits and solver of plans.

    Attributes:
        control_scale: unit of each control; steps are taken in ``u / control_scale``,
            so that a larger scale means larger steps of that control. ``(1, 1)`` in the
            units of the reward is the plain gradient.
        control_limit: bound on the magnitude of each control, infinite for none.
        grip: total acceleration that tyres hold [m/s^2]; plans are cut down to it and
            do not reverse, see `ms_highway.game.game.bounded`. None for no such limit.
        solver: improves plans.
        horizon: number of planned controls, K in the paper (static).
    """

    control_scale: Control
    control_limit: Control
    grip: Scalar | None = None
    solver: Solver = Ascent()
    horizon: int = field(default=5, metadata={"static": True})


# Number and size of gradient steps


@dataclass(frozen=True)
class PlanningSettings:
    """Horizon, time step and gradient steps of the plans of robot and human alike.

    They depend on each other: the reward's curvature in the controls grows with the
    fourth power of the horizon, and a gradient step longer than `longest_step`
    overshoots. With K = 10, the paper's step size of 0.03 makes theory of mind earn -9
    in Merger; 60 steps of 0.01 earn 6.4. `gradient_steps` chooses the values that are
    None.

    Attributes:
        horizon: number of planned controls, K.
        time_step: of plans and world [s].
        iterations: number of gradient steps, or None.
        step_size: length of a gradient step per unit of gradient, or None.
    """

    horizon: int = 5
    time_step: float = 0.1
    iterations: int | None = None
    step_size: float | None = None


PAPER_PLANNING = PlanningSettings()
"""The paper's: half a second ahead, in its gradient steps."""


@cache
def gradient_steps(planning: PlanningSettings) -> tuple[int, float]:
    """Return the number and the size of a plan's gradient steps.

    They are chosen where the settings leave them open.

    The step size is the paper's 0.03 or, if that is shorter, 0.6 of the `longest_step`.
    The number of steps times their size is that of the paper, 20 times 0.03, but there
    are at least 20 steps. With time steps of 0.1 s, these are 20 steps of 0.03 up to K
    = 7, 58 of 0.0104 at K = 10, and 929 of 0.00065 at K = 20.
    """
    paper_number = GRADIENT_STEPS.paper_number
    paper_size = GRADIENT_STEPS.paper_size

    # The step size.
    longest = float(longest_step(planning.horizon, planning.time_step))
    safe = GRADIENT_STEPS.share_of_longest * longest
    size = planning.step_size or min(paper_size, safe)

    # The number of steps.
    for_same_sum = round(paper_number * paper_size / size)
    number = planning.iterations or max(paper_number, for_same_sum)
    return number, size


def longest_step(horizon: int, time_step: Scalar) -> Scalar:
    """Return the longest gradient step that does not overshoot an optimum.

    The optimum is that of the paper's steepest feature, a squared lateral distance.

    To first order, control j moves the car sideways by ``y_k = v dt^2 max(k - j, 0)``
    at step k, both from 0. With s the largest singular value of this matrix, the
    curvature of ``-w y^2``, summed over the steps, is at most ``2 w s^2``. The inverse
    of the curvature is the step that reaches the optimum at once.

    Args:
        horizon: number of planned controls.
        time_step: dt [s]; JAX may trace it.
    """
    # dy_k / du_j per dt^2 [horizon, horizon], and its largest singular value.
    steps = np.arange(horizon)
    delays = np.maximum(np.subtract.outer(steps, steps), 0)
    sideways = GRADIENT_STEPS.paper_speed * delays
    singular_value = float(np.linalg.norm(sideways, 2))

    # The inverse of the curvature; a horizon of one step does not move sideways.
    curvature = 2 * GRADIENT_STEPS.steepest_weight * singular_value**2  # per dt^4
    longest = 1 / curvature if curvature > 0 else np.inf
    return longest / time_step**4
