"""The commands as a user types them."""

import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio
import pandas as pd
import pytest
from commands import run

from ms_highway.cli.main import main
from ms_highway.envs import ENVIRONMENTS, SCENARIOS
from ms_highway.envs.controllers import CONTROLLERS
from ms_highway.envs.short_names import SHORT_NAMES
from ms_highway.planning.human_models import MODELS

NAIVE = "compare stay_back --controllers naive --seeds 1 --out"


@pytest.mark.parametrize("content", ["[" * 100_000, '{"a":' * 100_000])
def test_json_that_is_nested_too_deeply_is_refused_wherever_it_is_read(content, tmp_path, refused):
    for name in ("settings.json", "provenance.json", "learned.json"):
        (tmp_path / name).write_text(content)
    for command in (
        "compare merger --controllers naive --out .",
        "sweep merger --controllers naive --out .",
        "compare merger --set human_reward=learned.json --out out",
    ):
        assert "nested too deeply" in refused(command)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("compare roundabout", "unknown scenario 'roundabout'"),
        ("compare merger --controllers oracle", "unknown controller 'oracle'"),
        ("compare merger --controllers switching:-1", "a number from 0 to"),
        ("compare merger --controllers schedule:tom,naive", "write it like schedule:tom=6,naive"),
        ("compare merger --controllers schedule:oracle", "names 'oracle'; the human models are"),
        ("compare merger --controllers schedule:tmo=3,naive", "names 'tmo'; the human models are"),
        ("compare merger --controllers period:tom=1,naive", "write it like period:tom=1,naive=3"),
        (
            "compare merger --controllers random:tom",
            "write it like random:naive=0.7",
        ),
        ("compare merger --controllers random:naive=0.7,tom=0.2", "['shares'] sum to 0.9; change one"),
        ("--import brief.py compare", "--import brief.py: give the name of a module, such as brief"),
        ("compare merger --set ladder=tom,naive", "cheapest first"),
        (
            "compare merger --set ladder=naive,tom@8 --controllers naive learned:1",
            "without 'tom@8'; choose another controller",
        ),
        ("compare merger --set costs=measured --controllers naive learned:1", "not those measured here"),
        ("compare dense_merge --set ladder=turn,tom --controllers turn learned:1", "begin the ladder with it"),
        ("compare merger --controllers naive schedule:naive/tom=1,tom", "has 2 models for 1 humans"),
        ("sweep merger --set ladder=naive,tom@8 --controllers naive learned:1 --out sweep", "without 'tom@8'"),
        ("frontier merger --set ladder=naive,tom@8 --controllers learned", "without 'tom@8'"),
        ("frontier merger --controllers idm", "T(M) of 'idm' in merger is not known, but regrets need it"),
        ("video merger --set ladder=naive,tom@8 --against learned:1 --out film.mp4", "without 'tom@8'"),
        ("compare merger --set horizon", "say it like --set horizon=10"),
        ("compare merger --set controller=tom", "who drives is no key"),
        ("compare merger --set horizn=10", "did you mean 'horizon'?"),
        ("compare merger --set horizon=ten", "config['horizon'] is 'ten'"),
        ("compare --import mine", "unrecognized arguments: --import; --import MODULE goes before the command"),
        ("compare merger --seed 1000", "unrecognized arguments: --seed 1000"),
        ("compare merger --lambdas 1:1.01:25", "lambdas are '1:1.01:25'; give a number like 0.1, or LOW:"),
        ("compare merger --lambdas 0.1:10:1000000000000", "lambdas are '0.1:10:1000000000000'"),
        ("compare merger --lambdas -1", "lambdas are '-1'"),
        ("--import no_such_module compare", "--import no_such_module: ModuleNotFoundError: No module named"),
        ("compare merger --seeds 0", "--seeds: '0' is no whole number from 1 to"),
        ("compare merger --out caf\udce9", "'caf\\udce9' is not UTF-8"),
        (
            "compare merger --controllers schedule:tom=10000000000,naive",
            "write it like schedule:tom=6,naive",
        ),
        ("compare merger --controllers switching:0.1\n", "write it like switching:0.1"),
        (
            "irl record --driver mpc --dataset a/b-v0 --episodes 1000000000000",
            "from 1 to 1,000,000",
        ),
        ("bench merger --batches 1000000000000", "--batches: '1000000000000'"),
        ("compare merger --set costs=naive=cheap", "config['costs']"),
        ("compare merger --set costs=naive=0.1", "'turn'"),
        ("compare merger --set human_reward=taught", "human_reward is neither learned nor published"),
        ("video merger --out film.mp4 --set human_reward=nobody", "nobody cannot be read"),
        ("video merger --out film.avi", ".mp4 or .gif"),
        (
            "video merger --out film.mp4 --speed 1e300",
            "--speed: '1e300' is no number from 0.01 to 100",
        ),
        ("irl record --driver mpc --dataset a/b-v0 --episodes 1", "name it like ms-highway"),
        ("video merger --out film.mp4 --seed -1", "--seed"),
        ("video roundabout --out film.mp4", "unknown scenario 'roundabout'"),
        ("video merger --out film.mp4 --against oracle", "unknown controller 'oracle'"),
        ("video merger --out film.mp4 --width 2000", "'2000' is no whole number from 160 to 1,280"),
        ("validate nowhere", "there is no directory nowhere"),
        ("bench roundabout", "'roundabout'; the scenarios are"),
        ("sweep merger give_way --out sweep", "there are 2 scenarios; a sweep is of one"),
    ],
)
def test_a_wrong_command_says_so_in_one_line_and_writes_nothing(command, message, refused):
    assert message in refused(command)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_a_video_plays_at_true_speed(suffix, tmp_path, capsys):
    film = tmp_path / "films" / f"stay_back.{suffix}"
    run(f"video stay_back --controller naive --seed 1 --out {film}")
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


@pytest.mark.slow
def test_a_command_knows_the_scenarios_of_a_module_that_it_imports(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "my_scenarios.py").write_text(MODULE)
    try:
        run("--import my_scenarios compare empty --controllers naive --seeds 1 --out results")
    finally:
        del ENVIRONMENTS["empty"], SCENARIOS["empty"]
    assert pd.read_csv("results/summary.csv")["reward"].item() > 2  # nothing stands in the way


@pytest.mark.slow
def test_commands_know_the_rules_and_models_of_a_module_that_they_import(tmp_path, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    monkeypatch.setattr(sys, "path", list(sys.path))
    asked = "--set ladder=coasting,tom --controllers coasting near:6"
    try:
        for command in ("compare merger --set costs=measured", "sweep merger --set costs=coasting=0.09,tom=0.37"):
            out = tmp_path / command.partition(" ")[0]
            run(f"--import notebooks.examples.rule {command} {asked} --seeds 2 --out {out}")
            summary = pd.read_csv(out / "summary.csv").set_index("controller")
            assert (summary["counted_ms"] > 0).all()
            assert summary["kind"]["near:6"] == "near"
            assert 0 < summary["share_tom"]["near:6"] < 1
    finally:
        del MODELS["coasting"], CONTROLLERS["near"], SHORT_NAMES["near"]


@pytest.mark.slow
def test_commands_keep_compiled_planners_in_the_users_own_cache_unless_told_not_to(tmp_path):
    """In processes of their own, as no process forgets what it has compiled."""
    home = tmp_path / "home"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_COMPILATION")}
    environment["XDG_CACHE_HOME"] = str(home)
    for keeps, option in enumerate(("--no-compilation-cache ", "")):
        command = f"-m ms_highway {option}{NAIVE} {tmp_path / str(keeps)}"
        subprocess.run([sys.executable, *command.split()], check=True, capture_output=True, env=environment)
        assert (home / "ms_highway").exists() == keeps
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


def test_a_warning_of_a_command_is_one_line_without_a_place_in_the_source(tmp_path):
    """In a process of its own, as the tests turn warnings into errors."""
    command = f"-m ms_highway {NAIVE} {tmp_path} --set step_size=0.5"
    said = subprocess.run([sys.executable, *command.split()], check=True, capture_output=True, text=True).stderr
    (line,) = {line for line in said.splitlines() if "overshoot" in line}
    assert line.startswith("ms-highway: config['step_size'] is 0.5")
    assert "warn(" not in said
    assert ".py" not in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("around", "message"),
    [
        ("{} >&-", "standard output is closed"),
        ("{} | true; exit ${{PIPESTATUS[0]}}", "Broken pipe"),
        ("JAX_PLATFORMS=cuda {}", "JAX_PLATFORMS is 'cuda'"),
    ],
)
def test_a_command_that_cannot_print_or_compute_says_so_in_one_line(around, message, tmp_path):
    command = around.format(f"{sys.executable} -m ms_highway {NAIVE} {tmp_path}")
    ran = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert ran.returncode == 2
    (line,) = [line for line in ran.stderr.splitlines() if not line.startswith("episodes")]
    assert message in line
