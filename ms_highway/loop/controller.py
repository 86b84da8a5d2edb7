"""Define controllers, and drivers of humans that do not plan.

Controllers take and return float64 NumPy states and controls in SI units. They drive
car 0; the next cars are its partners. Humans who do not plan are driven by functions of
the state, or by objects that remember; the package has two such functions, see
`ms_highway.loop.yielding`.
"""

import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from inspect import signature
from time import perf_counter
from typing import ClassVar, Protocol, TypeAlias, TypeGuard, cast

import jax
import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from jax import numpy as jnp

from ms_highway.choice.records import highest_gains
from ms_highway.game.dynamics import facing
from ms_highway.game.game import Game, swap_roles
from ms_highway.loop.step import Status
from ms_highway.loop.yielding import always_yields, never_yields
from ms_highway.planning.ladders import cheapest_first
from ms_highway.runtime.arrays import (
    Control,
    Controls,
    Gains,
    HumansControls,
    ModelProbabilities,
    State,
    naming_writes,
    read_only,
)
from ms_highway.runtime.names import keep_apart


@dataclass(frozen=True)
class ControlStep:
    """Record of one step of a controller.

    Attributes:
        control: to execute now, ``(omega, acceleration)``.
        plan: controls over the horizon; fewer where only part of the last plan is left.
        humans: controls that the plan expects of every human.
        models: for every human, the name of the model that predicted it in this plan.
        planning_seconds: wall time of the plan and of the way-out check together,
            without compilation.
        decision_seconds: wall time of choosing the models, with the belief, without
            compilation; 0 if nothing is chosen or inferred.
        compile_seconds: wall time of compiling and warming up in this step.
        ladder: names of the models to choose from.
        gains: estimated gain of each of them over the first one for every human, before
            the price of its time, see `ms_highway.choice.rule.Estimate`; NaN where none
            was estimated.
        choice_failed: whether gains that were asked for could not be computed.
        status: where the control comes from, see `ms_highway.loop.step.Status`.
        belief: for every human, the probability that each of
            `ms_highway.planning.ladders.PACKAGE_MODELS` predicts it; None where it is
            not inferred.
        planned: for every human, the name of its model in the plan of this step, which
            is not ``plan`` if it is late or failed.
        plan_steps: number of iterations of the ascent to this plan.
        converged: whether the last of them hardly moved the plan.
    """

    control: Control
    plan: Controls
    humans: HumansControls
    models: tuple[str, ...]
    planning_seconds: float = 0.0
    decision_seconds: float = 0.0
    compile_seconds: float = 0.0
    ladder: tuple[str, ...] = ()
    gains: Gains | None = None
    choice_failed: bool = False
    status: Status = "planned"
    belief: ModelProbabilities | None = None
    planned: tuple[str, ...] = ()
    plan_steps: int = 0
    converged: bool = False

    @property
    def model(self) -> str:
        """Name of the most expensive model in use."""
        if len(self.models) == 1:
            return self.models[0]
        named = cheapest_first(self.models)  # on stock roads, paths may have no model
        return named[-1] if named else ""

    @property
    def counted_models(self) -> tuple[str, ...]:
        """Names of the models in the plan of this step, whose time is counted."""
        return self.planned or self.models

    def highest_gains(self) -> dict[str, float]:
        """Return the highest estimated gain of each model over all humans, by name."""
        if self.gains is None:
            return {}
        highest = highest_gains(np.asarray(self.gains)).tolist()
        by_name = dict(zip(self.ladder, highest, strict=True))
        return {name: gain for name, gain in by_name.items() if np.isfinite(gain)}


class Controller(Protocol):
    """Drive car 0 of a game, one step at a time.

    Attributes:
        game: may be replaced between steps; a game of the same shapes compiles nothing.
    """

    game: Game

    def reset(self) -> None:
        """Forget the past, before a new episode."""

    def step(self, state: State) -> ControlStep:
        """Return the control of the coming step, from the states of all cars now."""


# Drivers of humans that do not plan

DriverFunction: TypeAlias = Callable[[Game, State], Control]
"""Control of a car from its own game, where it is car 0, and the state of all cars
[cars, 4].
"""


class RememberingDriver(Protocol):
    """A driver that remembers or draws.

    Every car that it drives in an episode gets a copy of its own.
    """

    def reset(self, key: int) -> object:
        """Forget the past, before a new episode.

        Args:
            key: seed of all random numbers.
        """

    def __call__(self, game: Game, state: State) -> Control:
        """Return the control of the coming step."""


HumanDriver: TypeAlias = DriverFunction | RememberingDriver | type
"""What may drive a human: a function, an object that remembers, a class of such
objects, or a class of highway-env vehicles.
"""


def remembers(
    driver: object,
) -> TypeGuard[RememberingDriver | type[RememberingDriver]]:
    """Return whether a driver has a memory, or is a class of such drivers.

    See `RememberingDriver`.
    """
    return hasattr(driver, "reset") and not is_vehicle(driver)


def is_vehicle(driver: object) -> TypeGuard[type[Vehicle]]:
    """Return whether a driver is a class of highway-env vehicles."""
    return isinstance(driver, type) and issubclass(driver, Vehicle)


def new_driver(driver: HumanDriver) -> DriverFunction:
    """Return what drives one car in one episode.

    It is a function itself, a copy of an object, or an object of a class.
    """
    if not remembers(driver):
        return cast(DriverFunction, driver)
    return driver() if isinstance(driver, type) else deepcopy(driver)


def draw_key(driver: HumanDriver, random: np.random.Generator) -> int:
    """Return the key of an episode for a driver that remembers.

    For other drivers, draw nothing.
    """
    keys = 2**31  # NumPy and JAX take each of them as a seed
    return int(random.integers(keys)) if remembers(driver) else 0


def check_driver(name: str, driver: object) -> None:
    """Check that something drives.

    A function does, an object or a class with a memory, or a class of vehicles.

    Raises:
        ValueError: if it does not; it names the driver and a remedy.
    """
    place = f"the human driver {name!r} is {driver!r}"
    if is_vehicle(driver):
        return
    is_other_class = isinstance(driver, type) and not remembers(driver)
    if not callable(driver) or is_other_class:
        remedy = (
            "give a function of the game and the state, an object with `reset(key)`"
            " that is called like one"
        )
        raise ValueError(f"{place}; {remedy}, or a class of highway-env vehicles")
    if remembers(driver):
        _check_memory(place, driver)


def _check_memory(
    place: str,
    driver: RememberingDriver | type[RememberingDriver],
) -> None:
    """Check that a driver with a memory can begin an episode.

    Raises:
        ValueError: if it cannot; it begins with ``place``.
    """
    try:
        copied = new_driver(driver)
        signature(copied.reset).bind(0)  # type: ignore[attr-defined]
    except Exception as error:  # anything that code of the user's raises
        remedy = (
            "give a class that is made without arguments or an object that can be"
            " copied; let `reset` take a key"
        )
        raise ValueError(
            f"{place}, which cannot begin an episode: {error}; {remedy}"
        ) from error
    if not callable(copied) or copied is driver:
        remedy = (
            "give an object of a class with the methods `reset(key)` and"
            " `__call__(game, state)`"
        )
        raise ValueError(
            f"{place}, which cannot be copied or cannot be called; {remedy}"
        )


class FunctionDriver:
    """Drive a car by a function of the state, or by an object that remembers.

    Nothing is planned. A function has to answer the same question in the same way. In
    the first, second, fourth, eighth step and so on, it is asked once more what it was
    asked in the first one. An object with a memory is not.

    Args:
        game: of which car 0 is driven.
        name: in records.
        driver: see `ms_highway.add_driver`.
        key: of the episode, for an object.

    Attributes:
        same_answer: largest relative difference between two answers to the same
            question, for rounding.
        control_remedy: what a driver has to return, for messages.
        memory_remedy: what to do about a function that remembers or draws, for
            messages.
    """

    same_answer: ClassVar[float] = 1e-6
    control_remedy: ClassVar[str] = (
        "return a curvature [1/m] and an acceleration [m/s^2]"
    )
    memory_remedy: ClassVar[str] = (
        "give add_driver an object with `reset(key)`, which keeps its memory and its"
        " random numbers in itself"
    )

    def __init__(
        self,
        game: Game,
        name: str,
        driver: HumanDriver,
        key: int = 0,
    ) -> None:
        self.game = game
        self.name = name
        self._added = driver
        self._key = key
        self.reset()

    @property
    def game(self) -> Game:
        """The game, whose car 0 is driven; its arrays cannot be written."""
        return self._game

    @game.setter
    def game(self, game: Game) -> None:
        self._game = read_only(game)

    def reset(self) -> None:
        """Begin an episode: copy an object that remembers anew, and give it the key."""
        self._function = new_driver(self._added)
        self._steps = 0
        self._first: tuple[Game, State, Control] | None = None
        if remembers(self._added):
            self._function.reset(self._key)  # type: ignore[attr-defined]

    def step(self, state: State) -> ControlStep:
        """Return the control of the coming step.

        Raises:
            ValueError: if the driver does not return two finite numbers, writes into
                what it is given, or is a function that answers the same question in two
                ways.
        """
        seen = read_only(facing(state))
        start = perf_counter()
        control = self._ask(self.game, seen)
        seconds = perf_counter() - start
        self._check_answers(seen, control)

        repeated = np.tile(control, (self.game.planner.horizon, 1))
        return ControlStep(
            control=control,
            plan=repeated,
            humans=np.zeros((0, *repeated.shape)),
            models=(self.name,) * self.game.number,
            planning_seconds=seconds,
        )

    def _ask(self, game: Game, state: State) -> Control:
        """Return the driver's answer, a copy, as drivers may use their array again."""
        with naming_writes(f"the driver {self.name!r}"):
            control = np.array(self._function(game, state), dtype=float)
        if control.shape != (2,) or not np.isfinite(control).all():
            raise ValueError(
                f"the driver {self.name!r} returned {control.tolist()};"
                f" {self.control_remedy}"
            )
        return control

    def _check_answers(self, state: State, control: Control) -> None:
        """Ask a function the first question again, and compare its answers.

        It is asked in steps 1, 2, 4, 8 and so on.
        """
        self._steps += 1
        is_power_of_two = self._steps & (self._steps - 1) == 0
        if remembers(self._added) or not is_power_of_two:
            return
        if self._first is None:
            self._first = (self.game, state, control)
        first_game, first_state, first = self._first
        again = self._ask(first_game, first_state)
        tolerance = self.same_answer
        if not np.allclose(again, first, rtol=tolerance, atol=tolerance):
            answers = f"{first.tolist()} and then {again.tolist()} in the same state"
            raise ValueError(
                f"the driver {self.name!r} returned {answers}, so it remembers or"
                f" draws; {self.memory_remedy}"
            )


HUMAN_DRIVERS: dict[str, HumanDriver] = {"never": never_yields, "always": always_yields}
"""Human drivers by name. They do not plan."""

keep_apart("a human driver", lambda: HUMAN_DRIVERS)


def function_names() -> list[str]:
    """Return the names of the drivers that are called with a game and a state."""
    return [name for name, driver in HUMAN_DRIVERS.items() if not is_vehicle(driver)]


def traceable(name: str, game: Game) -> DriverFunction:
    """Return the function of a human driver, if JAX can trace it in a simulation.

    Raises:
        ValueError: if the driver is a class of vehicles, the keyboard, a driver that
            remembers, or a function that JAX cannot trace or traces in two ways.
    """
    driver = HUMAN_DRIVERS.get(name)
    remedy = "give add_driver a pure function of jax.numpy, or use `compare`"
    if driver is None or is_vehicle(driver):
        raise ValueError(
            f"config['human_driver'] is {name!r}, which cannot be simulated; {remedy}"
        )
    if remembers(driver):
        raise ValueError(
            f"config['human_driver'] is {name!r}, which remembers and cannot be"
            f" simulated; {remedy}"
        )
    function = cast(DriverFunction, driver)
    question = swap_roles(game), jnp.zeros((2 + game.number, 4))
    try:
        control = jax.eval_shape(function, *question)
        programs = {_program(function, question) for _ in range(2)}
    except Exception as error:  # anything that code of the user's raises
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"JAX cannot trace the human driver {name!r}: {reason}; {remedy}"
        ) from error
    if jax.tree.map(jnp.shape, control) != (2,):
        raise ValueError(
            f"the human driver {name!r} returns {control};"
            f" {FunctionDriver.control_remedy}"
        )
    if len(programs) > 1:
        raise ValueError(
            f"the human driver {name!r} computes something else when it is asked again;"
            f" {FunctionDriver.memory_remedy}"
        )
    return function


def _program(driver: DriverFunction, question: tuple[Game, State]) -> str:
    """Return the text of what JAX computes for a driver, with its constants."""
    # JAX caches the trace of a function, so a new function makes it trace again.
    traced = jax.make_jaxpr(lambda game, state: driver(game, state))(*question)
    constants = [_as_numbers(constant).tolist() for constant in traced.consts]
    return re.sub("0x[0-9a-f]+", "", f"{traced} {constants}")  # addresses differ


def _as_numbers(constant: jax.Array | np.ndarray) -> np.ndarray:
    """Return a constant of a program as numbers, also keys of random numbers."""
    if jnp.issubdtype(constant.dtype, jax.dtypes.prng_key):
        return np.asarray(jax.random.key_data(constant))  # which NumPy cannot convert
    return np.asarray(constant)
