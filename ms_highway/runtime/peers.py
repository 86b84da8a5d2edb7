"""Let processes share a computation: they begin together, and all end if one ends before it is done.

Process 0 listens at a given address, and the others stay connected to it. They exchange single lines; a connection that
breaks shows that the process at its other end has ended. The computation itself needs no connection.
"""

import socket
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from select import select
from threading import Event, Thread
from time import monotonic, sleep
from typing import TypeAlias

from ms_highway.runtime.interrupt import end

PATIENCE = 300  # s, for which processes wait for the next one at the beginning
PAUSE = 0.2  # s, between attempts to connect
GREETING = 5  # s, within which a process that connects must say which one it is
LONGEST = 200  # bytes of a line
SILENCE = 60  # s, after which a connection is tested
BEGIN, DONE = "begin", "done"

Links: TypeAlias = dict[socket.socket, int]
"""Connections, each with the index of the process at its other end."""


@contextmanager
def together(address: str, of: int, place: int, task: str = "") -> Iterator[None]:
    """Run the block once all processes are connected; end this process if another ends meanwhile.

    Process 0, through which the others know of each other, leaves the block when all have said that they are done.

    Args:
        address: ``HOST:PORT`` of process 0, which listens only there.
        of: number of processes.
        place: index of this process, from 0.
        task: what they compute, the same for all: who cannot name it is a stranger, and not counted.

    Raises:
        ValueError: if the address is wrong or in use, or the others do not connect or give another number or task.
    """
    links: Links = {}
    leaving = Event()
    watching = Thread(target=_watch, args=(links, leaving), daemon=True)
    try:
        try:
            _connect(links, address, of, place, task)
        except (ValueError, OSError, OverflowError) as error:
            remedy = "give HOST:PORT, a free port of the machine of process 0"
            raise ValueError(f"--coordinator {address}: {error}; {remedy}") from error
        watching.start()
        yield
        if place == 0:
            watching.join()
        else:
            leaving.set()  # before process 0 hears it, which may close the connection at once
            _say(links, DONE)
    finally:
        leaving.set()
        for link in links:
            with suppress(OSError):  # the other process has closed it
                link.shutdown(socket.SHUT_RDWR)  # wakes `_watch`
        if watching.is_alive():
            watching.join()
        for link in links:
            link.close()


def _connect(links: Links, address: str, of: int, place: int, task: str) -> None:
    name, _, port = address.rpartition(":")
    host = name.strip("[]"), int(port)
    if not host[0]:
        raise ValueError("it names no host")
    if place == 0:
        family = socket.getaddrinfo(*host, type=socket.SOCK_STREAM)[0][0]
        with socket.create_server(host, family=family) as server:
            server.settimeout(PATIENCE)
            while lacking := sorted({*range(1, of)}.difference(links.values())):
                _accept(links, server, {_greeting(each, of, task): each for each in lacking})
        _test_silence(links)
        _say(links, BEGIN)
        return
    for _ in range(round(PATIENCE / PAUSE)):
        with suppress(ConnectionRefusedError):
            links[socket.create_connection(host)] = 0
            break
        sleep(PAUSE)
    else:
        raise OSError(f"process 0 was not there within {PATIENCE} s")
    _test_silence(links)
    (link,) = links
    _say(links, _greeting(place, of, task))
    link.settimeout(of * PATIENCE)  # in which process 0 hears from all, if it is process 0
    heard = _hear(link)
    link.settimeout(None)
    if heard != BEGIN:
        raise OSError(heard or "process 0 has ended or is silent")


def _greeting(place: int, of: int, task: str) -> str:
    return f"{place} {of} {sha256(task.encode()).hexdigest()}"


def _accept(links: Links, server: socket.socket, lacking: dict[str, int]) -> None:
    """Connect process 0 with one that it lacks, or refuse whoever comes."""
    try:
        link, _ = server.accept()
    except TimeoutError:
        names = ", ".join(map(str, lacking.values()))
        raise OSError(f"process {names} did not come within {PATIENCE} s") from None
    greeting, deadline = b"", monotonic() + GREETING  # of all of it: whoever dribbles would hold up the others
    with suppress(OSError):
        while not greeting.endswith(b"\n") and len(greeting) < LONGEST:
            link.settimeout(max(deadline - monotonic(), 0.0))
            greeting += link.recv(LONGEST) or b"\n"
    link.settimeout(GREETING)
    if (said := greeting.decode(errors="replace").strip()) in lacking:
        links[link] = lacking[said]
    else:
        waiting = ", ".join(map(str, lacking.values()))
        _say([link], f"process 0 waits for process {waiting}, of as many, with the same task")
        link.close()


def _test_silence(links: Iterable[socket.socket]) -> None:
    for link in links:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        if hasattr(socket, "TCP_KEEPIDLE"):
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, SILENCE)


def _say(links: Iterable[socket.socket], line: str) -> None:
    for link in links:
        with suppress(OSError):  # a process that has ended is noticed by listening
            link.sendall(f"{line}\n".encode())


def _hear(link: socket.socket) -> str:
    """Return the next line; empty when the connection has broken or its time is up."""
    with suppress(OSError), link.makefile("rb", buffering=0) as lines:
        return lines.readline(LONGEST).decode(errors="replace").strip()
    return ""


def _watch(links: Links, leaving: Event) -> None:
    """End this process if another ends before it is done; process 0, which all are connected to, informs the others."""
    busy = dict(links)
    while busy:
        for link in select(busy, (), ())[0]:
            heard = _hear(link)
            if heard == DONE:
                del busy[link]
            elif leaving.is_set():
                return
            else:
                message = heard or f"process {links[link]} has ended before it was done"
                _say(links.keys() - {link}, message)
                end(f"ms-highway: {message}, and so does this one; start all again in the same way to resume", status=1)
