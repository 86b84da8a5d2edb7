"""Files are whole or absent, whatever happens and whoever else writes."""

import resource
from concurrent.futures import ThreadPoolExecutor

import pytest

from ms_highway.runtime.files import FILE_NAMES, file_name, locked, replacing, tidy

SIZE = 20_000  # bytes


def test_a_file_that_does_not_fit_changes_nothing(tmp_path):
    """As on a full disk, the error of the system names no file."""
    file = tmp_path / "summary.csv"
    file.write_text("before")
    usual, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    refused = pytest.raises(
        OSError, match=r"summary\.csv cannot be written: File too large"
    )
    with refused, replacing(file) as path:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, most))
        try:
            path.write_text("x" * SIZE)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (usual, most))
    assert file.read_text() == "before"
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_that_several_write_is_always_whole(tmp_path):
    file = tmp_path / "report.html"

    def write(letter):
        for _ in range(50):
            with replacing(file) as path:
                path.write_text(letter * SIZE)

    with ThreadPoolExecutor(2) as threads:
        writers = [threads.submit(write, letter) for letter in "ab"]
        while not all(writer.done() for writer in writers):
            assert not file.exists() or file.read_text() in ("a" * SIZE, "b" * SIZE)
    assert [writer.exception() for writer in writers] == [None, None]
    assert list(tmp_path.iterdir()) == [file]


def test_one_command_at_a_time_writes_to_a_directory(tmp_path):
    directory = tmp_path / "out"
    (directory / "steps").mkdir(parents=True)
    for name in (
        FILE_NAMES.lock,
        f"steps/.part.{16 * 'a'}.settings.json",
        ".part.notes.txt",
        "download.part",
    ):
        # The file of a killed command locks nothing.
        (directory / name).touch()
    with locked(directory):
        tidy(directory)
        assert not list((directory / "steps").iterdir())
        with (
            pytest.raises(
                ValueError, match=f"another command is writing to {directory}; wait"
            ),
            locked(directory),
        ):
            pass
    with locked(directory), locked(tmp_path / "other"):
        pass
    assert {path.name for path in directory.iterdir()} == {
        "steps",
        ".part.notes.txt",
        "download.part",
    }
    assert not (tmp_path / "other").exists()


NAMES = [
    "",
    ".",
    "..",
    "../../x",
    "/tmp/x",
    "..\\x",
    "C:x",
    "~",
    "-rf",
    "-a",
    "+a",
    "x\0y",
    "x\ny",
    ".part.lock",
    "a b",
    "a:b",
    "a/b",
    "a.b",
    "\udcff",
    "priced:1",
    "learned:1:/path/values.npz",
    "x" * 400,
    "x" * 401,
    "\N{HIRAGANA LETTER A}" * 100,
    "\N{HIRAGANA LETTER A}" * 101,
]


def test_every_name_has_its_own_file_in_the_directory(tmp_path):
    for name in NAMES:
        file = tmp_path / f"{file_name(name)}.solution.xml"
        assert file.resolve().parent == tmp_path
        with replacing(file) as path:
            path.touch()
    assert len(list(tmp_path.iterdir())) == len(NAMES)
    plain = (
        "USA_US101-3_1_T-1",
        "merge-v0_idm_success_5",
        "tom@6+warm",
        "Stra\N{LATIN SMALL LETTER SHARP S}e",
    )
    assert list(map(file_name, plain)) == list(plain)
