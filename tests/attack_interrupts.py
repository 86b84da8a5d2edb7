"""Interrupt a command at random moments and count how it ends; run by hand, as it takes minutes.

    python tests/attack_interrupts.py 30 compare merger --seeds 200
    python tests/attack_interrupts.py 30 sweep merger --episodes 20000

What is right is one kind of end only: status 130 after one sentence. In its first 0.06 seconds, before it has come to
this package, Python tells of an interrupt itself.
"""

import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter

LATEST = 30.0  # s
PATIENCE = 60.0  # s


def attack(arguments: list[str], seconds: float) -> str:
    """Begin a command, interrupt it after some seconds, and tell how it ended."""
    with tempfile.TemporaryDirectory() as directory, tempfile.TemporaryFile("w+") as said:
        command = [sys.executable, "-m", "ms_highway", *arguments, "--out", f"{directory}/out"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said)
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        start = time.monotonic()
        try:
            status = str(process.wait(PATIENCE))
        except subprocess.TimeoutExpired:
            process.kill()
            status = "swallowed"
        said.seek(0)
        text = said.read()
        kinds = ("Traceback", "terminate called", "Fatal", "ms-highway: stopped")
        kind = next((kind for kind in kinds if kind in text), "silent")
        print(f"after {seconds:.2f} s: {status}, {kind}, {time.monotonic() - start:.1f} s later", flush=True)
        return f"{status}, {kind}"


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # or else the commands would ignore it where this does
    moments = random.Random(0)
    ends = Counter(attack(sys.argv[2:], moments.uniform(0.05, LATEST)) for _ in range(int(sys.argv[1])))
    print(dict(ends))
