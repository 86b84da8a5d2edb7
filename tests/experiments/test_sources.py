"""Results never go stale: what they depend on must not change."""

import shutil
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ms_highway import add_driver
from ms_highway.choice import learned_value
from ms_highway.envs.registry import controller_settings
from ms_highway.experiments.batch import simulate_parts
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import run, run_batched
from ms_highway.experiments.summary import read_results
from ms_highway.loop.controller import HUMAN_DRIVERS
from ms_highway.runtime.definitions import source_now
from ms_highway.runtime.sources import import_modules, imported_sources

DRIVER = """
from pathlib import Path
from braking import BRAKING
import ms_highway
STRENGTH = float(Path("strength.txt").read_text())
ms_highway.add_driver("brakes", lambda game, state: [0.0, -BRAKING * STRENGTH])
"""
FILES = {"my_driver.py": DRIVER, "braking.py": "BRAKING = 1.0", "strength.txt": "2"}
"""A user's module, a module that it imports, and a file that it reads."""

SHIPPED = Path(learned_value.__file__).parents[1] / "data"


LATE = """
from pathlib import Path
import ms_highway
def brakes(game, state):
    from braking import BRAKING
    return [0.0, -BRAKING * float(Path("strength.txt").read_text())]
ms_highway.add_driver("brakes", brakes)
"""
"""The same, but it imports and reads only when it drives."""


@pytest.fixture
def imports(tmp_path, monkeypatch):
    """Return a function that imports the user's module as a new process does."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for name, text in FILES.items():
        Path(name).write_text(text)

    def import_anew():
        for name in ("my_driver", "braking", "made"):
            sys.modules.pop(name, None)
        import_modules(["my_driver"])

    yield import_anew
    import_modules([])
    for name in ("made", "installed_elsewhere"):
        sys.modules.pop(name, None)
    HUMAN_DRIVERS.pop("brakes", None)


def begin(*controllers, out="out"):
    """Begin a comparison in a directory, or go on with it, without driving."""
    next(run(Comparison({"merger": controllers}, seeds=1), out))


def begin_sweep():
    comparison = Comparison({"merger": ["naive"]}, seeds=1)
    next(run_batched(comparison, Path("swept"), compute=simulate_parts))


@pytest.mark.parametrize("changed", FILES)
def test_results_are_refused_after_a_module_or_its_file_changed(changed, imports):
    imports()
    begin("naive", "brakes")
    begin_sweep()
    imports()
    begin("naive", "brakes")
    with Path(changed).open("a") as file:
        file.write(" ")
    imports()
    before = Path("out/settings.json").read_text()
    name = changed.removesuffix(".py")
    reason = f"before {name} changed; choose another"
    with pytest.raises(ValueError, match=f"results of naive in merger .* {reason}"):
        begin("naive", "brakes")
    with pytest.raises(ValueError, match=f"swept holds .* {reason}"):
        begin_sweep()
    assert Path("out/settings.json").read_text() == before
    begin("naive", "brakes", out="elsewhere")


def test_other_results_are_refused_beside_those_of_a_changed_module(imports):
    """Results of other controllers and scenarios stand in one table with them.

    The module may drive their humans.
    """
    imports()
    begin("naive")
    with Path("braking.py").open("a") as file:
        file.write(" ")
    imports()
    refused = r"results of naive in merger .* before braking changed; choose another"
    with pytest.raises(ValueError, match=refused):
        begin("tom")
    with pytest.raises(ValueError, match=refused):
        next(run(Comparison({"give_way": ["naive"]}, seeds=1), "out"))


def test_results_are_refused_after_late_imports_and_files_changed(imports):
    """A driver imports and reads them while it drives."""
    Path("my_driver.py").write_text(LATE)
    imports()
    asked = Comparison({"merger": ["brakes"]}, seeds=1, config={"duration": 0.1})
    list(run(asked, "out"))
    imports()
    assert list(run(asked, "out")) == [1]
    for name in ("braking.py", "strength.txt"):
        text = Path(name).read_text()
        Path(name).write_text(f"{text} ")
        imports()
        reason = f"results that .* before {name} changed"
        with pytest.raises(ValueError, match=f"out holds {reason}; choose another"):
            next(run(asked, "out"))
        with pytest.raises(ValueError, match=f"{reason}; add --no-videos"):
            read_results(Path("out")).refuse_changed("merger", ["brakes"])
        Path(name).unlink()
        with pytest.raises(ValueError, match=rf"before {name} changed"):
            next(run(replace(asked, controllers={"merger": ["naive"]}), "out"))
        Path(name).write_text(text)


def test_imports_are_added_to_results_but_not_taken_away(imports):
    begin("naive")
    imports()
    begin("naive", "brakes")
    import_modules([])
    begin("naive", "turn")
    # As if another module had added it.
    HUMAN_DRIVERS["brakes"] = HUMAN_DRIVERS["never"]
    reason = "computed with my_driver, which is not imported now"
    with pytest.raises(ValueError, match=reason):
        begin("brakes")


def test_results_are_refused_after_a_name_has_got_another_meaning(
    tmp_path, monkeypatch
):
    """A notebook defines a driver again, or two modules add one name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(HUMAN_DRIVERS, "mine", None)

    def brakes(game, state):
        return [0.0, -1.0]

    def stays(game, state):
        return [0.0, 0.0]

    strengths = [1.0]

    def brakes_by(strength, game, state):
        return [0.0, -strength * strengths[0]]

    for function in (brakes, stays, brakes_by):
        function.__module__ = "__main__"
    add_driver("mine", brakes)
    begin("mine", "naive")
    add_driver("mine", brakes)
    begin("mine", "naive")
    add_driver("mine", stays)
    begin("naive")
    reason = "before the definition of mine changed"
    with pytest.raises(ValueError, match=f"results of mine in merger .* {reason}"):
        begin("mine", "naive")

    # The same text with other numbers: of a partial function, and of the function
    # around it.
    for strength, around, directory in ((1.0, 1.0, "partial"), (2.0, 1.0, "around")):
        strengths[0] = around
        add_driver("mine", partial(brakes_by, strength))
        begin("mine", out=directory)
    for strength, around, directory in ((2.0, 1.0, "partial"), (2.0, 3.0, "around")):
        strengths[0] = around
        add_driver("mine", partial(brakes_by, strength))
        with pytest.raises(ValueError, match=reason):
            begin("mine", out=directory)


def test_results_are_refused_after_a_file_of_values_has_changed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(SHIPPED / "values.npz", "mine.npz")
    begin("learned:1:mine.npz", "budget:20:mine.npz")
    begin("learned:1:mine.npz", "budget:20:mine.npz")
    with np.load("mine.npz") as arrays:
        np.savez_compressed("mine.npz", **arrays)
    for name in ("learned:1:mine.npz", "budget:20:mine.npz"):
        with pytest.raises(ValueError, match=r"before mine\.npz changed"):
            begin(name)
    assert controller_settings("agents/mine.zip").files() == ("agents/mine.zip",)


def test_files_beside_a_package_are_sources_of_its_modules(
    imports, tmp_path, monkeypatch
):
    package = Path("own package") / "cars" / "humans"
    package.mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path / "own package")
    (package / "__init__.py").touch()
    (package.parent / "__init__.py").touch()
    read = (
        "from pathlib import Path\nSTRENGTH = (Path(__file__).parents[2] / 'data' /"
        " 'strength').read_text()"
    )
    (package / "calm.py").write_text(read)
    data = package.parents[1] / "data"
    data.mkdir()
    (data / "strength").write_text("1")
    monkeypatch.chdir(package)
    import_modules(["cars.humans.calm"])
    modules = {"cars", "cars.humans", "cars.humans.calm"}
    file = str(Path("..") / ".." / "data" / "strength")
    assert imported_sources().keys() == {*modules, file}


def test_films_are_refused_only_after_sources_of_results_changed(imports):
    imports()
    asked = Comparison(
        {"merger": ["naive"]},
        seeds=1,
        config={"human_driver": "brakes", "duration": 0.2},
    )
    assert [*run(asked, "out")] == [0, 1]
    read_results(Path("out")).refuse_changed("merger", ["naive"])
    Path("strength.txt").write_text("3")
    imports()
    reason = r"of naive in merger .* before strength\.txt changed; add --no-videos"
    with pytest.raises(ValueError, match=reason):
        read_results(Path("out")).refuse_changed("merger", ["naive"])


def test_results_are_read_but_not_filmed_without_their_driver(imports):
    imports()
    asked = Comparison(
        {"merger": ["naive"]},
        seeds=1,
        config={"human_driver": "brakes", "duration": 0.2},
    )
    assert [*run(asked, "out")] == [0, 1]
    HUMAN_DRIVERS.pop("brakes")
    results = read_results(Path("out"))
    assert len(results.records) == 2
    reason = r"merger cannot be filmed .*'human_driver'\] is 'brakes'; .* with --import"
    with pytest.raises(ValueError, match=reason):
        results.refuse_changed("merger", ["naive"])


# They were learned among other humans.
@pytest.mark.filterwarnings("ignore:the values of computation were learned")
def test_a_worker_with_the_same_imports_has_the_same_sources(imports):
    imports()
    shutil.copy(SHIPPED / "values.npz", "learned.npz")
    asked = Comparison(
        {"merger": ["learned:1:learned.npz"]}, config={"human_driver": "brakes"}
    )
    (sources,) = asked.sources()["merger"].values()
    assert sources.keys() == {
        "my_driver",
        "braking",
        "strength.txt",
        "the definition of brakes",
        "learned.npz",
    }
    assert {name: source_now(name) for name in sources} == sources
    assert source_now("the definition of nothing") is None


def test_a_module_imported_before_counts_as_what_was_loaded(imports):
    imports()
    loaded = imported_sources()
    Path("my_driver.py").write_text("")
    import_modules(["my_driver"])
    assert imported_sources() == loaded


def test_modules_of_packages_and_without_files_are_no_sources(imports):
    """Packages are installed, or this one."""
    making = (
        "import sys, types; sys.modules['made'] = made = types.ModuleType('made');"
        " made.__file__ = '_made.py'"
    )
    Path("braking.py").write_text(
        f"import installed_elsewhere; BRAKING = 1.0; {making}"
    )
    # As of an environment that this one builds on.
    elsewhere = Path("other/site-packages").absolute()
    elsewhere.mkdir(parents=True)
    (elsewhere / "installed_elsewhere.py").write_text("")
    sys.path.append(str(elsewhere))
    imports()
    assert imported_sources().keys() == {"my_driver", "braking", "strength.txt"}
