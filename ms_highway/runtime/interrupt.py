"""End the command at once on Ctrl-C, with one sentence, whatever it is doing.

Python itself raises ``KeyboardInterrupt`` in the main thread between two lines of Python: only after a compilation or a
batch has ended. In a callback of JAX or an import, the exception is lost. Where it arrives, Python shuts down while
threads of JAX still compute: a thread that then needs the interpreter is unwound out of C++ code that does not allow
it, and the process aborts.

So a thread waits for the signal and ends the process. All results are written under temporary names and moved when they
are whole, so that only unwritten results are lost.
"""

import os
import signal
import sys
from contextlib import suppress
from typing import NoReturn

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of an interrupted command, by the convention of shells."""

RESUMES = ("compare", "sweep", "frontier", "record")
STOPPED = "ms-highway: stopped" + ("; started again in the same way, it resumes" if {*RESUMES} & {*sys.argv} else "")
"""Last line of an interrupted command."""


def watch() -> None:
    """Let interrupts end this process, if it is the command ``ms-highway`` and does not ignore them."""
    if not is_command() or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # also in threads and processes that start later
    from threading import Thread

    import ms_highway.runtime.files  # noqa: F401  # for `_end`, which would wait for imports of the main thread

    Thread(target=_wait, daemon=True).start()


def _wait() -> NoReturn:
    signal.sigwait({signal.SIGINT})
    _end()


def _end() -> NoReturn:
    """End this process at once from any thread: write a line to standard error, and remove temporary files."""
    from ms_highway.runtime.files import remove_temporary

    after_a_count = "\n" if sys.stderr.isatty() else ""
    with suppress(OSError):
        os.write(sys.stderr.fileno(), f"{after_a_count}{STOPPED}\n".encode())
    remove_temporary()
    os._exit(INTERRUPTED)


def is_command() -> bool:
    """Return whether this process was started as ``ms-highway`` or ``python -m ms_highway``, not as a worker of it."""
    by_module = sys.argv[0] == "-m" and "ms_highway" in sys.orig_argv
    by_name = os.path.splitext(os.path.basename(sys.argv[0]))[0] == "ms-highway"
    return (by_module or by_name) and "--multiprocessing-fork" not in sys.orig_argv
