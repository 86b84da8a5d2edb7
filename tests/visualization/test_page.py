"""The page and the table that are made of a comparison."""

import json
import re
import shutil
import subprocess
from base64 import b64decode
from html.parser import HTMLParser
from importlib.metadata import version

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest

from ms_highway.cli.main import main
from ms_highway.envs.drivers import controller_config
from ms_highway.experiments.findings import worth_seeing
from ms_highway.experiments.results import read_results
from ms_highway.visualization.comparison import bars
from ms_highway.visualization.video import film

CONTROLLERS = ["naive", "switching:0.4"]
COMPARE = ["compare", "stay_back", "--controllers", *CONTROLLERS, "--out"]

PROBE = """<script>
addEventListener("load", () => {
  const films = [...document.querySelectorAll("video")];
  const tell = () => document.title = "seen " + JSON.stringify({
    images: [...document.images].map(image => image.naturalWidth),
    films: films.map(film => [film.videoWidth, film.duration]),
    below: films.every(film => film.clientHeight - film.clientWidth * film.videoHeight / film.videoWidth > 60),
    fits: document.documentElement.scrollWidth <= innerWidth,
    loaded: performance.getEntriesByType("resource").map(entry => entry.name.slice(0, 40)),
  });
  tell();
  films.forEach(film => film.addEventListener("loadeddata", tell));
})
</script></body>"""


class Page(HTMLParser):
    """The elements of a page, which must be closed in the order in which they were opened, and its text."""

    EMPTY = ("meta", "img", "link", "br", "hr")

    def __init__(self, text):
        super().__init__()
        self.elements, self.texts, self.open = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.texts.append(data.strip())

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A comparison of which one episode was run first, and the rest later."""
    directory = tmp_path_factory.mktemp("compare")
    for seeds in ("1", "2"):
        assert main([*COMPARE, str(directory), "--seeds", seeds]) == 0
    return directory


@pytest.fixture(scope="module")
def html(compared):
    assert main(["report", str(compared)]) == 0
    return (compared / "report.html").read_text()


def content(source, kind):
    assert source.startswith(f"data:{kind};base64,")
    return b64decode(source.partition(",")[2])


def failure(capsys, *arguments):
    assert main(list(arguments)) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_the_page_holds_tables_figures_and_a_video_of_both_controllers(html, compared):
    page = Page(html)
    assert page.all("html")[0]["lang"] == "en"
    summary = pd.read_csv(compared / "summary.csv").set_index("controller")
    for name in CONTROLLERS:
        row = page.texts.index(name, page.texts.index("controller"))
        assert page.texts[row + 1].startswith(f"{summary.loc[name, 'reward']:.2f} (")
    for image in page.all("img"):
        assert imageio.imread(content(image["src"], "image/png")).std() > 10
        assert len(image["alt"]) > 40
    assert len(page.all("img")) == 3
    (film,) = page.all("video")
    assert "naive above, switching:0.4 below" in film["aria-label"]
    frames = imageio.imread(content(film["src"], "video/mp4"), plugin="pyav", extension=".mp4")
    assert frames.shape == (35, 816, 960, 3)
    poster = imageio.imread(content(film["poster"], "image/png"))
    assert np.abs(poster.astype(int) - frames[14]).mean() < 4


def test_what_is_filmed_for_the_page_is_the_episode_that_was_recorded(compared):
    results = read_results(compared)
    filmed = film("stay_back", "switching:0.4", 1, **results.config("stay_back")).records
    recorded = results.records.query("controller == 'switching:0.4' and seed == 1")
    np.testing.assert_allclose([record["reward"] for record in filmed], recorded["reward"])
    assert [record["model"] for record in filmed] == list(recorded["model"])


def test_the_page_refers_to_nothing_outside_itself(html):
    assert "http:" not in html
    assert "https:" not in html
    for _, attributes in Page(html).elements:
        for name in ("src", "href", "poster"):
            assert attributes.get(name, "#").startswith(("data:", "#"))
    assert "url(" not in html
    assert "@import" not in html


def test_the_page_tells_what_made_the_results(html, compared):
    said = " ".join(Page(html).texts)
    assert f"ms-highway compare stay_back --controllers naive switching:0.4 --out {compared} --seeds 1" in said
    assert f"jax {version('jax')}" in said
    assert "learned" in said


def test_a_browser_shows_every_picture_and_the_video_above_its_controls_without_loading_anything(html, tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if not browser:
        pytest.skip("neither chromium nor google-chrome is installed")
    page = tmp_path / "page.html"
    page.write_text(html.replace("</body>", PROBE))
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    run = subprocess.run(
        [browser, *options, "--window-size=600,900", "--timeout=5000", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    seen = json.loads(run.stdout.partition("<title>seen ")[2].partition("</title>")[0])
    assert seen == {"images": [1600] * 3, "films": [[960, 3.5]], "below": True, "fits": True, "loaded": []}
    assert "CONSOLE" not in run.stderr


def test_without_videos_the_page_is_small_and_goes_where_it_is_told(compared, tmp_path):
    out = tmp_path / "pages" / "small.html"
    assert main(["report", str(compared), "--no-videos", "--out", str(out)]) == 0
    page = Page(out.read_text())
    assert not page.all("video")
    assert len(page.all("img")) == 3
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_what_names_say_is_text_and_no_markup(compared, tmp_path):
    shutil.copytree(compared, tmp_path, dirs_exist_ok=True)
    runs = json.loads((compared / "provenance.json").read_text())
    (tmp_path / "provenance.json").write_text(json.dumps([runs[0] | {"command": "<script>alert(1)</script>"}]))
    assert main(["report", str(tmp_path), "--no-videos"]) == 0
    page = Page((tmp_path / "report.html").read_text())
    assert not page.all("script")
    assert "<script>alert(1)</script>" in page.texts


def test_provenance_grows_when_a_comparison_goes_on_and_only_then(compared):
    runs = json.loads((compared / "provenance.json").read_text())
    assert [run["command"][-1] for run in runs] == ["1", "2"]
    assert runs[0]["time"] < runs[1]["time"]
    assert runs[0]["machine"]["cores"] >= 1
    assert runs[0]["versions"]["highway-env"] == version("highway-env")
    assert main([*COMPARE, str(compared), "--seeds", "2"]) == 0
    assert json.loads((compared / "provenance.json").read_text()) == runs


def test_a_comparison_refuses_provenance_that_cannot_be_read_and_leaves_everything(tmp_path, capsys):
    (tmp_path / "provenance.json").write_text("[")
    assert "provenance.json cannot be read" in failure(capsys, *COMPARE, str(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["provenance.json"]


def test_the_markdown_table_has_the_numbers_of_the_summary(compared, capsys):
    assert main(["report", str(compared), "--markdown"]) == 0
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()]
    headings, rules, *rows = lines
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
        ({}, ["compare", "other"]),
    ],
)
def test_directories_beside_each_other_are_called_by_what_tells_them_apart(changes, names, compared, tmp_path, capsys):
    other = shutil.copytree(compared, tmp_path / "other")
    settings = json.loads((compared / "settings.json").read_text())
    (other / "settings.json").write_text(json.dumps(settings | changes))
    records = pd.read_csv(other / "steps.csv")
    naive_records = records[records["controller"] == "naive"]
    naive_records.assign(reward=naive_records["seed"] + 1.0).to_csv(other / "steps.csv", index=False)
    assert main(["report", str(compared), str(other), "--markdown"]) == 0
    heading, _, naive, switching = capsys.readouterr().out.splitlines()
    for name in names:
        assert heading.count(name) == 2
    assert naive.split("|")[5].strip().startswith("1.50 (")
    assert switching.split("|")[5].strip() == ""


def test_the_best_fixed_model_is_shown_beside_switching_at_the_papers_conservative_lambda():
    rows = [("naive", 1.0), ("switching:0.6", 3.0), ("tom", 5.0), ("switching:0.1", 4.0), ("turn", 2.0)]
    rows += [("switching:0.001", 4.5)]
    summaries = pd.DataFrame(
        [
            {
                "scenario": "merger",
                "controller": name,
                "reward": reward,
                "kind": config["type"],
                "price": config.get("lambda"),
            }
            for name, reward in rows
            for config in [controller_config(name)]
        ]
    )
    assert worth_seeing(summaries, "merger") == ["tom", "switching:0.1"]  # the paper's
    assert worth_seeing(summaries[summaries["price"] != 0.1], "merger") == ["tom", "switching:0.001"]
    assert worth_seeing(summaries[summaries["reward"] < 3], "merger") == ["naive", "turn"]
    assert worth_seeing(summaries[summaries["reward"] == 5], "merger") == ["tom"]


def test_the_bar_of_a_dear_model_that_decides_nothing_leaves_room_for_the_legend(compared):
    summaries = read_results(compared).summaries
    summaries.loc[summaries["controller"] == "naive", "planning_ms"] = 10.0
    _, right = bars(summaries, "stay_back").axes
    assert right.get_ylim()[0] == 0
    assert right.get_ylim()[1] >= 12


def without_column(directory):
    pd.read_csv(directory / "steps.csv").drop(columns="model").to_csv(directory / "steps.csv", index=False)


def with_a_broken_line(directory):
    with (directory / "steps.csv").open("a") as file:
        file.write("stay_back,naive,2,0,naive,0.5\n")


def renamed(old, new):
    def rename(directory):
        text = (directory / "steps.csv").read_text()
        (directory / "steps.csv").write_text(re.sub(rf"(?m)(^|,){re.escape(old)}(?=,)", rf"\1{new}", text))

    return rename


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (shutil.rmtree, "there is no directory"),
        (lambda directory: (directory / "steps.csv").unlink(), "has no steps.csv; name a directory"),
        (lambda directory: (directory / "settings.json").unlink(), "has no settings.json"),
        (lambda directory: (directory / "settings.json").write_text("{"), "settings.json cannot be read"),
        (lambda directory: (directory / "settings.json").write_text("{}"), "holds no settings"),
        (lambda directory: (directory / "steps.csv").write_text(""), "steps.csv cannot be read"),
        (lambda directory: (directory / "steps.csv").write_bytes(bytes(range(256))), "steps.csv cannot be read"),
        (lambda directory: (directory / "provenance.json").write_text("{}"), "provenance.json is no list of runs"),
        (without_column, "has no column model"),
        (with_a_broken_line, "holds an unfinished episode"),
        (renamed("naive", "brief"), "holds model 'brief', not one of naive, turn, tom; if it is of your own, --import"),
        (renamed("switching:0.4", "swerving"), "unknown controller 'swerving'"),
        (renamed("stay_back", "zipper"), "holds scenario 'zipper', not one of stay_back, merger, give_way"),
        (renamed("0.09", "cheap"), "has texts where numbers belong, in column counted_seconds"),
    ],
)
def test_results_that_are_no_results_are_refused_in_one_line(spoil, message, compared, tmp_path, capsys):
    directory = shutil.copytree(compared, tmp_path / "results", ignore=shutil.ignore_patterns("*.html"))
    spoil(directory)
    assert message in failure(capsys, "report", str(directory), "--out", str(tmp_path / "page.html"))
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "page.pdf"], "--out is page.pdf; name an .html file"),
        (["--markdown", "--out", "page.html"], "leave it out with --markdown"),
        (["elsewhere"], "there is no directory elsewhere"),
    ],
)
def test_a_page_that_cannot_be_is_refused_in_one_line(options, message, compared, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert message in failure(capsys, "report", str(compared), *options)
    assert not list(tmp_path.iterdir())


def test_a_directory_named_twice_is_refused(compared, capsys):
    assert "named twice" in failure(capsys, "report", str(compared), str(compared), "--markdown")


def test_results_know_the_settings_of_their_environments(compared):
    config = read_results(compared).config("stay_back")
    assert config == {"semantics": "paper", "solver": "gradient", "human_reward": "learned", "costs": "published"}


def with_settings(compared, directory, **changes):
    """A copy of the comparison with other settings."""
    shutil.copytree(compared, directory, ignore=shutil.ignore_patterns("*.html"))
    settings = json.loads((compared / "settings.json").read_text())
    (directory / "settings.json").write_text(json.dumps(settings | changes))
    return str(directory)


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
    assert main(["report", str(compared), other, "--markdown"]) == 0
    heading, _, *rows = capsys.readouterr().out.splitlines()
    assert heading.endswith("| published |") == comparable
    assert [row.split("|")[-2].strip() for row in rows] == ["-7.73", "2.59"] or not comparable


def test_a_page_of_several_comparisons_has_them_beside_each_other(compared, tmp_path):
    other = with_settings(compared, tmp_path / "other", semantics="released", human_reward="published")
    page = tmp_path / "page.html"
    assert main(["report", str(compared), other, "--no-videos", "--out", str(page)]) == 0
    texts = Page(page.read_text()).texts
    for name in ("paper", "released"):
        assert f"reward per step (90 % interval), {name} semantics" in texts
    assert {"-7.73", "2.59", f"Settings of {compared}", f"Settings of {other}"} <= set(texts)


def test_a_page_shows_collisions_that_were_counted_under_limits(compared, tmp_path):
    counted = tmp_path / "safety"
    counted.mkdir()
    (counted / "settings.json").write_text(json.dumps({"semantics": "paper", "limits": [None, [0.2, 9.0]]}))
    rows = [("stay_back", "turn", 0.2, 50.0, 300, 11, 1.6), ("stay_back", "turn", 0.2, 9.0, 300, 300, -18.0)]
    columns = ["scenario", "controller", "omega", "acceleration", "episodes", "collision_episodes", "reward"]
    pd.DataFrame(rows, columns=columns).to_csv(counted / "safety.csv", index=False)
    page = tmp_path / "page.html"
    assert main(["report", str(counted), str(compared), "--no-videos", "--out", str(page)]) == 0
    texts = Page(page.read_text()).texts
    sentence = "Within 0.2 1/m and 9 m/s², episodes with a collision are in Stay Back 300 of 300 with turn."
    assert any(text.endswith(sentence) for text in texts)
    place = texts.index("0.2 1/m and 50 m/s²")
    row = [text for text in texts[place:] if text][1:]
    assert row[:5] == ["0.2 1/m and 9 m/s²", "Stay Back", "turn", "11 of 300", "300 of 300"]
    assert f"Settings of {counted}" in texts


def test_a_page_begins_with_few_controllers_and_has_a_curve_where_there_are_three_lambdas(compared, html, tmp_path):
    records = pd.read_csv(compared / "steps.csv")
    naive, switching = (records[records["controller"] == name] for name in CONTROLLERS)
    more = [naive.assign(controller=f"schedule:turn={steps},naive") for steps in range(1, 8)]
    more += [switching.assign(controller=f"switching:{price}") for price in (0.1, 5)]
    directory = with_settings(compared, tmp_path / "more")
    pd.concat([records, *more]).to_csv(tmp_path / "more" / "steps.csv", index=False)
    assert main(["report", directory, "--no-videos"]) == 0
    page = Page((tmp_path / "more" / "report.html").read_text())
    first = page.texts[: page.texts.index("8 more controllers")]
    assert {"naive", "switching:0.4", "switching:5"} <= set(first)
    assert "schedule:turn=3,naive" in set(page.texts) - set(first)
    assert [image["alt"].split(".")[0] for image in page.all("img")] == [
        "Stay Back, curve",
        "Stay Back, timeline",
        "Stay Back, decisions",
    ]
    assert "Stay Back, bars" in html
    assert "Stay Back, curve" not in html


def test_people_read_the_title_of_a_scenario_and_no_identifier(html):
    page = Page(html)
    assert "Stay Back" in page.texts
    told = [text for text in page.texts if "ms-highway" not in text]
    told += [
        attributes[name] for _, attributes in page.elements for name in ("alt", "aria-label") if name in attributes
    ]
    assert not any("stay_back" in text for text in told)


def test_a_page_of_a_comparison_that_was_stopped_says_how_many_episodes_are_missing(compared, html, tmp_path, capsys):
    assert "are missing" not in html
    directory = shutil.copytree(compared, tmp_path / "stopped")
    records = pd.read_csv(directory / "steps.csv")
    records[(records["controller"] == "naive") & (records["seed"] == 0)].to_csv(directory / "steps.csv", index=False)
    assert main(["report", str(directory), "--no-videos"]) == 0
    assert "lacks 3 episodes; start the same" in capsys.readouterr().err
    assert "3 of the episodes that were asked for are missing." in Page((directory / "report.html").read_text()).texts
