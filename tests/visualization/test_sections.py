"""Pages of other results than comparisons: stock roads, recorded traffic, best orders, evaluations, films."""

import json
from pathlib import Path

import pandas as pd
import pytest
from commands import run
from comparisons import Page

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "notebooks" / "results"
FILM = ROOT / "notebooks" / "figures" / "merger.gif"
PRICED = json.loads((KEPT / "road.json").read_text())["merge-v0"]["priced"]
REGRETS = "controller,kind,scenario,price,reward,counted_seconds,meta_reward,regret,regret_low,regret_high\n"


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Results as commands write them, of the files that are kept with the project."""
    directory = tmp_path_factory.mktemp("found")
    kept = json.loads((KEPT / "settings.json").read_text())["frontier"]
    (directory / "frontier").mkdir()
    for name in ("settings", "provenance"):
        (directory / "frontier" / f"{name}.json").write_text(json.dumps(kept[name]))
    behind = pd.read_csv(KEPT / "regrets.csv").query("run == 'frontier'").drop(columns="run")
    behind.to_csv(directory / "frontier" / "regrets.csv", index=False)
    (directory / "road.json").write_text((KEPT / "road.json").read_text())
    recorded = json.loads((KEPT / "recorded.json").read_text())["problem_replay"]
    (directory / "recorded.json").write_text(json.dumps({"recorded": recorded}))
    return directory


@pytest.fixture(scope="module")
def page(found):
    out = found / "page.html"
    run(f"report {found / 'frontier'} {found / 'road.json'} {found / 'recorded.json'} {FILM} --out {out}")
    assert out.stat().st_size < 3e6
    return Page(out.read_text())


def test_a_page_of_any_results_begins_with_what_was_asked_and_the_answers(page, found):
    said = " ".join(page.texts[: page.texts.index("How does it look?")])
    behind = pd.read_csv(found / "frontier" / "regrets.csv").query("scenario == 'merger' and price == 1")
    row = behind.set_index("controller").loc["learned:1"]
    interval = f"({row['regret_low']:.2f}, {row['regret_high']:.2f})"
    assert f"in Merger learned:1 {row['regret']:.2f} {interval}" in said
    priced = json.loads((found / "recorded.json").read_text())["recorded"]["priced"]
    assert f"priced succeeds in {100 * priced['success']:.0f} % (76, 99) of its episodes of recorded; " in said
    assert f"it collides in {priced['collisions']} of {priced['episodes']} episodes, in" in said
    roads = json.loads((found / "road.json").read_text())
    shared = [drivers for drivers in roads.values() if "idm" in drivers]
    means = [100 * sum(drivers[name]["success"] for drivers in shared) / len(shared) for name in ("idm", "priced")]
    assert f"idm in {means[0]:.0f} % in {len(shared)} of them, where priced does in {means[1]:.0f} %" in said
    assert said.count("Who reaches its goal without a collision") == 2


def test_it_holds_every_table_figure_and_film_and_what_made_them(page, found):
    scenes = json.loads((found / "road.json").read_text())
    assert set(scenes) <= set(page.texts)
    images = page.all("img")
    assert [image["src"].split(";")[0] for image in images] == ["data:image/png"] * 3 + ["data:image/gif"]
    assert all(len(image["alt"]) > 10 for image in images)
    assert any(text.startswith("ms-highway frontier") for text in page.texts)
    assert not page.all("script")
    assert not page.all("link")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("road.json", "{", "cannot be read as JSON"),
        ("road.json", '{"merge-v0": {"priced": {"success": 1}}}', "as figures of drivers"),
        ("road.json", '{"merge-v0": {}}', "holds no driver yet"),
        (
            "road.json",
            json.dumps({"merge-v0": {"priced": PRICED | {"success": 2.0}}}),
            "road.json cannot be read as fig",
        ),
        ("road.json", json.dumps({"merge-v0": {"priced": PRICED | {"jerk": float("nan")}}}), "as figures of drivers"),
        ("road.json", json.dumps({"merge-v0": {"priced": PRICED | {"p99_ms": None}}}), "but p99_ms None"),
        ("film.gif", "GIF", "film.gif cannot be read as a film"),
        ("notes.txt", "none", "notes.txt holds no results; name directories of"),
        ("found/regrets.csv", REGRETS, "it has no rows"),
        ("found/regrets.csv", REGRETS + 2 * "naive,fixed,merger,1,1,1,1,1,,\n", "it has a controller twice"),
        ("found/regrets.csv", "controller,kind\nnaive,fixed\n", "it has no column 'scenario'"),
    ],
)
def test_results_that_cannot_be_read_are_refused_by_name(name, content, message, tmp_path, refused):
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text(content)
    assert message in refused(f"report {file.parent if name.endswith('csv') else file} --out page.html")
