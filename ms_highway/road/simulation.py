"""Simulate plans of the robot in traffic."""

from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.geometry.curve import Curve
from ms_highway.perception.scene import (
    PerPathAndStep,
    RoadScene,
    States,
    Steps,
    Traffic,
    World,
)
from ms_highway.road.following import (
    Behaviour,
    TrafficMotion,
    lateral_positions,
    move_traffic,
    positions_and_speeds,
    traffic_motion,
)
from ms_highway.road.plan_control import plan_control
from ms_highway.road.proposals import Profiles
from ms_highway.road.robot_motion import GRIP_USE, advance, bodies
from ms_highway.road.traffic import Situation
from ms_highway.runtime.arrays import (
    Array,
    Car,
    Control,
    ManyControls,
    Numeric,
)


class SimulatedPlans(NamedTuple):
    """Simulated plans.

    Attributes:
        states: states of the robot after each step, in road coordinates.
        controls: executed controls of the robot.
        centre: trajectories of the robot's centre.
        world: trajectories of others.
        traffic: motion of others on the robot's route after each step.
    """

    states: States
    controls: ManyControls
    centre: World
    world: World
    traffic: TrafficMotion

    @property
    def robot(self) -> PerPathAndStep:
        """The robot's s, d, heading and speed, [4, plans, 1, steps]."""
        return jnp.moveaxis(self.states[:, None], -1, 0)


class Moving(NamedTuple):
    """What moves from step to step.

    Attributes:
        car: state of the robot.
        along: positions of others along their paths [m].
        speed: of others along their paths [m/s].
    """

    car: Car
    along: Traffic
    speed: Traffic


class StepInputs(NamedTuple):
    """What is given for a step, whatever happens before it.

    Attributes:
        control: of the robot, if its controls are given.
        across: lateral positions of others on their paths [m].
        rows: accelerations, residuals and limits of others, see `move_traffic`.
    """

    control: Control
    across: Traffic
    rows: Float[Array, "3 traffic"]


class StepRecord(NamedTuple):
    """What a step of the simulation records.

    Attributes:
        state: of the robot after the step.
        control: that the robot executed.
        traffic: motion of others after the step.
    """

    state: Car
    control: Control
    traffic: TrafficMotion


def simulate(
    situation: Situation,
    behaviour: Behaviour,
    plans: Profiles,
) -> SimulatedPlans:
    """Simulate plans among others that respond to each of them."""
    scene = situation.scene
    planning = situation.planning
    across = lateral_positions(scene, planning.times)  # [traffic, steps]
    first_along, first_speed = positions_and_speeds(scene)
    start = Moving(scene.robot, first_along, first_speed)

    def simulate_one(plan: Profiles, accelerations: PerPathAndStep) -> StepRecord:
        """Simulate a plan, given the accelerations of others that do not follow."""

        def step(now: Moving, given: StepInputs) -> tuple[Moving, StepRecord]:
            """Move the robot and the others; both act on what is now."""
            traffic = traffic_motion(situation, now.along, given.across, now.speed)
            own_control = plan_control(situation, plan, now.car, traffic)
            desired = jnp.where(plan.is_given, given.control, own_control)
            car, control = advance(scene, planning, now.car, desired)
            along, speed = move_traffic(
                situation, behaviour, given.rows, traffic, now.car
            )
            moved = traffic_motion(situation, along, given.across, speed)
            return Moving(car, along, speed), StepRecord(car, control, moved)

        # What others do in each step, [3, traffic, steps] to [steps, 3, traffic].
        rows = jnp.stack([accelerations, behaviour.residual, behaviour.limit])
        rows_of_steps = rows.T.swapaxes(1, 2)
        inputs = StepInputs(plan.controls, across.T, rows_of_steps)
        _, records = jax.lax.scan(step, start, inputs)
        return records

    records = jax.vmap(simulate_one)(plans, behaviour.accelerations)

    # Others have their steps in the last axis, [plans, traffic, steps].
    traffic = jax.tree.map(lambda field: jnp.swapaxes(field, 1, 2), records.traffic)

    # The robot in world coordinates, [plans, 4, steps].
    own_pose = bodies(scene, records.state)
    own_speed = records.state[..., 3]
    centre = jnp.stack([*own_pose, own_speed], axis=-2)
    world = _in_world(scene, traffic, across)
    return SimulatedPlans(records.state, records.control, centre, world, traffic)


def _in_world(
    scene: RoadScene, traffic: TrafficMotion, across: PerPathAndStep
) -> World:
    """Return trajectories of others in world coordinates, [plans, traffic, 4, steps].

    Args:
        scene: the road.
        traffic: motion of others after each step.
        across: lateral positions on their paths after each step [m].
    """
    place_on_paths = jax.vmap(Curve.place, (0, -2, 0), -2)
    x, y, path_heading = place_on_paths(scene.paths, traffic.along, across)
    slip_angles = _slip_angles(scene, traffic.along)
    heading = path_heading + scene.body_angle - slip_angles
    return jnp.stack([x, y, heading, traffic.speed], axis=-2)


def _slip_angles(scene: RoadScene, along: PerPathAndStep) -> PerPathAndStep:
    """Return the slip angles of others.

    In bends, centres do not move along the heading.
    """
    bend_of_paths = jax.vmap(Curve.bend, (0, -2), -2)
    bends = bend_of_paths(scene.paths, along)
    bends = jnp.where(scene.moving[:, None], bends, 0.0)
    sine = bends * scene.sizes[:, :1] / 2
    largest = GRIP_USE.largest_slip_sine
    return jnp.arcsin(jnp.clip(sine, -largest, largest))


def earlier(first: Numeric, values: Steps) -> Steps:
    """Shift values by a step.

    The first value comes first, the last of the values is dropped.
    """
    first_column = jnp.full_like(values[..., :1], first)
    return jnp.concatenate([first_column, values[..., :-1]], axis=-1)
