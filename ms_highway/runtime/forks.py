"""Refuse to compute with JAX in a process that was forked after JAX had begun, where it would wait for ever.

A hook notes forks from the first import of the package on, without importing JAX.
"""

import os
import sys

_forked = False  # whether this process was forked from one in which JAX had begun


def jax_has_begun() -> bool:
    """Return whether JAX has begun to compute in this process, or has looked for devices."""
    bridge = sys.modules.get("jax._src.xla_bridge")  # JAX has no public name for this
    return bridge is not None and bridge.backends_are_initialized()


def _note_fork() -> None:
    global _forked
    _forked = _forked or jax_has_begun()


os.register_at_fork(after_in_child=_note_fork)


def refuse_after_fork() -> None:
    """Refuse to compute in a process that was forked after JAX had begun.

    Raises:
        RuntimeError: there.
    """
    if _forked:
        remedy = "start it with context='forkserver' or 'spawn', or before JAX begins in the process that starts it"
        raise RuntimeError(f"JAX cannot compute in a process forked from one in which it had begun; {remedy}")
