"""A process does not grow with what it has done: chunks, saves and evaluations."""

import gc
import subprocess
import sys
from pathlib import Path

import pytest

from ne_dreamer_jax.runs import run_directory, training
from tests.experiments import stub, toy

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="expected /proc/self/statm")
PAGE = 4096
ROOT = Path(__file__).parents[2]


def resident():
    """Bytes of this process in memory."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def growth(path, chunks):
    """How many bytes a process grows by over the second half of so many chunks, all of them saved, some evaluated."""
    config = toy.config(env_steps=8 * chunks, chunk_steps=4, eval_every=8 * (chunks // 12), capacity=80)
    run, sizes, said = stub.build(config, image=False), [], 0

    def echo(line):
        nonlocal said
        said += "env step" in line and "updates/s" in line
        if "env step" in line and said in (chunks // 2, chunks - 5):
            sizes.append(resident())

    with run_directory.claim(path, config) as files:
        assert training.train(run, files, checkpoint_minutes=0, echo=echo) == 0
    return sizes[-1] - sizes[0]


def bearable(chunks):
    """Metrics of a chunk stay at hand for the curve: some 1.2 kB. The allocator takes pages in larger pieces."""
    return 500_000 + 2_000 * chunks


def test_memory_stays_what_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "draw", lambda *_: None)  # the first ten curves fill matplotlib's caches
    assert growth(tmp_path / "run", 60) < bearable(60)


@pytest.mark.slow
def test_memory_stays_what_it_is_over_two_thousand_chunks(tmp_path):
    """In a process of its own, whose memory no earlier test has used and freed, where growth would not show."""
    chunks = 2_000
    command = [sys.executable, "-m", "tests.faults.test_growth", str(tmp_path / "run"), str(chunks)]
    grown = int(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()[-1])
    print(f"{grown / chunks * 2:,.0f} bytes a chunk")
    assert grown < bearable(chunks)


if __name__ == "__main__":
    print(growth(Path(sys.argv[1]), int(sys.argv[2])))
