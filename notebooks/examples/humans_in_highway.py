"""Put humans on a stock highway-env road: commuters.

They drive like the drivers recorded on US-101. Every commuter has a desired speed, a
headway and a patience of its own. Commuters change lanes as highway-env's drivers do,
and give way where ways meet. Run::

    python notebooks/examples/humans_in_highway.py
"""

import gymnasium as gym

# Registers its environments, and those of highway-env
import ms_highway  # noqa: F401

config = {"other_vehicles_type": "ms_highway.vehicle.CommuterVehicle"}
env = gym.make("highway-v0", config={**config, "vehicles_count": 5, "duration": 3})
env.reset(seed=0)
done = False
while not done:
    *_, terminated, truncated, _ = env.step(
        1
    )  # the ego car, highway-env's own, keeps its lane
    done = terminated or truncated
for vehicle in env.unwrapped.road.vehicles:
    print(f"{type(vehicle).__name__:15} {vehicle.speed:.1f} m/s")
