"""The page that is made of a comparison."""

import json
import shutil
import subprocess
from base64 import b64decode
from importlib.metadata import version

import imageio.v3 as imageio
import numpy as np
import pandas as pd
import pytest
from commands import run
from comparisons import CONTROLLERS, Page, with_settings

from ms_highway.experiments.results import read_results
from ms_highway.visualization.comparison import bars
from ms_highway.visualization.video import film

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


@pytest.fixture(scope="module")
def html(compared):
    run(f"report {compared}")
    return (compared / "report.html").read_text()


def content(source, kind):
    assert source.startswith(f"data:{kind};base64,")
    return b64decode(source.partition(",")[2])


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
    shown = subprocess.run(
        [browser, *options, "--window-size=600,900", "--timeout=5000", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    seen = json.loads(shown.stdout.partition("<title>seen ")[2].partition("</title>")[0])
    assert seen == {"images": [1600] * 3, "films": [[960, 3.5]], "below": True, "fits": True, "loaded": []}
    assert "CONSOLE" not in shown.stderr


def test_without_videos_the_page_is_small_and_goes_where_it_is_told(compared, tmp_path):
    out = tmp_path / "pages" / "small.html"
    run(f"report {compared} --no-videos --out {out}")
    page = Page(out.read_text())
    assert not page.all("video")
    assert len(page.all("img")) == 3
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_what_names_say_is_text_and_no_markup(compared, tmp_path):
    shutil.copytree(compared, tmp_path, dirs_exist_ok=True)
    runs = json.loads((compared / "provenance.json").read_text())
    (tmp_path / "provenance.json").write_text(json.dumps([runs[0] | {"command": "<script>alert(1)</script>"}]))
    run(f"report {tmp_path} --no-videos")
    page = Page((tmp_path / "report.html").read_text())
    assert not page.all("script")
    assert "<script>alert(1)</script>" in page.texts


def test_the_bar_of_a_dear_model_that_decides_nothing_leaves_room_for_the_legend(compared):
    summaries = read_results(compared).summaries
    summaries.loc[summaries["controller"] == "naive", "planning_ms"] = 10.0
    _, right = bars(summaries, "stay_back").axes
    assert right.get_ylim()[0] == 0
    assert right.get_ylim()[1] >= 12


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--out page.pdf", "--out is page.pdf; name an .html file"),
        ("--markdown --out page.html", "leave out --out"),
        ("elsewhere", "there is no elsewhere; name directories of"),
    ],
)
def test_a_page_that_cannot_be_is_refused_in_one_line(options, message, compared, refused):
    assert message in refused(f"report {compared} {options}")


def test_a_page_begins_with_few_controllers_and_has_a_curve_where_there_are_three_lambdas(compared, html, tmp_path):
    records = pd.read_csv(compared / "steps.csv")
    naive, switching = (records[records["controller"] == name] for name in CONTROLLERS)
    more = [naive.assign(controller=f"schedule:turn={steps},naive") for steps in range(1, 8)]
    more += [switching.assign(controller=f"switching:{price}") for price in (0.1, 5)]
    directory = with_settings(compared, tmp_path / "more")
    pd.concat([records, *more]).to_csv(directory / "steps.csv", index=False)
    run(f"report {directory} --no-videos")
    page = Page((directory / "report.html").read_text())
    first = page.texts[: page.texts.index("8 more controllers")]
    assert {"naive", "switching:0.4", "switching:5"} <= set(first)
    assert "schedule:turn=3,naive" in set(page.texts) - set(first)
    figures = [image["alt"].split(".")[0] for image in page.all("img")]
    assert figures == [f"Stay Back, {name}" for name in ("curve", "timeline", "decisions")]
    assert "Stay Back, bars" in html
    assert "Stay Back, curve" not in html


def test_people_read_the_title_of_a_scenario_and_no_identifier(html):
    page = Page(html)
    assert "Stay Back" in page.texts
    labels = [attributes.get(name, "") for _, attributes in page.elements for name in ("alt", "aria-label")]
    assert not any("stay_back" in text and "ms-highway" not in text for text in [*page.texts, *labels])


def test_a_page_of_a_comparison_that_was_stopped_says_how_many_episodes_are_missing(compared, html, tmp_path, capsys):
    assert "are missing" not in html
    directory = shutil.copytree(compared, tmp_path / "stopped")
    records = pd.read_csv(directory / "steps.csv")
    records[(records["controller"] == "naive") & (records["seed"] == 0)].to_csv(directory / "steps.csv", index=False)
    run(f"report {directory} --no-videos")
    assert "lacks 3 episodes; start the same" in capsys.readouterr().err
    assert "3 of the requested episodes are missing." in Page((directory / "report.html").read_text()).texts
