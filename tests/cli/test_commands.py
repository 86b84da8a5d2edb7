"""The commands as a user types them."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import imageio.v3 as imageio
import pandas as pd
import pytest

from ms_highway.benchmarks.latency import bench
from ms_highway.cli.main import main
from ms_highway.envs import ENVIRONMENTS, SCENARIOS
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


def test_compare_keeps_measured_costs_with_the_results(tmp_path):
    arguments = ["compare", "stay_back", "--controllers", "switching:1", "--seeds", "1", "--costs", "measured"]
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
    assert f"goes on with jax {run['versions']['jax']} instead of 0.1, XLA_FLAGS" in said
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
    line = failure(capsys, *COMPARE, str(compared), "--semantics", "released")
    assert "choose another directory" in line


def test_compare_plans_with_the_solver_that_is_asked_for_and_keeps_its_results_apart(compared, tmp_path, capsys):
    arguments = ["compare", "stay_back", "--controllers", "naive", "--seeds", "1", "--solver", "newton", "--out"]
    assert "choose another directory" in failure(capsys, *arguments, str(compared))
    assert main([*arguments, str(tmp_path)]) == 0
    assert json.loads((tmp_path / "settings.json").read_text())["solver"] == "newton"
    plain = untimed(compared).query("controller == 'naive' and seed == 0")
    assert (abs(untimed(tmp_path)["reward"].to_numpy() - plain["reward"].to_numpy()) > 1e-3).any()


def test_compare_keeps_results_among_other_humans_apart(compared, tmp_path, capsys):
    assert json.loads((compared / "settings.json").read_text())["human_reward"] == "learned"
    assert "choose another directory" in failure(capsys, *COMPARE, str(compared), "--human-reward", "published")
    learned = tmp_path / "lazy.json"
    save(replace(shipped("demonstrations"), weights=shipped("demonstrations").weights | {"speed": 0.5}), learned)
    arguments = ["compare", "merger", "--controllers", "turn", "--seeds", "1", "--human-reward", str(learned), "--out"]
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


@pytest.mark.parametrize("content", ["[" * 100_000, '{"a":' * 100_000])
def test_json_that_is_nested_too_deeply_is_refused_wherever_it_is_read(content, tmp_path, capsys):
    for name in ("settings.json", "provenance.json", "learned.json"):
        (tmp_path / name).write_text(content)
    learned = str(tmp_path / "learned.json")
    arguments = ["compare", "merger", "--controllers", "naive", "--seeds", "1"]
    assert "nested too deeply" in failure(capsys, *arguments, "--out", str(tmp_path))
    assert "nested too deeply" in failure(capsys, "sweep", *arguments[1:4], "--out", str(tmp_path))
    assert "nested too deeply" in failure(capsys, *arguments, "--human-reward", learned, "--out", str(tmp_path / "out"))
    report = ["irl", "report", "--evaluation", learned, "--theta", "us101", "--data", str(tmp_path)]
    assert "nested too deeply" in failure(capsys, *report, "--out", str(tmp_path / "out"))


def test_compare_refuses_a_corrupt_file_and_leaves_it(compared, tmp_path, capsys):
    (tmp_path / "settings.json").write_text((compared / "settings.json").read_text())
    (tmp_path / "steps.csv").write_text("these are\nno, records\n")
    assert "cannot be gone on with" in failure(capsys, *COMPARE, str(tmp_path))
    assert (tmp_path / "steps.csv").read_text() == "these are\nno, records\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compare", "roundabout"], "unknown scenario 'roundabout'"),
        (["compare", "merger", "--controllers", "oracle"], "unknown controller 'oracle'"),
        (["compare", "merger", "--controllers", "switching"], "switching:0.1"),
        (["compare", "merger", "--controllers", "switching:-1"], "a number from 0 to"),
        (["compare", "merger", "--controllers", "schedule:tom,naive"], "say it like schedule:tom=6,naive"),
        (["compare", "merger", "--controllers", "schedule:oracle"], "['oracle']; give a list of human models"),
        (["compare", "merger", "--controllers", "schedule:tmo=3,naive"], "unknown human model 'tmo'"),
        (["compare", "merger", "--controllers", "schedule:tom=5"], "the last model goes on, so name it without steps"),
        (
            ["compare", "merger", "--controllers", "random:tom"],
            "'tom' where a share belongs; say it like random:naive=0.7",
        ),
        (["compare", "merger", "--controllers", "random:tom=0.5,tom=0.5"], "names 'tom' twice"),
        (["compare", "merger", "--controllers", "random:naive=0.7,tom=0.2"], "['shares'] sum to 0.9; change one"),
        (["--import", "brief.py", "compare"], "--import brief.py: give the name of a module, such as brief"),
        (["compare", "merger", "--ladder", "tom", "naive"], "cheapest first"),
        (["--import", "no_such_module", "compare"], "--import no_such_module: ModuleNotFoundError: No module named"),
        (["compare", "merger", "--seeds", "0"], "--seeds is 0"),
        (["compare", "merger", "--out", "caf\udce9"], "'caf\\udce9' is not UTF-8"),
        (
            ["compare", "merger", "--seeds", "9223372036854775808"],
            "--seeds is 9223372036854775808; it must be 1000000 or",
        ),
        (["compare", "merger", "--controllers", "schedule:tom=10000000000,naive"], "no episode has 10000000000 steps"),
        (["compare", "merger", "--controllers", "switching:0.1\n"], "needs its lambda as a number"),
        (["frontier", "merger", "--seeds", "1000000000000"], "--seeds is 1000000000000; it must be 1000000 or less"),
        (["frontier", "merger", "--population", "1000000"], "is 30000000 orders in a round"),
        (["irl", "record", "--driver", "mpc", "--dataset", "a/b-v0", "--episodes", "1000000000000"], "1000000 or less"),
        (["bench", "merger", "--batches", "1000000000000"], "--batches has 1000000000000"),
        (["compare", "merger", "--costs", "naive=cheap"], "--costs"),
        (["compare", "merger", "--costs", "naive=0.1"], "'turn'"),
        (["compare", "merger", "--human-reward", "taught"], "--human-reward is neither learned nor published"),
        (["video", "merger", "--out", "film.mp4", "--human-reward", "nobody"], "nobody cannot be read"),
        (["video", "merger", "--out", "film.avi"], ".mp4 or .gif"),
        (["video", "merger", "--out", "film.mp4", "--speed", "0"], "--speed"),
        (["video", "merger", "--out", "film.mp4", "--speed", "nan"], "--speed"),
        (["video", "merger", "--out", "film.mp4", "--speed", "1e300"], "--speed is 1e+300; it must be between"),
        (["video", "merger", "--out", "film.gif", "--speed", "1e-300"], "--speed is 1e-300; it must be between"),
        (["irl", "record", "--driver", "mpc", "--dataset", "a/b-v0", "--episodes", "1"], "name it like ms-highway"),
        (["video", "merger", "--out", "film.mp4", "--seed", "-1"], "--seed"),
        (["video", "roundabout", "--out", "film.mp4"], "unknown scenario 'roundabout'"),
        (["video", "merger", "--out", "film.mp4", "--against", "oracle"], "unknown controller 'oracle'"),
        (["video", "merger", "--out", "film.mp4", "--width", "2000"], "the width is 2000 px"),
        (["validate", "nowhere"], "no reference episodes"),
        (["bench", "roundabout"], "'roundabout'; the scenarios are"),
    ],
)
def test_a_wrong_command_says_so_in_one_line_and_writes_nothing(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert message in failure(capsys, *arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_a_video_plays_at_true_speed(suffix, tmp_path, capsys):
    film = tmp_path / "films" / f"stay_back.{suffix}"
    assert main(["video", "stay_back", "--controller", "naive", "--seed", "1", "--out", str(film)]) == 0
    assert imageio.imread(film, plugin="pyav").shape == (35, 352, 960, 3)
    seconds = imageio.immeta(film, plugin="pyav")["duration"]
    assert seconds == pytest.approx(3.5, abs=0.11)
    assert [path.name for path in film.parent.iterdir()] == [film.name]


MODULE = """
from dataclasses import replace
from ms_highway.envs import StayBackEnv, add_scenario

class EmptyEnv(StayBackEnv):
    scenario = replace(StayBackEnv.scenario, name="empty", cones=())

add_scenario(EmptyEnv)
"""


def test_a_command_knows_the_scenarios_of_a_module_that_it_imports(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "my_scenarios.py").write_text(MODULE)
    arguments = ["compare", "empty", "--controllers", "naive", "--seeds", "1", "--out", "results"]
    try:
        assert main(["--import", "my_scenarios", *arguments]) == 0
    finally:
        del ENVIRONMENTS["empty"], SCENARIOS["empty"]
    assert pd.read_csv("results/summary.csv")["reward"].item() > 2  # nothing stands in the way


IRL_COMMANDS = [["irl", name] for name in ("record", "fit", "evaluate", "recover", "report")]


@pytest.mark.parametrize(
    "command",
    [[], ["compare"], ["frontier"], ["video"], ["report"], ["bench"], ["sweep"], ["validate"], ["irl"], *IRL_COMMANDS],
)
def test_help_teaches_the_command(command):
    run = subprocess.run(
        [sys.executable, "-m", "ms_highway", *command, "--help"], capture_output=True, text=True, check=True
    )
    assert "ms-highway" in run.stdout
    assert len(run.stdout) > 250


def test_commands_keep_compiled_planners_in_the_users_own_cache_unless_told_not_to(tmp_path):
    """In processes of their own, as no process forgets what it has compiled."""
    home = tmp_path / "home"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMPILATION")}
    environment["XDG_CACHE_HOME"] = str(home)
    arguments = ["compare", "stay_back", "--controllers", "naive", "--seeds", "1", "--out"]
    for run, options in enumerate((["--no-compilation-cache"], [])):
        command = [sys.executable, "-m", "ms_highway", *options, *arguments, str(tmp_path / str(run))]
        subprocess.run(command, check=True, capture_output=True, env=environment)
        assert (home / "ms_highway").exists() == (run == 1)
    assert (home / "ms_highway" / "compiled").stat().st_mode & 0o077 == 0
    assert list((home / "ms_highway" / "compiled").iterdir())


def test_a_command_goes_on_where_compiled_planners_cannot_be_kept(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert main(["bench", "roundabout"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert "not kept" in said[0]
    assert "roundabout" in said[1]


def test_bench_measures_a_plan_and_a_peer_that_plans_the_same():
    name, result = next(bench("stay_back", peer=True))
    assert name == "naive"
    assert 0 < result["plan_us"]["p50"] <= result["plan_us"]["p99"] < 1e6
    assert 0 < result["peer_us"]["p50"] < 1e6
    assert 0 < result["decision_us"] < 1e6
    assert 0 < result["step_us"] < 1e6
    assert 0 < result["compile_s"]["cached"] < result["compile_s"]["cold"]
    assert result["flop"] > 1e5
    assert set(result["plans_per_s"]) == {"1", "32", "1024"}
