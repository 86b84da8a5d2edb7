"""Watch over the process: end it on Ctrl-C, and refuse to compute in a fork of it.

**Ctrl-C** ends the command at once, with one sentence, whatever it is doing. Python
itself raises ``KeyboardInterrupt`` in the main thread between two lines of Python: only
after a compilation or a batch has ended. In a callback of JAX or an import, the
exception is lost. Where it arrives, Python shuts down while threads of JAX still
compute: a thread that then needs the interpreter is unwound out of C++ code that does
not allow it, and the process aborts. So a thread waits for the signal and ends the
process. All results are written under temporary names and moved when they are whole, so
that only unwritten results are lost.

**Forks**: in a process that was forked after JAX had begun, JAX would wait for ever. A
hook notes forks from the first import of the package on, without importing JAX.
"""

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn, TypeAlias

INTERRUPTED = 128 + signal.SIGINT
"""Exit status of an interrupted command, by the convention of shells."""


def last_line() -> str:
    """Return the last line of an interrupted command."""
    stopped = "ms-highway: stopped"
    resuming_commands = {"compare", "sweep", "frontier", "record"}
    if resuming_commands.isdisjoint(sys.argv):
        return stopped
    return f"{stopped}; started again in the same way, it resumes"


def watch() -> None:
    """Let interrupts end this process, if it is the command ``ms-highway``.

    Nothing changes if it ignores interrupts.
    """
    handler = signal.getsignal(signal.SIGINT)
    if not is_command() or handler is not signal.default_int_handler:
        return
    # This holds also in threads and processes that start later.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    from threading import Thread

    # Imported for `_end`, which would otherwise wait for imports of the main thread.
    import ms_highway.runtime.files  # noqa: F401

    Thread(target=_wait, daemon=True).start()


def _wait() -> NoReturn:
    """Wait for an interrupt, and then end this process."""
    signal.sigwait({signal.SIGINT})
    _end()


def _end() -> NoReturn:
    """End this process at once from any thread.

    Write a line to standard error, and remove temporary files.
    """
    from ms_highway.runtime.files import remove_temporary

    # In a terminal, a count of episodes may stand in the line.
    line_break = "\n" if sys.stderr.isatty() else ""
    message = f"{line_break}{last_line()}\n"
    with suppress(OSError):
        os.write(sys.stderr.fileno(), message.encode())
    remove_temporary()
    os._exit(INTERRUPTED)


def is_command() -> bool:
    """Return whether this process is the command ``ms-highway``, not a worker of it.

    The command may also be started as ``python -m ms_highway``.
    """
    by_module = sys.argv[0] == "-m" and "ms_highway" in sys.orig_argv
    program, _ = os.path.splitext(os.path.basename(sys.argv[0]))
    by_name = program == "ms-highway"
    is_worker = "--multiprocessing-fork" in sys.orig_argv
    return (by_module or by_name) and not is_worker


# Whether this process was forked from one in which JAX had begun.
_forked = False


def jax_has_begun() -> bool:
    """Return whether JAX has begun to compute, or has looked for devices."""
    # JAX has no public name for this.
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bridge.backends_are_initialized()


def _note_fork() -> None:
    """Note in a forked process whether JAX had begun before."""
    global _forked
    _forked = _forked or jax_has_begun()


os.register_at_fork(after_in_child=_note_fork)


def refuse_after_fork() -> None:
    """Refuse to compute in a process that was forked after JAX had begun.

    Raises:
        RuntimeError: there.
    """
    if _forked:
        remedy = (
            "start it with context='forkserver' or 'spawn', or before JAX begins in the"
            " process that starts it"
        )
        raise RuntimeError(
            "JAX cannot compute in a process forked from one in which it had begun;"
            f" {remedy}"
        )


Progress: TypeAlias = Callable[[str], object]
"""Called with a message when a part of a computation begins."""


def silent(message: str) -> None:
    """Report nothing."""
