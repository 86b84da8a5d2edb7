"""Hold the parameters with which vehicles follow by the Intelligent Driver Model."""

from dataclasses import dataclass

from ms_highway.planning.manoeuvres import idm_acceleration


@dataclass(frozen=True)
class IDMParameters:
    """Parameters of the Intelligent Driver Model; gaps are between bumpers.

    Attributes:
        headway: desired time gap [s].
        standstill: desired gap between standing vehicles [m].
        strongest: acceleration from standstill on a free road [m/s^2].
        braking: comfortable deceleration [m/s^2].
    """

    headway: float
    standstill: float
    strongest: float
    braking: float

    def acceleration(
        self,
        speed: float,
        wanted: float,
        gap: float,
        leader_speed: float,
    ) -> float:
        """Return the acceleration of a follower [m/s^2].

        Args:
            speed: of the follower [m/s].
            wanted: its desired speed [m/s].
            gap: to the leader, between bumpers [m]; infinite without one.
            leader_speed: [m/s].
        """
        change = idm_acceleration(
            speed,
            wanted,
            gap,
            leader_speed,
            headway=self.headway,
            standstill=self.standstill,
            strongest=self.strongest,
            braking=self.braking,
        )
        return float(change)


COMMUTERS = IDMParameters(headway=1.26, standstill=2.0, strongest=2.0, braking=1.5)
"""Parameters of commuters who start off.

The headway is the median on US-101, where drivers have their own; 2 m is the gap of
the learned reward in a standing queue. Calm drivers in towns accelerate like this.
"""
