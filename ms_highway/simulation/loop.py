"""The closed loop in pure JAX: human and robot plan, switching decides, the world moves; many episodes at once.

The pure functions are those that the environments call, so that both loops agree. Planning times are not measured here:
T(M) comes from a table.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, Int

from ms_highway.control.fallback import BRAKING, braking_control, followed
from ms_highway.game.dynamics import keep_velocity, recover_control, step
from ms_highway.game.features import features
from ms_highway.game.game import Game, swap
from ms_highway.metareasoning.switching import Memory, Switching, decide, first_memory
from ms_highway.planning.human_models import HumanModel, JointPlan, Naive
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.cores import cores

__all__ = [
    "DECIDES",
    "Episodes",
    "Loop",
    "Records",
    "device_mesh",
    "simulate",
    "use_devices",
    "usual_chunk",
]

AXIS = "episodes"  # of a mesh of devices
CHUNK, WIDE_CHUNK = 8, 256  # episodes that a processor computes together, one in each lane of AVX2, and an accelerator
CHUNKS = 128  # that a device takes at a time

IN_ONE_MODULE = {"xla_cpu_parallel_codegen_split_count": 1}
"""Compiler options, without which LLVM rounds otherwise where there are more threads to compile with."""

DECIDES = -1
"""In a schedule: Algorithm 1 chooses the rung of this step."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Loop:
    """What all episodes of a simulation have in common.

    Attributes:
        game: what is played.
        switching: ladder, costs, and the numbers of Algorithm 1; its price is each episode's own.
        others: models that schedules may use beside the ladder; their numbers go on after its rungs (static).
        chunk: episodes that are computed together (static). Each human model is computed only for the chunks that use
            it, so that smaller chunks compute less in vain, and larger ones make better use of wide hardware. The last
            digits depend on it, and chaotic episodes, as in Stay Back, make much of them.
    """

    game: Game
    switching: Switching
    others: tuple[HumanModel, ...] = field(default=(), metadata={"static": True})
    chunk: int = field(default=CHUNK, metadata={"static": True})

    @property
    def models(self) -> tuple[HumanModel, ...]:
        """All models, in the order of the numbers that stand for them in schedules and records."""
        return (*self.switching.ladder, *self.others)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episodes:
    """Where episodes differ.

    Attributes:
        starts: all cars at the start, robot first, then the human.
        prices: lambda, where Algorithm 1 decides.
        schedules: the number of the model that each step is planned with, or `DECIDES`.
        robot_weights, human_weights: of both rewards, in the order of their features.
    """

    starts: Float[Array, "episodes cars 4"]
    prices: Float[Array, "episodes"]
    schedules: Int[Array, "episodes steps"]
    robot_weights: Float[Array, "episodes features"]
    human_weights: Float[Array, "episodes features"]

    def __len__(self) -> int:
        return len(self.starts)


class Records(NamedTuple):
    """What happened, a record per step, like those of `ms_highway.experiments.runner.episode`.

    Attributes:
        model: number of the model that planned, in `Loop.models`.
        status: how the robot's control came about, a place in `ms_highway.control.fallback.STATUSES`.
        reward: the robot's, after the step.
        collision: whether the robot collided in it.
        gain_up, gain_down: estimated before the step, NaN where none was.
        states: all cars after the step.
    """

    model: Int[Array, "episodes steps"]
    status: Int[Array, "episodes steps"]
    reward: Float[Array, "episodes steps"]
    collision: Any  # truth values [episodes, steps]
    gain_up: Float[Array, "episodes steps"]
    gain_down: Float[Array, "episodes steps"]
    states: Float[Array, "episodes steps cars 4"]


def usual_chunk() -> int:
    """The size of a chunk that suits the devices that JAX uses by default."""
    return CHUNK if jax.default_backend() == "cpu" else WIDE_CHUNK


def device_mesh(devices: Sequence[jax.Device] | None = None) -> Mesh:
    """Devices in a row, to share episodes among; without any named, all of this process."""
    return Mesh(np.array(jax.local_devices() if devices is None else devices), (AXIS,))


def use_devices(count: int | None = None) -> Mesh:
    """Devices to share episodes among; where those are of CPUs, as many as wanted, or one per core.

    CPUs have as many devices as they are told to before JAX begins to compute; by ``XLA_FLAGS`` they may be told to
    have more than cores.

    Raises:
        ValueError: if there are fewer than wanted.
    """
    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        most = cores()
        with suppress(RuntimeError):  # it has begun, and has those that it has
            jax.config.update("jax_num_cpu_devices", min(count or most, most))
    devices = jax.local_devices()
    if count is not None and not 0 < count <= len(devices):
        raise ValueError(f"{count} devices are wanted; this process has {len(devices)}, of kind {devices[0].platform}")
    return device_mesh(devices[:count])


def simulate(loop: Loop, episodes: Episodes, mesh: Mesh | None = None) -> Records:
    """Run episodes from start to end, shared by the devices of a mesh.

    In every step, a device puts its episodes in the order of their models and computes them chunk by chunk, so that
    most chunks need a single model: under `jax.vmap` alone, every episode would pay for every model.

    Each device runs the same program, compiled for it alone, whatever their number and that of the episodes: XLA
    compiles a program for several devices otherwise than for one, and the two differ in their last digits.

    Nothing is checked on the way: where a state or a weight is not finite, rewards are not either.

    Args:
        loop: what the episodes have in common.
        episodes: one at least.
        mesh: of `device_mesh`; without, the first device.

    Returns:
        NumPy arrays.

    Raises:
        ValueError: without an episode.
    """
    count, mesh = len(episodes), device_mesh(jax.local_devices()[:1]) if mesh is None else mesh
    if count == 0:
        raise ValueError("there are no episodes to simulate; give one at least")
    share = loop.chunk * min(CHUNKS, -(-count // (loop.chunk * mesh.size)))
    shares = np.split(np.arange(count), range(share, count, share))
    records = []
    for first in range(0, len(shares), mesh.size):
        records += _simulate_shares(loop, episodes, shares[first : first + mesh.size], mesh)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *records)


def _simulate_shares(loop: Loop, episodes: Episodes, shares: list[np.ndarray], mesh: Mesh) -> list[Records]:
    """Run shares of the episodes, given by their places, one on each of the first devices."""
    size, counts = loop.chunk * CHUNKS, np.array([len(share) for share in shares])
    places = np.concatenate([np.pad(share, (0, size - len(share)), mode="edge") for share in shares])
    used = NamedSharding(Mesh(mesh.devices[: len(shares)], mesh.axis_names), PartitionSpec(AXIS))
    given = jax.device_put((jax.tree.map(lambda part: np.asarray(part)[places], episodes), counts), used)
    leaves, structure = jax.tree.flatten(given)
    own = zip(*([shard.data for shard in leaf.addressable_shards] for leaf in leaves), strict=True)
    with ThreadPoolExecutor(len(shares)) as threads:  # a device's first computation compiles its program
        each = threads.map(lambda parts: jax.device_get(_simulate(loop, *jax.tree.unflatten(structure, parts))), own)
        done = list(each)  # wait here: Python 3.11 forgets a thread if it is interrupted while it waits for its end
    return [jax.tree.map(lambda part, n=n: part[:n], records) for records, n in zip(done, counts, strict=True)]


class _Rest(NamedTuple):
    """What is left of a driver's last good plan: its scaled controls, and how many; none after braking."""

    controls: Float[jax.Array, "horizon 2"]
    steps: Int[jax.Array, ""]


class _Now(NamedTuple):
    """What an episode carries from step to step."""

    state: Float[jax.Array, "cars 4"]
    memory: Memory
    gain_up: Float[jax.Array, ""]
    gain_down: Float[jax.Array, ""]
    robot: _Rest
    human: _Rest


class _Own(NamedTuple):
    """An episode's own numbers."""

    price: Float[jax.Array, ""]
    robot_weights: Float[jax.Array, "features"]
    human_weights: Float[jax.Array, "features"]


@partial(jit_quickly, options=IN_ONE_MODULE)
def _simulate(loop: Loop, episodes: Episodes, count: Int[jax.Array, "1"]) -> Records:
    """Run the first episodes of as many as `CHUNKS` chunks hold; the records of others are of no use."""
    size = len(episodes)
    own = _Own(*map(jnp.asarray, (episodes.prices, episodes.robot_weights, episodes.human_weights)))
    none = _Rest(jnp.zeros((loop.game.planner.horizon, 2)), jnp.int32(0))
    unknown = jnp.float32(jnp.nan)
    before = _Now(jnp.zeros(0), first_memory(loop.switching), unknown, unknown, none, none)
    first = jax.tree.map(lambda part: jnp.broadcast_to(part, (size, *part.shape)), before)
    first = first._replace(state=jnp.asarray(episodes.starts, jnp.float32))
    chunks = (count[0] + loop.chunk - 1) // loop.chunk
    last = 2 * len(loop.models)  # in the order of models

    def one_step(now: _Now, scheduled: Int[jax.Array, "episodes"]) -> tuple[_Now, Records]:
        decides = scheduled == DECIDES
        models = jnp.where(decides, now.memory.rung, scheduled)
        now = now._replace(memory=now.memory._replace(rung=models))
        order = jnp.argsort(jnp.where(jnp.arange(size) < count, 2 * models + decides, last), stable=True)

        def one_chunk(number: Int[jax.Array, ""], done: tuple[_Now, Records]) -> tuple[_Now, Records]:
            places = jax.lax.dynamic_slice_in_dim(order, number * loop.chunk, loop.chunk)
            stepped = _step(loop, *jax.tree.map(lambda part: part[places], (now, own, decides)))
            return jax.tree.map(lambda part, new: part.at[places].set(new, unique_indices=True), done, stepped)

        return jax.lax.fori_loop(0, chunks, one_chunk, (now, _no_records(now)))

    _, records = jax.lax.scan(one_step, first, jnp.asarray(episodes.schedules).T)
    return jax.tree.map(lambda part: jnp.swapaxes(part, 0, 1), records)


def _no_records(now: _Now) -> Records:
    """Records of a step that are still to be filled in."""
    zero = jnp.zeros_like(now.gain_up)
    number = zero.astype(jnp.int32)
    return Records(number, number, zero, zero.astype(bool), zero, zero, jnp.zeros_like(now.state))


def _step(loop: Loop, now: _Now, own: _Own, decides: jax.Array) -> tuple[_Now, Records]:
    """One step of a chunk of episodes."""
    moved, records = jax.vmap(partial(_move, loop.game))(now, own, _plan(loop, now, own))
    return _choose(loop, now, own, decides, moved), records


def _game(game: Game, own: _Own) -> Game:
    """The game of one episode."""
    robot, human = game.robot, game.human
    return replace(
        game, robot=replace(robot, weights=own.robot_weights), human=replace(human, weights=own.human_weights)
    )


def _plan(loop: Loop, now: _Now, own: _Own) -> JointPlan:
    """The plan of every episode; only the models that some episode uses are computed."""

    def planned(model: HumanModel) -> JointPlan:
        return jax.vmap(lambda own, state: model.plan(_game(loop.game, own), state))(own, now.state)

    still = jnp.zeros((loop.chunk, loop.game.planner.horizon, 2))
    chosen = JointPlan(still, still)
    for number, model in enumerate(loop.models):
        uses = now.memory.rung == number
        plan = jax.lax.cond(uses.any(), partial(planned, model), lambda: JointPlan(still, still))
        chosen = jax.tree.map(lambda new, old, uses=uses: jnp.where(uses[:, None, None], new, old), plan, chosen)
    return chosen


def _follow(
    game: Game, car: Float[jax.Array, "4"], plan: JointPlan, rest: _Rest
) -> tuple[Float[jax.Array, "2"], Int[jax.Array, ""], _Rest]:
    """The scaled control to execute, its status and the rest that it leaves, see `ms_highway.control.fallback`."""
    finite = jnp.isfinite(plan.robot).all() & jnp.isfinite(plan.human).all()
    status, left = followed(finite, rest.steps, game.planner.horizon)
    controls = jnp.where(finite, plan.robot, jnp.roll(rest.controls, -1, axis=0))
    braking = braking_control(game, car) / game.planner.control_scale
    return jnp.where(status == BRAKING, braking, controls[0]), status, _Rest(controls, left)


class _Moved(NamedTuple):
    """What a step came to."""

    now: _Now  # before the choice of the next rung
    robot: Float[jax.Array, "2"]  # scaled, as executed
    human: Float[jax.Array, "2"]  # scaled, as observed
    reward: Float[jax.Array, ""]


def _move(game: Game, now: _Now, own: _Own, plan: JointPlan) -> tuple[_Moved, Records]:
    """The human plans, the world moves, and the robot earns its reward."""
    game, state = _game(game, own), now.state
    scale = game.planner.control_scale
    robot, status, robot_rest = _follow(game, state[0], plan, now.robot)
    mirrored, mirrored_state = swap(game, state)
    human, _, human_rest = _follow(mirrored, state[1], Naive().plan(mirrored, mirrored_state), now.human)
    controls = jnp.concatenate([jnp.stack([robot, human]) * scale, keep_velocity(game.world, state[2:])])
    after = step(game.world, state, controls)
    phi = features(game.scene, game.robot, after)
    reward, collision = phi @ game.robot.weights, phi[game.robot.names.index("collision")] > 0
    observed = recover_control(game.world, state[1], after[1]) / scale
    records = Records(now.memory.rung, status, reward, collision, now.gain_up, now.gain_down, after)
    unknown = jnp.float32(jnp.nan)
    following = _Now(after, now.memory, unknown, unknown, robot_rest, human_rest)
    return _Moved(following, robot, observed, reward), records


def _choose(loop: Loop, before: _Now, own: _Own, decides: jax.Array, moved: _Moved) -> _Now:
    """The rungs of the next step, where Algorithm 1 decides about them."""

    def one(before: _Now, own: _Own, moved: _Moved) -> _Now:
        switching = replace(loop.switching, price=own.price)
        game = _game(loop.game, own)
        memory, up, down = decide(switching, game, before.memory, before.state, moved.robot, moved.human, moved.reward)
        return moved.now._replace(memory=memory, gain_up=up, gain_down=down)

    decided = jax.lax.cond(decides.any(), lambda: jax.vmap(one)(before, own, moved), lambda: moved.now)
    return jax.tree.map(
        lambda new, old: jnp.where(decides.reshape(-1, *[1] * (new.ndim - 1)), new, old), decided, moved.now
    )
