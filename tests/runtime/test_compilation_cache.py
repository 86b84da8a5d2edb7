"""Compiled functions that are kept: where, and what is taken from there."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.cli.main import main
from ms_highway.runtime.jax_settings import keep_compilations


@pytest.fixture
def kept(tmp_path):
    """A directory that keeps everything."""
    directory = keep_compilations(tmp_path / "kept")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return directory


def computed():
    """Two like computations and one of another form, compiled or fetched from where they are kept."""
    jax.clear_caches()
    x = jnp.arange(4.0)
    results = jax.jit(lambda x: x + 1)(x), jax.jit(lambda x: x * 3)(x), jax.jit(lambda x, y: (x - y, y))(x, 2 * x)
    return jax.tree.map(np.asarray, results)


def test_compiled_functions_that_have_changed_places_are_compiled_anew(kept):
    expected = computed()
    files = sorted(kept.iterdir())
    contents = [file.read_bytes() for file in files]
    assert len(files) >= 3
    for file, content in zip(files, contents[1:] + contents[:1], strict=True):
        file.write_bytes(content)
    jax.tree.map(np.testing.assert_array_equal, computed(), expected)
    assert sorted(kept.iterdir()) == files
    mended = [file.read_bytes() for file in files]
    assert all(one != other for one, other in zip(mended, contents[1:] + contents[:1], strict=True))
    jax.tree.map(np.testing.assert_array_equal, computed(), expected)


@pytest.mark.parametrize("damage", [lambda content: content[: len(content) // 2], lambda content: b""])
def test_damaged_compiled_functions_are_compiled_anew(kept, damage):
    expected = computed()
    for file in kept.iterdir():
        file.write_bytes(damage(file.read_bytes()))
    jax.tree.map(np.testing.assert_array_equal, computed(), expected)
    assert all(len(file.read_bytes()) > 100 for file in kept.iterdir())


def test_compiled_functions_are_used_again(kept):
    computed()
    before = {file: file.stat().st_mtime_ns for file in kept.iterdir()}
    computed()
    assert {file: file.stat().st_mtime_ns for file in kept.iterdir()} == before


def test_a_directory_that_others_may_write_to_is_refused(tmp_path):
    tmp_path.chmod(0o770)
    with pytest.raises(PermissionError, match=f"chmod go-w {tmp_path}"):
        keep_compilations(tmp_path)
    assert jax.config.jax_compilation_cache_dir is None


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root gives directories away")
def test_a_directory_of_somebody_else_is_refused(tmp_path):
    os.chown(tmp_path, 12345, 12345)
    with pytest.raises(PermissionError, match="belongs to somebody else"):
        keep_compilations(tmp_path)


def test_a_command_goes_on_without_a_directory_that_others_may_write_to(tmp_path, monkeypatch, capsys):
    tmp_path.chmod(0o777)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    assert main(["bench", "roundabout"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert "compiled planners are not kept: others may write to" in said[0]
    assert "roundabout" in said[1]
    assert not list(tmp_path.iterdir())


def test_compilations_are_kept_where_the_environment_says(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert keep_compilations() == Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    assert keep_compilations() == tmp_path / "cache" / "ms_highway" / "compiled"
    assert keep_compilations(tmp_path / "own") == tmp_path / "own"
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")  # which the standard has ignored
    assert keep_compilations() == tmp_path / "home" / ".cache" / "ms_highway" / "compiled"
