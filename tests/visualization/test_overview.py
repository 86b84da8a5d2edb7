"""Comparisons beside each other in one table."""

import pandas as pd
import pytest
from commands import run
from comparisons import CONTROLLERS, Page, with_settings


def table(capsys, *directories):
    """The cells of the table that is printed of directories, line by line."""
    run(" ".join(map(str, ("report", *directories, "--markdown"))))
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()]


def test_the_markdown_table_has_the_numbers_of_the_summary(compared, capsys):
    headings, rules, *rows = table(capsys, compared)
    assert set(rules) == {"---"}
    summary = pd.read_csv(compared / "summary.csv")
    assert len(rows) == len(summary) == 2
    for row, expected in zip(rows, summary.to_dict("records"), strict=True):
        cells = dict(zip(headings, row, strict=True))
        assert cells["controller"] == expected["controller"]
        interval = f"({expected['reward_low']:.2f}, {expected['reward_high']:.2f})"
        assert cells["reward per step (90 % interval)"] == f"{expected['reward']:.2f} {interval}"
        assert cells["plan ms"] == f"{expected['planning_ms']:.2f}"
        assert cells["episodes with a collision"] == f"{expected['collision_episodes']} of 2"
    assert rows[0][-1] == "100 / 0 / 0"


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"human_reward": "published"}, ["learned human reward", "published human reward"]),
        ({"semantics": "released", "human_reward": "published"}, ["paper semantics", "released semantics"]),
        ({"human_reward": {"speed": 2.0}}, ["learned human reward", "given human reward"]),
        ({"control_limit": [0.2, 9.0]}, ["usual control limit", "0.2 and 9.0 control limit"]),
        ({}, ["compare", "other"]),
    ],
)
def test_directories_beside_each_other_are_called_by_what_tells_them_apart(changes, names, compared, tmp_path, capsys):
    other = with_settings(compared, tmp_path / "other", **changes)
    records = pd.read_csv(other / "steps.csv").query("controller == 'naive'")
    records.assign(reward=records["seed"] + 1.0).to_csv(other / "steps.csv", index=False)
    headings, _, naive, switching = table(capsys, compared, other)
    for name in names:
        assert " ".join(headings).count(name) == 2
    assert naive[4].startswith("1.50 (")
    assert switching[4] == ""


def test_a_directory_named_twice_is_refused(compared, refused):
    assert "named twice" in refused(f"report {compared} {compared} --markdown")


@pytest.mark.parametrize(
    ("changes", "comparable"),
    [
        ({}, True),
        ({"semantics": "paper"}, False),
        ({"human_reward": "learned"}, False),
        ({"ladder": ["naive", "turn"]}, False),
        ({"horizon": 5, "control_limit": [0.2, 9.0]}, False),
        ({"costs": "measured"}, False),
    ],
)
def test_what_the_paper_published_stands_beside_what_may_be_compared_with_it_only(
    changes, comparable, compared, tmp_path, capsys
):
    released = {"semantics": "released", "human_reward": "published"}
    other = with_settings(compared, tmp_path / "other", **(released | changes))
    headings, _, *rows = table(capsys, compared, other)
    assert (headings[-1] == "published") == comparable
    assert [row[-1] for row in rows] == ["-7.73", "2.59"] or not comparable


def test_a_page_of_several_comparisons_has_them_beside_each_other(compared, tmp_path):
    other = with_settings(compared, tmp_path / "other", semantics="released", human_reward="published")
    page = tmp_path / "page.html"
    run(f"report {compared} {other} --no-videos --out {page}")
    texts = Page(page.read_text()).texts
    for name in ("paper", "released"):
        assert f"reward per step (90 % interval), {name} semantics" in texts
    assert {"-7.73", "2.59", f"Settings of {compared}", f"Settings of {other}"} <= set(texts)


def test_episodes_of_every_directory_are_in_the_table_and_on_the_page_also_where_the_first_one_lacks_them(
    compared, tmp_path, capsys
):
    other = with_settings(compared, tmp_path / "other", human_reward="published")
    records = pd.read_csv(other / "steps.csv").replace({"controller": {"naive": "schedule:turn=9,naive"}})
    merger = records[records["controller"] == "switching:0.4"].assign(scenario="merger")
    longer = merger[merger["step"] < 5].assign(step=merger["step"] + 35)  # an episode has 40 steps there
    pd.concat([records, merger, longer]).to_csv(other / "steps.csv", index=False)
    rows = table(capsys, compared, other)[2:]
    assert [row[0] for row in rows] == ["stay_back"] * 3 + ["merger"]
    assert [row[1] for row in rows] == [*CONTROLLERS, "schedule:turn=9,naive", "switching:0.4"]
    assert [bool(row[2]) for row in rows] == [True, True, False, False]
    assert [bool(row[4]) for row in rows] == [False, True, True, True]
    page = tmp_path / "page.html"
    run(f"report {compared} {other} --no-videos --out {page}")
    assert {"schedule:turn=9,naive", "Merger"} <= set(Page(page.read_text()).texts)
