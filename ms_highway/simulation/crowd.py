"""Run the closed loop of a crowd in pure JAX: humans and robot plan, a rule decides, the world moves.

The order of a step is that of `ms_highway.control.crowd`: the rule chooses from the outcome of the last step, the robot
plans from the rest of its last plan, all cars move.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int

from ms_highway.control.fallback import PLANNED, WAY_OUT
from ms_highway.game.crowd import Crowd, others_of
from ms_highway.game.dynamics import keep_velocity, recover_control, step, within_grip
from ms_highway.game.features import features
from ms_highway.metareasoning.crowd.rule import CrowdMemory, CrowdOutcome, CrowdRule, first_crowd_memory
from ms_highway.planning.crowd import RUNGS, CrowdPlan, cold_crowd_start, plan_crowd, predict_human
from ms_highway.planning.human_models import JointPlan
from ms_highway.planning.way_out import keep_way_out
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.simulation.devices import device_mesh, share_among
from ms_highway.simulation.following import Rest, follow, warm_plan
from ms_highway.simulation.loop import IN_ONE_MODULE
from ms_highway.simulation.records import DECIDES

__all__ = ["CrowdEpisodes", "CrowdLoop", "CrowdRecords", "simulate_crowd"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CrowdLoop:
    """What all episodes of a crowd share.

    Attributes:
        crowd: the game, with the humans' rewards as the robot believes them.
        rule: chooses rungs where a schedule leaves them to it; None where schedules leave nothing.
        way_out: whether a control that leaves no way out is replaced, see `ms_highway.planning.way_out` (static).
    """

    crowd: Crowd
    rule: CrowdRule | None = None
    way_out: bool = field(default=True, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CrowdEpisodes:
    """What is each episode's own.

    Attributes:
        starts: all cars at the start: robot, humans, scripted cars.
        weights: of the rewards that the humans drive by, in the order of their features.
        seeds: for rules that draw.
        schedules: rung of every human in each step, or `ms_highway.simulation.records.DECIDES`.
    """

    starts: Float[Array, "episodes cars 4"]
    weights: Float[Array, "episodes humans features"]
    seeds: Int[Array, "episodes"]
    schedules: Int[Array, "episodes steps humans"]

    def __len__(self) -> int:
        return len(self.starts)


class CrowdRecords(NamedTuple):
    """Records of all steps.

    Attributes:
        rungs: that every human was predicted with, numbers of `ms_highway.planning.crowd.RUNGS`.
        status: of the robot's control, an index of `ms_highway.control.fallback.STATUSES`.
        reward: the robot's, after the step.
        collision: whether the robot collides in it.
        humans_collision: whether humans collide with each other, or with obstacles.
        gains: of each rung over the cheapest, estimated before the step; NaN where none was.
        states: all cars after the step.
    """

    rungs: Int[Array, "episodes steps humans"]
    status: Int[Array, "episodes steps"]
    reward: Float[Array, "episodes steps"]
    collision: Bool[Array, "episodes steps"]
    humans_collision: Bool[Array, "episodes steps"]
    gains: Float[Array, "episodes steps humans rungs"]
    states: Float[Array, "episodes steps cars 4"]


def simulate_crowd(loop: CrowdLoop, episodes: CrowdEpisodes, mesh: Mesh | None = None) -> CrowdRecords:
    """Run episodes from start to end, shared by the devices of a mesh, see `ms_highway.simulation.devices.share_among`.

    A device runs them one after the other: `ms_highway.planning.crowd.plan_crowd` takes as many rounds as there are
    humans to predict, and under `jax.vmap` every episode would take as many as the dearest one.

    Nothing is checked: where a state or a weight is not finite, rewards are not either.

    Args:
        loop: what the episodes share.
        episodes: one at least.
        mesh: of `ms_highway.simulation.devices.device_mesh`; by default, the first device.

    Returns:
        NumPy arrays.

    Raises:
        ValueError: without an episode.
    """
    if len(episodes) == 0:
        raise ValueError("there are no episodes to simulate; give one at least")
    mesh = device_mesh(jax.local_devices()[:1]) if mesh is None else mesh
    return share_among(mesh, partial(_simulate, loop), episodes, 1)


@partial(jit_quickly, options=IN_ONE_MODULE)
def _simulate(loop: CrowdLoop, episodes: CrowdEpisodes, count: Int[jax.Array, "1"]) -> CrowdRecords:
    """Run the first ``count`` episodes; the records of the others mean nothing."""
    run = partial(_episode, loop)
    shape = jax.eval_shape(run, jax.tree.map(lambda part: part[0], episodes))
    none = jax.tree.map(lambda part: jnp.zeros((len(episodes), *part.shape), part.dtype), shape)

    def one(place: Int[jax.Array, ""], done: CrowdRecords) -> CrowdRecords:
        records = run(jax.tree.map(lambda part: part[place], episodes))
        return jax.tree.map(lambda part, new: part.at[place].set(new), done, records)

    return jax.lax.fori_loop(0, count[0], one, none)


class _Now(NamedTuple):
    """What an episode carries from step to step."""

    outcome: CrowdOutcome  # of the last step
    memory: CrowdMemory
    robot: Rest[CrowdPlan]
    humans: Rest[JointPlan]  # of each human


def _episode(loop: CrowdLoop, own: CrowdEpisodes) -> CrowdRecords:
    """Run one episode, given without its axis."""
    crowd, start = loop.crowd, jnp.asarray(own.starts, jnp.float32)
    truth, still = replace(crowd, weights=own.weights), jnp.zeros((crowd.game.planner.horizon, 2))
    stills = jnp.zeros((crowd.humans, *still.shape))
    nowhere = CrowdPlan(still, stills)
    memory = jax.tree.map(jnp.asarray, first_crowd_memory(crowd.humans))._replace(seed=own.seeds)
    now = _Now(
        CrowdOutcome(start, start, still[0], stills[:, 0], jnp.zeros(()), nowhere),
        memory,
        Rest(nowhere, jnp.int32(0)),
        Rest(JointPlan(stills, stills[:, :0]), jnp.zeros(crowd.humans, jnp.int32)),
    )
    return jax.lax.scan(partial(_step, loop, truth), now, own.schedules)[1]


def _step(loop: CrowdLoop, truth: Crowd, now: _Now, scheduled: Int[jax.Array, "humans"]) -> tuple[_Now, CrowdRecords]:
    """Choose, plan and move; the humans plan for their rewards in the crowd ``truth``."""
    game, humans, state = loop.crowd.game, loop.crowd.humans, jnp.asarray(now.outcome.after)
    memory, gains = _choose(loop, now, scheduled)
    plan = _plan(loop, state, jnp.asarray(memory.rungs), now.robot)
    robot, status, robot_rest = follow(game, state[0], plan, now.robot)
    if loop.way_out:
        robot, replaced = keep_way_out(game, state, robot)
        status = jnp.where(replaced & (status == PLANNED), WAY_OUT, status)

    def drive(given: tuple[Int[jax.Array, ""], Rest[JointPlan]]) -> tuple[Float[jax.Array, "2"], Rest[JointPlan]]:
        human, rest = given
        own = JointPlan(predict_human(truth, state, human), rest.plan.human)
        control, _, rest = follow(game, state[1 + human], own, rest)
        return control, rest

    controls, human_rests = jax.lax.map(drive, (jnp.arange(humans), now.humans))
    players, scale = state[: 1 + humans], game.planner.control_scale
    driven = jnp.concatenate([robot[None], controls]) * scale
    if game.planner.grip is not None:  # as vehicles do
        driven = within_grip(game.world, jnp.asarray(game.planner.grip), players[:, 3], driven)
    scripted = keep_velocity(game.world, state[1 + humans :])
    after = step(game.world, state, jnp.concatenate([driven, scripted]))
    phi = features(game.scene, game.robot, after)
    reward, collision = phi @ game.robot.weights, phi[game.robot.names.index("collision")] > 0
    observed = recover_control(game.world, players[1:], after[1 : 1 + humans]) / scale
    outcome = CrowdOutcome(state, after, robot, observed, reward, robot_rest.plan)
    records = CrowdRecords(memory.rungs, status, reward, collision, _humans_collide(loop.crowd, after), gains, after)
    return _Now(outcome, memory, robot_rest, human_rests), records


def _choose(
    loop: CrowdLoop, now: _Now, scheduled: Int[jax.Array, "humans"]
) -> tuple[CrowdMemory, Float[jax.Array, "humans rungs"]]:
    """Return the memory with the rungs of the coming step, and the gains, where the rule decides."""
    unknown = jnp.full((loop.crowd.humans, len(RUNGS)), jnp.nan)
    undecided = now.memory._replace(rungs=scheduled, step=now.memory.step + 1)
    rule = loop.rule
    if rule is None:
        return undecided, unknown

    def decided() -> tuple[CrowdMemory, Float[jax.Array, "humans rungs"]]:
        memory, gains, _ = rule.choose(loop.crowd, now.memory, now.outcome)
        rungs = jnp.where(scheduled == DECIDES, memory.rungs, scheduled)
        return memory._replace(rungs=rungs), jnp.asarray(gains, jnp.float32)

    return jax.lax.cond((scheduled == DECIDES).any(), decided, lambda: (undecided, unknown))


def _plan(
    loop: CrowdLoop, state: Float[jax.Array, "cars 4"], rungs: Int[jax.Array, "humans"], rest: Rest[CrowdPlan]
) -> CrowdPlan:
    """Plan from the rest of the last plan, or where nothing is left, as without one."""
    cold = cold_crowd_start(loop.crowd, state)
    start = jax.tree.map(lambda warm, cold: jnp.where(rest.steps > 0, warm, cold), warm_plan(rest), cold)
    return plan_crowd(loop.crowd, state, rungs, start)


def _humans_collide(crowd: Crowd, state: Float[jax.Array, "cars 4"]) -> Bool[jax.Array, ""]:
    """Return whether a human collides with another human or with an obstacle."""
    game, humans = crowd.game, state[1 : 1 + crowd.humans]
    place = game.human.names.index("collision")

    def collides(human: Float[jax.Array, "4"], others: Float[jax.Array, "others 4"]) -> Bool[jax.Array, ""]:
        return features(game.scene, game.human, jnp.concatenate([human[None], others]))[place] > 0

    return jax.vmap(collides)(humans, humans[jnp.asarray(others_of(len(humans)))]).any()
