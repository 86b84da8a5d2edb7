"""`ms-highway compare` as a user types it."""

import json

import imageio.v3 as imageio
import msgspec
import pandas as pd
import pytest

from ms_highway.cli.main import build_parser, main
from ms_highway.cli.options import comparison, configuration
from ms_highway.experiments.records import columns
from ms_highway.game.learned_reward import save, shipped
from ms_highway.runtime.files import held

COMPARE = ["compare", "stay_back", "--controllers", "naive", "switching:0.4", "--seeds", "2", "--out"]


def failure(capsys, *arguments):
    """The one line that a refused command prints."""
    assert main(list(arguments)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def untimed(directory):
    """The records without their measured times."""
    records = pd.read_csv(directory / "steps.csv")
    return records.drop(columns=[name for name in records if name.endswith("seconds")])


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    directory = tmp_path_factory.mktemp("compare")
    assert main([*COMPARE, str(directory)]) == 0
    return directory


def test_compare_writes_a_row_per_step_a_summary_and_figures(compared):
    records = pd.read_csv(compared / "steps.csv")
    assert list(records) == columns()
    assert len(records) == 2 * 2 * 35
    summary = pd.read_csv(compared / "summary.csv").set_index("controller")
    means = records.groupby("controller")["reward"].mean()
    for controller in ("naive", "switching:0.4"):
        assert summary.loc[controller, "reward"] == pytest.approx(means[controller])
        assert summary.loc[controller, "reward_low"] < means[controller] < summary.loc[controller, "reward_high"]
    assert summary.loc["naive", "share_naive"] == 1
    assert summary.loc["naive", "decision_ms"] == 0 < summary.loc["switching:0.4", "decision_ms"]
    for name in ("bars", "timeline"):
        assert imageio.imread(compared / f"stay_back_{name}.png").std() > 10
    assert not list(compared.glob("*part*"))


def test_compare_goes_on_where_it_was_stopped(compared, tmp_path, capsys):
    lines = (compared / "steps.csv").read_text().splitlines(keepends=True)
    (tmp_path / "settings.json").write_text((compared / "settings.json").read_text())
    (tmp_path / "steps.csv").write_text("".join(lines[: 1 + 35 + 10]) + lines[46][:20])  # killed in the second episode
    assert main([*COMPARE, str(tmp_path)]) == 0
    pd.testing.assert_frame_equal(untimed(tmp_path), untimed(compared))
    before = (tmp_path / "steps.csv").read_text()
    assert main([*COMPARE, str(tmp_path)]) == 0
    assert (tmp_path / "steps.csv").read_text() == before


@pytest.mark.slow
def test_a_comparison_that_adds_a_controller_tells_of_all_that_are_there(compared, tmp_path, capsys):
    for name in ("settings.json", "steps.csv"):
        (tmp_path / name).write_text((compared / name).read_text())
    arguments = [
        "compare",
        "stay_back",
        "--controllers",
        "schedule:turn=2,naive",
        "random:naive=0.5,turn=0.5",
        "--seeds",
        "1",
        "--out",
        str(tmp_path),
    ]
    assert main(arguments) == 0
    assert "switching:0.4" not in capsys.readouterr().out
    summary = pd.read_csv(tmp_path / "summary.csv")
    added = arguments[3:5]
    assert summary["controller"].tolist() == ["naive", "switching:0.4", *added]
    assert summary["kind"].tolist() == ["fixed", "switching", "schedule", "random"]
    assert summary["episodes"].tolist() == [2, 2, 1, 1]


def test_a_controller_named_twice_runs_once(compared, tmp_path):
    arguments = ["compare", "stay_back", "--controllers", "naive", "naive", "--seeds", "1", "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert len(pd.read_csv(tmp_path / "steps.csv")) == 35


@pytest.mark.slow
def test_compare_keeps_measured_costs_with_the_results(tmp_path):
    arguments = ["compare", "stay_back", "--controllers", "switching:1", "--seeds", "1", "--set", "costs=measured"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    settings = (tmp_path / "settings.json").read_text()
    costs = json.loads(settings)["measured"]["stay_back"]
    assert 0 < costs["naive"] < 0.1
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    assert (tmp_path / "settings.json").read_text() == settings


def test_compare_says_that_it_goes_on_with_other_versions(compared, tmp_path, capsys):
    for name in ("settings.json", "steps.csv", "provenance.json"):
        (tmp_path / name).write_text((compared / name).read_text())
    (run,) = json.loads((compared / "provenance.json").read_text())
    older = [run | {"versions": run["versions"] | {"jax": "0.1"}, "xla_flags": "--other"}]
    (tmp_path / "provenance.json").write_text(json.dumps(older))
    arguments = [*COMPARE[:2], "--controllers", "turn", "--seeds", "1", "--out", str(tmp_path)]
    assert main(arguments) == 0
    said = capsys.readouterr().err
    assert f"continues with jax {run['versions']['jax']} instead of 0.1, XLA_FLAGS" in said
    assert "instead of --other; results may not agree" in said
    assert main([*arguments[:4], "naive", *arguments[4:]]) == 0
    assert "instead of" not in capsys.readouterr().err


def test_compare_refuses_records_of_another_version(compared, tmp_path, capsys):
    (tmp_path / "settings.json").write_text((compared / "settings.json").read_text())
    older = pd.read_csv(compared / "steps.csv").drop(columns="status").to_csv(index=False)
    (tmp_path / "steps.csv").write_text(older)
    assert "its columns are not" in failure(capsys, *COMPARE, str(tmp_path))
    assert (tmp_path / "steps.csv").read_text() == older


def test_compare_refuses_a_directory_of_other_settings(compared, capsys):
    line = failure(capsys, *COMPARE, str(compared), "--set", "semantics=released")
    assert "choose another directory" in line


@pytest.mark.slow
def test_compare_plans_with_the_solver_that_is_asked_for_and_keeps_its_results_apart(compared, tmp_path, capsys):
    arguments = ["compare", "stay_back", "--controllers", "naive", "--seeds", "1", "--set", "solver=newton", "--out"]
    assert "choose another directory" in failure(capsys, *arguments, str(compared))
    assert main([*arguments, str(tmp_path)]) == 0
    assert json.loads((tmp_path / "settings.json").read_text())["solver"] == "newton"
    plain = untimed(compared).query("controller == 'naive' and seed == 0")
    assert (abs(untimed(tmp_path)["reward"].to_numpy() - plain["reward"].to_numpy()) > 1e-3).any()


@pytest.mark.slow
def test_compare_keeps_results_among_other_humans_apart(compared, tmp_path, capsys):
    assert json.loads((compared / "settings.json").read_text())["human_reward"] == "learned"
    assert "choose another directory" in failure(capsys, *COMPARE, str(compared), "--set", "human_reward=published")
    learned = tmp_path / "lazy.json"
    known = shipped("demonstrations")
    save(msgspec.structs.replace(known, weights=known.weights | {"speed": 0.5}), learned)
    arguments = [
        "compare",
        "merger",
        "--controllers",
        "turn",
        "--seeds",
        "1",
        "--set",
        f"human_reward={learned}",
        "--out",
    ]
    assert main([*arguments, str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "settings.json").read_text())["human_reward"]["speed"] == 0.5
    assert main([*arguments, str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert "choose another directory" in failure(capsys, *arguments[:-3], "--out", str(tmp_path / "out"))


def test_of_two_commands_that_write_to_a_directory_the_second_is_refused(compared, capsys):
    before = (compared / "steps.csv").read_text()
    with held(compared):
        assert "another command is writing to" in failure(capsys, *COMPARE, str(compared), "--seeds", "3")
    assert (compared / "steps.csv").read_text() == before


def test_compare_refuses_texts_where_numbers_belong_before_it_drives(compared, tmp_path, capsys):
    (tmp_path / "settings.json").write_text((compared / "settings.json").read_text())
    damaged = (compared / "steps.csv").read_text().replace("stay_back,naive,0,0,", "stay_back,naive,nought,0,")
    (tmp_path / "steps.csv").write_text(damaged)
    assert "texts where numbers belong, in column seed" in failure(capsys, *COMPARE, str(tmp_path))
    assert (tmp_path / "steps.csv").read_text() == damaged


def test_compare_drives_episodes_anew_whose_records_have_holes(compared, tmp_path):
    (tmp_path / "settings.json").write_text((compared / "settings.json").read_text())
    head, first, *others = (compared / "steps.csv").read_text().splitlines(keepends=True)
    cells = dict(zip(head.split(","), first.split(","), strict=True)) | {"reward": ""}
    (tmp_path / "steps.csv").write_text("".join([head, ",".join(cells.values()), *others]))
    assert main([*COMPARE, str(tmp_path)]) == 0
    order = ["controller", "seed", "step"]
    again, before = (untimed(directory).sort_values(order, ignore_index=True) for directory in (tmp_path, compared))
    pd.testing.assert_frame_equal(again, before)


def test_compare_refuses_a_corrupt_file_and_leaves_it(compared, tmp_path, capsys):
    (tmp_path / "settings.json").write_text((compared / "settings.json").read_text())
    (tmp_path / "steps.csv").write_text("these are\nno, records\n")
    assert "cannot be resumed" in failure(capsys, *COMPARE, str(tmp_path))
    assert (tmp_path / "steps.csv").read_text() == "these are\nno, records\n"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("horizon=10", 10),
        ("control_limit=0.2,9", [0.2, 9]),
        ("control_limit=unlimited", "unlimited"),
        ("ladder=tom,", ["tom"]),
        ("costs=naive=0.1,tom=0.2", {"naive": 0.1, "tom": 0.2}),
        ('costs={"naive": 0.1}', {"naive": 0.1}),
        ("way_out=false", False),
        ("human_reward=published", "published"),
    ],
)
def test_a_key_is_set_by_json_or_by_words(text, value):
    options = build_parser().parse_args(["compare", "--set", "grip=8", "--set", text])
    assert configuration(options) == {"grip": 8, text.partition("=")[0]: value}


def test_without_controllers_the_ladder_and_switching_are_compared_at_the_lambdas_that_are_named():
    def names(*arguments):
        return comparison(build_parser().parse_args(["compare", "merger", *arguments])).controllers["merger"]

    assert names() == ["naive", "turn", "tom", "switching:0.6", "switching:0.1"]
    assert names("--set", "ladder=naive,tom", "--lambdas", "0.5", "1") == [
        "naive",
        "tom",
        "switching:0.5",
        "switching:1",
    ]
    assert names("--controllers", "tom", "learned", "--lambdas", "0.01:1:3") == [
        "tom",
        *(f"learned:{price}" for price in ("0.01", "0.1", "1")),
    ]
