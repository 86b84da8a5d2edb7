"""The same plans in CasADi, compiled to C: what `ms_highway.benchmarks.latency` measures ours against.

A plan is written for one game, whose numbers become constants of the C code; only the state is an argument. It is
independent of this package's planners: the equations are written out step by step, and CasADi differentiates them.
"""

import ctypes
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.game.collision_risk import CAR_SHARPNESS, OBSTACLE_SHARE, OBSTACLE_SHARPNESS
from ms_highway.game.features import HEADING_SHARE
from ms_highway.game.game import Game
from ms_highway.game.reward import Reward

__all__ = ["compiled_peer"]

SWEEPS = 6  # of Jacobi's eigenvalue method; more change nothing in float64
FLAGS = ("-O3", "-march=native")

State = list[Any]  # symbols of x, y, heading, speed


def compiled_peer(
    game: Game, model: str, cars: int, directory: Path
) -> tuple[Callable[[Float[np.ndarray, "cars 4"]], Float[np.ndarray, "steps 2"]], Callable[[], None]]:
    """Return the function that plans in a state, scaled, and one that repeats its last computation, to be timed.

    Args:
        game: whose numbers are built in.
        model: ``naive``, ``turn`` or ``tom``.
        cars: number of cars.
        directory: where the C code is written and compiled.

    Raises:
        ImportError: without CasADi.
        ValueError: for a model without a peer, and for a game that looks at what tyres hold.
        OSError: without gcc.
    """
    try:
        import casadi
    except ImportError:
        raise ImportError('the peer needs CasADi: pip install "ms-highway[bench]"') from None
    if game.planner.grip is not None:
        raise ValueError("the peer knows bounds of each control only; leave out the grip")
    function = _plan(casadi, game, model, cars)
    generator = casadi.CodeGenerator("plan.c")
    generator.add(function)
    generator.generate(f"{directory}/")
    library = directory / f"{model}.so"
    subprocess.run(
        ["gcc", *FLAGS, "-fPIC", "-shared", str(directory / "plan.c"), "-o", str(library), "-lm"], check=True
    )
    return _bind(function, library)


def _bind(
    function: Any, library: Path
) -> tuple[Callable[[Float[np.ndarray, "cars 4"]], Float[np.ndarray, "steps 2"]], Callable[[], None]]:
    """Python's hands on the C function, whose buffers are allocated once."""
    plan = ctypes.CDLL(str(library)).plan
    real = ctypes.POINTER(ctypes.c_double)
    given, planned = np.zeros(function.numel_in(0)), np.zeros(function.numel_out(0))
    work, integers = np.zeros(max(1, function.sz_w())), np.zeros(max(1, function.sz_iw()), dtype=np.int64)
    arguments, results = (real * max(1, function.sz_arg()))(), (real * max(1, function.sz_res()))()
    arguments[0], results[0] = given.ctypes.data_as(real), planned.ctypes.data_as(real)
    scratch = integers.ctypes.data_as(ctypes.POINTER(ctypes.c_longlong)), work.ctypes.data_as(real)

    def repeat() -> None:
        plan(arguments, results, *scratch, 0)

    def call(state: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "steps 2"]:
        given[:] = np.asarray(state, dtype=float).ravel()
        repeat()
        return planned.reshape(-1, 2).copy()

    repeat.buffers = given, planned, integers, work  # type: ignore[attr-defined]  # C sees only their addresses
    return call, repeat


def _plan(ca: Any, game: Game, model: str, cars: int) -> Any:
    """Return the plan as a CasADi function of the ravelled state."""
    planner, dynamics = game.planner, game.dynamics
    steps, dt, drag = planner.horizon, float(dynamics.time_step), float(dynamics.drag)
    scale = np.asarray(planner.control_scale, dtype=float)
    limit = np.tile(np.asarray(planner.control_limit, dtype=float) / scale, steps)
    size, step_size = 2 * steps, float(planner.step_size)
    state = ca.SX.sym("state", 4 * cars)
    robot, human = ca.SX.sym("robot", size), ca.SX.sym("human", size)
    starts = [[state[4 * car + i] for i in range(4)] for car in range(cars)]

    def drive(car: State, controls: Any) -> list[State]:
        path = []
        for k in range(steps):
            x, y, heading, speed = car
            omega, acceleration = controls[2 * k] * scale[0], controls[2 * k + 1] * scale[1] - drag * speed
            turning = speed * omega if dynamics.steering == "curvature" else omega
            distance = speed * dt + acceleration * dt**2 / 2
            car = [
                x + distance * ca.cos(heading),
                y + distance * ca.sin(heading),
                heading + turning * dt,
                speed + acceleration * dt,
            ]
            path.append(car)
        return path

    def keep(car: State) -> list[State]:
        x, y, heading, speed = car
        ahead = [speed * dt * (k + 1) for k in range(steps)]
        return [[x + d * ca.cos(heading), y + d * ca.sin(heading), heading, speed] for d in ahead]

    rest = [keep(car) for car in starts[2:]]

    def total(parameters: Reward, own: list[State], partner: list[State]) -> Any:
        return sum(_reward(ca, game, parameters, own[k], [partner[k], *(car[k] for car in rest)]) for k in range(steps))

    def improved(controls: Any, slope: Any) -> Any:
        return ca.fmin(ca.fmax(controls + step_size * slope, -limit), limit)

    def ascent(name: str, controls: Any, value: Any, given: Sequence[Any]) -> Any:
        slope = ca.gradient(value, controls)
        return ca.Function(name, [controls, *given], [ca.cse(improved(controls, slope))]).fold(planner.iterations)

    robot_path, human_path = drive(starts[0], robot), drive(starts[1], human)
    now, still = ca.MX.sym("now", 4 * cars), ca.DM.zeros(size)
    if model == "naive":
        alone = ascent("alone", robot, total(game.robot, robot_path, keep(starts[1])), [state])
        return ca.Function("plan", [now], [alone(still, now)])
    if model == "turn":
        predict = ascent("predict", human, total(game.human, human_path, keep(starts[0])), [state])
        against = ascent("against", robot, total(game.robot, robot_path, human_path), [human, state])
        return ca.Function("plan", [now], [against(still, predict(still, now), now)])
    if model != "tom":
        raise ValueError(f"no peer for {model!r}; there are naive, turn, tom")
    robot_value, human_value = total(game.robot, robot_path, human_path), total(game.human, human_path, robot_path)
    push = ca.SX.sym("push", size)
    human_slope = ca.gradient(human_value, human)
    derivatives = ca.Function(
        "derivatives",
        [robot, human, state],
        ca.cse([ca.gradient(robot_value, human), ca.hessian(human_value, human)[0]]),
    )
    slope = ca.gradient(robot_value, robot) + ca.gradient(ca.dot(human_slope, push), robot)
    update = ca.Function(
        "update", [robot, human, push, state], ca.cse([improved(robot, slope), improved(human, human_slope)])
    )
    both = ca.MX.sym("both", 2 * size)
    along, hessian = derivatives(both[:size], both[size:], now)
    moved = update(both[:size], both[size:], _response(ca, game.influence, hessian, along, size), now)
    once = ca.Function("once", [both, now], [ca.vertcat(*moved)])
    return ca.Function("plan", [now], [once.fold(planner.iterations)(ca.DM.zeros(2 * size), now)[:size]])


def _response(ca: Any, influence: str, hessian: Any, vector: Any, size: int) -> Any:
    """`ms_highway.optimization.second_derivatives.response`; eigenvalues by sweeps of Jacobi rotations."""
    if influence == "exact":
        return -ca.solve(hessian, vector)
    matrix, basis = ca.SX.sym("matrix", size, size), ca.SX.sym("basis", size, size)
    a, v = ca.SX(matrix), ca.SX(basis)
    for p in range(size):
        for q in range(p + 1, size):
            angle = 0.5 * ca.atan2(2 * a[p, q], a[q, q] - a[p, p])
            cosine, sine = ca.cos(angle), ca.sin(angle)
            a[:, p], a[:, q] = cosine * a[:, p] - sine * a[:, q], sine * a[:, p] + cosine * a[:, q]
            a[p, :], a[q, :] = cosine * a[p, :] - sine * a[q, :], sine * a[p, :] + cosine * a[q, :]
            v[:, p], v[:, q] = cosine * v[:, p] - sine * v[:, q], sine * v[:, p] + cosine * v[:, q]
    packed = ca.vertcat(ca.vec(matrix), ca.vec(basis))
    sweep = ca.Function("sweep", [packed], [ca.vertcat(ca.vec(a), ca.vec(v))]).fold(SWEEPS)
    done = sweep(ca.vertcat(ca.vec(hessian), ca.vec(ca.DM.eye(size))))
    values = ca.diag(ca.reshape(done[: size**2], size, size))
    vectors = ca.reshape(done[size**2 :], size, size)
    return vectors @ ((vectors.T @ vector) / ca.fmax(ca.fabs(values), 1.0))


def _reward(ca: Any, game: Game, parameters: Reward, own: State, others: list[State]) -> Any:
    """Theta . phi, without the indicators, which have no gradient."""
    scene = game.scene
    weight = dict(zip(parameters.names, np.asarray(parameters.weights, dtype=float), strict=True))
    unit, target, corner = float(scene.length_unit), float(scene.target_lane), float(scene.corner)
    lanes, (length, width) = np.asarray(scene.lanes, dtype=float), np.asarray(scene.car_size, dtype=float)
    x, y, heading, speed = own
    cosine, sine = ca.cos(heading), ca.sin(heading)
    forward = speed * cosine / float(parameters.speed_limit)
    offset = (y - lanes[0]) ** 2
    for lane in lanes[1:]:
        offset = ca.fmin(offset, (y - lane) ** 2)
    value = -weight["speed"] * forward * (forward - 2)
    value += weight["lane_alignment"] * (-offset / unit**2 + HEADING_SHARE * cosine)
    shares = [(i * corner, j * corner) for i in (1, -1) for j in (1, -1)] + [(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)]
    points = [(a * length, b * width) for a, b in (*shares, (0, 0))]
    world = [(x + cosine * a - sine * b, y + sine * a + cosine * b) for a, b in points]
    risk = 0
    for other_x, other_y, other_heading, _ in others:
        c, s = ca.cos(other_heading), ca.sin(other_heading)
        for px, py in world:
            dx, dy = px - other_x, py - other_y
            distance = (2 * (c * dx + s * dy) / length) ** 2 + (2 * (c * dy - s * dx) / width) ** 2
            risk += ca.exp(-CAR_SHARPNESS * (distance - 1))
    for cone_x, cone_y in np.asarray(scene.obstacles, dtype=float):
        cone_length, cone_width = np.asarray(scene.obstacle_size, dtype=float)
        for px, py in world:
            distance = (2 * (px - cone_x) / cone_length) ** 2 + (2 * (py - cone_y) / cone_width) ** 2
            risk += OBSTACLE_SHARE * ca.exp(-OBSTACLE_SHARPNESS * (distance - 1))
    value += weight["collision_risk"] * risk
    reach = (length * ca.fabs(sine) + width * ca.fabs(cosine)) / 2
    margin = float(scene.lane_width) / 2
    depth = ca.fmax(0, ca.fmax(y + reach - (lanes.max() + margin), lanes.min() - margin - (y - reach)))
    value += weight["off_road"] * (depth / unit) ** 2 - weight["target_lane"] * ((y - target) / unit) ** 2
    if scene.leader is not None:
        gap = x - (others[scene.leader - 1][0] - float(parameters.gap))
        value -= weight["gap"] * (gap / unit) ** 2
    return value - weight["partner_target_lane"] * ((others[0][1] - target) / unit) ** 2
