"""Properties of the coordinates along curves that hold on every arc."""

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as draw
from roads import arc

KNOTS = 10  # so that no arc turns so far that its ends, going straight on, cross
PLACES = 8

bends = draw.floats(-1 / 12, 1 / 12)
shares = draw.lists(draw.floats(0.0, 1.0), min_size=PLACES, max_size=PLACES)
drawn_shares = shares.map(np.array)


def there_and_back(curve, s, d, turned):
    """Return the poses at coordinates, and the coordinates of poses there."""
    x, y, heading = curve.place(s, d)
    return (x, y, heading), curve.project(x, y, heading + turned + 2 * np.pi)


there_and_back_in_jax = jax.jit(there_and_back)


@given(bends, drawn_shares, drawn_shares, drawn_shares)
def test_projecting_a_placed_pose_returns_its_coordinates(bend, along, aside, angle):
    """In NumPy and in JAX, also beyond the ends and beside tight bends."""
    curve = arc(KNOTS, bend)
    farthest = min(6.0, 0.5 / max(abs(bend), 0.01))
    s = curve.start - 30.0 + along * (curve.end - curve.start + 60.0)
    d = (2 * aside - 1) * farthest
    turned = 6.0 * angle - 3.0

    poses, found = there_and_back(curve, s, d, turned)
    poses_in_jax, found_in_jax = there_and_back_in_jax(curve, s, d, turned)

    np.testing.assert_allclose(poses_in_jax, poses, atol=1e-3)
    np.testing.assert_allclose(found, (s, d, turned), atol=0.01)
    np.testing.assert_allclose(found_in_jax, (s, d, turned), atol=0.01)


@given(bends, draw.floats(0.5, 50.0))
def test_a_curve_goes_straight_on_beyond_its_ends(bend, distance):
    curve = arc(KNOTS, bend)
    for end, side in ((curve.start, -1), (curve.end, 1)):
        beyond = end + side * distance
        x, y, heading = curve.place(np.array([end, beyond]), np.zeros(2))
        assert heading[0] == heading[1]
        assert curve.bend(np.array([beyond])) == 0.0
        np.testing.assert_allclose(np.hypot(*np.diff([x, y])), distance, rtol=1e-4)
