"""Predict all cars of a moment in three ways.

These are the drivers learned on US-101, highway-env's IDM and constant velocity.
`ms_highway.predict` takes the cars and lanes of one moment of a straight road, and
their past where it is known. It returns, every 0.1 s, the modes of every car (it keeps
its lane, changes to the left, changes to the right), with weights, means and
covariances, and mean and covariance over all modes. Then the traffic drives on, and
each prediction is compared with where the cars are 3 s later. Run::

    python notebooks/examples/predict.py
"""

import gymnasium as gym
import numpy as np

import ms_highway

LANES = (0.0, 4.0, 8.0)
SECONDS = 3
FREQUENCY = 10

env = gym.make(
    "highway-v0",
    config={"lanes_count": 3, "vehicles_count": 15, "simulation_frequency": FREQUENCY},
)
env.reset(seed=0)
road = env.unwrapped.road


def drive(seconds):
    """Let the traffic drive, and return x, y, heading and speed of all cars before
    every frame and at the end.
    """
    states = []
    for frame in range(seconds * FREQUENCY + 1):
        if frame:
            road.act()
            road.step(1 / FREQUENCY)
        states.append(
            [(*car.position, car.heading, car.speed) for car in road.vehicles]
        )
    return np.array(states)


past = drive(3)
predictors = {
    "model": "learned drivers",
    "idm": "IDM",
    "constant_velocity": "constant velocity",
}
forecasts = {
    name: ms_highway.predict(past, LANES, 30.0, seconds=SECONDS, predictor=name)
    for name in predictors
}
after = drive(SECONDS)[-1, :, :2]
for name, forecast in forecasts.items():
    off = np.linalg.norm(forecast.mean[:, -1] - after, axis=-1).mean()
    along, across = np.sqrt(
        np.diagonal(forecast.covariance[:, -1], axis1=1, axis2=2)
    ).mean(axis=0)
    print(
        f"{predictors[name]:18} off by {off:4.1f} m after 3 s, expects {along:4.1f} m"
        f" along, {across:.1f} m across"
    )
learned = forecasts["model"]
car = int(learned.weights[:, 0].argmin())
stays, left, right = learned.weights[car]
print(
    f"car {car} keeps its lane by {stays:.0%}, changes to the left by {left:.0%}, to"
    f" the right by {right:.0%}"
)
print(
    f"where it would then be in {SECONDS} s:"
    f" {learned.means[car, :, -1].round(1).tolist()}"
)
