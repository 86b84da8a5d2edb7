"""End the command at once at Ctrl-C, with one sentence, whatever it is doing.

Python itself would raise ``KeyboardInterrupt`` in the main thread between two instructions: only after a compilation or
a batch. Within a callback of JAX or an import the exception is lost; elsewhere, Python would shut down while threads of
JAX still compute, and the process would abort.

So a thread waits for the signal and ends the process. All results are written atomically: only what had not been
written is lost.
"""

import os
import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:  # slow imports wait until interrupts are watched
    from socket import socket

__all__ = ["INTERRUPTED", "STOPPED", "end", "watch"]

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of an interrupted command, by the convention of shells."""

STOPPED = "ms-highway: stopped; started again in the same way, compare, sweep, frontier and irl record go on"

FLUSHING = 1.0  # s, at most, as nobody may be reading the output
SHOW_CURSOR = "\x1b[?25h"  # hidden by progress bars


def watch() -> None:
    """Let interrupts end this process, if it is the command ``ms-highway`` and does not ignore them."""
    if not _is_command() or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    signal.signal(signal.SIGINT, _end_early)
    from socket import socketpair
    from threading import Thread

    import ms_highway.runtime.files  # noqa: F401  # `end` needs it, and would wait for imports of the main thread

    watched, told = socketpair()
    told.setblocking(False)
    signal.set_wakeup_fd(told.fileno())
    Thread(target=_wait, args=(watched, told), daemon=True).start()
    signal.signal(signal.SIGINT, lambda *_: None)


def end(told: str, status: int) -> NoReturn:
    """End this process at once, from any thread: print a line on standard error, and remove temporary files."""
    from threading import Thread

    from ms_highway.runtime.files import remove_temporary

    _tell(told)
    if "multiprocessing" in sys.modules:
        for worker in sys.modules["multiprocessing"].active_children():
            worker.terminate()
    flushing = Thread(target=sys.stdout.flush, daemon=True)
    flushing.start()
    flushing.join(FLUSHING)
    remove_temporary()
    os._exit(status)


def _tell(told: str) -> None:
    after_a_bar = f"{SHOW_CURSOR}\n" if sys.stderr.isatty() else ""
    with suppress(OSError):
        os.write(sys.stderr.fileno(), f"{after_a_bar}{told}\n".encode())


def _end_early(signal_number: int, frame: FrameType | None) -> NoReturn:
    """End this process before the thread that waits for interrupts runs, when there is nothing to clean up."""
    _tell(STOPPED)
    os._exit(INTERRUPTED)


def _is_command() -> bool:
    """Return whether this process was started as ``ms-highway`` or ``python -m ms_highway``, not as its worker."""
    by_module = sys.argv[0] == "-m" and "ms_highway" in sys.orig_argv
    by_name = os.path.splitext(os.path.basename(sys.argv[0]))[0] == "ms-highway"
    return (by_module or by_name) and "--multiprocessing-fork" not in sys.orig_argv


def _wait(watched: "socket", told: "socket") -> None:
    """Wait for the signal and end the process; keep ``told`` open until then."""
    with told:
        while signal.SIGINT not in watched.recv(1):
            pass
        end(STOPPED, INTERRUPTED)
