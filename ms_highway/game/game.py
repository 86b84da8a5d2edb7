"""Define the game that a robot and humans play, and the rewards of their plans.

The robot is car 0. The humans follow, then the scripted cars, which keep their
velocity. *Players* are the robot and the humans. The *others* of a car are all cars but
itself, and its *partner* is the first of them.

Throughout the core, controls of plans are in units of the planner's ``control_scale``
("scaled"). They become curvatures and accelerations only where a plan is executed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.dynamics import (
    Dynamics,
    coast,
    keep_velocity,
    rollout,
    rollout_jacobian,
    speeds,
    within_grip,
)
from ms_highway.game.payoff import Payoff
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.numerics.second_derivatives import Influence
from ms_highway.numerics.solvers import Newton, Planner
from ms_highway.runtime.arrays import (
    Array,
    Car,
    Controls,
    HumansControls,
    Index,
    ManyControls,
    SameArray,
    Scalar,
    State,
    Trajectories,
    Trajectory,
    for_numbers,
    for_rows,
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Game:
    """All that a planner needs. Changing a number in it never recompiles a plan.

    The first car is the robot, the next ones are the humans. All others are scripted:
    they keep their velocity.

    Attributes:
        scene: road, obstacles and bodies.
        robot: the reward of car 0.
        humans: the humans' rewards, which differ in their weights, an array [humans,
            features].
        dynamics: assumed by plans.
        world: dynamics of the real cars, from which executed controls are recovered.
        planner: horizon, solver and limits of all plans.
        influence: form of the humans' response to the robot under gradient steps, see
            `ms_highway.numerics.second_derivatives.minus_inverse_times` (static).
    """

    scene: Scene
    robot: Reward
    humans: Reward
    dynamics: Dynamics
    world: Dynamics
    planner: Planner
    influence: Influence = field(default="damped", metadata={"static": True})

    @property
    def number(self) -> int:
        """Number of humans."""
        return int(np.shape(self.humans.weights)[0])

    @property
    def payoff(self) -> Payoff:
        """The objective of plans of car 0: the robot, or a human after `swap_roles`.

        Under a smooth reward, the robot keeps room to stop before obstacles.
        """
        smooth = self.planner.solver.smooth
        braking = None
        if smooth and len(self.scene.obstacles):
            braking = jnp.asarray(self.planner.control_limit)[1]
            if self.planner.grip is not None:
                braking = jnp.minimum(braking, jnp.asarray(self.planner.grip))
        return Payoff(self.scene, self.robot, braking, smooth)

    @property
    def observed_payoff(self) -> Payoff:
        """What driven trajectories of the robot earn, with the reward's jumps."""
        return Payoff(self.scene, self.robot, None, smooth=False)

    def human(self, human: Index = 0) -> Reward:
        """Return the reward of a human."""
        weights = self.humans.weights
        if not isinstance(human, int):  # NumPy's arrays cannot be indexed by a tracer
            weights = jnp.asarray(weights)
        return replace(self.humans, weights=weights[human])

    def players(self) -> Reward:
        """Return the rewards of the robot and of the only human, stacked.

        Raises:
            ValueError: if they compute different features.
        """
        robot = self.robot
        human = self.human()
        same_names = robot.names == human.names
        if not same_names or robot.user_features != human.user_features:
            both = f"{', '.join(robot.names)} and {', '.join(human.names)}"
            raise ValueError(
                f"robot and human have rewards of other features, {both}; build both"
                " with the same ones"
            )
        return jax.tree.map(lambda *sides: jnp.stack(sides), robot, human)


@cache
def others_of(cars: int) -> Int[np.ndarray, "cars others"]:
    """Return for each of some cars the indices of all others, in ascending order."""
    indices = np.tile(np.arange(cars), (cars, 1))  # [cars, cars]
    is_other = ~np.eye(cars, dtype=bool)
    return indices[is_other].reshape(cars, -1)


Result = TypeVar("Result")


def each_human(game: Game, function: Callable[[Index], Result]) -> Result:
    """Compute a function of every human's index; the results get an axis of humans."""
    return for_numbers(game.number, function)


def pair(game: Game, state: State, human: Index) -> tuple[Game, State]:
    """Return the game of the robot with one of the humans, and its state.

    The other humans count as scripted.
    """
    if game.number == 1:
        return game, state
    others = jnp.asarray(others_of(len(state) - 1))[human]
    robot, cars = jnp.split(jnp.asarray(state), [1])
    partner = cars[human][None]
    only_human = _as_only_human(game.human(human))
    pair_state = jnp.concatenate([robot, partner, cars[others]])
    return replace(game, humans=only_human), pair_state


def _as_only_human(reward: Reward) -> Reward:
    return replace(reward, weights=reward.weights[None])


def swap_players(game: Game, state: State, human: Index = 0) -> tuple[Game, State]:
    """Return a human's `pair` from its own side: it is car 0, the robot is car 1."""
    _, state = pair(game, state, human)
    human_then_robot = state[1::-1]
    swapped = jnp.concatenate([human_then_robot, state[2:]])
    return swap_roles(game, human), swapped


def swap_roles(game: Game, human: Index = 0) -> Game:
    """Return the game in which a human plans as car 0, and the robot is its partner.

    Other humans count as scripted. Humans plan by the robot's solver, but anew in every
    step and without its ease.
    """
    planner = replace(game.planner, solver=game.planner.solver.of_human())
    return replace(
        game,
        robot=game.human(human),
        humans=_as_only_human(game.robot),
        planner=planner,
    )


def constant_velocity(
    game: Game,
    cars: Float[SameArray, "*cars 4"],
) -> Float[SameArray, "*cars steps 2"]:
    """Return the scaled controls that keep speed and heading over the horizon."""
    xp = cars.__array_namespace__()
    control = keep_velocity(game.dynamics, cars)
    scaled = control[..., None, :] / game.planner.control_scale
    return xp.repeat(scaled, game.planner.horizon, axis=-2)


def bounded(game: Game, car: Car, controls: ManyControls) -> ManyControls:
    """Limit scaled controls to the planner's ``control_limit`` and ``grip``.

    The limit by grip depends on the speed, which is computed from the unlimited
    accelerations: the first control is exact, later ones may exceed the grip by a
    quarter. Executed controls never do.
    """
    planner = game.planner
    scale = jnp.asarray(planner.control_scale)
    limit = jnp.asarray(planner.control_limit) / scale
    controls = jnp.clip(controls, -limit, limit)
    if planner.grip is None:
        return controls
    bend = 0.0 if game.scene.bend is None else game.scene.bend
    physical = controls * planner.control_scale
    grip = jnp.asarray(planner.grip)
    limited = _plans_within_grip(game.dynamics, grip, jnp.asarray(bend), car, physical)
    return limited / planner.control_scale


@jax.jit
def _plans_within_grip(
    dynamics: Dynamics,
    grip: jax.Array,
    bend: jax.Array,
    car: Car,
    controls: Float[jax.Array, "*batch steps 2"],
) -> Float[jax.Array, "*batch steps 2"]:
    """Limit controls at the speeds that they would lead to without a limit."""
    now = jnp.broadcast_to(car[3], controls.shape[:-2])
    unlimited = speeds(dynamics, now, controls[..., 1])
    before = jnp.maximum(unlimited[..., :-1], 0.0)
    return within_grip(dynamics, grip, before, controls, bend)


def discomfort(game: Game, car: Car, controls: Controls) -> Scalar:
    """Return car 0's cost of not keeping its present velocity.

    It is ``sum comfort (u - u_keep)^2 / 2`` of scaled controls u.

    The ease of `Newton` is added to the weights of comfort. For steering, it is
    multiplied by the square of the lateral acceleration that a curvature causes,
    relative to the one at the speed limit: a standing car steers for nothing.
    """
    solver = game.planner.solver
    keeping = keep_velocity(game.dynamics, car) / game.planner.control_scale
    comfort = game.robot.comfort
    if isinstance(solver, Newton):
        # Lateral acceleration is v^2 omega with curvatures, v omega with yaw rates.
        pace = jnp.minimum(jnp.abs(car[3]) / game.robot.speed_limit, 1.0)
        steering = pace**4 if game.dynamics.steering == "curvature" else pace**2
        acceleration = jnp.ones_like(pace)
        comfort = comfort + solver.ease * jnp.stack([steering, acceleration])
    squares = (controls - keeping) ** 2
    return jnp.sum(comfort * squares) / 2


def move(game: Game, car: Car, controls: Controls) -> Trajectory:
    """Return the trajectory of a car under scaled controls."""
    physical = controls * game.planner.control_scale
    motion = rollout(game.dynamics, car, physical)
    return jnp.stack(motion)


def move_jacobian(
    game: Game,
    car: Car,
    controls: Controls,
) -> Float[jax.Array, "fields steps controls"]:
    """Return the derivative of `move` in the ravelled scaled controls."""
    scale = jnp.asarray(game.planner.control_scale)
    jacobian = rollout_jacobian(game.dynamics, car, controls * scale)
    return jacobian * jnp.tile(scale, len(controls))


def move_all(
    game: Game,
    cars: State,
    controls: Float[Array, "cars steps 2"],
) -> Trajectories:
    """Return the trajectories of some cars under scaled controls."""
    return for_rows(partial(move, game), cars, controls)


def with_scripted(
    game: Game,
    state: State,
    players: Float[jax.Array, "players fields steps"],
) -> Float[jax.Array, "all_cars fields steps"]:
    """Return the trajectories of some cars, then those of the scripted cars after them.

    Scripted cars keep their velocity.

    Args:
        game: with the dynamics.
        state: all cars now.
        players: trajectories of the first cars after car 0.
    """
    cars = state[1 + len(players) :]
    steps = players.shape[-1]
    scripted = jnp.stack(coast(game.dynamics, cars, steps), axis=1)
    return jnp.concatenate([players, scripted])


def step_rewards(
    game: Game,
    payoff: Payoff,
    state: State,
    robot: Controls,
    humans: HumansControls,
) -> Float[jax.Array, "steps"]:
    """Return what each step earns under scaled controls of the robot and the humans.

    Args:
        game: that is played.
        payoff: the game's ``payoff`` or ``observed_payoff``.
        state: all cars now.
        robot: scaled controls of the robot.
        humans: scaled controls of the humans.
    """
    human_cars = state[1 : 1 + len(humans)]
    human_paths = move_all(game, human_cars, humans)
    others = with_scripted(game, state, human_paths)
    path = move(game, state[0], robot)
    return payoff.steps(path, others)


def total_reward(
    game: Game,
    state: State,
    robot: Controls,
    humans: HumansControls,
) -> Scalar:
    """Return the sum of `step_rewards` of plans, R_R(x, u_R, u_H)."""
    return jnp.sum(step_rewards(game, game.payoff, state, robot, humans))
