"""Name and number the models that predict traffic on roads."""

TRAFFIC_MODELS = ("naive", "idm", "tom")
"""Models that predict traffic, cheapest first: keep the velocity along the lane; follow
by IDM, but keep the velocity on paths that cross the robot's; respond optimally to the
robot's plan (theory of mind).
"""


class ModelNumber:
    """Number the models in the order of `TRAFFIC_MODELS`."""

    naive: int = 0
    idm: int = 1
    tom: int = 2
