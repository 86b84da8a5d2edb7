"""Put humans on a stock highway-env road: they plan for their own reward and drive by themselves.

They keep within what tyres hold, 8 m/s^2 in all, never reverse, and slow down for bends. They know no right of way and
hardly change lanes: roundabouts among cars that brake for nobody are not for them (see `ms_highway.HumanVehicle`).
Run::

    python notebooks/examples/humans_in_highway.py
"""

import gymnasium as gym

import ms_highway  # noqa: F401  # registers its environments, and those of highway-env

config = {"other_vehicles_type": "ms_highway.vehicle.HumanVehicle"}  # or CommuterVehicle, who follows as on US-101
env = gym.make("highway-v0", config={**config, "vehicles_count": 5, "duration": 3})
env.reset(seed=0)
done = False
while not done:
    *_, terminated, truncated, _ = env.step(1)  # the ego car, highway-env's own, keeps its lane
    done = terminated or truncated
for vehicle in env.unwrapped.road.vehicles:
    print(f"{type(vehicle).__name__:14} {vehicle.speed:.1f} m/s")
