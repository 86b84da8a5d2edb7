"""Ctrl-C, at any time."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import python

from ms_highway.runtime.process import INTERRUPTED

SWEEP = "sweep merger --seeds 100000 --part 1024 --devices 1 --out"
ENDED = "ms-highway: stopped; started again in the same way, it resumes", INTERRUPTED
SCRIPT = Path(sys.executable).with_name("ms-highway")


def begin(words):
    """A process of Python that reacts to interrupts, even if this one ignores them."""
    heeded = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return subprocess.Popen(
            [sys.executable, *words.split()], stderr=subprocess.PIPE, text=True
        )
    finally:
        signal.signal(signal.SIGINT, heeded)


def interrupted(process):
    """What a process says last after an interrupt, and its exit status; it is killed if
    it does not end.
    """
    process.send_signal(signal.SIGINT)
    try:
        _, said = process.communicate(timeout=300)
    finally:
        process.kill()
    assert "Traceback" not in said
    return said.splitlines()[-1], process.returncode


def test_an_interrupt_during_imports_ends_a_command_with_one_sentence(tmp_path):
    process = begin(f"{SCRIPT} {SWEEP} {tmp_path}")
    while "numpy" not in Path(f"/proc/{process.pid}/maps").read_text():
        time.sleep(0.01)
    assert interrupted(process) == ENDED


def test_an_interrupt_during_a_batch_ends_the_command_at_once(tmp_path):
    process = begin(f"-m ms_highway {SWEEP} {tmp_path}")
    while not (tmp_path / "provenance.json").exists():
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(0.5)
    assert interrupted(process) == ENDED
    assert {file.name for file in tmp_path.rglob("*")} == {
        "settings.json",
        "provenance.json",
    }  # parts take longer


LONG = """
import signal, threading
from itertools import count

import jax
import numpy as np

from ms_highway.runtime.compilation import GROUP_SIZES, share_among

signal.signal(signal.SIGINT, signal.default_int_handler)

@jax.jit
def long(items):
    return jax.lax.fori_loop(0, 1_000_000, lambda _, x: jax.numpy.sin(x), items)

chunk = GROUP_SIZES.cpu_chunk
items = np.zeros((chunk, 40), np.float32)
main = threading.get_ident()
# Compile first: meanwhile an interrupt may be lost.
share_among(jax.local_devices(), long, items, chunk)
threading.Timer(0.2, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
try:
    all(share_among(jax.local_devices(), long, items, chunk).size for _ in count())
except KeyboardInterrupt:
    names = [thread.name for thread in threading.enumerate()]
    print([name for name in names if name.startswith("ThreadPool")])
"""


@pytest.mark.slow
def test_threads_of_an_interrupted_simulation_are_waited_for():
    """In Python 3.11, threads that an interrupted `Thread.join` waits for count as
    ended, and outlive Python.

    A simulation takes longer than the time until the interrupt, which so comes while a
    thread computes.
    """
    assert python("-c", LONG, timeout=300).stdout == "[]\n"
