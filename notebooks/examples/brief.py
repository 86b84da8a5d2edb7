r"""Add a human model of your own: theory of mind in 8 gradient steps.

It takes 8 steps instead of 20, at 40 % of the cost. A model is a rung of the ladder: a
frozen dataclass with a name that predicts the human, or ``responds`` in the steps of
its own `solver` (see `ms_highway.HumanModel`), alone and among several humans. Run it,
or let a command know it::

    python notebooks/examples/brief.py
    ms-highway --import notebooks.examples.brief compare merger give_way \
      --set ladder=naive,brief \
      --set costs=naive=0.09,turn=0.17,brief=0.148,tom=0.37 --out results/brief \
      --controllers naive brief tom switching:0.1 switching:0.001

Prints::

           controller  reward  counted_ms  share_brief
    0           brief    6.23       148.0         1.00
    1             tom    6.29       370.0         0.00
    2  switching:0.02    5.77       127.7         0.65
"""

from dataclasses import dataclass, replace
from typing import ClassVar

from ms_highway import TheoryOfMind, register
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import read, run
from ms_highway.experiments.summary import summary


@dataclass(frozen=True)
class BriefTheoryOfMind(TheoryOfMind):
    """Theory of mind in 8 gradient steps instead of 20, each twice as long."""

    name: ClassVar[str] = "brief"

    def solver(self, game):
        usual = game.planner.solver  # an Ascent, which takes gradient steps
        return replace(usual, iterations=8, step_size=2 * usual.step_size)


register(BriefTheoryOfMind(), before="tom")  # the next more expensive rung

if __name__ == "__main__":
    costs = {
        "naive": 0.09,
        "turn": 0.17,
        "brief": 0.4 * 0.37,
        "tom": 0.37,
    }  # T(M) [s]; "measured" measures them
    controllers = ["brief", "tom", "switching:0.02"]
    config = {"costs": costs, "ladder": ["naive", "brief"]}
    comparison = Comparison({"merger": controllers}, seeds=5, config=config)
    print(*run(comparison, "results/brief"))  # episodes that are done
    print(
        summary(read(comparison, "results/brief"))[
            ["controller", "reward", "counted_ms", "share_brief"]
        ].round(2)
    )
