"""SIGTERM and SIGINT at any moment: a checkpoint at the next boundary, the signal's exit code; twice leaves at once."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest

from ne_dreamer_jax.runs import checkpoint

MOMENTS = [
    "Compiling",
    "Traced in",
    *(f"env step {step} " for step in (16, 32, 48, 64, 96, 112, 144)),
    "Saved the agent",
]


def run(path, *arguments):
    """Exit code and output of the toy run, and how long after the last signal it ended."""
    command = [sys.executable, "-m", "tests.faults.training_child", str(path), *map(str, arguments)]
    compiled = {"JAX_COMPILATION_CACHE_DIR": str(path.parent), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=300, env={**os.environ, **compiled}
    )
    ended = time.monotonic()
    sent = re.findall(r"sent \d+ at ([\d.]+)", done.stdout)
    return done.returncode, done.stdout, done.stderr, ended - float(sent[-1]) if sent else None


def newest(path):
    found = checkpoint.checkpoints(path / "checkpoints")[0]
    return found.step, checkpoint.digest(found, "agent"), checkpoint.digest(found, "loop")


@pytest.mark.slow
@pytest.mark.strict
def test_ten_moments(tmp_path):
    assert run(tmp_path / "whole")[0] == 0
    for index, moment in enumerate(MOMENTS):
        number = (signal.SIGTERM, signal.SIGINT)[index % 2]
        path = tmp_path / str(index)
        code, said, errors, seconds = run(path, moment, int(number))
        assert (code, errors) == (128 + number, ""), (moment, said)
        assert "The same command goes on from there." in said, moment
        print(f"{number.name} at {moment!r}: left after {seconds:.2f} s, at step {newest(path)[0]}")
        code, said, errors, _ = run(path)
        assert (code, errors) == (0, ""), said
        assert "loaded from the cache" in said, "a resumed run is the same program as a fresh one"
        assert newest(path) == newest(tmp_path / "whole"), moment


BUSY = """
import os, signal, sys, threading, time
import jax, jax.numpy as jnp
from ne_dreamer_jax.runs.signals import Stop

def send():
    for _ in range(2):
        time.sleep(0.3)
        os.kill(os.getpid(), int(sys.argv[1]))

signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background ignores
spin = jax.jit(lambda x: jax.lax.fori_loop(0, 2**31 - 2, lambda i, x: x * 0.5 + 1.0, x)).lower(jnp.zeros(())).compile()
with Stop(print):
    threading.Thread(target=send, daemon=True).start()
    print(time.monotonic(), flush=True)
    spin(jnp.zeros(())).block_until_ready()
    print("came to its end", time.monotonic())
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_leaves_at_once_while_the_main_thread_is_in_a_library(number):
    done = subprocess.run(
        [sys.executable, "-c", BUSY, str(int(number))], capture_output=True, text=True, check=False, timeout=120
    )
    seconds = time.monotonic() - float(done.stdout.split()[0]) - 0.6
    assert (done.returncode, done.stderr) == (128 + number, "")
    assert "came to its end" not in done.stdout
    print(f"left {seconds:.2f} s after the second one")


DOUBLED = """
import os, signal, time
from ne_dreamer_jax.runs.signals import Stop

with Stop(lambda line: None) as stop:
    for _ in range(2):
        os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(1.0)
    print("goes on", stop.signal, flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(5)
    print("came to its end")
"""


def test_a_signal_that_is_sent_twice_at_once_is_one():
    """As GNU timeout does."""
    done = subprocess.run([sys.executable, "-c", DOUBLED], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGTERM, f"goes on {signal.SIGTERM:d}\n", "")


@pytest.mark.slow
def test_a_second_signal_leaves_at_once_while_a_run_starts(tmp_path):
    code, said, _, seconds = run(tmp_path / "run", "Compiling", int(signal.SIGTERM), 0.2)
    assert code in (128 + signal.SIGTERM, -signal.SIGTERM), said
    assert "Traced in" not in said, "it is left in the middle of it"
    print(f"left {seconds:.2f} s after the second one")


@pytest.mark.slow
def test_a_parent_that_dies_frees_the_directory(tmp_path):
    command = [sys.executable, "-m", "tests.faults.training_child", str(tmp_path / "run"), "Compiling", "9"]
    assert subprocess.run(command, capture_output=True, check=False, timeout=300).returncode == -signal.SIGKILL
    assert run(tmp_path / "run")[0] == 0, "no lock is left behind"
