"""One process of a toy run, for `test_parallel`:

``python -m tests.processes LOGDIR PROCESSES PROCESS PORT [STOP_AT [SEEDS]]``.

Process 0 asks for the end, as Ctrl-C does, once a line holds the text STOP_AT. SEEDS is "the same" or "other seeds".
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import jax

from ne_dreamer_jax.runs import building, run_directory, start, training
from ne_dreamer_jax.system import parallel
from tests.experiments import toy


def main(logdir: str, processes: str, process: str, port: str, stop_at: str = "never", seeds: str = "the same") -> int:
    """Trains; returns the exit code."""
    jax.config.update("jax_disable_most_optimizations", True)
    mesh, first = None, process == "0"
    if processes != "1":
        parallel.connect(f"127.0.0.1:{port}", int(processes), int(process))
        mesh = parallel.make_mesh(1)
    config = replace(toy.config(), seed=0 if seeds == "the same" else int(process))
    run = building.build(config, toy.env(), mesh)
    start.check_processes(run.config, int(processes), None)

    def echo(line: str) -> None:
        print(line, flush=True)
        if first and stop_at in line:
            os.kill(os.getpid(), signal.SIGTERM)

    with contextlib.ExitStack() as stack:
        files = run_directory.RunDirectory(Path(logdir))
        if first:
            files = stack.enter_context(run_directory.claim(Path(logdir), run.config))
        return training.train(run, files, checkpoint_minutes=0, echo=echo)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
