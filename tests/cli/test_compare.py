"""`ms-highway compare` and `report` as users type them."""

import contextlib
import io
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import time
from base64 import b64decode
from functools import reduce
from html import unescape
from importlib.metadata import version
from operator import getitem
from pathlib import Path
from xml.etree import ElementTree
from zipfile import ZipFile

import imageio.v3 as imageio
import pandas as pd
import pytest
from commands import run
from matplotlib import rc_context
from matplotlib.figure import Figure

import ms_highway
from ms_highway.cli import console
from ms_highway.cli.main import main
from ms_highway.cli.options import FORMATS
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.directory import ResultsDirectory, this_run
from ms_highway.experiments.runner import run as run_comparison
from ms_highway.experiments.summary import read_results
from ms_highway.visualization.figures import rewards
from ms_highway.visualization.style import content, drawn, looks
from ms_highway.visualization.tradeoff import curve, frontier

COMPARE = "compare stay_back --controllers naive naive switching:0.4 --seeds 2 --out"
FIGURES = "bars", "reward", "timeline", "decisions"
VALUES = Path(ms_highway.__file__).parent / "data" / "values.npz"
KEPT = Path(__file__).parents[2] / "notebooks" / "results"


def untimed(directory):
    """The records without their measured times."""
    records = pd.read_csv(directory / "steps.csv")
    return records.loc[:, ~records.columns.str.endswith("seconds")]


def parts(directory):
    return {*(directory / "parts").glob("[!.]*")}


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A comparison that was run in two parts."""
    directory = tmp_path_factory.mktemp("compare")
    run(f"{COMPARE.replace('2', '1')} {directory}")
    run(f"{COMPARE} {directory}")
    return directory


@pytest.fixture
def begun(compared, tmp_path):
    """A copy of its settings and records."""
    for name in ("settings.json", "steps.csv"):
        shutil.copy(compared / name, tmp_path)
    return tmp_path


def test_compare_writes_steps_a_summary_and_what_made_them(compared):
    records = pd.read_csv(compared / "steps.csv")
    assert list(records) == Comparison({"stay_back": []}).columns()
    assert len(records) == 2 * 2 * 35
    summary = pd.read_csv(compared / "summary.csv").set_index("controller")
    means = records.groupby("controller")["reward"].mean()
    assert summary["reward"].to_dict() == pytest.approx(means.to_dict())
    assert summary.loc["naive", "share_naive"] == 1
    assert summary.loc["naive", "decision_ms"] == 0
    assert summary.loc["switching:0.4", "decision_ms"] > 0
    runs = json.loads((compared / "provenance.json").read_text())
    assert ["--seeds 1" in run["command"] for run in runs] == [True, False]

    # The same command computes nothing.
    run(f"{COMPARE} {compared}")
    assert json.loads((compared / "provenance.json").read_text()) == runs


def test_compare_tells_every_minute_how_many_episodes_are_done(
    tmp_path, monkeypatch, capsys
):
    # Instead of a minute, which an episode does not take.
    monkeypatch.setattr(console, "PROGRESS_SECONDS", 0.001)
    run(f"{COMPARE} {tmp_path}")
    lines = capsys.readouterr().err.splitlines()
    told = [line for line in lines if line.startswith("episodes: ")]
    assert told[0] == "episodes: 0 of 4"
    after_one = next(line for line in told if "1 of 4" in line)
    assert re.fullmatch(r"episodes: 1 of 4, \d+ s left", after_one)
    assert told[-1] == "episodes: 4 of 4, 0 s left"


@pytest.mark.slow
def test_a_killed_comparison_resumes_to_the_same_results(tmp_path):
    """It runs on two cores, the other in one process.

    No episode is lost or repeated, and no process is left behind.
    """
    asked = Comparison({"merger": ["naive", "turn"]}, 40)
    alone = tmp_path / "1"
    killed = tmp_path / "2"
    assert list(run_comparison(asked, alone)) == list(range(81))
    words = f"compare merger --controllers naive turn --seeds 40 --out {killed}"
    process = subprocess.Popen([sys.executable, "-m", "ms_highway", *words.split()])
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    while len(parts(killed)) < 10:
        assert process.poll() is None
        time.sleep(0.01)
    workers = [Path("/proc") / child for child in children.read_text().split()]
    process.kill()
    process.wait()
    left = len(parts(killed))
    assert 10 <= left < 80
    while any(worker.exists() for worker in workers):
        time.sleep(0.1)
    assert list(run_comparison(asked, killed)) == list(range(left, 81))
    pd.testing.assert_frame_equal(untimed(killed), untimed(alone))
    assert not parts(killed)


def test_compare_resumes_from_steps_and_parts(compared, begun):
    steps = begun / "steps.csv"
    parts = begun / "parts"
    head, *lines = steps.read_text().splitlines(keepends=True)
    steps.write_text("".join([head, *lines[:35]]))
    parts.mkdir()
    (parts / "3.csv").write_text("".join([head, *lines[-35:]]))
    # A file that a killed process has left.
    (parts / f".part.{'0' * 16}.1.csv").write_text(head + lines[40][:20])
    run(f"{COMPARE} {begun}")
    pd.testing.assert_frame_equal(untimed(begun), untimed(compared))
    before = steps.read_text()
    run(f"{COMPARE} {begun} --format svg")
    assert steps.read_text() == before
    # The figure that was there shows the same records.
    assert (begun / "stay_back_bars.png").exists()
    for name in FIGURES:
        assert (begun / f"stay_back_{name}.svg").read_text().count("<path") > 20
    assert not parts.exists()


@pytest.mark.filterwarnings("always:.*not whole")
def test_episodes_that_are_not_whole_are_computed_again(compared, begun, capsys):
    """One lacks its last rows, the end of its last row or a row, or has a row twice."""
    steps = begun / "steps.csv"
    wanted = untimed(compared)
    head, *lines = steps.read_text().splitlines(keepends=True)
    cut = [
        lines[:-30],
        [*lines[:-1], lines[-1][:-4]],
        lines[:80] + lines[81:],
        [*lines, lines[-1]],
    ]
    for rest in cut:
        steps.write_text("".join([head, *rest]))
        run(f"report {begun} --no-videos")
        assert "lacks 1 episodes" in capsys.readouterr().err
        run(f"{COMPARE} {begun}")
        warning = "steps.csv: episodes that are not whole are computed again: 1"
        assert warning in capsys.readouterr().err
        pd.testing.assert_frame_equal(untimed(begun), wanted)


def test_a_page_runs_no_code_that_results_name(begun, capsys):
    """A file of an agent can run any code when it is opened."""
    steps = begun / "steps.csv"
    agent = begun / "agent.zip"
    ran = begun / "ran"
    with ZipFile(agent, "w") as archive:
        archive.writestr("data", pickle.dumps(Traps(str(ran))))
    steps.write_text(steps.read_text().replace(",switching:0.4,", f",{agent},"))
    run(f"report {begun}")
    assert f"films do not show {agent}" in capsys.readouterr().err
    (film,) = elements((begun / "report.html").read_text(), "video")
    assert "naive." in film["aria-label"]
    assert "agent.zip" not in film["aria-label"]
    assert not ran.exists()

    # With --film-own, it is opened, and is no agent.
    main(["report", str(begun), "--film-own"])
    assert str(agent) in capsys.readouterr().err


class Traps:
    """Writes a file when it is unpickled."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return open, (self.file, "w")


def test_a_closed_pipe_costs_no_results(begun, monkeypatch, capsys):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed, contextlib.suppress(SystemExit):
        monkeypatch.setattr(sys, "stdout", closed)
        run(f"{COMPARE} {begun}")
    assert "pipe" not in capsys.readouterr().err
    assert (begun / "summary.csv").exists()


@pytest.mark.slow
def test_compare_keeps_measured_costs_with_the_results(tmp_path):
    command = (
        "compare stay_back --controllers switching:1 --seeds 1 --set costs=measured"
        f" --out {tmp_path}"
    )
    run(command)
    settings = (tmp_path / "settings.json").read_text()
    assert 0 < json.loads(settings)["measured"]["stay_back"]["naive"] < 0.1
    run(command)
    assert (tmp_path / "settings.json").read_text() == settings


def test_compare_warns_if_it_resumes_with_other_versions(compared, begun, capsys):
    made = json.loads((compared / "provenance.json").read_text())[0]
    versions = made["versions"] | {"jax": "0.1"}
    older = made | {"versions": versions, "xla_flags": "--other"}
    (begun / "provenance.json").write_text(json.dumps([older]))
    run(f"compare stay_back --seeds 1 --out {begun} --controllers turn")
    said = capsys.readouterr().err
    jax = made["versions"]["jax"]
    assert f"continues with jax {jax} instead of 0.1, XLA_FLAGS" in said
    assert "instead of --other; results may not agree" in said


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        (
            "(stay_back,naive,0,0,naive),[^,]*",
            r"\1,1e400",
            "reward of naive with seed 0 is inf; it must be",
        ),
        (
            "stay_back,naive,0,0,",
            "stay_back,na\xefve,0,0,",
            "steps.csv cannot be read ('utf-8' codec can't decode",
        ),
    ],
)
def test_compare_refuses_damaged_records_and_leaves_them_unchanged(
    pattern, replacement, message, begun, refused
):
    steps = begun / "steps.csv"
    spoilt = re.sub(pattern, replacement, steps.read_text())
    steps.write_text(spoilt, encoding="latin-1")
    assert message in refused(f"{COMPARE} .")
    assert steps.read_text(encoding="latin-1") == spoilt


def test_compare_changes_no_settings_without_a_record_of_runs(begun, refused):
    (begun / "provenance.json").write_text("{}")
    before = (begun / "settings.json").read_text()
    assert "provenance.json cannot be read as a list of runs" in refused(
        "compare stay_back --controllers turn --out ."
    )
    assert (begun / "settings.json").read_text() == before


WRONG = [None, -1, 2.5, "x", [1], {"a": [1]}, True, float("nan")]
"""Values that replace those of a file: each is of a wrong type somewhere."""


def places_of(content, place=()):
    """Yield the keys and numbers that lead to every value in the content of a file."""
    yield place
    if isinstance(content, dict | list):
        for key in content if isinstance(content, dict) else range(len(content)):
            yield from places_of(content[key], (*place, key))


def test_no_edit_of_settings_or_provenance_ends_in_a_traceback(compared, begun):
    """Each is read, or refused in one sentence that names the file."""
    shutil.copy(compared / "provenance.json", begun)
    asked = Comparison({"stay_back": ["naive", "switching:0.4"]}, seeds=2)
    sentences = []
    for name in ("settings.json", "provenance.json"):
        file = begun / name
        kept = file.read_text()
        for number, place in enumerate(places_of(json.loads(kept))):
            content = {"": json.loads(kept)}
            *above, last = ("", *place)
            parent = reduce(getitem, above, content)
            parent[last] = WRONG[number % len(WRONG)]
            file.write_text(json.dumps(content[""]))
            try:
                read_results(begun)
                next(run_comparison(asked, begun))
                ResultsDirectory(begun).differing(this_run())
            except ValueError as error:
                sentences.append(str(error))
        file.write_text(kept)
    assert len(sentences) > 15
    for sentence in sentences:
        assert str(begun) in sentence
        assert "\n" not in sentence


def texts_of(html):
    """The texts between the tags of a page."""
    return [unescape(text).strip() for text in re.split("<[^>]*>", html)]


def elements(html, tag):
    """The attributes of all elements with a tag."""
    return [
        dict(re.findall(r'([\w-]+)="([^"]*)"', found))
        for found in re.findall(f"<{tag} [^>]*>", html)
    ]


def content_of(element):
    """What the source of a picture or film holds."""
    return b64decode(element["src"].partition(";base64,")[2])


def test_the_page_has_all_results_and_needs_no_other_file(compared):
    run(f"report {compared}")
    html = (compared / "report.html").read_text()
    texts = texts_of(html)
    said = " ".join(texts)
    rewards = pd.read_csv(compared / "summary.csv").set_index("controller")["reward"]
    assert f"naive earns a reward of {rewards['naive']:.2f} per step" in said
    for name, reward in rewards.items():
        assert re.search(rf">{name}</t[hd]>\s*<td>{reward:.2f}</td>", html)
    images = elements(html, "img")
    (film,) = elements(html, "video")
    assert [image["alt"].split(".")[0] for image in images] == [
        f"Stay Back, {name}" for name in FIGURES
    ]
    for image in images:
        assert imageio.imread(content_of(image)).std() > 10
    assert "naive above, switching:0.4 below" in film["aria-label"]
    frames = imageio.imread(content_of(film), plugin="pyav", extension=".mp4")
    assert frames.shape == (35, 816, 960, 3)
    assert f"ms-highway {COMPARE} {compared}" in said
    assert f"jax {version('jax')}" in said
    assert {"human reward", "learned"} <= set(texts)
    assert "are missing" not in said
    assert not any(text in html for text in ("http:", "https:", "url(", "@import"))
    for place in re.findall(r'\b(?:src|href)="([^"]*)"', html):
        assert place.startswith(("data:", "#"))


def test_a_page_says_what_is_missing_and_escapes_markup(compared, begun, capsys):
    steps = begun / "steps.csv"
    out = begun / "pages" / "small.html"
    records = pd.read_csv(steps).query("controller == 'naive' and seed == 0")
    records.to_csv(steps, index=False)
    made = json.loads((compared / "provenance.json").read_text())[0]
    hostile = made | {"command": "<script>alert(1)</script>"}
    (begun / "provenance.json").write_text(json.dumps([hostile]))
    run(f"report {begun} --no-videos --out {out}")
    assert "lacks 3 episodes; start the same" in capsys.readouterr().err
    html = out.read_text()
    assert "3 of the requested episodes are missing." in texts_of(html)
    assert "<script>alert(1)</script>" in unescape(html)
    assert not elements(html, "video")
    assert "<script" not in html
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_figures_survive_odd_names_and_the_users_matplotlibrc(begun):
    file = begun / r"$a_b^{c%d\e$#~&" / "values_$.npz"
    file.parent.mkdir()
    shutil.copy(VALUES, file)
    odd = f"learned:1:{file}"
    spelled = {"steps.csv": odd, "settings.json": json.dumps(odd)[1:-1]}
    for name, written in spelled.items():
        text = (begun / name).read_text()
        (begun / name).write_text(text.replace("switching:0.4", written))
    users_settings = {
        "text.usetex": True,
        "axes.formatter.use_mathtext": True,
        "font.family": "no such font",
    }
    with rc_context(users_settings):
        run(f"report {begun} --no-videos")
    images = elements((begun / "report.html").read_text(), "img")
    assert [image["alt"].split(".")[0] for image in images] == [
        f"Stay Back, {name}" for name in FIGURES
    ]
    run(f"report {begun} --out {begun / 'tables.tex'}")
    tex = (begun / "tables.tex").read_text()
    directory = (
        r"/\$a\_b\textasciicircum{}\{c\%d\textbackslash{}e\$\#\textasciitilde{}\&"
    )
    assert directory + r"/values\_\$.npz} & " in tex
    rows = [line for line in tex.splitlines() if line.endswith(r" \\")]
    assert len(rows) == 3
    assert len({row.replace(r"\&", "").count("&") for row in rows}) == 1
    assert r"90 \% interval" in rows[0]


def test_a_figure_that_cannot_be_made_is_one_warning(compared, begun, capsys):
    """The results are whole."""
    (begun / "stay_back_reward.png").mkdir()
    run(f"{COMPARE} {begun}")
    lines = capsys.readouterr().err.splitlines()
    (warning,) = (line for line in lines if line.startswith("ms-highway:"))
    assert "stay_back_reward.png cannot be written" in warning
    there = {path.stem for path in begun.glob("stay_back_*.png") if path.is_file()}
    assert there == {f"stay_back_{name}" for name in FIGURES if name != "reward"}
    summary = pd.read_csv(begun / "summary.csv")
    assert summary.equals(pd.read_csv(compared / "summary.csv"))

    broken = {"broken": lambda: Figure().subplots().plot([1, 2], [1]), "empty": Figure}
    warning = "the figure broken is left out, as it cannot be drawn .ValueError"
    with pytest.warns(UserWarning, match=warning):
        assert [*drawn(broken)] == ["empty"]


def test_no_two_controllers_look_alike_and_legends_fit(tmp_path):
    name = "values_of_computation.npz"
    files = [tmp_path / folder / name for folder in ("first", "second")]
    for file in files:
        file.parent.mkdir()
        shutil.copy(VALUES, file)
    switching = [f"switching:{price}" for price in range(9)]
    several = [
        "budget:10",
        "budget:20",
        "nearest:1",
        "nearest:2",
        "horizon:1",
        "random:naive=0.5,tom=0.5",
    ]
    names = [
        "naive",
        "turn",
        "tom",
        "tom+belief",
        "tom@8",
        *switching,
        *several,
        *(f"learned:1:{file}" for file in files),
        "schedule:tom=6,naive",
    ]
    found = looks(names)
    for parts in (lambda look: look[:3], lambda look: look.label):
        assert len({parts(look) for look in found.values()}) == len(names)
    assert looks(names[:8]) == {name: found[name] for name in names[:8]}

    rows = [
        ("merger", name, seed, step, 1.0 * seed)
        for name in names[-8:]
        for seed in (0, 1)
        for step in (0, 1)
    ]
    columns = ["scenario", "controller", "seed", "step", "reward"]
    figure = rewards(pd.DataFrame(rows, columns=columns), "merger")
    content(figure)
    (legend,) = figure.legends
    assert figure.bbox.x0 <= legend.get_window_extent().x0
    assert legend.get_window_extent().x1 <= figure.bbox.x1
    assert len(legend.get_texts()) == 8


def test_curves_and_frontiers_are_written_in_every_format():
    kept = pd.read_csv(KEPT / "summary.csv")
    drawn = (
        curve(kept[kept["run"] == "curve"], "merger"),
        frontier(pd.read_csv(KEPT / "regrets.csv"), "merger", 30),
    )
    for figure in drawn:
        png, pdf, svg = (content(figure, kind) for kind in FORMATS)
        assert imageio.imread(io.BytesIO(png)).std() > 10
        assert len(pdf) > 8000
        # Publishers refuse fonts of type 3.
        assert not re.search(rb"/Type3\b", pdf)
        paths = ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}path")
        assert len(list(paths)) > 20
