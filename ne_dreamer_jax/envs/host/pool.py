"""The main process's side: worker processes, what is asked of them, and what becomes of those that fail."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any, Literal, NamedTuple

import numpy as np

from ne_dreamer_jax.envs.host.players import Player, Seen
from ne_dreamer_jax.envs.host.spaces import Described
from ne_dreamer_jax.envs.host.worker import BEGIN, NOTHING, STEP, Failed, Make, Seed, Step, another_seed
from ne_dreamer_jax.system import processors

START_SECONDS = 600.0
"""What a worker may take to load its libraries and make its environments."""
FAILURES = 5
"""Of an environment, without an episode that ended or `STEPS` steps in between, after which it is given up."""
STEPS = 1_000
STARTS = 3
"""Attempts to start a worker anew."""
VARIABLE = "NE_DREAMER_WORKER"
"""Environment variable of workers that holds their number in their pool, from 0."""
_MAIN = "from ne_dreamer_jax.envs.host.worker import main; main()"
_LINES = 20
"""At most so many are kept of what happens in a chunk."""


class HostEnvError(RuntimeError):
    """An environment can't be made, or fails again and again."""


class Workers(NamedTuple):
    """How environments are spread over processes, and what their failures lead to."""

    processes: int | None = None
    """At most one an environment; None: as many as this process has processors."""
    step_seconds: float = 60.0
    """What a step or the beginning of an episode may take. A worker whose environments, one after another, have taken
    more than that each counts as hung."""
    on_failure: Literal["restart", "stop"] = "restart"
    """Whether training goes on with a new worker or environment, or is saved and stopped."""


class Lost(NamedTuple):
    """The answer in place of an environment whose worker is gone or failed: its episode is cut where it was."""

    why: str


class Kind(NamedTuple):
    """Environments of one kind."""

    factory: bytes  # of players, as cloudpickle stores it
    draws: bool  # whether pictures of them are drawn


class Worker:
    """One process with some environments."""

    def __init__(self, kind: Kind, count: int, number: int, tries: bool) -> None:
        """Starts it, and asks for its environments, of which the first ``tries`` to begin an episode."""
        self.number, self.count = number, count
        ours, theirs = socket.socketpair()
        command = [sys.executable, "-c", _MAIN, str(theirs.fileno())]
        # A session of its own: Ctrl-C in a terminal reaches the main process alone, which then ends the workers.
        self.process = subprocess.Popen(
            command,
            pass_fds=[theirs.fileno()],
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path),
                VARIABLE: str(number),
            },
        )
        theirs.close()
        self.connection = Connection(ours.detach())
        self.send(Make(_Pickled(kind.factory), count, kind.draws, tries))

    def send(self, message: Any) -> None:
        """Sends, or leaves it to `receive` to find that nobody is there."""
        with contextlib.suppress(OSError):
            self.connection.send(message)

    def receive(self, seconds: float, deadline: float | None = None) -> Any:
        """The answer to the last question, or `Lost` where there is none in time.

        Args:
          seconds: what an answer may take.
          deadline: of the monotonic clock, where the question was asked a while ago.
        """
        try:
            if self.connection.poll(seconds if deadline is None else max(0.0, deadline - time.monotonic())):
                return self.connection.recv()
            return Lost(f"worker {self.number} did not answer for {seconds:g} s")
        except (EOFError, OSError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(5.0)
            return Lost(f"worker {self.number} {_ended(self.process.returncode)}")

    def close(self, seconds: float = 5.0) -> None:
        """Asks it to end, and ends it where it does not."""
        self.connection.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(seconds)
        with contextlib.suppress(ProcessLookupError):  # what it started is in its group, and may outlive it
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


class _Pickled:
    """A factory that is unpickled where it is called, so that what it needs loads in the worker."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def __call__(self) -> Player:
        import cloudpickle

        return cloudpickle.loads(self._content)()


class Pool:
    """N environments in worker processes, stepped together."""

    def __init__(
        self, kind: Kind, n: int, workers: Workers, report: Callable[[str], None], tries: bool = False
    ) -> None:
        """Starts the workers.

        Args:
          report: takes a line on each failure.
          tries: whether an environment has to begin an episode first.

        Raises:
          HostEnvError: an environment can't be made.
        """
        self.n, self._kind, self._options, self._report = n, kind, workers, report
        count = min(n, workers.processes or processors.available())
        bounds = np.linspace(0, n, count + 1).astype(int)
        self._shares = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
        self._failures = np.zeros(n, int)
        self._steps = np.zeros(n, int)  # since the last failure
        self._faults = np.zeros(n, int)  # episodes in a row that began with a number that was not finite
        self._gone = np.zeros(n, bool)  # what became of the episode with its worker, and is still to be told
        self._restarts = np.zeros(n, int)
        self._seeds = np.zeros(n, np.uint64)
        self.started: int | None = None
        """The number of the step that workers were last asked for."""
        self._asked = False  # whether they have not been heard since
        self._workers = [self._start(i, tries) for i in range(count)]
        for i in range(count):
            self.described = self._ready(i, attempts=1)

    def seed(self, seeds: Sequence[int]) -> None:
        """Seeds the next beginnings of all environments."""
        self._seeds = np.array([seed % 2**63 for seed in seeds], np.uint64)
        self._restarts[:] = 0
        for worker, share in zip(self._workers, self._shares, strict=True):
            worker.send(Seed([another_seed(int(seed), 0) for seed in self._seeds[share]]))

    def start(self, number: int, actions: np.ndarray, restart: np.ndarray) -> None:
        """Asks for step ``number``, if that has not been done; environments to ``restart`` begin an episode instead."""
        if self.started is not None and number <= self.started:
            return
        self.started, self._asked = number, True
        what = np.where(restart, BEGIN, np.where(self._gone, NOTHING, STEP)).astype(np.int8)
        self._gone[:] = False
        for worker, share in zip(self._workers, self._shares, strict=True):
            worker.send(Step(actions[share], what[share]))

    def finish(self, actions: np.ndarray, restart: np.ndarray) -> list[Seen | Lost]:
        """Waits for the step that was asked for; workers that are gone or hang are replaced, and named.

        Returns:
          An answer for each environment; never `Lost` where it was to ``restart``.

        Raises:
          HostEnvError: an environment fails again and again.
        """
        if not self._asked:
            raise HostEnvError(
                "expected the state that the last step returned: environments in worker processes can't be stepped "
                "twice from one"
            )
        asked = time.monotonic()
        answers: list[Any] = []
        gone: list[int] = []
        for i, share in enumerate(self._shares):
            seconds = self._options.step_seconds * (share.stop - share.start)
            answer = self._workers[i].receive(seconds, asked + seconds)
            if isinstance(answer, Lost):
                gone.append(i)
                self._report(f"{answer.why}; it is started anew, and its episodes are cut.")
                answer = [answer] * (share.stop - share.start)
            answers += answer
        self._replace(gone)
        self._asked = False
        for i, first in enumerate(restart):
            answers[i] = self._counted(i, answers[i], first)
            while first and isinstance(answers[i], Lost):  # what has not begun can't be cut
                answers[i] = self._counted(i, self._begin(i, actions), first)
            self._note(i, answers[i])
        return answers

    def settle(self) -> None:
        """Hears out what workers were asked for, so that the next answer is that to the next question."""
        if self._asked:
            self.finish(np.zeros(self.n), np.zeros(self.n, bool))

    def close(self) -> None:
        """Ends all workers."""
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.connection.close()  # all of them, before any is waited for
        for worker in workers:
            worker.close()

    def _start(self, number: int, tries: bool = False) -> Worker:
        share = self._shares[number]
        return Worker(self._kind, share.stop - share.start, number, tries)

    def _ready(self, i: int, attempts: int) -> Described:
        """Waits until a worker has made its environments, and starts it anew where it can't.

        Raises:
          HostEnvError: it can't in so many attempts; the pool is then closed.
        """
        for attempt in range(attempts):
            if attempt:
                time.sleep(attempt)
                self._workers[i].close(0.0)
                self._workers[i] = self._start(i)
            answer = self._workers[i].receive(START_SECONDS)
            if isinstance(answer, Described):
                return answer
        self.close()
        raise HostEnvError(answer.error if isinstance(answer, Failed) else answer.why)

    def _replace(self, gone: Sequence[int]) -> None:
        """Starts workers in place of those that are gone, all at the same time. Errors as of `_ready`."""
        for i in gone:
            self._workers[i].close(0.0)
            self._workers[i] = self._start(i)
        for i in gone:
            self._ready(i, STARTS)
            share = self._shares[i]
            self._restarts[share] += 1
            self._gone[share] = True
            numbers = zip(self._seeds[share], self._restarts[share], strict=True)
            self._workers[i].send(Seed([another_seed(int(seed), int(number)) for seed, number in numbers]))

    def _counted(self, i: int, answer: Seen | Failed | Lost | None, first: bool) -> Seen | Lost:
        """Reports and counts what an environment failed at, on the ``first`` step of an episode or later."""
        if answer is None:
            return Lost("its worker was started anew")
        if isinstance(answer, Seen):
            if answer.fault:
                self._report(f"environment {i}: {answer.fault}; its episode is cut.")
                self._faults[i] = self._faults[i] + 1 if first else 0
                if self._faults[i] > FAILURES:
                    raise HostEnvError(f"environment {i}: {answer.fault}, where each episode begins")
            elif first:
                self._faults[i] = 0
            return answer
        why = answer.why if isinstance(answer, Lost) else f"environment {i} raised {answer.error}"
        self._failures[i] += 1
        if self._failures[i] > FAILURES:
            raise HostEnvError(f"{why}; {FAILURES} failures came before it, without an episode that ended in between")
        if isinstance(answer, Failed):
            self._report(f"{why}; it is made anew{'' if first else ', and its episode is cut'}.")
        return Lost(why)

    def _note(self, i: int, answer: Seen | Lost) -> None:
        """Counts steps without a failure, after so many of which, or an episode's end, failures are forgotten."""
        fine = isinstance(answer, Seen) and not answer.fault
        self._steps[i] = self._steps[i] + 1 if fine else 0
        if isinstance(answer, Seen) and fine and (answer.is_last or self._steps[i] >= STEPS):
            self._failures[i] = 0

    def _begin(self, i: int, actions: np.ndarray) -> Seen | Failed | Lost:
        """Asks again for the first step of one environment's episode."""
        j = next(j for j, share in enumerate(self._shares) if share.start <= i < share.stop)
        share = self._shares[j]
        what = np.full(share.stop - share.start, NOTHING, np.int8)
        what[i - share.start] = BEGIN
        self._workers[j].send(Step(actions[share], what))
        answer = self._workers[j].receive(self._options.step_seconds)
        if isinstance(answer, Lost):
            self._report(f"{answer.why}; it is started anew, and its episodes are cut.")
            self._replace([j])
            return answer
        self._gone[i] = False
        return answer[i - share.start]


class Pools:
    """All pools of one kind of environment: the training's, and those of evaluations, which are used again.

    Pools are known by a number that no other process gives to one of its own, so that a state of the environments
    that was stored by another process is recognised as such.
    """

    def __init__(self, factory: Callable[[], Player], workers: Workers | None = None, draws: bool = False) -> None:
        """Starts one worker, to see what the environments are like, and whether they can begin an episode.

        Args:
          factory: makes one; pickled by value where it stands in a script or notebook.
          draws: whether pictures of them are drawn.

        Raises:
          HostEnvError: the environment can't be made or begun, or an agent can't see it or act in it; the message says
            why.
        """
        self.workers = workers or Workers()
        self._lock = threading.RLock()
        self._pools: dict[int, Pool] = {}
        self._idle: list[Pool] = []
        try:
            import cloudpickle
        except ImportError as error:
            raise HostEnvError(
                "environments in worker processes need the package cloudpickle; install it with: pip install "
                "'ne-dreamer-jax[host]'"
            ) from error
        try:
            self._kind = Kind(cloudpickle.dumps(factory), draws)
        except Exception as error:  # whatever an object's own pickling raises
            raise HostEnvError(
                f"expected a factory that makes the environment where it is called, in a worker process, got one that "
                f"holds what can't be sent there: {type(error).__name__}: {error}"
            ) from error
        self._lines: list[str] = []
        self.failure: str | None = None
        """Why environments were given up, where they were."""
        self.should_stop = False
        """Whether something failed and that is to end the run."""
        self._looked_at = self._make(1, tries=True)
        self.described = self._looked_at.described
        self._idle.append(self._looked_at)

    def __del__(self) -> None:
        """Ends the workers of environments that nobody can step any more."""
        self.close()

    def open(self, seeds: Sequence[int]) -> int:
        """The number of a pool with as many environments, of which the next steps begin seeded episodes."""
        try:
            return self._open(seeds)
        except HostEnvError as error:
            self.failure = str(error)
            raise

    def _open(self, seeds: Sequence[int]) -> int:
        with self._lock:
            n = len(seeds)
            fitting = next((pool for pool in self._idle if pool.n == n), None)
            if fitting is None:
                pool = self._make(n)
                if self._looked_at in self._idle:  # it has served its purpose
                    self._idle.remove(self._looked_at)
                    self._looked_at.close()
            else:
                pool = fitting
                self._idle.remove(pool)
            pool.seed(seeds)
            pool.started = None
            number = int.from_bytes(os.urandom(4), "little") >> 1
            self._pools[number] = pool
            return number

    def get(self, number: int) -> Pool | None:
        """The pool of this number; None for one of another process."""
        return self._pools.get(number)

    def release(self, number: int) -> None:
        """Gives a pool back, whose workers wait for the next `open` of as many environments."""
        with self._lock:
            pool = self._pools.pop(number, None)
            if pool is not None:
                try:
                    pool.settle()
                    self._idle.append(pool)
                except HostEnvError:  # it could not be put right; the next is made anew
                    pool.close()

    def lines(self) -> list[str]:
        """What happened since this was last asked."""
        lines, self._lines = self._lines, []
        return lines

    def report(self, line: str) -> None:
        """Takes a line on something that happened, of which few are kept when there are very many."""
        if len(self._lines) < _LINES:
            self._lines.append(line)

    def failed(self, line: str) -> None:
        """Takes a line on a failure."""
        self.report(line)
        self.should_stop = self.workers.on_failure == "stop"

    def close(self) -> None:
        """Ends all workers; whoever goes on with the environments begins with new ones, and without their failures."""
        self.failure, self.should_stop = None, False
        with self._lock:
            pools = [*self._pools.values(), *self._idle]
            self._pools, self._idle = {}, []
        for pool in pools:
            pool.close()

    def _make(self, n: int, tries: bool = False) -> Pool:
        return Pool(self._kind, n, self.workers, self.failed, tries)


def _ended(code: int | None) -> str:
    if code is None:
        return "closed its connection"
    if code < 0:
        return f"was ended by signal {-code} ({signal.Signals(-code).name})"
    return f"ended with exit code {code}"
