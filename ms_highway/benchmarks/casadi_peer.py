"""The same plans in CasADi, compiled to C: what `ms_highway.benchmarks.latency` measures ours against.

Importing it needs the packages of the extra ``bench``.

A plan is written for one game, whose numbers become constants of the C code; only the state is an argument. Rewards are
translated from the operations that JAX traces; CasADi differentiates them, and its ascent and its responses are written
here once more, so that equal plans check ours.
"""

from collections.abc import Callable, Sequence
from importlib import import_module
from itertools import combinations
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.game import Game, constant_velocity, discomfort, swap_roles, total_reward
from ms_highway.runtime.extras import needing

with needing("bench"):
    ca: Any = import_module("casadi")  # whose declared types are not those of its functions

SWEEPS = 6  # of Jacobi's eigenvalue method; more change nothing in float64
COMPILER = {"compiler": "gcc", "flags": ["-O3", "-march=native"], "cleanup": False}
NAMES = {
    **{"add": "plus", "sub": "minus", "mul": "times", "div": "rdivide", "pow": "power", "abs": "fabs", "max": "fmax"},
    **{"min": "fmin", "or": "logic_or", "and": "logic_and", "not": "logic_not"},
    **{name: name for name in ("exp", "cos", "sin", "sqrt", "lt", "le", "gt", "ge", "eq")},
}
"""What CasADi calls JAX's operations on single elements."""

SAME = "convert_element_type", "stop_gradient", "optimization_barrier"


def compiled_peer(
    game: Game, model: str, cars: int, directory: Path
) -> tuple[Callable[[Any], np.ndarray], Callable[[], None]]:
    """Return the function that plans in a state, scaled, and one that repeats its last computation, to be timed.

    Args:
        game: whose numbers are built in.
        model: ``naive``, ``turn`` or ``tom``.
        cars: number of cars.
        directory: where the C code is written and compiled.

    Raises:
        ValueError: for a model without a peer, and for a game that looks at what tyres hold.
        RuntimeError: without gcc.
    """
    if game.planner.grip is not None:
        raise ValueError("the peer knows bounds of each control only; leave out the grip")
    if model not in ("naive", "turn", "tom"):
        raise ValueError(f"no peer for {model!r}; there are naive, turn, tom")
    now = ca.MX.sym("now", 4 * cars)
    compiling = {**COMPILER, "directory": f"{directory}/"}
    compiler = {"jit": True, "compiler": "shell", "jit_cleanup": False, "jit_options": compiling}
    function = ca.Function("plan", [now], [_plan(game, model, now)], compiler)
    given, planned = np.zeros(4 * cars), np.zeros(2 * game.planner.horizon)
    buffer, evaluate = function.buffer()
    buffer.set_arg(0, given.data)
    buffer.set_res(0, planned.data)

    def repeat(kept: Any = (function, buffer, given, planned)) -> None:  # C sees only their addresses
        evaluate()

    def call(state: Any) -> np.ndarray:
        given[:] = np.ravel(state)
        repeat()
        return planned.reshape(-1, 2).copy()

    return call, repeat


def _plan(game: Game, model: str, now: Any) -> Any:
    """Return the plan in a state, ravelled."""
    planner, size = game.planner, 2 * game.planner.horizon
    limit = np.tile(np.asarray(planner.control_limit, float) / np.asarray(planner.control_scale), planner.horizon)
    state, robot, human, push = map(ca.SX.sym, ("state", "robot", "human", "push"), (now.numel(), size, size, size))

    def reward(car: int, *controls: Any) -> Any:
        """Return the reward of a car for its controls, and for its partner's; without these, it keeps its velocity."""

        def earned(state: jax.Array, own: jax.Array, partner: jax.Array | None = None) -> jax.Array:
            played, state = (swap_roles(game), jnp.concatenate([state[1::-1], state[2:]])) if car else (game, state)
            partner = constant_velocity(game, state[1]) if partner is None else partner
            return total_reward(played, state, own, partner[None]) - discomfort(played, state[0], own)

        numbers = [np.zeros((part.numel() // 2, 2), np.float32) for part in controls]
        traced = jax.make_jaxpr(earned)(np.zeros((state.numel() // 4, 4), np.float32), *numbers)
        return _evaluated(traced.jaxpr, traced.consts, state, *controls)[0]

    def improved(controls: Any, slope: Any) -> Any:
        return ca.fmin(ca.fmax(controls + float(planner.step_size) * slope, -limit), limit)

    def ascent(car: int, controls: Any, *others: Any) -> Any:
        moved = ca.cse(improved(controls, ca.gradient(reward(car, controls, *others), controls)))
        plan = ca.Function("ascent", [controls, state, *others], [moved]).fold(planner.iterations)
        return lambda *given: plan(ca.DM.zeros(size), now, *given)

    if model == "naive":
        return ascent(0, robot)()
    if model == "turn":
        return ascent(0, robot, human)(ascent(1, human)())
    earned, human_reward = reward(0, robot, human), reward(1, human, robot)
    human_slope = ca.gradient(human_reward, human)
    found = ca.cse([ca.gradient(earned, human), ca.hessian(human_reward, human)[0]])
    derivatives = ca.Function("derivatives", [robot, human, state], found)
    slope = ca.gradient(earned, robot) + ca.gradient(ca.dot(human_slope, push), robot)
    moved = ca.cse([improved(robot, slope), improved(human, human_slope)])
    update = ca.Function("update", [robot, human, push, state], moved)
    both = ca.MX.sym("both", 2 * size)
    parts = ca.vertsplit(both, size)
    after = update(*parts, _response(game.influence, *derivatives(*parts, now)), now)
    once = ca.Function("once", [both, now], [ca.vertcat(*after)])
    return once.fold(planner.iterations)(ca.DM.zeros(2 * size), now)[:size]


def _response(influence: str, vector: Any, hessian: Any) -> Any:
    """`ms_highway.optimization.second_derivatives.response`; eigenvalues by sweeps of Jacobi rotations."""
    if influence == "exact":
        return -ca.solve(hessian, vector)
    size = vector.numel()
    matrix, basis = ca.SX.sym("matrix", size, size), ca.SX.sym("basis", size, size)
    turned, vectors = matrix, basis
    for p, q in combinations(range(size), 2):
        angle, rotation = 0.5 * ca.atan2(2 * turned[p, q], turned[q, q] - turned[p, p]), ca.SX.eye(size)
        rotation[p, p] = rotation[q, q] = ca.cos(angle)
        rotation[p, q], rotation[q, p] = ca.sin(angle), -ca.sin(angle)
        turned, vectors = rotation.T @ turned @ rotation, vectors @ rotation
    sweep = ca.Function("sweep", [ca.horzcat(matrix, basis)], [ca.horzcat(turned, vectors)]).fold(SWEEPS)
    values, vectors = ca.horzsplit(sweep(ca.horzcat(hessian, ca.DM.eye(size))), size)
    return vectors @ ((vectors.T @ vector) / ca.fmax(ca.fabs(ca.diag(values)), 1.0))


def _evaluated(traced: Any, constants: Sequence[Any], *given: Any) -> list[Any]:
    """Evaluate traced operations on ravelled expressions of CasADi."""
    known = dict(zip(traced.constvars, (ca.SX(np.ravel(value).astype(float)) for value in constants), strict=True))
    known |= dict(zip(traced.invars, given, strict=True))
    for step in traced.eqns:
        name, parameters, size = step.primitive.name, step.params, step.outvars[0].aval.size
        values = [ca.SX(float(place.val)) if hasattr(place, "val") else known[place] for place in step.invars]
        every, first, places = ca.vertcat(*values), 0, []  # places of the elements of each of the values among all
        for place, value in zip(step.invars, values, strict=True):
            places.append(np.arange(first, first := first + value.numel(), dtype=np.int32).reshape(place.aval.shape))

        def taken(numbers: Any, every: Any = every) -> Any:
            return ca.reshape(every[np.ravel(numbers).tolist()], np.size(numbers), 1)

        if inner := parameters.get("jaxpr", parameters.get("call_jaxpr")):
            results = _evaluated(inner.jaxpr, inner.consts, *values)
        elif name in SAME:
            results = values
        elif name == "reduce_sum":
            axes = parameters["axes"]
            terms = np.moveaxis(places[0], axes, range(len(axes))).reshape(-1, size)
            results = [sum(map(taken, terms))]
        elif name == "integer_pow":
            results = [every ** parameters["y"]]
        elif name == "neg":
            results = [-every]
        elif name == "select_n":
            results = [ca.if_else(values[0], values[2], values[1])]
        elif name in NAMES:
            shape = step.outvars[0].aval.shape
            spread = (taken(np.broadcast_to(place, shape)) for place in places)
            results = [getattr(ca, NAMES[name])(*spread)]
        elif not values:
            results = [ca.SX(np.ravel(step.primitive.bind(**parameters)).astype(float))]
        else:  # it only moves elements: let JAX move their places
            moved = step.primitive.bind(*places, **parameters)
            several = moved if step.primitive.multiple_results else [moved]
            results = list(map(taken, several))
        known.update(zip(step.outvars, results, strict=True))
    return [known[place] for place in traced.outvars]
