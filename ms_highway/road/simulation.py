"""Simulate plans of the robot in traffic."""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.geometry.curve import Curve
from ms_highway.perception.scene import (
    PerPathAndStep,
    RoadScene,
    States,
    Steps,
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


class StepRecord(NamedTuple):
    """What a step of the simulation records.

    These are the robot's state after it, its executed control, and the motion of others
    after it.
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
    start = (scene.robot, *positions_and_speeds(scene))

    def simulate_one(plan: Profiles, accelerations: PerPathAndStep) -> StepRecord:
        """Simulate a plan, given the accelerations of others that do not follow."""

        def step(carry: tuple, inputs: tuple) -> tuple[tuple, StepRecord]:
            car, along, speed = carry
            given_control, step_across, rows = inputs
            traffic = traffic_motion(situation, along, step_across, speed)

            # Both the robot and the others act on what is now.
            own_control = plan_control(situation, plan, car, traffic)
            desired = jnp.where(plan.is_given, given_control, own_control)
            next_car, control = advance(scene, planning, car, desired)
            along, speed = move_traffic(situation, behaviour, rows, traffic, car)

            moved = traffic_motion(situation, along, step_across, speed)
            return (next_car, along, speed), StepRecord(next_car, control, moved)

        # What others do in each step, [steps, 3, traffic].
        rows = jnp.stack([accelerations, behaviour.residual, behaviour.limit])
        rows = rows.T.swapaxes(1, 2)
        inputs = (plan.controls, across.T, rows)
        return jax.lax.scan(step, start, inputs)[1]

    records = jax.vmap(simulate_one)(plans, behaviour.accelerations)

    # Others have their steps in the last axis, [plans, traffic, steps].
    traffic = jax.tree.map(lambda field: jnp.swapaxes(field, 1, 2), records.traffic)

    # The robot in world coordinates, [plans, 4, steps].
    own_pose = bodies(scene, records.state)
    own_speed = records.state[..., 3]
    centre = jnp.stack([*own_pose, own_speed], axis=-2)

    # The others in world coordinates, [plans, traffic, 4, steps].
    place_on_paths = jax.vmap(Curve.place, (0, -2, 0), -2)
    x, y, path_heading = place_on_paths(scene.paths, traffic.along, across)
    heading = path_heading + scene.body_angle - _slip_angles(scene, traffic.along)
    world = jnp.stack([x, y, heading, traffic.speed], axis=-2)
    return SimulatedPlans(records.state, records.control, centre, world, traffic)


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
