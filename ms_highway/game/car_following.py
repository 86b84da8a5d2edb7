"""Hold how cars follow the car ahead, and how hard they brake and accelerate.

Cars follow by the Intelligent Driver Model, IDM (Treiber, Hennecke and Helbing 2000).
Everybody who follows by it, robot, human or vehicle, takes its parameters from here.
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from ms_highway.geometry.curve import namespace
from ms_highway.runtime.arrays import Numbers, Numeric, Scalar

MeasuredBetween: TypeAlias = Literal["bumpers", "centres"]

FREE_GAP = 1e3
"""Gap to the car ahead where there is none [m].

It changes an acceleration by less than 0.01 m/s^2 from that of an infinite gap.
"""


@dataclass(frozen=True)
class CarLimits:
    """Limit how hard a car brakes and accelerates."""

    acceleration: float
    """Hardest acceleration [m/s^2]."""
    braking: float
    """Hardest deceleration, a positive number [m/s^2]."""


CAR_LIMITS = CarLimits(acceleration=4.0, braking=8.0)
"""Limits of robots and of learned drivers: what tyres hold on a dry road, and what the
engine of a family car gives.
"""

TRAFFIC_LIMITS = CarLimits(acceleration=3.0, braking=6.0)
"""Limits of highway-env's traffic: its ``COMFORT_ACC_MAX`` and ``ACC_MAX``."""


@dataclass(frozen=True)
class IdmParameters:
    """Parameters of the Intelligent Driver Model.

    Attributes:
        headway: desired time gap T [s].
        standstill: desired gap s0 between standing cars [m].
        max_acceleration: acceleration a from standstill on a free road [m/s^2].
        comfortable_braking: deceleration b, a positive number [m/s^2].
        between: whether all gaps are between bumpers or between centres.
        max_braking: deceleration beyond which no follower brakes [m/s^2].
    """

    headway: Scalar
    standstill: Scalar
    max_acceleration: Scalar
    comfortable_braking: Scalar
    between: MeasuredBetween
    max_braking: float = TRAFFIC_LIMITS.braking

    def acceleration(
        self,
        speed: Numeric,
        desired_speed: Numeric,
        gap: Numeric,
        leader_speed: Numeric,
    ) -> Numbers:
        """Return the acceleration of a follower [m/s^2]; arrays of NumPy or JAX.

        With the follower's speed v, its desired speed v0, the gap s and the leader's
        speed v_l::

            s* = s0 + max(T v + v (v - v_l) / (2 sqrt(a b)), 0)
            acceleration = a (1 - (v / v0)^4 - (s* / s)^2)

        The part of the desired gap that depends on speeds is at least 0, as in the
        paper; in highway-env it may be negative behind a faster car.

        Args:
            speed: of the follower [m/s].
            desired_speed: of the follower [m/s].
            gap: to the car ahead, measured as ``between`` says [m]; `FREE_GAP` or
                infinity where there is none.
            leader_speed: speed of the car ahead [m/s].
        """
        xp = namespace(speed, desired_speed, gap, leader_speed)
        a = self.max_acceleration
        b = self.comfortable_braking

        # The desired gap, larger behind a slower car.
        closing = speed * (speed - leader_speed) / (2 * (a * b) ** 0.5)
        desired_gap = self.standstill + xp.maximum(speed * self.headway + closing, 0.0)

        # Divisors are kept from 0, for standing traffic and touching cars.
        free_road = 1 - (speed / xp.maximum(desired_speed, 0.1)) ** 4
        interaction = (desired_gap / xp.maximum(gap, 0.5)) ** 2
        return xp.maximum(a * (free_road - interaction), -self.max_braking)


HIGHWAY_ENV_IDM = IdmParameters(
    headway=1.5,
    standstill=10.0,
    max_acceleration=TRAFFIC_LIMITS.acceleration,
    comfortable_braking=5.0,
    between="centres",
)
"""Parameters of highway-env's ``IDMVehicle``, the traffic on its roads."""

STREAM_IDM = IdmParameters(
    headway=0.1,
    standstill=1.0,
    max_acceleration=TRAFFIC_LIMITS.acceleration,
    comfortable_braking=5.0,
    between="bumpers",
)
"""Parameters of the human model ``idm``: 3 m at 20 m/s, as in the streams of Dense
Merge.
"""

COMMUTER_IDM = IdmParameters(
    headway=1.26,
    standstill=2.0,
    max_acceleration=2.0,
    comfortable_braking=1.5,
    between="bumpers",
)
"""Parameters of commuters who start off.

The headway is the median on US-101, where drivers have their own; 2 m is the gap of the
learned reward in a standing queue. Calm drivers in towns accelerate like this.
"""

ROBOT_IDM = IdmParameters(
    headway=0.7,
    standstill=2.0,
    max_acceleration=TRAFFIC_LIMITS.acceleration,
    comfortable_braking=5.0,
    between="bumpers",
)
"""Parameters of the robot on roads, which follows more closely than their traffic."""
