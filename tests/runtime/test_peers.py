"""Processes that share a sweep: they begin together, and end together."""

import signal
import socket
import subprocess
import sys
import time
from threading import Thread

import pytest

from ms_highway.runtime.peers import together

SWEEP = ["sweep", "merger", "--episodes", "100000", "--part", "1024", "--devices", "1"]
ENDED = 1


@pytest.fixture
def address():
    """A free one, on this machine only."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def begin(address, of, place, out):
    several = ["--coordinator", address, "--processes", str(of), "--process", str(place), "--out", str(out)]
    command = [sys.executable, "-m", "ms_highway", *SWEEP, *several]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 2])
def test_when_a_process_of_a_sweep_dies_the_others_end_with_one_sentence(killed, address, tmp_path):
    processes = [begin(address, 3, place, tmp_path) for place in range(3)]
    while not (tmp_path / "settings.json").exists():
        assert all(process.poll() is None for process in processes)
        time.sleep(0.05)
    time.sleep(0.5)
    processes[killed].send_signal(signal.SIGKILL)
    for place, process in enumerate(processes):
        said = process.communicate(timeout=300)[1].splitlines()
        if place != killed:
            (sentence,) = [line for line in said if "episodes" not in line]  # the bar
            assert f"process {killed} has ended" in sentence
            assert "start" in sentence
            assert process.returncode == ENDED


WAIT = """
import sys, time
from ms_highway.runtime.peers import together
with together(sys.argv[1], 3, int(sys.argv[2])):
    print("begun", flush=True)
    time.sleep(float(sys.argv[3]))
"""


def test_when_process_0_is_done_first_it_stays_to_tell_the_others_that_one_died(address):
    processes = [
        subprocess.Popen([sys.executable, "-c", WAIT, address, str(place), seconds], stdout=-1, stderr=-1, text=True)
        for place, seconds in enumerate(("0", "600", "600"))
    ]
    for process in processes:
        assert process.stdout.readline() == "begun\n"
    time.sleep(0.5)
    processes[2].kill()
    for process in processes[:2]:
        assert "process 2 has ended before it was done" in process.communicate(timeout=300)[1]
        assert process.returncode == ENDED
    processes[2].communicate()


def test_whoever_is_nobodys_process_is_not_counted_and_only_the_named_address_listens(address):
    host, port = address.split(":")
    begun = []

    def take_part(place):
        with together(address, 2, place):
            begun.append(place)

    threads = [Thread(target=take_part, args=(0,))]
    threads[0].start()
    for line in (b"hello\n", b"1 3\n", b"7 2\n"):
        with connected(host, int(port)) as stranger:
            stranger.sendall(line)
            answer = stranger.makefile().readline()
            assert ("counts 2 processes" in answer) == line[:1].isdigit()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", int(port)), 1).close()
    assert not begun
    threads.append(Thread(target=take_part, args=(1,)))
    threads[1].start()
    for thread in threads:
        thread.join(100)
    assert sorted(begun) == [0, 1]


def connected(host, port):
    """A connection, as soon as somebody listens."""
    while True:
        try:
            return socket.create_connection((host, port), 10)
        except ConnectionRefusedError:
            time.sleep(0.01)


def test_a_port_that_is_in_use_is_refused(address):
    host, port = address.split(":")
    taken = socket.create_server((host, int(port)))
    with taken, pytest.raises(ValueError, match="give HOST:PORT, a free port"), together(address, 2, 0):
        pass
