"""Ctrl-C, at any time."""

import os
import resource
import signal
import subprocess
import sys
import threading
import time
from itertools import count
from pathlib import Path

import pytest

from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.simulated import make_batch, run_episodes
from ms_highway.runtime.interrupt import INTERRUPTED

SWEEP = ["sweep", "merger", "--episodes", "100000", "--part", "1024", "--devices", "1"]


def begin(*command):
    """A process that heeds interrupts, even where this one ignores them."""
    heeded = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, heeded)


def interrupted(process):
    """What a process says after an interrupt, its exit status, and the processor's seconds that it took to end.

    Not the clock's, which depend on what else the machine does.
    """
    ticks = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    before = seconds_of_ended() + sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=300)
    return said.splitlines(), process.returncode, seconds_of_ended() - before


def seconds_of_ended():
    """The processor's seconds of all processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def started(process):
    """Wait until a process of Python's has begun with its program."""
    while not any("numpy" in line for line in Path(f"/proc/{process.pid}/maps").read_text().splitlines()):
        assert process.poll() is None
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("command", "seconds"), [(["-m", "ms_highway"], 0.0), ([str(Path(sys.executable).with_name("ms-highway"))], 0.8)]
)
def test_an_interrupt_while_a_command_imports_what_it_needs_ends_it_with_one_sentence(command, seconds, tmp_path):
    process = begin(sys.executable, *command, *SWEEP, "--out", str(tmp_path / "out"))
    started(process)
    time.sleep(seconds)
    said, status, _ = interrupted(process)
    assert (said[-1], status) == ("ms-highway: stopped; started again in the same way, it resumes", INTERRUPTED)
    assert not any("Traceback" in line for line in said)


def test_an_interrupt_while_a_batch_is_computed_ends_the_command_at_once(tmp_path):
    process = begin(sys.executable, "-m", "ms_highway", *SWEEP, "--out", str(tmp_path))
    while not (tmp_path / "provenance.json").exists():
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(0.5)
    said, status, seconds = interrupted(process)
    assert (said[-1], status) == ("ms-highway: stopped; started again in the same way, it resumes", INTERRUPTED)
    assert seconds < 5  # a part takes longer than that
    assert not list(tmp_path.rglob(".part.*"))


@pytest.mark.slow
def test_threads_of_an_interrupted_simulation_are_waited_for():
    """In Python 3.11, those that `Thread.join` was waiting for count as ended, and outlive Python."""
    batch = make_batch(Comparison({"stay_back": ["naive"]}, seeds=64), "stay_back")
    run_episodes(batch, batch.keys()[:1])  # compiles
    main = threading.get_ident()
    heeded = signal.signal(signal.SIGINT, signal.default_int_handler)  # a process in the background ignores it
    threading.Timer(0.3, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            all(run_episodes(batch, batch.keys()) for _ in count())
    finally:
        signal.signal(signal.SIGINT, heeded)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("ThreadPool")]
