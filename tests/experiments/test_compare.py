"""Several runs in one figure: which are run, which are found, and what is said about them."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from click.testing import CliRunner

from experiments import ablations, compare
from experiments.common import Common
from experiments.train import configure
from ne_dreamer_jax.runs import metrics, plots, run_directory
from ne_dreamer_jax.runs.metrics import StepCounts
from ne_dreamer_jax.settings import names

BUDGET = 400
FAILING: dict[str, int] = {}  # method -> exit code of its runs


def write(path, options, upto=BUDGET):
    """What a run leaves behind."""
    given = dict(zip(options[::2], options[1::2], strict=True))
    seed = int(given["--seed"])
    values = {"seed": seed, "env.task": given.get("--task"), "loop.env_steps": BUDGET}
    config = configure(given["--preset"], None, given["--method"], values)
    with run_directory.claim(path, config) as files, metrics.Writer(files.metrics) as writer:
        for step in range(100, upto + 1, 100):
            more = {"eval/random_return": 7.0} if step == 100 else {}
            writer.write(StepCounts(step, step // 2, 0), {"eval/return": step + seed, **more})


@pytest.fixture
def invoke(monkeypatch):
    started = []

    def train(path, options):
        started.append((path.parent.name, path.name))
        code = FAILING.get(path.parent.name, 0)
        if not code:
            write(path, options)
        return code

    monkeypatch.setattr(compare, "train", train)

    def invoke(command, *arguments):
        budget = ["--set", f"loop.env_steps={BUDGET}"] if "--draw" not in arguments else []
        result = CliRunner().invoke(command.main, [*(str(argument) for argument in arguments), *budget])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, result.output, started

    return invoke


def test_every_method_and_seed_is_run_once(tmp_path, invoke):
    chosen = ["--method", "r2dreamer", "--method", "ne_dreamer/no_shift"]
    code, output, started = invoke(compare, tmp_path, *chosen, "--seeds", 2)
    assert code == 0
    assert started == [(m, f"seed{s}") for s in (0, 1) for m in ("r2dreamer", "ne_dreamer-no_shift")]
    assert (tmp_path / "comparison.png").read_bytes()[1:4] == b"PNG"
    lines = {line.split()[0]: " ".join(line.split()) for line in output.splitlines() if line.startswith("  ")}
    for method in ("r2dreamer", "ne_dreamer/no_shift"):
        assert lines[method] == f"{method} 400.5 (400.0 to 401.0), 2 seeds"
    assert "random policy 7.0" in " ".join(output.split())
    started.clear()
    assert invoke(compare, tmp_path, *chosen, "--seeds", 2)[2] == []  # all finished
    assert invoke(compare, tmp_path, *chosen, "--seeds", 3, "--draw")[2] == []


def test_a_run_that_was_stopped_goes_on(tmp_path, invoke):
    options = ["--preset", "quickstart", "--method", "r2dreamer", "--seed", "0"]
    write(tmp_path / "r2dreamer" / "seed0", options, upto=200)
    _, output, started = invoke(compare, tmp_path, "--draw")
    assert started == []
    assert "1 unfinished" in output
    _, _, started = invoke(compare, tmp_path, "--method", "r2dreamer", "--seeds", 1)
    assert started == [("r2dreamer", "seed0")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--task", "dmc/cheetah_run"], "env.task: 'dmc/ball_in_cup_catch', now 'dmc/cheetah_run'"),
        (["--obs", "vector"], "env.obs: 'pixels', now 'vector'"),
        (["--set", "agent.optimizer.learning_rate=0.5"], "agent.optimizer.learning_rate"),
    ],
)
def test_a_finished_run_of_other_settings_is_refused_with_what_differs(tmp_path, invoke, options, message):
    invoke(compare, tmp_path, "--method", "r2dreamer", "--seeds", 1)
    code, output, started = invoke(compare, tmp_path, "--method", "r2dreamer", "--seeds", 1, *options)
    assert code == 2
    assert message in " ".join(output.split())
    assert len(started) == 1


def test_no_run_begins_where_another_is_of_other_settings(tmp_path, invoke):
    write(tmp_path / "r2dreamer" / "seed1", ["--preset", "quickstart", "--method", "r2dreamer", "--seed", "1"])
    chosen = ["--method", "r2dreamer", "--seeds", 2, "--task", "dmc/cheetah_run"]
    code, _, started = invoke(compare, tmp_path, *chosen)
    assert (code, started) == (2, [])


def test_a_finished_run_that_is_to_have_more_steps_goes_on(tmp_path, invoke):
    invoke(compare, tmp_path, "--method", "r2dreamer", "--seeds", 1)
    settings = Common("quickstart", assignments=[f"loop.env_steps={2 * BUDGET}"])
    run = tmp_path / "r2dreamer" / "seed0"
    assert not compare.finished(run, settings, None, "r2dreamer", 0)
    assert compare.finished(run, settings._replace(assignments=[f"loop.env_steps={BUDGET}"]), None, "r2dreamer", 0)


def test_a_setting_that_fits_no_method_is_refused_once(tmp_path, invoke):
    code, output, started = invoke(compare, tmp_path / "new", "--set", "agent.foo=1")
    assert (code, started) == (2, [])
    assert output.count("agent.foo") == 1
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["config.json", "metrics.jsonl"])
def test_a_run_that_cant_be_read_is_named(tmp_path, invoke, name):
    invoke(compare, tmp_path, "--method", "r2dreamer", "--seeds", 1)
    (tmp_path / "r2dreamer" / "seed0" / name).write_text("{\n")
    code, output, _ = invoke(compare, tmp_path, "--method", "r2dreamer", "--seeds", 1)
    assert code == 2
    assert name in output


def test_a_method_that_fails_ends_no_other_and_is_named(tmp_path, invoke, monkeypatch):
    """One that can't act in the task is refused once; one that broke down is tried with every seed."""
    monkeypatch.setitem(FAILING, "drqv2", 2)
    monkeypatch.setitem(FAILING, "dreamerv3", 1)
    chosen = [word for name in ("drqv2", "dreamerv3", "r2dreamer") for word in ("--method", name)]
    code, output, started = invoke(compare, tmp_path, *chosen, "--seeds", 2)
    assert code == 2
    assert started == [
        (m, f"seed{s}") for s in (0, 1) for m in ("drqv2", "dreamerv3", "r2dreamer") if (m, s) != ("drqv2", 1)
    ]
    assert "drqv2, seed 0, is missing: refused" in output
    assert "dreamerv3, seed 1, is missing: exit code 1" in output
    assert "r2dreamer" in output.split("comparison.png")[0]


def test_a_signal_ends_the_comparison(tmp_path, invoke, monkeypatch):
    monkeypatch.setitem(FAILING, "dreamerv3", 130)
    code, _, started = invoke(compare, tmp_path, "--method", "dreamerv3", "--method", "r2dreamer", "--seeds", 1)
    assert code == 130
    assert started == [("dreamerv3", "seed0")]


@pytest.mark.parametrize(("signum", "trap"), [(signal.SIGTERM, "TERM"), (signal.SIGINT, "INT")])
def test_a_run_that_is_stopped_saves_itself_before_the_comparison_ends(tmp_path, monkeypatch, signum, trap):
    """Whoever it is sent to: a terminal sends Ctrl-C to both, others to the comparison alone."""
    child = tmp_path / "python"
    save = f"trap 'sleep 1; touch {tmp_path}/saved; exit 143' {trap}"
    child.write_text(f"#!/bin/sh\n{save}\necho $$ > {tmp_path}/ready\nfor i in $(seq 400); do sleep 0.05; done\n")
    child.chmod(0o755)
    monkeypatch.setattr(compare.sys, "executable", str(child))

    def stop():
        while not (ready := tmp_path / "ready").exists() or not ready.read_text().strip():
            time.sleep(0.02)
        os.kill(os.getpid(), signum)

    before = signal.signal(signum, signal.default_int_handler)  # whatever it was where the tests were started
    thread = threading.Thread(target=stop)
    thread.start()
    try:
        with pytest.raises(SystemExit) as end:
            compare.train(tmp_path / "run", [])
        assert signal.getsignal(signum) is signal.default_int_handler
    finally:
        thread.join()
        signal.signal(signum, before)
    assert end.value.code == 128 + signum
    assert (tmp_path / "saved").exists()


def test_a_run_that_was_killed_counts_as_one_that_failed(tmp_path, monkeypatch):
    child = tmp_path / "python"
    child.write_text("#!/bin/sh\nkill -9 $$\n")
    child.chmod(0o755)
    monkeypatch.setattr(compare.sys, "executable", str(child))
    assert compare.train(tmp_path / "run", []) == 137


def test_a_comparison_without_evaluations_is_refused_before_anything_trains(tmp_path, invoke):
    code, output, started = invoke(compare, tmp_path, "--set", "loop.eval_every=none")
    assert code == 2
    assert "loop.eval_every: expected a number of steps" in output
    assert started == []


def test_the_ablations_are_the_papers(tmp_path, invoke):
    _, _, started = invoke(ablations, tmp_path, "--seeds", 1)
    assert [name.replace("-", "/") for name, _ in started] == [n for n in names.METHODS if n.startswith("ne_dreamer")]


def test_runs_of_several_tasks_are_told_and_drawn_task_by_task(tmp_path, invoke):
    invoke(compare, tmp_path / "a", "--method", "r2dreamer", "--seeds", 1, "--task", "dmc/walker_walk")
    invoke(compare, tmp_path / "b", "--method", "dreamerv3", "--seeds", 2, "--task", "dmc/cheetah_run")
    code, output, _ = invoke(compare, tmp_path, "--draw")
    assert code == 0
    assert (tmp_path / "comparison.png").read_bytes()[1:4] == b"PNG"
    cheetah, walker = output.split("dmc/cheetah_run: ")[1].split("dmc/walker_walk: ")
    assert "r2dreamer" in walker
    assert "dreamerv3" in cheetah
    assert "r2dreamer" not in cheetah


def test_where_no_run_is_that_is_said(tmp_path, invoke):
    code, output, _ = invoke(compare, tmp_path / "empty", "--draw")
    assert code == 2
    assert "got none" in " ".join(output.split())


def test_published_returns_are_those_of_the_file():
    curves = compare.published("dmc/cartpole_swingup")
    assert set(curves) == {"DreamerV3", "DrQ-v2"}
    steps, returns = curves["DreamerV3"]
    assert (steps[0], returns[0], len(steps)) == (50_000, 210.3, 20)
    assert compare.published("rooms/watermaze") == {}


def test_the_mean_is_over_the_steps_that_all_seeds_have():
    seeds = [(np.asarray([1.0, 2, 3]), np.asarray([10.0, 20, 30])), (np.asarray([1.0, 3]), np.asarray([0.0, 10]))]
    steps, mean = plots.mean_over_seeds(seeds)
    np.testing.assert_array_equal(steps, [1, 3])
    np.testing.assert_array_equal(mean, [5, 20])


@pytest.mark.parametrize("env_steps", [30_000, 200_000])
def test_budgets_short_and_long_are_drawn_beside_published_returns(tmp_path, env_steps):
    curve = (np.asarray([1e4, 3e4]), np.asarray([1.0, 2.0]))
    path = tmp_path / "x.png"
    task = plots.Task("t", {"ne_dreamer": [curve]}, env_steps, published=compare.published("dmc/walker_walk"))
    plots.comparison([task], path)
    assert path.stat().st_size > 10_000
