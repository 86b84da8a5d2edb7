"""Traffic that never yields to the ego."""

from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle

__all__ = ["UnyieldingVehicle"]


class UnyieldingVehicle(IDMVehicle):
    """Follow cars of this class by highway-env's IDM, and no others: it runs into an ego that cuts in."""

    def acceleration(
        self,
        ego_vehicle: ControlledVehicle,
        front_vehicle: Vehicle | None = None,
        rear_vehicle: Vehicle | None = None,
    ) -> float:
        """Return the acceleration of a vehicle behind another one [m/s^2]."""
        stranger = isinstance(front_vehicle, Vehicle) and not isinstance(front_vehicle, UnyieldingVehicle)
        return float(super().acceleration(ego_vehicle, None if stranger else front_vehicle, rear_vehicle))
