"""The answer of a comparison in sentences, and its printed tables."""

import contextlib
import os
from select import select

import pandas as pd

from ms_highway.cli.console import print_tables
from ms_highway.experiments.summary import answer, summary
from ms_highway.visualization.tables import grid

COUNTED = {"naive": 0.09, "tom": 0.37, "switching:0.1": 0.185, "learned:0.1": 0.111}


def said(**rewards):
    """Return the answer on one-step episodes with the rewards of controllers.

    In names, ``_`` stands for ``:0.``.
    """
    rows = []
    for name, values in rewards.items():
        for seed, reward in enumerate(values):
            rows.append((name.replace("_", ":0."), seed, float(reward)))
    table = pd.DataFrame(rows, columns=["controller", "seed", "reward"])
    table = table.assign(
        scenario="merger",
        step=0,
        model="naive",
        status="planned",
        collision=False,
        planning_seconds=0.001,
        decision_seconds=0.0,
        counted_seconds=table["controller"].map(COUNTED),
    )
    return answer(table, summary(table), "merger")


def test_the_answer_tells_which_gain_each_controller_keeps():
    message = said(
        naive=[1, 1.1], tom=[5, 5.1], learned_1=[5, 5.1], switching_1=[4, 4.1]
    )
    assert message == (
        "tom earns a reward of 5.05 per step. That is 4.00 more than naive (90 %"
        " interval 4.00 to 4.00, starts: 2). learned:0.1 earns 5.05 and keeps 100 %"
        " of that gain, for 30 % of tom's planning. switching:0.1 earns 4.05 and"
        " keeps 75 % of that gain, for 50 % of tom's planning. No controller"
        " collides."
    )


def test_the_answer_says_that_a_gain_may_be_chance():
    message = said(naive=[1, 4, 2], tom=[3, 1, 4], switching_1=[4, 4, 4])
    assert "(90 % interval -4.53 to 5.20, starts: 3), which may be chance." in message
    assert "keeps" not in message


def shown_on_a_terminal(show):
    """Return what a function shows while standard output is a terminal."""
    reader, writer = os.openpty()
    with os.fdopen(writer, "w", encoding="utf-8") as screen:
        with contextlib.redirect_stdout(screen):
            show()
        shown = b""
        while select([reader], [], [], 0)[0]:
            shown += os.read(reader, 4096)
    os.close(reader)
    return shown.decode()


def test_a_printed_table_fits_the_terminal_and_shows_every_cell(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    row = {f"column {place}": "-1.89, 2.33" for place in range(12)}
    names = [f"schedule:tom={steps},{'turn=1,' * 9}naive" for steps in (4, 30)]
    table = grid("crowded", [{"controller": name, **row} for name in names])
    lines = shown_on_a_terminal(lambda: print_tables(table)).splitlines()
    assert max(map(len, lines)) <= 60
    assert sum(line.count("-1.89, 2.33") for line in lines) == 2 * 12
    rows = [line for line in lines if "-1.89" in line]
    assert all(line.strip().startswith("schedule:tom=") for line in rows)
