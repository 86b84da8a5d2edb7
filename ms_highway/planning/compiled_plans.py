"""Plan with a human model for each human, by functions that are compiled once.

`plan_for` is the pure function, and `CompiledPlans` calls and times it. `plan` is for
users.
"""

from collections.abc import Sequence
from functools import cache, partial
from typing import ClassVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Int

from ms_highway.game.dynamics import facing
from ms_highway.game.features import check_user_features
from ms_highway.game.game import Game, constant_velocity, pair
from ms_highway.numerics.solvers import Ascent
from ms_highway.planning.human_models import (
    HumanModel,
    Naive,
    own_solver,
    own_start,
    scaled_prediction,
    warn_of_limits,
    within,
)
from ms_highway.planning.joint import joint_ascent, plan_against
from ms_highway.planning.ladders import human_model
from ms_highway.planning.plans import Plan, Solution, cold_start
from ms_highway.planning.responders import (
    AssignedResponders,
    Interaction,
    KnownResponders,
)
from ms_highway.planning.way_out import Escape, keep_way_out
from ms_highway.runtime.arrays import (
    Array,
    Control,
    Controls,
    HumansControls,
    Index,
    Rungs,
    State,
    for_each,
    for_numbers,
)
from ms_highway.runtime.compilation import (
    Compiled,
    ReusedArguments,
    jit_quickly,
    single,
    timed,
    warm_up,
)
from ms_highway.runtime.process import refuse_after_fork


def plan_for(
    models: tuple[HumanModel, ...],
    game: Game,
    state: State,
    rungs: Rungs | None,
    start: Plan | None = None,
) -> Solution:
    """Plan with a model for each human.

    All controls keep to `ms_highway.game.game.bounded`.

    A single model is known before the call, so that the program holds only what it
    needs. With several models, one program plans under all assignments: for each model
    that predicts, a loop takes one round for every human on it; in each step of the
    ascent, a loop takes one round for every responding human. So the time of a plan is
    a sum over the humans.

    Args:
        models: human models.
        game: with the humans' rewards as the robot believes them.
        state: all cars now.
        rungs: of every human, its model's place; None for a single model.
        start: scaled plan to improve; None for `ms_highway.planning.plans.cold_start`.
    """
    if start is None:
        start = cold_start(game, state)
    last = Plan(*map(jnp.asarray, start))
    rungs = None if len(models) == 1 else rungs

    # A model either predicts the controls of its humans, who keep to them, or lets its
    # humans respond, perhaps from a start of its own.
    humans_now = state[1 : 1 + game.number]
    expected: HumansControls = constant_velocity(game, humans_now)
    begin = last
    for rung, model in enumerate(models):
        chosen = None if rungs is None else jnp.asarray(rungs) == rung
        has_own_start = type(model).start is not HumanModel.start
        if model.responds and has_own_start:
            begin = _with_own_starts(model, chosen, game, state, last, begin)
        if not model.responds and type(model) is not Naive:
            expected = _with_predictions(model, chosen, game, state, last, expected)

    if rungs is None:
        (model,) = models
        return _plan_for_one(model, game, state, begin, expected)
    responders = assigned_responders(models, game, rungs)
    responds = responders.steps > 0
    humans = jnp.where(responds[:, None, None], begin.humans, expected)
    interaction = Interaction(game, state, responders)
    return joint_ascent(interaction, Plan(begin.robot, humans))


def _plan_for_one(
    model: HumanModel,
    game: Game,
    state: State,
    begin: Plan,
    expected: HumansControls,
) -> Solution:
    """Plan with the same model for all humans, known before the call.

    Args:
        model: of all humans.
        game: that is played.
        state: all cars now.
        begin: scaled plan from which the robot starts, and humans who respond.
        expected: scaled controls of humans who do not respond.
    """
    own_game = within(model, game)
    if model.responds:
        everybody = KnownResponders(tuple(range(game.number)))
        interaction = Interaction(own_game, state, everybody)
        return joint_ascent(interaction, begin)
    return plan_against(own_game, state, expected, begin)


def _with_predictions(
    model: HumanModel,
    chosen: Bool[Array, "humans"] | None,
    game: Game,
    state: State,
    start: Plan,
    expected: HumansControls,
) -> HumansControls:
    """Return expected controls, those of the chosen humans predicted by a model.

    It predicts each human in the game of the robot with this human alone.

    Args:
        model: that predicts.
        chosen: whether the model predicts each human; None for all.
        game: that is played.
        state: all cars now.
        start: scaled plan from which the robot's starts.
        expected: controls of the humans who are not chosen.
    """

    def predict(human: Index) -> Controls:
        begin = None  # plans up a smooth reward find their own start
        if not game.planner.solver.smooth:
            begin = Plan(start.robot, start.humans[human][None])
        own_game, own_state = pair(game, state, human)
        return scaled_prediction(model, own_game, own_state, begin)

    def with_prediction(human: Index, humans: jax.Array) -> jax.Array:
        return humans.at[human].set(predict(human))

    if chosen is None:
        return for_numbers(game.number, predict)
    return for_each(chosen, with_prediction, jnp.asarray(expected))


def _with_own_starts(
    model: HumanModel,
    chosen: Bool[Array, "humans"] | None,
    game: Game,
    state: State,
    last: Plan,
    start: Plan,
) -> Plan:
    """Return a start, replaced by a model's own for the chosen humans and the robot.

    The robot takes the model's start for the first chosen human.

    Args:
        model: that responds.
        chosen: whether each human is predicted by the model; None for all.
        game: that is played.
        state: all cars now.
        last: scaled plan that the model starts from.
        start: scaled plan from which the others start.
    """

    def begin(human: Index) -> Plan:
        own_game, own_state = pair(game, state, human)
        rest = Plan(last.robot, last.humans[human][None])
        own = own_start(model, own_game, own_state, rest)
        return Plan(own.robot, own.humans[0])

    starts = for_numbers(game.number, begin)
    if chosen is None:
        return Plan(starts.robot[0], starts.humans)

    # The humans' starts, and the robot's for the first of them.
    of_chosen = chosen[:, None, None]
    humans = jnp.where(of_chosen, starts.humans, start.humans)
    first = jnp.argmax(chosen)
    robot_of_first = starts.robot[first]
    robot = jnp.where(chosen.any(), robot_of_first, start.robot)
    return Plan(robot, humans)


def assigned_responders(
    models: tuple[HumanModel, ...],
    game: Game,
    rungs: Rungs,
) -> AssignedResponders:
    """Return the responding humans under an assignment, and the steps of all cars.

    Each human takes the steps of its own model. The robot takes those of the model in
    use with the most steps; where somebody responds, of the models that respond.
    """
    solvers = [own_solver(model, game) for model in models]
    joint = [solver.most_steps(responds=True) for solver in solvers]
    alone = [solver.most_steps(responds=False) for solver in solvers]

    # By human.
    rungs_respond = jnp.array([model.responds for model in models])
    responds = rungs_respond[rungs]
    joint_steps = _of_rungs(joint, rungs)
    steps_alone = _of_rungs(alone, rungs)

    # Humans with more steps come first. The robot takes as many steps as the first of
    # them.
    steps = jnp.where(responds, joint_steps, 0).astype(jnp.int32)
    order = jnp.argsort(-steps, stable=True)
    longest = steps.max()
    robot_steps = jnp.where(longest > 0, longest, jnp.max(steps_alone))

    # Each human's gradient steps have the length of its model, the robot's that of the
    # leading model.
    own_sizes = [solver.step_size for solver in solvers if isinstance(solver, Ascent)]
    are_usual = all(solver is game.planner.solver for solver in solvers)
    if not own_sizes or are_usual:
        return AssignedResponders(order, steps, robot_steps)
    rung_sizes = jnp.stack([jnp.asarray(size, jnp.float32) for size in own_sizes])
    sizes = rung_sizes[rungs]
    steps_of_robot = jnp.where(longest > 0, steps, steps_alone)
    leading = jnp.argmax(steps_of_robot)
    return AssignedResponders(order, steps, robot_steps, sizes, sizes[leading])


def _of_rungs(values: Sequence[int], rungs: Rungs) -> Int[Array, "humans"] | int:
    """Return the value of each human's rung; one number if all rungs have the same."""
    if len({*values}) == 1:
        return values[0]
    return jnp.array(values)[rungs]


class CompiledPlans:
    """Plan in a game with the models of a ladder.

    Plans are compiled once for all games of the same shapes. With one human, each model
    has a function of its own; among several, one serves all assignments.

    Args:
        game: may differ in numbers from the games that it was compiled for.
        ladder: human models.

    Attributes:
        repeats: number of times that plans and decisions are timed (constant).
    """

    repeats: ClassVar[int] = 20

    def __init__(self, game: Game, ladder: Sequence[HumanModel]) -> None:
        self.game = game
        self.ladder = tuple(ladder)
        self._function_of_each = game.number == 1  # which is smaller than one for all
        warm = any(model.warm for model in self.ladder)
        self._continues = warm or game.planner.solver.continues
        self._arguments = ReusedArguments(single(game))

    def plan(
        self,
        state: State,
        rungs: Rungs | Sequence[int],
        start: Plan | None = None,
    ) -> tuple[Solution, float]:
        """Return the solution, as NumPy arrays, and the seconds that it took.

        Args:
            state: all cars now, a `checked_state`.
            rungs: of every human.
            start: scaled plan to improve; by default,
                `ms_highway.planning.plans.cold_start`.
        """
        function, *arguments = self.call(state, rungs, start)
        solution, seconds = timed(function, *arguments)
        return jax.tree.map(np.asarray, solution), seconds

    def call(
        self,
        state: State,
        rungs: Rungs | Sequence[int],
        start: Plan | None = None,
    ) -> tuple:
        """Return the compiled `plan_function` of a plan, and its arguments."""
        # Plans that may continue have one program, which takes a start in any case.
        if start is None and self._continues:
            start = cold_start(self.game, np.asarray(state))

        models = self.ladder
        if self._function_of_each:
            models = (self.ladder[int(rungs[0])],)

        # A program of one model does not take the rungs: passing them takes time.
        traced_rungs = None
        if len(models) > 1:
            traced_rungs = np.asarray(rungs, np.int32)
        arguments = (self._arguments.take(), state, traced_rungs, start)
        return plan_function(models).of(*arguments), *arguments

    def warm_up(self, state: State, way_out: bool = False) -> float:
        """Compile and run what has not run before; return the seconds spent.

        Args:
            state: all cars now.
            way_out: whether to warm up the way out beside the plans.
        """
        check_user_features(self.game.scene, self.game.robot, self.game.number, state)
        warn_of_limits(self.ladder, self.game, state)

        # Run each function once, with all humans on the same rung.
        functions = len(self.ladder) if self._function_of_each else 1
        seconds = 0.0
        for rung in range(functions):
            rungs = [rung] * self.game.number
            function, *arguments = self.call(state, rungs)
            seconds += warm_up(function, *arguments)
        if way_out:
            control = np.zeros(2, np.float32)
            seconds += warm_up(escape, self._arguments.take(), state, control)
        return seconds

    def keep_way_out(self, state: State, control: Control) -> tuple[Escape, float]:
        """Return the result of `keep_way_out`, and the seconds that it took.

        See `ms_highway.planning.way_out.keep_way_out`.
        """
        planned = np.asarray(control, np.float32)
        found, seconds = timed(escape, self._arguments.take(), state, planned)
        return Escape(*map(np.asarray, found)), seconds


escape = jit_quickly(keep_way_out)


@cache
def plan_function(models: tuple[HumanModel, ...]) -> Compiled:
    """Compile `plan_for` once for these models, whatever the game's numbers."""
    return jit_quickly(partial(plan_for, models))


def plan(game: Game, state: State, model: HumanModel | str = "tom") -> Plan:
    """Plan in one situation: return controls of the robot, and those it expects.

    They are arrays [steps, 2] of the robot and [humans, steps, 2] of the humans.
    Controls are curvatures [1/m], or yaw rates [rad/s] under ``steering="yaw_rate"`` of
    the game's dynamics, and accelerations before friction [m/s^2]: with the paper's
    friction, 4 m/s^2 keep 20 m/s. Compiled once for all games of the same shapes.

    Args:
        game: what is played, see `ms_highway.game.scenario`.
        state: x, y [m], heading [rad], speed [m/s] of all cars: the robot, the humans,
            then scripted cars.
        model: human model of all humans, or its name.

    Raises:
        TypeError: if the game is no `Game`.
        ValueError: for an unknown model, a state that is not a finite array [cars, 4]
            of the game's cars or more, or a user-defined feature that is not finite in
            it.
    """
    if not isinstance(game, Game):
        remedy = "make a ms_highway.Game with ms_highway.build_game or driving_game"
        raise TypeError(f"the game is {game!r}; {remedy}")
    refuse_after_fork()
    known = human_model(model) if isinstance(model, str) else model
    now = checked_state(state)
    if len(now) <= game.number:
        raise ValueError(
            f"the state has {len(now)} cars; the game has a robot and {game.number}"
            " humans"
        )
    check_user_features(game.scene, game.robot, game.number, now)
    plans = CompiledPlans(game, [known])
    solution, _ = plans.plan(now, [0] * game.number)
    scaled = solution.plan

    # In SI units.
    scale = np.asarray(game.planner.control_scale, dtype=float)
    return Plan(scaled.robot * scale, scaled.humans * scale)


def checked_state(state: State) -> State:
    """Convert a state to single precision without whole turns in headings.

    NumPy does so faster than JAX.

    Raises:
        ValueError: if it is not a finite array [cars, 4] of two cars or more, in that
            precision.
    """
    state = np.asarray(state)
    is_table = state.ndim == 2
    if not is_table or len(state) < 2 or state.shape[1] != 4:
        raise ValueError(
            "a state has shape [cars, 4] with the robot, its partner and any others;"
            f" got {state.shape}"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        converted = facing(state).astype(np.float32)
    is_finite = np.isfinite(converted)
    if is_finite.all():
        return converted

    # The first wrong number: it may be finite in double precision.
    car, column = np.argwhere(~is_finite)[0]
    value = state[car, column]
    name = ["x", "y", "heading", "speed"][column]
    why = ""
    if np.isfinite(value):
        why = ", too large for single precision"
    raise ValueError(f"the state of car {car} is not finite: {name} is {value}{why}")
