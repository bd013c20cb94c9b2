"""A toy run for signals: ``python -m tests.faults.training_child LOGDIR [MOMENT NUMBER [AGAIN]]``.

At the first line that holds the text MOMENT, this process sends itself the signal NUMBER, a little later, from another
thread; AGAIN seconds after that once more. It says when.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

import jax

from ne_dreamer_jax.runs import building, run_directory, training
from ne_dreamer_jax.system.quiet import quiet
from tests.experiments import toy


def main(logdir: str, moment: str = "never", number: str = "15", again: str = "") -> int:
    """Trains; returns the exit code."""
    jax.config.update("jax_disable_most_optimizations", True)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background ignores
    run = building.build(toy.config(env_steps=160, eval_every=None), toy.env())
    sent: list[float] = []

    def send() -> None:
        for wait in (0.05, *([float(again)] if again else [])):
            time.sleep(wait)
            print(f"sent {number} at {time.monotonic():.3f}", flush=True)
            os.kill(os.getpid(), int(number))

    def echo(line: str) -> None:
        print(line, flush=True)
        if moment in line and not sent:
            sent.append(0.0)
            threading.Thread(target=send, daemon=True).start()

    with run_directory.claim(Path(logdir), run.config) as files:
        return training.train(run, files, checkpoint_minutes=0, echo=echo)


if __name__ == "__main__":
    quiet()
    code = main(*sys.argv[1:])
    print(f"left at {time.monotonic():.3f}", flush=True)
    sys.exit(code)
