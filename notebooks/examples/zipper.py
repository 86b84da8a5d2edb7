"""Add a scenario of your own, Zipper.

The robot's lane is closed by cones, and a human drives beside it. It has everything
that the paper's scenarios have: an environment (``ms-highway/zipper-v0``),
configuration, films, comparisons. Run it, or make it known to any command::

    python notebooks/examples/zipper.py
    ms-highway --import notebooks.examples.zipper compare zipper --out results/zipper

Prints::

           controller  reward  counted_ms  share_tom
    0           naive    5.96        90.0       0.00
    1             tom    6.86       370.0       1.00
    2  switching:0.02    6.70       163.0       0.22
"""

from ms_highway import COMMON_WEIGHTS, InteractionEnv, Scenario, add_scenario
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import read, run
from ms_highway.experiments.summary import summary


class ZipperEnv(InteractionEnv):
    """The robot's lane is closed by cones, and a human drives beside it in the other;
    lengths in metres.
    """

    scenario = Scenario(
        name="zipper",
        lanes=(-10 / 3, 0.0),
        cars=((-10 / 3, 0.0), (-13 / 3, -10 / 3)),  # robot, human
        cones=((55 / 3, 1.0), (21.0, 1.0), (71 / 3, 1.0), (79 / 3, 1.0)),
        steps=40,
        ladder=("naive", "turn", "tom"),
        prices=(
            0.1,
            0.02,
        ),  # lambdas of the two switching controllers that are compared by default
        robot_weights={**COMMON_WEIGHTS, "target_lane": 150, "merged": 5},
        human_weights={**COMMON_WEIGHTS, "target_lane": 1000},
    )


add_scenario(ZipperEnv)

if __name__ == "__main__":
    comparison = Comparison({"zipper": ["naive", "tom", "switching:0.02"]}, seeds=5)
    print(*run(comparison, "results/zipper"))  # episodes that are done
    print(
        summary(read(comparison, "results/zipper"))[
            ["controller", "reward", "counted_ms", "share_tom"]
        ].round(2)
    )
