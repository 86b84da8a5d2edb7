"""Processes that share a computation: they begin together, and end together."""

import socket
import subprocess
import sys
import time
from hashlib import sha256
from threading import Thread

import pytest

from ms_highway.runtime.peers import together

WAIT = """
import sys, time
from ms_highway.runtime.peers import together
with together(sys.argv[1], 3, int(sys.argv[2])):
    print("begun", flush=True)
    time.sleep(float(sys.argv[3]))
"""


@pytest.fixture
def address():
    """A free one, on this machine only."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


@pytest.mark.slow
@pytest.mark.parametrize(("killed", "first"), [(0, "600"), (2, "600"), (2, "0")])
def test_when_a_process_dies_the_others_end_with_one_sentence_even_if_process_0_is_done(killed, first, address):
    processes = [
        subprocess.Popen([sys.executable, "-c", WAIT, address, str(place), seconds], stdout=-1, stderr=-1, text=True)
        for place, seconds in enumerate((first, "600", "600"))
    ]
    for process in processes:
        assert process.stdout.readline() == "begun\n"
    time.sleep(0.5)
    processes[killed].kill()
    for place, process in enumerate(processes):
        (_, said), own = process.communicate(timeout=300), place == killed
        assert own or f"process {killed} has ended before it was done" in said
        assert own or (len(said.splitlines()), process.returncode) == (1, 1)


def test_a_stranger_is_not_counted_and_only_the_named_address_listens(address):
    host, port = address.split(":")
    begun = []

    def take_part(place):
        with together(address, 2, place, "a sweep"):
            begun.append(place)

    threads = [Thread(target=take_part, args=(place,)) for place in range(2)]
    threads[0].start()
    another = sha256(b"another sweep").hexdigest().encode()
    for line in (b"hello\n", b"1 2\n", b"1 2 " + another + b"\n", b"\xff" * 200, b"1 3\n"):
        with connected(host, int(port)) as stranger:
            stranger.sendall(line)
            assert "waits for process 1" in stranger.makefile().readline()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", int(port)), 1).close()
    assert not begun
    threads[1].start()
    for thread in threads:
        thread.join(100)
    assert sorted(begun) == [0, 1]


def test_a_process_whose_greeting_comes_in_two_parts_is_counted_and_one_that_dribbles_is_not(address, monkeypatch):
    monkeypatch.setattr("ms_highway.runtime.peers.GREETING", 0.5)
    host, port = address.split(":")

    def take_part():
        with together(address, 2, 0):
            pass

    first = Thread(target=take_part, daemon=True)
    first.start()
    with connected(host, int(port)) as dribbling, connected(host, int(port)) as process:
        for _ in range(4):
            dribbling.sendall(b"1")
            time.sleep(0.1)
        assert "waits for process 1" in dribbling.makefile().readline()
        greeting = b"1 2 " + sha256(b"").hexdigest().encode() + b"\n"
        for part in (greeting[:9], greeting[9:]):
            process.sendall(part)
            time.sleep(0.1)
        lines = process.makefile()
        assert lines.readline() == "begin\n"
        process.sendall(b"done\n")
        first.join(100)


LEAVE_AT_ONCE = """
import socket, sys
from threading import Thread
from ms_highway.runtime.peers import BEGIN, DONE, together

def lead(server):  # as process 0 does, which has nothing else to do
    link, _ = server.accept()
    lines = link.makefile("rw")
    lines.readline()
    print(BEGIN, file=lines, flush=True)
    assert lines.readline().strip() == DONE
    link.shutdown(socket.SHUT_RDWR)

sys.setswitchinterval(1e-6)  # s: threads take turns at any line
for _ in range(300):
    with socket.create_server(("127.0.0.1", 0)) as server:
        leading = Thread(target=lead, args=(server,))
        leading.start()
        with together(f"127.0.0.1:{server.getsockname()[1]}", 2, 1):
            pass
        leading.join()
"""


def test_a_process_that_is_done_is_not_ended_by_process_0_which_leaves_at_once():
    ended = subprocess.run([sys.executable, "-c", LEAVE_AT_ONCE], capture_output=True, text=True, timeout=300)
    assert (ended.returncode, ended.stderr) == (0, "")


def connected(host, port):
    """A connection, as soon as somebody listens."""
    while True:
        try:
            return socket.create_connection((host, port), 10)
        except ConnectionRefusedError:
            time.sleep(0.01)


@pytest.mark.parametrize("wrong", ["{}", "nonsense", ":4000", "[]:4000"])
def test_an_address_that_is_in_use_or_impossible_is_refused(wrong, address):
    host, port = address.split(":")
    refused = pytest.raises(ValueError, match="give HOST:PORT, a free port")
    with socket.create_server((host, int(port))), refused, together(wrong.format(address), 2, 0):
        pass


def test_a_server_that_is_not_process_0_is_not_waited_for_without_end(address, monkeypatch):
    monkeypatch.setattr("ms_highway.runtime.peers.PATIENCE", 0.2)
    host, port = address.split(":")
    refused = pytest.raises(ValueError, match="process 0 has ended or is silent")
    with socket.create_server((host, int(port))), refused, together(address, 2, 1):
        pass
