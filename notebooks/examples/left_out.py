r"""Add scenarios that no values of computation were learned on.

So one sees what the shipped values are worth there. *Squeeze*: on three lanes, robot
and human both want into the left one, between two scripted cars. *Works*: the human's
lane is closed by cones, and the robot beside it is rewarded for letting it in. A third
is *Zipper*, from the example of that name::

    ms-highway --import notebooks.examples.zipper --import notebooks.examples.left_out \
        frontier zipper squeeze works --controllers learned
"""

from ms_highway import COMMON_WEIGHTS, InteractionEnv, Scenario, add_scenario


class SqueezeEnv(InteractionEnv):
    """Robot on the right, human in the middle: both want into the left lane, between
    two scripted cars.
    """

    scenario = Scenario(
        name="squeeze",
        lanes=(-20 / 3, -10 / 3, 0.0),
        cars=((0.0, 0.0), (-4.0, -10 / 3), (25 / 3, -20 / 3), (-35 / 3, -20 / 3)),
        steps=40,
        ladder=("naive", "turn", "tom"),
        prices=(0.1, 0.02),
        robot_weights={**COMMON_WEIGHTS, "target_lane": 150, "merged": 5},
        human_weights={**COMMON_WEIGHTS, "target_lane": 300},
        merging_car=0,
    )


class WorksEnv(InteractionEnv):
    """The human's lane is closed by cones; the robot beside it is rewarded for letting
    it in.
    """

    scenario = Scenario(
        name="works",
        lanes=(-10 / 3, 0.0),
        cars=((-10 / 3, -10 / 3), (-2.0, 0.0)),
        steps=40,
        ladder=("naive", "turn", "tom"),
        prices=(0.1, 0.02),
        robot_weights={
            **COMMON_WEIGHTS,
            "target_lane": 500,
            "partner_target_lane": 250,
            "partner_merged": 5,
        },
        human_weights={**COMMON_WEIGHTS, "target_lane": 120},
        cones=((20.0, 2 / 3), (67 / 3, 2 / 3), (74 / 3, 2 / 3), (27.0, 2 / 3)),
        merging_car=1,
    )


for environment in (SqueezeEnv, WorksEnv):
    add_scenario(environment)

if __name__ == "__main__":
    print("known now: squeeze and works")
