"""What a page says was found, which depends on nothing but the numbers."""

import numpy as np
import pandas as pd
import pytest

from ms_highway.cli.console import print_tables
from ms_highway.experiments.analysis.findings import answer
from ms_highway.experiments.analysis.summary import summary
from ms_highway.visualization.comparison import cells
from ms_highway.visualization.comparison import table as printed
from ms_highway.visualization.tables import grid

COUNTED = {"naive": 0.09, "turn": 0.17, "tom": 0.37, "switching:0.1": 0.185, "learned:0.1": 0.111}


def records(**rewards):
    """An episode of one step for every reward of a controller, ``_`` standing for ``:0.`` in its name."""
    rows = [(name.replace("_", ":0."), *each) for name, values in rewards.items() for each in enumerate(values)]
    table = pd.DataFrame(rows, columns=["controller", "seed", "reward"]).astype({"reward": float})
    table = table.assign(scenario="merger", step=0, model="naive", status="planned", collision=False)
    return table.assign(planning_seconds=0.001, decision_seconds=0.0, counted_seconds=table["controller"].map(COUNTED))


def said(table):
    return answer(table, summary(table), "merger")


def test_a_gain_and_what_switching_keeps_of_it_are_told_in_shares():
    message = said(records(naive=[1, 1.1], tom=[5, 5.1], switching_1=[4, 4.1]))
    assert message == (
        "switching:0.1 keeps 75 % of tom's gain over naive for 50 % of its planning. The gain is 4.00 (4.00, 4.00); "
        "reward per step: naive 1.05, tom 5.05, switching:0.1 4.05. No controller collides."
    )


def test_every_kind_that_chooses_online_is_told_learned_values_first():
    message = said(records(naive=[1, 1.1], tom=[5, 5.1], switching_1=[4, 4.1], learned_1=[5, 5.1]))
    assert message.startswith(
        "learned:0.1 keeps 100 % of tom's gain over naive for 30 % of its planning; switching:0.1 keeps 75 % of"
    )


def test_a_gain_that_may_be_chance_is_called_no_gain():
    message = said(records(naive=[1, 4, 2], tom=[3, 1, 4], switching_1=[4, 4, 4]))
    assert "but 3 episodes do not show that it is better (difference 0.33, 90 % interval -4.53 to 5.20)." in message
    assert "keeps" not in message


def test_a_gain_is_judged_from_the_starts_that_both_drove_from():
    apart = np.arange(10.0)  # episodes differ by far more than the controllers
    assert "do not show" not in said(records(naive=apart, tom=apart + [0.5, 0.6] * 5))
    assert "do not show" in said(records(naive=apart, tom=apart[::-1] + 0.5))


def test_one_episode_shows_no_gain_and_one_controller_is_told_alone():
    assert "; one episode cannot show that it is better." in said(records(naive=[1], tom=[2]))
    assert said(records(naive=[1])).startswith("Planning every step with naive earns a reward of 1.00 per step. No")
    assert said(records(switching_1=[1, 2])).startswith("switching:0.1 earns a reward of 1.50 per step.")
    assert "earns a reward of 3.00 per step, and no more expensive model earns more in these episodes." in said(
        records(naive=[3], tom=[2])
    )


@pytest.mark.parametrize(
    ("hit", "said_of_it"),
    [
        ({("tom", 0)}, "There are collisions with tom, in 1 of 2 episodes."),
        ({("tom", 0), ("tom", 1), ("turn", 0)}, "There are collisions with turn and tom, in up to 2 of 2 episodes."),
        (
            {("naive", 0), ("turn", 1), ("tom", 1)},
            "There are collisions with every controller, in up to 1 of 2 episodes.",
        ),
    ],
)
def test_who_collides_is_told(hit, said_of_it):
    table = records(naive=[1, 1], turn=[1, 1], tom=[2, 3])
    table["collision"] = [key in hit for key in zip(table["controller"], table["seed"], strict=True)]
    assert said(table).endswith(said_of_it)


def test_tables_tell_the_steps_whose_plans_failed_where_there_are_any():
    table = records(naive=[1, 4, 2], tom=[3, 1, 4])
    assert "fallback steps" not in cells(summary(table), "merger")
    table.loc[[1, 2], "status"] = ["previous plan", "braking"]
    assert cells(summary(table), "merger")["fallback steps"].tolist() == ["2", "0"]


def test_a_sweep_tells_them_as_well():
    table = pd.DataFrame({"controller": ["naive", "naive", "turn"], "seed": [0, 1, 2], "fallbacks": [0, 3, 0]})
    table = table.assign(scenario="merger", reward=1.0, counted_seconds=0.1, share_naive=1.0, collisions=0)
    assert cells(summary(table), "merger")["fallback steps"].tolist() == ["3", "0"]


def test_counted_milliseconds_have_two_digits_and_a_table_tells_of_whom_they_are_not_known():
    table = records(naive=[1], tom=[2], idm=[3]).replace({"counted_seconds": {0.09: 0.000432}})
    assert cells(summary(table), "merger")["counted ms"].tolist() == ["0.43", "370", ""]
    assert printed(summary(table), "merger").caption.startswith("counted ms: T(M) is not known of idm; put")
    assert printed(summary(table[:2]), "merger").caption is None


@pytest.mark.parametrize("width", [80, 120])
def test_a_printed_table_is_no_wider_than_the_terminal_and_shows_every_cell(width, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(width))
    cells = {f"column {place}": "-1.89, 2.33" for place in range(12)}
    print_tables(grid("crowded", [{"controller": f"schedule:tom={steps},naive", **cells} for steps in (4, 30)]))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= width
    assert sum(line.count("-1.89, 2.33") for line in lines) == 2 * 12
    assert all(line.strip().startswith("schedule:tom=") for line in lines if "-1.89" in line)
