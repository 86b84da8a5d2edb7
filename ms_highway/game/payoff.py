"""Sum a car's reward over its trajectory among those of others, and differentiate it.

The payoff of plans under a smooth reward includes the cost of stopping too late before
obstacles (`stopping_cost`), as horizons end before an obstacle matters. Without this
cost, a car drives fast until the obstacle is within the horizon, brakes as hard as
tyres allow, and stops too close to the obstacle to steer around it.

The matrix C, `Payoff.curvature`, is positive semidefinite. It takes the place of minus
the Hessian and needs no eigenvalues. Most features are concave functions of quantities
that are taken as linear in the motion (Gauss-Newton), so their sum is positive
semidefinite. Closeness to a body differs: it is a convex cost of a distance that is a
square itself, so the reward has a minimum between the two ways around the body. The
magnitude of this part is taken, as in the saddle-free Newton step of Dauphin et al.
(2014). C then bounds the Hessian H of closeness, ``-C <= H <= C``, and a step
``C^-1 g`` along the gradient g at most doubles the difference between two plans. Smooth
indicators of a lane, induced braking and user-defined features have no such form: they
are left out, and plans take short steps up them.

On physical ground, smooth plans also pay near other bodies (`ms_highway.game.contact`),
whatever the weights of the reward. This cost is convex in a distance D; second
derivatives of D are left out of C, so that C bounds the Hessian from above alone.
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
    RISK,
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
from ms_highway.runtime.arrays import (
    Array,
    Scalar,
    Times,
    Trajectories,
    Trajectory,
)


@dataclass(frozen=True)
class StoppingSettings:
    """Set the room that plans keep to stop before obstacles, see `stopping_cost`."""

    room: float = 0.8
    """Distance left to an obstacle after a stop [car lengths]: 4 m to steer around it.
    """
    lateral_gap: float = 0.4
    """Gap between bodies at which an obstacle is out of the way [car widths]: 1 m."""
    smoothing: float = 0.2
    """Excess beyond which the cost of being late or aligned is nearly linear [1]."""


STOPPING = StoppingSettings()


def stopping_cost(scene: Scene, braking: Scalar, own: Motion) -> Times:
    """Return the cost of stopping too late before obstacles ahead, ``sum r^2`` with::

        r = soft(d) soft(1 - (dy / w)^2) s,  soft(z) = max(z, 0)^2 / (max(z, 0) + 0.2)
        d = (v^2 / (2 b) + l - dx) / car length + room

    The centres are (dx, dy) apart. Bodies touch at ``dx = l``, and pass each other with
    the ``lateral_gap`` of `StoppingSettings` between them at ``dy = w``. The factor s
    falls smoothly from 1 at ``dx = l`` to 0 at ``dx = -l``, where the obstacle is
    passed.

    Args:
        scene: obstacles and sizes of bodies.
        braking: deceleration b; if it is infinite, only the gap counts.
        own: motion of the car, arrays [steps].

    Returns:
        An array [steps], zero except in the middle step: a plan pays it once.
    """
    return jnp.sum(lateness(scene, braking, own) ** 2, axis=0)


def lateness(
    scene: Scene,
    braking: Scalar,
    own: Motion,
) -> Float[jax.Array, "obstacles steps"]:
    """Return r of `stopping_cost` for each obstacle, zero except in the middle step."""
    obstacle_x, obstacle_y = jnp.asarray(scene.obstacles).T[..., None]
    car_size = jnp.asarray(scene.car_size)
    car_length, car_width = car_size
    length, width = (car_size + jnp.asarray(scene.obstacle_size)) / 2
    gap = obstacle_x - own.x  # dx, between centres

    # soft(d): how much too late the car would stop.
    stopping_distance = own.speed**2 / (2 * braking)
    missing_room = (stopping_distance + length - gap) / car_length
    too_far = missing_room + STOPPING.room
    late = soft_positive(too_far, STOPPING.smoothing)

    # soft(1 - (dy / w)^2): how much the obstacle is in the car's way.
    offset = own.y - obstacle_y
    clear = width + STOPPING.lateral_gap * car_width
    in_way = 1 - (offset / clear) ** 2
    aligned = soft_positive(in_way, STOPPING.smoothing)

    # s: smooth step from the obstacle's near end to its far end.
    ahead = jnp.clip((gap / length + 1) / 2, 0.0, 1.0)
    steps = own.x.shape[-1]
    half_way = np.arange(steps) == (steps - 1) // 2
    return half_way * late * aligned * ahead**2 * (3 - 2 * ahead)


HessianBlocks = Float[jax.Array, "fields fields steps"]
"""Second derivatives in the fields of a trajectory at every step.

A Hessian over all steps is zero outside of these blocks.
"""

PointPlaces = Float[jax.Array, "2 points steps"]
"""x and y of points of a car."""


class SecondOrder(NamedTuple):
    """Derivatives of a payoff at every step of a trajectory.

    Attributes:
        gradient: in the car's own fields.
        hessian: twice in its own fields.
        mixed_hessian: in its own fields, then in those of its partner.
    """

    gradient: Trajectory
    hessian: HessianBlocks
    mixed_hessian: HessianBlocks


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Payoff:
    """What trajectories earn.

    It holds only what this needs, so that all plans share one trace of each method.

    Attributes:
        scene: road, obstacles and bodies.
        reward: of the car.
        braking: deceleration with which the car keeps room to stop before obstacles;
            None without the `stopping_cost`, which the price of a collision weighs.
        smooth: whether jumps of the reward are smooth (static).
    """

    scene: Scene
    reward: Reward
    braking: Scalar | None
    smooth: bool = field(metadata={"static": True})

    @property
    def avoids_contact(self) -> bool:
        """Whether plans pay near other bodies: if they climb a smooth reward."""
        return self.smooth and self.scene.bodies_collide

    @jax.jit
    def steps(self, own: Trajectory, others: Trajectories) -> Float[Array, "steps"]:
        """Compute the reward after each step of a trajectory among those of others."""
        motion = Motion(*own)
        around = Motion(*jnp.moveaxis(others, 1, 0))
        rewards = motion_reward(self.scene, self.reward, motion, around, self.smooth)
        if self.avoids_contact:
            rewards = rewards - contact_cost(self.scene, motion, around)
        if self.braking is None:
            return rewards
        price = self.reward.price("collision")
        lateness_cost = stopping_cost(self.scene, self.braking, motion)
        return rewards - price * lateness_cost

    @jax.jit
    def total(self, own: Trajectory, others: Trajectories) -> Scalar:
        """Sum the rewards of all steps."""
        return jnp.sum(self.steps(own, others))

    @jax.jit
    def slopes(
        self,
        own: Trajectory,
        others: Trajectories,
    ) -> tuple[Trajectory, Trajectories]:
        """Return the gradients in the car's trajectory, and in those of others."""
        gradients = jax.grad(lambda *paths: self.total(*paths), argnums=(0, 1))
        return gradients(own, others)

    @jax.jit
    def second_order(self, own: Trajectory, others: Trajectories) -> SecondOrder:
        """Differentiate the sum twice, in as many directions as a motion has fields."""

        def gradients(own: Trajectory) -> tuple[Trajectory, Trajectory]:
            own_gradient, gradients_of_others = self.slopes(own, others)
            return own_gradient, gradients_of_others[0]

        values, derivatives = along_fields(gradients, own)
        gradient, _ = values
        hessian, mixed_hessian = derivatives
        return SecondOrder(gradient, hessian, mixed_hessian)

    @jax.jit
    def curvature(self, own: Trajectory, others: Trajectories) -> HessianBlocks:
        """Return a positive semidefinite approximation of minus the Hessian of the sum.

        It is in the fields of the car's trajectory. For costs ``c_j(q_j)`` of
        quantities q_j, it is ``sum_j max(c_j'', 0) (dq_j/ds) (dq_j/ds)^T``. For the
        distances D of `ms_highway.game.collision_risk`, ``|c_j'| d2D_j/ds2`` is added.
        """
        scene = self.scene
        around = Motion(*jnp.moveaxis(others, 1, 0))
        points = body_points(jnp.asarray(scene.car_size), scene.corner)

        # Closeness to bodies, by the places of points of the car.
        bodies = bodies_around(scene, around)
        total = _half_hessian_of_points(own, points, partial(self._closeness, bodies))
        if self.avoids_contact:
            contact = partial(car_residuals, scene, others=around)
            corners = contact_points(scene)
            total = total + _half_hessian_of_points(own, corners, contact)

        # All else is a sum of squares of quantities that are taken as linear in the
        # motion.
        residuals = partial(self._residuals, around)
        _, slopes = along_fields(residuals, own)  # [fields, residuals, steps]
        products = slopes[:, None] * slopes
        return 2 * (total + jnp.sum(products, axis=2))

    def _residuals(
        self,
        others: Motion,
        path: Trajectory,
    ) -> Float[jax.Array, "residuals steps"]:
        """Return quantities whose squares are the costs of road and traffic.

        They are so up to constants.
        """
        scene = self.scene
        reward = self.reward
        own = Motion(*path)
        per_unit = 1 / self.scene.length_unit
        weights = dict(zip(reward.names, jnp.unstack(reward.weights), strict=True))

        # Pairs of a weight and a quantity that it weighs the square of.
        progress = own.speed * own.cosine / reward.speed_limit
        lane_weight = weights["lane_alignment"] + weights["target_lane"]
        depth = depth_off_road(scene, own, smooth=True) * per_unit
        costs = [
            (weights["speed"], progress),
            (lane_weight, own.y * per_unit),
            (-weights["off_road"], depth),
        ]
        if scene.leader is not None:
            costs.append((weights["gap"], own.x * per_unit))
        if "headway" in weights:
            along, _, attended = attention(scene, own, others)
            to_leaders = jnp.where(along > 0, attended, 0.0).sum(axis=0)
            share = jax.lax.stop_gradient(jnp.sqrt(to_leaders))
            reach = share * (own.x + reward.headway * own.speed) * per_unit
            pace = share * own.speed / reward.speed_limit
            costs.append((weights["headway"], reach))
            costs.append((weights["closing_speed"], pace))
        weighed = []
        for weight, quantity in costs:
            root = jnp.sqrt(jnp.maximum(weight, 0.0))
            weighed.append(root * quantity)
        residuals = jnp.stack(weighed)

        # Costs of plans that the reward does not weigh.
        if self.avoids_contact and len(scene.obstacles):
            residuals = jnp.concatenate([residuals, obstacle_residuals(scene, own)])
        if self.braking is None:
            return residuals
        root_of_price = jnp.sqrt(reward.price("collision"))
        late = root_of_price * lateness(scene, self.braking, own)
        return jnp.concatenate([residuals, late])

    def _closeness(
        self,
        bodies: Bodies,
        points: PointPlaces,
    ) -> Float[jax.Array, "3 bodies points steps"]:
        """Return quantities whose squares have second derivatives like closeness.

        With the offsets p along and q across a body, in halves of its length and width,
        closeness costs ``c(D - 1)`` at ``D = p^2 + q^2``. The quantities are
        ``sqrt(-c') p``, ``sqrt(-c') q`` and ``sqrt(c'' / 2) (D - 1)``, with both roots
        taken as constant.
        """
        # Offsets of the points in the frame of each body [bodies, points, steps].
        other = Motion(*(part[:, None] for part in bodies.motion))
        dx = points[0] - other.x
        dy = points[1] - other.y
        ahead = (other.cosine * dx + other.sine * dy) / (bodies.length / 2)
        across = (other.cosine * dy - other.sine * dx) / (bodies.width / 2)
        distance = ahead**2 + across**2 - 1

        # Derivatives of the cost of the risk, -c' and c'' / 2.
        now = jax.lax.stop_gradient(distance)
        risk_price = self.reward.price("collision_risk") * bodies.share
        risk = risk_price * jnp.exp(-bodies.sharpness * now)
        fall = bodies.sharpness * risk
        half_second_derivative = bodies.sharpness**2 * risk / 2

        # Those of the smooth indicator, factor max(margin - (D - 1), 0)^3.
        if not self.avoids_contact:
            price = RISK.smooth_factor * self.reward.price("collision")
            depth = jnp.maximum(RISK.smooth_margin - now, 0.0)
            fall = fall + 3 * price * depth**2
            half_second_derivative = half_second_derivative + 3 * price * depth
        fall = jnp.sqrt(fall)
        half_second_derivative = jnp.sqrt(half_second_derivative)
        return jnp.stack(
            [fall * ahead, fall * across, half_second_derivative * distance]
        )


def _half_hessian_of_points(
    own: Trajectory,
    points: Float[Array, "points 2"],
    residuals: Callable[[PointPlaces], Float[jax.Array, "*rows points steps"]],
) -> HessianBlocks:
    """Return half of the second derivatives of the sum of squares of residuals.

    They are in the fields of a trajectory.

    Args:
        own: trajectory of the car.
        points: of its body, in its own frame [m].
        residuals: function of the points' places; each result depends on one point and
            one step.
    """
    along, across = points.T[..., None]

    def places_of(path: Trajectory) -> PointPlaces:
        x, y, cosine, sine, _ = path
        point_x = x + cosine * along - sine * across
        point_y = y + sine * along + cosine * across
        return jnp.stack([point_x, point_y])

    # Derivatives of the places in the fields, and of the residuals in the places.
    places, place_slopes = along_fields(places_of, own)
    _, residual_slopes = along_fields(residuals, places)

    # Gauss-Newton: products of slopes, summed over residuals but not points. A sum is
    # one kernel, unlike an einsum.
    rows = tuple(range(2, residual_slopes.ndim - 1))
    products = residual_slopes[:, None] * residual_slopes
    hessians = jnp.sum(products, axis=rows)  # [coordinates, coordinates, points, steps]

    # Chain rule, summed over points: f and g are fields, a and b coordinates of places.
    return jnp.einsum("fapt,abpt,gbpt->fgt", place_slopes, hessians, place_slopes)
