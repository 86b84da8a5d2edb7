"""Let processes share a computation: they begin together, and all end if one ends before it is done.

Process 0 listens at a given address, and the others stay connected to it. They exchange single lines; a connection that
breaks shows that the process at its other end has ended. The computation itself needs no connection.
"""

import socket
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from threading import Event, Thread
from time import monotonic, sleep

from ms_highway.runtime.interrupt import end

__all__ = ["together"]

PATIENCE = 300.0  # s, that processes wait for each other at the beginning
PAUSE = 0.2  # s, between attempts to connect
GREETING = 5.0  # s, within which a process that connects must say which one it is
SILENCE = 60  # s, after which a connection is tested
BEGIN, DONE = "begin", "done"


class _Link:
    """A connection, line by line."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        if hasattr(socket, "TCP_KEEPIDLE"):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, SILENCE)
        self.connection = connection
        self._lines = connection.makefile("rb", buffering=0)

    def say(self, line: str) -> None:
        with suppress(OSError):  # a process that has ended is noticed by listening
            self.connection.sendall(f"{line}\n".encode())

    def hear(self, seconds: float | None = None) -> str:
        """Return the next line; empty when the connection has broken, or after this many seconds."""
        self.connection.settimeout(seconds)
        try:
            return self._lines.readline(200).decode(errors="replace").strip()
        except OSError:
            return ""

    def close(self) -> None:
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)
        self.connection.close()


@contextmanager
def together(address: str, of: int, place: int) -> Iterator[None]:
    """Begin the block when all processes are there; while it runs, this process ends if one of them does.

    Args:
        address: ``HOST:PORT`` of process 0, which listens there and nowhere else.
        of: how many processes there are.
        place: which of them this is, from 0.

    Raises:
        ValueError: if there is no such address, it is in use, or the others do not come, or count differently.
    """
    with ExitStack() as closing:
        try:
            host, port = _parts(address)
            links = _gather(host, port, of, closing) if place == 0 else _reach(host, port, of, place, closing)
        except (ValueError, OSError, OverflowError) as error:
            remedy = "give HOST:PORT, a free port of the machine of process 0"
            raise ValueError(f"--coordinator {address}: {error}; {remedy}") from error
        leaving = Event()
        for other in links:
            Thread(target=_watch, args=(other, links, leaving), daemon=True).start()
        try:
            yield
            for link in links.values():
                link.say(DONE)
        finally:
            leaving.set()


def _parts(address: str) -> tuple[str, int]:
    host, _, port = address.rpartition(":")
    if not host.strip("[]"):
        raise ValueError("it names no host")
    return host.strip("[]"), int(port)


def _gather(host: str, port: int, of: int, closing: ExitStack) -> dict[int, _Link]:
    """Connections with all other processes, by their places."""
    links: dict[int, _Link] = {}
    family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
    with socket.create_server((host, port), family=family) as server:
        end_of_patience = monotonic() + PATIENCE
        while len(links) < of - 1:
            server.settimeout(max(end_of_patience - monotonic(), PAUSE))
            try:
                link = _Link(server.accept()[0])
            except TimeoutError:
                lacking = [str(place) for place in range(1, of) if place not in links]
                raise OSError(f"process {', '.join(lacking)} did not come within {PATIENCE:g} s") from None
            closing.callback(link.close)
            greeting = link.hear(GREETING).split()
            if len(greeting) != 2 or not all(word.isdecimal() for word in greeting):
                link.close()  # somebody else
                continue
            place, counted = map(int, greeting)
            if counted != of or place in links or not 0 < place < of:
                link.say(f"process 0 counts {of} processes, and knows of {sorted([0, *links])}")
                link.close()
                continue
            links[place] = link
    for link in links.values():
        link.say(BEGIN)
    return links


def _reach(host: str, port: int, of: int, place: int, closing: ExitStack) -> dict[int, _Link]:
    """Return the connection with process 0."""
    end_of_patience = monotonic() + PATIENCE
    while True:
        try:
            link = _Link(socket.create_connection((host, port), PATIENCE))
            break
        except ConnectionRefusedError:
            if monotonic() > end_of_patience:
                raise
            sleep(PAUSE)
    closing.callback(link.close)
    link.say(f"{place} {of}")
    heard = link.hear(PATIENCE)
    if heard != BEGIN:
        raise OSError(heard or "process 0 has ended")
    return {0: link}


def _watch(other: int, links: Mapping[int, _Link], leaving: Event) -> None:
    """End this process if another ends before it is done; process 0, which all are connected to, informs the others."""
    heard = links[other].hear()
    if heard == DONE or leaving.is_set():
        return
    message = heard or f"process {other} has ended before it was done"
    for place, link in links.items():
        if place != other:
            link.say(message)
    end(f"ms-highway: {message}, and so does this one; start all again in the same way to resume", status=1)
