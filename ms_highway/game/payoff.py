"""Sum a car's reward over its trajectory among those of others, and differentiate the
sum.

The payoff of a plan for seconds includes the cost of stopping too late before obstacles
(`stopping_cost`), as horizons end before an obstacle matters. Without this cost, a car
drives fast until the obstacle is within the horizon, brakes as hard as tyres allow, and
stops too close to the obstacle to steer around it.

The matrix `Payoff.curvature` is positive semidefinite and takes the place of minus the
Hessian, without eigenvalues. Most features are concave functions of quantities that are
taken as linear in the motion (Gauss-Newton), so their sum is positive semidefinite.
Closeness to a body differs: it is a convex cost of a distance that is a square itself,
so the reward bends upwards between the two ways around the body. The magnitude of this
part is taken, as in the saddle-free Newton step of Dauphin et al. (2014). The matrix C
then bounds the Hessian H of closeness, ``-C <= H <= C``, and a step ``C^-1 g`` at most
doubles the difference between two plans. Smooth indicators of a lane, induced braking
and user-defined features have no such form: they are left out, and plans take short
steps up them.

On physical ground, smooth plans also pay near other bodies (`ms_highway.game.contact`),
whatever the weights of the reward. This cost is convex in a distance D; how D bends is
left out of C, so that C bounds the Hessian from above alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.collision_risk import (
    SMOOTH_FACTOR,
    SMOOTH_MARGIN,
    Bodies,
    bodies_around,
)
from ms_highway.game.contact import (
    car_residuals,
    contact_cost,
    contact_points,
    obstacle_residuals,
)
from ms_highway.game.dynamics import Motion
from ms_highway.game.features import (
    attention,
    depth_off_road,
    motion_reward,
    soft_positive,
)
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.geometry.bodies import body_points
from ms_highway.numerics.second_derivatives import along_fields
from ms_highway.runtime.arrays import Scalar, Times, Trajectories, Trajectory

STOPPING_MARGIN = (
    0.8  # car lengths (4 m) left to an obstacle after a stop: room to steer around it
)
LATERAL_MARGIN = (
    0.4  # car widths (1 m) between bodies, at which an obstacle is no longer in the way
)
SMOOTHING = 0.2  # beyond which the cost of being late or aligned is nearly linear


def stopping_cost(scene: Scene, braking: Scalar, own: Motion) -> Times:
    """Return the cost of stopping too late before obstacles that are ahead in the car's
    way, ``sum r^2`` with::

        r = soft(d) soft(1 - (dy / w)^2) s,  soft(z) = max(z, 0)^2 / (max(z, 0) + 0.2)
        d = (v^2 / (2 b) + l - dx) / car length + room

    The centres are (dx, dy) apart. Bodies touch at ``dx = l``, and pass each other with
    `LATERAL_MARGIN` between them at ``dy = w``. The factor s falls smoothly from 1 at
    ``dx = l`` to 0 at ``dx = -l``, where the obstacle is passed.

    Args:
        scene: obstacles and sizes of bodies.
        braking: deceleration b; if it is infinite, only the gap counts.
        own: motion of the car, arrays [steps].

    Returns:
        An array [steps], zero except in the step half-way.
    """
    return jnp.sum(lateness(scene, braking, own) ** 2, axis=0)


def lateness(
    scene: Scene, braking: Scalar, own: Motion
) -> Float[jax.Array, "obstacles steps"]:
    """Return r of `stopping_cost` for every obstacle, zero except in the step half-way."""
    obstacle_x, obstacle_y = jnp.asarray(scene.obstacles).T[..., None]
    car_length, car_width = jnp.asarray(scene.car_size)
    length, width = (jnp.asarray(scene.car_size) + jnp.asarray(scene.obstacle_size)) / 2
    gap = obstacle_x - own.x
    late = soft_positive(
        (own.speed**2 / (2 * braking) + length - gap) / car_length + STOPPING_MARGIN,
        SMOOTHING,
    )
    aligned = soft_positive(
        1 - ((own.y - obstacle_y) / (width + LATERAL_MARGIN * car_width)) ** 2,
        SMOOTHING,
    )
    ahead = jnp.clip((gap / length + 1) / 2, 0.0, 1.0)
    steps = own.x.shape[-1]
    half_way = np.arange(steps) == (steps - 1) // 2
    return half_way * late * aligned * ahead**2 * (3 - 2 * ahead)


Bends = Float[jax.Array, "fields fields steps"]
Points = Float[jax.Array, "2 points steps"]


class SecondOrder(NamedTuple):
    """Derivatives of a payoff at every step of a trajectory.

    Attributes:
        slope: in the car's own fields.
        own: twice in its own fields.
        partner: in its own fields, then in those of its partner.
    """

    slope: Trajectory
    own: Bends
    partner: Bends


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Payoff:
    """What trajectories earn. It holds only what this needs, so that all plans share
    one trace of each method.

    Attributes:
        scene: road, obstacles and bodies.
        reward: of the car.
        braking: deceleration with which the car keeps room to stop before obstacles,
            see `stopping_cost`, at the price of a collision; None without this cost.
        smooth: whether jumps of the reward are smooth (static).
    """

    scene: Scene
    reward: Reward
    braking: Scalar | None
    smooth: bool = field(metadata={"static": True})

    @property
    def avoids_contact(self) -> bool:
        """Whether plans pay near other bodies; they do if they climb a smooth reward."""
        return self.smooth and self.scene.bodies_collide

    @jax.jit
    def steps(self, own: Trajectory, others: Trajectories) -> Float[jax.Array, "steps"]:
        """Compute the reward after each step of a trajectory, among the trajectories of
        all others.
        """
        motion = Motion(*own)
        around = Motion(*jnp.moveaxis(others, 1, 0))
        rewards = motion_reward(self.scene, self.reward, motion, around, self.smooth)
        if self.avoids_contact:
            rewards = rewards - contact_cost(self.scene, motion, around)
        if self.braking is None:
            return rewards
        return rewards - self.reward.price("collision") * stopping_cost(
            self.scene, self.braking, motion
        )

    @jax.jit
    def total(self, own: Trajectory, others: Trajectories) -> Scalar:
        """Sum the rewards of all steps."""
        return jnp.sum(self.steps(own, others))

    @jax.jit
    def slopes(
        self, own: Trajectory, others: Trajectories
    ) -> tuple[Trajectory, Trajectories]:
        """Differentiate the sum in the car's trajectory, and in those of all others."""
        return jax.grad(lambda *paths: self.total(*paths), argnums=(0, 1))(own, others)

    @jax.jit
    def second_order(self, own: Trajectory, others: Trajectories) -> SecondOrder:
        """Differentiate the sum twice, in as many directions as a motion has fields."""

        def slopes(own: Trajectory) -> tuple[Trajectory, Trajectory]:
            slope, around = self.slopes(own, others)
            return slope, around[0]

        (slope, _), bends = along_fields(slopes, own)
        return SecondOrder(slope, *bends)

    @jax.jit
    def curvature(self, own: Trajectory, others: Trajectories) -> Bends:
        """Return a convex matrix in place of minus the Hessian of the sum, in the
        fields of the car's trajectory.

        For costs ``c_j(q_j)`` of quantities q_j, it is ``sum_j max(c_j'', 0) (dq_j/ds)
        (dq_j/ds)^T``. For the distances D of `ms_highway.game.collision_risk`, ``|c_j'|
        d2D_j/ds2`` is added.
        """
        scene = self.scene
        around = Motion(*jnp.moveaxis(others, 1, 0))
        points = body_points(jnp.asarray(scene.car_size), scene.corner)

        # Closeness to bodies, by the places of points of the car.
        bodies = bodies_around(scene, around)
        total = _bends_of_points(own, points, partial(self._closeness, bodies))
        if self.avoids_contact:
            contact = partial(car_residuals, scene, others=around)
            total = total + _bends_of_points(own, contact_points(scene), contact)

        # All else is a sum of squares of quantities that are taken as linear in the
        # motion.
        _, slopes = along_fields(partial(self._residuals, around), own)
        return 2 * (total + jnp.sum(slopes[:, None] * slopes, axis=2))

    def _residuals(
        self, others: Motion, path: Trajectory
    ) -> Float[jax.Array, "residuals steps"]:
        """Return quantities whose squares are, up to constants, the costs of features
        of the road and of traffic.
        """
        scene = self.scene
        reward = self.reward
        own = Motion(*path)
        per_unit = 1 / self.scene.length_unit
        weights = dict(zip(reward.names, jnp.unstack(reward.weights), strict=True))
        costs = [
            (weights["speed"], own.speed * own.cosine / reward.speed_limit),
            (weights["lane_alignment"] + weights["target_lane"], own.y * per_unit),
            (-weights["off_road"], depth_off_road(scene, own, smooth=True) * per_unit),
        ]
        if scene.leader is not None:
            costs.append((weights["gap"], own.x * per_unit))
        if "headway" in weights:
            along, _, attended = attention(scene, own, others)
            ahead = jax.lax.stop_gradient(
                jnp.sqrt(jnp.where(along > 0, attended, 0.0).sum(axis=0))
            )
            costs.append(
                (
                    weights["headway"],
                    ahead * (own.x + reward.headway * own.speed) * per_unit,
                )
            )
            costs.append(
                (weights["closing_speed"], ahead * own.speed / reward.speed_limit)
            )
        residuals = jnp.stack(
            [
                jnp.sqrt(jnp.maximum(weight, 0.0)) * quantity
                for weight, quantity in costs
            ]
        )
        if self.avoids_contact and len(scene.obstacles):
            residuals = jnp.concatenate([residuals, obstacle_residuals(scene, own)])
        if self.braking is None:
            return residuals
        late = jnp.sqrt(reward.price("collision")) * lateness(scene, self.braking, own)
        return jnp.concatenate([residuals, late])

    def _closeness(
        self, bodies: Bodies, points: Points
    ) -> Float[jax.Array, "3 bodies points steps"]:
        """Return quantities whose squares bend like closeness: the offset from a body
        along and across it, and D.
        """
        other = Motion(*(part[:, None] for part in bodies.motion))
        dx = points[0] - other.x
        dy = points[1] - other.y
        ahead = (other.cosine * dx + other.sine * dy) / (bodies.length / 2)
        across = (other.cosine * dy - other.sine * dx) / (bodies.width / 2)
        distance = ahead**2 + across**2 - 1
        near = jax.lax.stop_gradient(distance)
        close = (
            self.reward.price("collision_risk")
            * bodies.share
            * jnp.exp(-bodies.sharpness * near)
        )
        fall = bodies.sharpness * close
        bend = bodies.sharpness**2 * close / 2
        if not self.avoids_contact:
            price = SMOOTH_FACTOR * self.reward.price("collision")
            depth = jnp.maximum(SMOOTH_MARGIN - near, 0.0)
            fall = fall + 3 * price * depth**2
            bend = bend + 3 * price * depth
        fall = jnp.sqrt(fall)
        bend = jnp.sqrt(bend)
        return jnp.stack([fall * ahead, fall * across, bend * distance])


def _bends_of_points(
    own: Trajectory,
    points: Float[jax.Array, "points 2"],
    residuals: Callable[[Points], Float[jax.Array, "*rows points steps"]],
) -> Bends:
    """Return half of how the sum of squares of residuals bends in the fields of a
    trajectory.

    Args:
        own: trajectory of the car.
        points: of its body, in its own frame [m].
        residuals: function of the points' places; each result depends on one point and
            one step.
    """
    along, across = points.T[..., None]

    def places_of(path: Trajectory) -> Points:
        x, y, cosine, sine, _ = path
        return jnp.stack(
            [x + cosine * along - sine * across, y + sine * along + cosine * across]
        )

    places, moved = along_fields(places_of, own)
    _, slopes = along_fields(residuals, places)
    rows = tuple(range(2, slopes.ndim - 1))
    bends = jnp.sum(slopes[:, None] * slopes, axis=rows)  # one kernel, unlike an einsum
    return jnp.einsum("fapt,abpt,gbpt->fgt", moved, bends, moved)
