"""Drive in closed loop: live among any number of humans, or many episodes at once.

`step` is the one step of all robots. `game_parts` and `braking` say how a robot in a
game chooses models, starts plans and brakes in it. `driver` takes the step live and
times it, `batch` takes it for many episodes in JAX, whose inputs and results are
`records`. `controller` holds the records of live steps, and drives humans by functions;
`yielding` are two of these.

Imports `ms_highway.choice` and what stands below it.
"""
