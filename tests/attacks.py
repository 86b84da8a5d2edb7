"""Attack the package with what it should refuse or survive, and count; run by hand, as it takes minutes.

    python tests/attacks.py
    python tests/attacks.py 30 compare merger --seeds 200
    python tests/attacks.py 30 sweep merger --episodes 20000

The first tries damaged configurations, command lines, files and plans, those of the tests and random ones. What is
right is an answer or one `ValueError`, in commands one line and status 2; everything else, warnings too, has failed.
The others interrupt a command at random moments. What is right is one kind of end only: status 130 after one sentence.
In its first 0.06 seconds, before it has come to this package, Python tells of an interrupt itself.
"""

import contextlib
import io
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ms_highway.cli.main import main
from ms_highway.control.fixed import FixedModel
from ms_highway.envs import ENVIRONMENTS, SCENARIOS, is_crowd
from ms_highway.envs.crowd.settings import CrowdEnvSettings
from ms_highway.envs.settings import Settings, merged
from ms_highway.experiments.resuming import check_settings
from ms_highway.experiments.settings import read_settings
from ms_highway.game.scenario import draw_starts
from ms_highway.irl.recordings.commonroad import read_directory
from ms_highway.planning.human_models import Naive

sys.path += [str(folder) for folder in Path(__file__).parent.iterdir()]
import test_commands
import test_commonroad
import test_environments
import test_wild_starts
from test_limits import GRIP, Reckless

LATEST = 30.0  # s
PATIENCE = 60.0  # s
HOSTILE = [None, True, -1, 0, 1e308, 10**400, float("nan"), float("inf"), "", "x" * 10**5, b"x", [], {}, [[]], object()]
HOSTILE += [np.array([]), np.array(np.nan), {"type": None}, {"type": "fixed"}, {1: 2}, [1e308, 1e308], [0.2, 1e-320]]
FILES, STATES = 400, 1000
Try = Callable[[], object]


def listed(test: Callable[..., None]) -> list:
    """What a test is tried with."""
    return test.pytestmark[0].args[1]


def configurations() -> Iterator[Try]:
    """Those of the tests, and hostile values under every key of every environment."""
    for config, _ in listed(test_environments.test_a_wrong_configuration_is_refused_with_the_remedy):
        yield lambda config=config: refused(lambda: test_environments.make("merger", **config))
    for name, environment in ENVIRONMENTS.items():
        kind = CrowdEnvSettings if is_crowd(name) else Settings
        for key in environment.default_config():
            for value in HOSTILE:
                yield lambda e=environment, k=kind, c={key: value}: survived(
                    lambda: k.read(e.checked_config(c)).game(e.scenario)
                )


def command_lines() -> Iterator[Try]:
    """Those of the tests, and words left out of them or put in."""
    shuffled = random.Random(0)
    lines = [line for line, _ in listed(test_commands.test_a_wrong_command_says_so_in_one_line_and_writes_nothing)]
    for line in lines:
        yield lambda line=line: one_line(line)
        place = shuffled.randrange(1, len(line))
        for word in ("--grip=nan", "--grip=1e308", "--control-limit=0,1e999", "--nonsense", ""):
            yield lambda line=[*line[:place], word, *line[place:]]: one_line(line)


def files() -> Iterator[Try]:
    """Recordings and settings, cut off, with bytes changed, and with pieces doubled."""
    shuffled = random.Random(0)
    readers = {
        "one.xml": (test_commonroad.scenario().encode(), read_directory),
        "settings.json": (json.dumps({"semantics": "paper", "costs": "published"}).encode(), settings_of),
    }
    for number in range(FILES):
        name, (whole, read) = list(readers.items())[number % 2]
        first, second = sorted(shuffled.randrange(len(whole)) for _ in range(2))
        noise = shuffled.randbytes(shuffled.randrange(1, 9))
        damaged = [whole[:first], whole[:first] + noise + whole[first + 1 :], whole[:second] + whole[first:]][
            number % 3
        ]
        yield lambda n=name, d=damaged, r=read: survived(lambda: with_file(n, d, r))


def plans() -> Iterator[Try]:
    """Finite states of all magnitudes, for a model of the package's and for one that plans beyond all limits."""
    game = Settings.read(merged(ENVIRONMENTS["merger"].default_config(), {"grip": GRIP})).game(SCENARIOS["merger"])
    start, chance = draw_starts(SCENARIOS["merger"], np.random.default_rng(0)), np.random.default_rng(1)
    controllers = [FixedModel(game, model) for model in (Naive(), Reckless())]
    limit = np.asarray(game.planner.control_limit)
    for states in test_wild_starts.absurd_states(STATES, len(start), 38):
        wild = np.where(chance.random(states.shape) < 0.3, states, start)
        for controller in controllers:
            yield lambda c=controller, s=wild: within(limit, c, s)


def refused(attempt: Try) -> None:
    try:
        attempt()
    except ValueError:
        return
    raise AssertionError("not refused")


def survived(attempt: Try) -> None:
    with contextlib.suppress(ValueError):
        attempt()


def one_line(line: list[str]) -> None:
    said = io.StringIO()
    with tempfile.TemporaryDirectory() as empty, contextlib.chdir(empty), contextlib.redirect_stderr(said):
        try:
            status = main(line)
        except SystemExit as end:  # argparse, which tells the usage first
            if end.code == 2:
                return
            raise
        assert not list(Path(empty).iterdir()), "has written something"
    assert status == 2, f"status {status}"
    assert len(said.getvalue().strip().splitlines()) == 1, said.getvalue()


def with_file(name: str, content: bytes, read: Callable[[Path], object]) -> None:
    with tempfile.TemporaryDirectory() as directory:
        Path(directory, name).write_bytes(content)
        read(Path(directory))


def settings_of(directory: Path) -> None:
    check_settings(directory, read_settings(directory / "settings.json"))


def within(limit: np.ndarray, controller: FixedModel, states: np.ndarray) -> None:
    controller.reset()
    step = controller.step(states)
    assert np.isfinite(step.plan).all(), step.plan
    friction = 0.2 * abs(states[0, 3])  # from 40 m/s on, it alone leaves the friction circle, and is made up for
    assert (abs(step.control) <= np.maximum(limit, [0, friction]) * 1.0001).all(), step.control


def count(kind: Callable[[], Iterator[Try]]) -> bool:
    """Try all of a kind, tell how many have failed, and the first of each way of failing."""
    start, failures, tried = time.monotonic(), Counter[str](), 0
    for attempt in kind():
        tried += 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                attempt()
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            failures[f"{type(error).__name__}: {error}"[:150]] += 1
    name, seconds = kind.__name__.replace("_", " "), time.monotonic() - start
    print(f"{name:16} {tried:6} tried {failures.total():6} failed {seconds:6.0f} s", flush=True)
    for failure, times in failures.most_common(10):
        print(f"    {times} times {failure}")
    return not failures


def interrupt(arguments: list[str], seconds: float) -> str:
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
    if len(sys.argv) == 1:
        survived_all = [count(kind) for kind in (configurations, files, command_lines, plans)]
        sys.exit(not all(survived_all))
    signal.signal(signal.SIGINT, signal.default_int_handler)  # or else the commands would ignore it where this does
    moments = random.Random(0)
    ends = Counter(interrupt(sys.argv[2:], moments.uniform(0.05, LATEST)) for _ in range(int(sys.argv[1])))
    print(dict(ends))
