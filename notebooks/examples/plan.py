"""Plan one situation under each human model, and print the first controls.

It also prints what the human is expected to do. `ms_highway.plan` returns the robot's
controls and those of every human that it counts on, here one: a row (curvature [1/m],
acceleration before friction [m/s^2], of which 4 keep 20 m/s) for each of 5 steps of 0.1
s, as NumPy arrays. The game and the state may be an environment's, or your own. Run::

    python notebooks/examples/plan.py
"""

import gymnasium as gym

from ms_highway import Scene, driving_game, plan

env = gym.make("ms_highway:ms-highway/merger-v0").unwrapped
env.reset(seed=0)
print(
    "x, y [m], heading [rad], speed [m/s] of robot, human, other car:",
    env.car_states.round(2).tolist(),
)
for model in ("naive", "turn", "tom"):
    robot, (human,) = plan(env.game, env.car_states, model)
    print(f"{model:5} robot {robot[0].round(3)}, human {human[0].round(3)}")

scene = Scene(lanes=[0.0, 4.0], lane_width=4.0)  # m
game = driving_game(
    scene, speed_limit=20.0
)  # both drive for the paper's common weights
state = [
    [0.0, 4.0, 0.0, 20.0],
    [-12.0, 4.0, 0.0, 24.0],
]  # the human comes up from behind
print("own scene:", plan(game, state, "tom").robot[0].round(3))
