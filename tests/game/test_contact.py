"""On physical ground, bodies collide that overlap, and plans pay before they touch."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from shapely import Point, affinity, box

from ms_highway.game.collision_risk import touches
from ms_highway.game.contact import contact_cost, overlap
from ms_highway.game.dynamics import observe
from ms_highway.game.scenario import build_game
from ms_highway.game.scenarios import DENSE_MERGE_V1
from ms_highway.game.scene import Scene

SCENE = Scene(np.zeros(1), 3.3, obstacles=np.zeros((1, 2)), contact="bodies")
ROAD = replace(SCENE, obstacles=np.zeros((0, 2)))
POSES = 10_000


def random_poses(random, spread):
    """Draw x, y and heading of bodies near the origin; the speed does not matter."""
    places = random.uniform(-spread, spread, (POSES, 2))
    headings = random.uniform(-np.pi, np.pi, (POSES, 1))
    return np.concatenate([places, headings, np.zeros((POSES, 1))], axis=1)


def rectangle(pose):
    """Return the body of a car as a polygon."""
    length, width = SCENE.car_size
    x, y, heading, _ = pose
    body = box(-length / 2, -width / 2, length / 2, width / 2)
    turned = affinity.rotate(body, heading, origin=(0, 0), use_radians=True)
    return affinity.translate(turned, x, y)


def check(found, bodies, others):
    """Check overlaps against those of shapely.

    Bodies that merely touch may count or not.
    """
    for overlaps, body, other in zip(found, bodies, others, strict=True):
        area = body.intersection(other).area
        touch = area < 1e-4 and body.distance(other) < 1e-4
        assert touch or overlaps == (area > 0)
    assert 0.2 < np.mean(found) < 0.8


def test_cars_overlap_exactly_where_shapely_says_so():
    random = np.random.default_rng(0)
    own = random_poses(random, 3.0)
    other = random_poses(random, 3.0)
    found = jax.jit(overlap)(ROAD, observe(own), observe(other[None]))
    check(np.asarray(found), map(rectangle, own), map(rectangle, other))


def test_a_cone_is_overlapped_like_a_circle_as_wide():
    own = random_poses(np.random.default_rng(1), 4.0)
    nobody = np.full((1, POSES, 4), 1e3)
    found = jax.jit(overlap)(SCENE, observe(own), observe(nobody))
    cone = Point(0, 0).buffer(SCENE.obstacle_size[1] / 2, quad_segs=512)
    check(np.asarray(found), map(rectangle, own), [cone] * POSES)


def test_where_cars_overlap_plans_pay():
    """A car pays itself if both directions differ by less than 7 degrees.

    Otherwise, one of both pays.
    """
    random = np.random.default_rng(2)
    one = random_poses(random, 4.0)
    two = random_poses(random, 4.0)
    two[::2, 2] = one[::2, 2] + random.uniform(-1, 1, POSES // 2) * np.radians(7)
    first = observe(one)
    second = observe(two)
    among_first = jax.tree.map(lambda part: part[None], first)
    among_second = jax.tree.map(lambda part: part[None], second)

    overlaps = np.asarray(jax.jit(overlap)(ROAD, first, among_second))
    of_first = np.asarray(jax.jit(contact_cost)(ROAD, first, among_second))
    of_second = np.asarray(jax.jit(contact_cost)(ROAD, second, among_first))
    parallel = np.arange(POSES) % 2 == 0
    assert (overlaps & parallel).sum() > 1000
    assert of_first[overlaps & parallel].min() > 0
    assert np.maximum(of_first, of_second)[overlaps].min() > 0


def test_where_a_car_overlaps_a_cone_plans_pay():
    own = observe(random_poses(np.random.default_rng(4), 4.0))
    nobody = observe(np.full((1, POSES, 4), 1e3))
    overlaps = np.asarray(jax.jit(overlap)(SCENE, own, nobody))
    costs = np.asarray(jax.jit(contact_cost)(SCENE, own, nobody))
    assert overlaps.sum() > 1000
    assert costs[overlaps].min() > 0


def test_cars_beside_and_behind_each_other_pay_nothing():
    game = build_game(DENSE_MERGE_V1, "physical")
    others = np.array([[0.0, -3.33, 0.0, 20.0], [-6.1, 0.0, 0.0, 20.0]])
    around = observe(others[:, None])
    assert not contact_cost(game.scene, observe(np.zeros((1, 4))), around).any()


@pytest.mark.parametrize(("contact", "collides"), [("paper", False), ("bodies", True)])
def test_overlapping_corners_collide_on_physical_ground_alone(contact, collides):
    """The paper's nine points miss them: its ellipse does not reach into corners."""
    scene = replace(ROAD, contact=contact)
    own = observe(np.zeros((1, 4)))
    other = observe(np.array([[[4.5, 2.0, 0.0, 20.0]]]))
    assert bool(touches(scene, own, other)[0]) == collides


def test_the_slope_of_the_cost_matches_finite_differences():
    random = np.random.default_rng(3)
    apart = 1e-3
    poses = random.uniform((-6.0, -3.0, -0.3), (6.0, 3.0, 0.3), (50, 3))
    others = observe(np.array([[0.0, 3.0, 0.1, 20.0], [4.0, -3.0, -0.1, 20.0]]))

    @jax.jit
    def cost(pose):
        own = observe(jnp.append(pose, 20.0))
        return contact_cost(SCENE, own, others)

    with jax.enable_x64(True):
        for pose in poses:
            slopes = [
                (cost(pose + step) - cost(pose - step)) / (2 * apart)
                for step in apart * np.eye(3)
            ]
            np.testing.assert_allclose(
                jax.grad(cost)(pose), slopes, rtol=1e-3, atol=1e-3
            )
