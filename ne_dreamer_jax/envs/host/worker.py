"""A worker process: some environments of one kind, stepped one after the other when the main process asks.

`pool` starts it with `main`, which takes the file descriptor of a connection as its argument. It ends when the main
process closes the connection or is gone, however that ends.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy as np

from ne_dreamer_jax.envs.host import opengl
from ne_dreamer_jax.envs.host.players import Player, Seen

STEP, BEGIN, NOTHING = 0, 1, 2
"""Whether an environment takes its action, begins an episode, or is left alone."""


class Make(NamedTuple):
    """Asks for as many environments; answered by what the first is like."""

    factory: Callable[[], Player]
    number: int
    draws: bool  # whether pictures of them are drawn
    tries: bool  # whether the first begins an episode, to see whether it can


class Seed(NamedTuple):
    """Seeds the next beginning of each environment; not answered."""

    seeds: list[int]


class Step(NamedTuple):
    """Asks for a step of all environments; answered by a list of `Seen`, `Failed` or, where left alone, None."""

    actions: Any  # [n, ...]
    what: Any  # int8 [n], of `STEP`, `BEGIN`, `NOTHING`


class Failed(NamedTuple):
    """What an environment raised; it is made anew."""

    error: str


class Envs:
    """The environments of a worker."""

    def __init__(self, factory: Callable[[], Player], count: int) -> None:
        self._factory = factory
        self._players: list[Player | None] = [factory() for _ in range(count)]
        self._seeds: list[int | None] = [None] * count
        self._begun: list[int | None] = [None] * count  # the seeds of the last beginnings that had one
        self._remade = [0] * count

    def describe(self, tries: bool) -> Any:
        """What the first is like; if it ``tries``, it has to begin an episode first."""
        player = self._players[0]
        assert player is not None
        if tries:
            player.reset(None)
        return player.described

    def seed(self, seeds: list[int]) -> None:
        """Seeds the next beginnings."""
        self._seeds, self._remade = list(seeds), [0] * len(seeds)

    def step(self, number: int, action: np.ndarray, what: int) -> Seen | Failed | None:
        """A step of one environment; what it raises is told, and the environment made anew at its next beginning.

        One that is made anew has a seed that follows from its last one, so that the run repeats.
        """
        if what == NOTHING:
            return None
        try:
            player = self._players[number]
            if player is None:
                player = self._players[number] = self._factory()
            if what == BEGIN:
                seed, self._seeds[number] = self._seeds[number], None
                self._begun[number] = self._begun[number] if seed is None else seed
                return checked(Seen(player.reset(seed), 0.0, False, False))
            return checked(player.step(action))
        except Exception as error:
            self._drop(number)
            self._remade[number] += 1
            before = self._begun[number]
            if self._seeds[number] is None and before is not None:
                self._seeds[number] = another_seed(before, self._remade[number])
            return Failed(summary(error))

    def close(self) -> None:
        """Closes all."""
        for number in range(len(self._players)):
            self._drop(number)

    def _drop(self, number: int) -> None:
        player, self._players[number] = self._players[number], None
        if player is not None:
            with contextlib.suppress(Exception):  # it is broken already, or nobody is left to hear of it
                player.close()


def another_seed(seed: int, number: int) -> int:
    """Of an environment that begins for the so-manieth time: 31 bits, as libraries take them."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0] >> 1)


def checked(stepped: Seen) -> Seen:
    """The same where all numbers are finite; else the episode's end, with zeros in place of what is not."""
    names = [f"obs[{name!r}]" for name, x in stepped.obs.items() if x.dtype == np.float32 and not np.isfinite(x).all()]
    names += ["the reward"] if not np.isfinite(np.float32(stepped.reward)) else []
    if not names:
        return stepped
    obs = {
        name: np.where(np.isfinite(x), x, np.float32(0)) if x.dtype == np.float32 else x
        for name, x in stepped.obs.items()
    }
    return Seen(obs, 0.0, True, False, f"{', '.join(names)} is not finite")


def summary(error: BaseException) -> str:
    """Kind and text of an error, and where it was raised, in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({os.path.basename(frames[-1].filename)}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:500]}{where}"


def serve(connection: Connection) -> None:
    """Answers until the connection is closed."""
    envs: Envs | None = None
    while True:
        try:
            message = connection.recv()
        except (EOFError, OSError):
            break
        answer: Any = None
        if isinstance(message, Make):
            try:
                if message.draws:
                    opengl.allow()  # before the factory loads MuJoCo
                envs = Envs(message.factory, message.number)
                answer = envs.describe(message.tries)
            except Exception as error:
                answer = Failed(summary(error) if not isinstance(error, ValueError) else str(error))
        elif envs is None:
            raise AssertionError(f"expected Make first, got {message}")
        elif isinstance(message, Seed):
            envs.seed(message.seeds)
            continue
        elif isinstance(message, Step):
            answer = [envs.step(i, a, int(w)) for i, (a, w) in enumerate(zip(*message, strict=True))]
        try:
            connection.send(answer)
        except OSError:
            break
    if envs is not None:
        envs.close()


def end_with(parent: int, seconds: float = 1.0) -> None:
    """Ends this process when its parent is gone, also while an environment hangs that lets other threads run."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(seconds)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main() -> None:
    """Serves the connection whose file descriptor is the argument."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the main process's to answer, which saves first
        signal.signal(number, signal.SIG_IGN)
    descriptor = int(sys.argv[1])
    os.set_inheritable(descriptor, False)  # simulators that an environment starts would keep the connection open
    end_with(os.getppid())
    os.dup2(2, 1)  # what environments print is no output of the run
    serve(Connection(descriptor))
