"""A sweep is the product of its options; a job that fails costs no other."""

import shlex
import signal
import sys
import threading
import time

import pytest
from click.testing import CliRunner

from experiments import sweep, train

submitit = pytest.importorskip("submitit")


def invoke(*arguments):
    result = CliRunner().invoke(sweep.main, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def test_every_run_has_its_command_and_its_directory(tmp_path):
    code, output = invoke(
        "--task", "dmc/walker_walk", "--task", "dmc/cheetah_run", "--method", "ne_dreamer/no_shift", "--seeds", 3,
        "--size", "1m", "--obs", "vector", "--set", "loop.num_envs=4", "--set", "agent.batch_size=8",
        "--logdir", tmp_path, "--dry-run",
    )  # fmt: skip
    assert code == 0
    assert not list(tmp_path.iterdir())
    commands = [shlex.split(line) for line in output.splitlines()]
    assert len(commands) == 6
    got = set()
    for command in commands:
        assert command[:4] == [sys.executable, "-m", "ne_dreamer_jax", "train"]
        options = train.main.make_context("train", command[4:]).params
        chosen = {"size": "1m", "preset": "dmc", "method": "ne_dreamer/no_shift", "obs": "vector"}
        assert {name: options[name] for name in chosen} == chosen
        assert options["assignments"] == ("loop.num_envs=4", "agent.batch_size=8")
        got.add((options["task"], options["seed"], options["logdir"]))
    assert {(task, seed) for task, seed, _ in got} == {
        (task, seed) for task in ("dmc/walker_walk", "dmc/cheetah_run") for seed in range(3)
    }
    assert len({logdir for *_, logdir in got}) == 6
    assert [command[command.index("--seed") + 1] for command in commands] == ["0", "0", "1", "1", "2", "2"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "dmc/walker_wlak"], "no environment is called 'dmc/walker_wlak'"),
        (["--task", "dmc/walker_walk", "--partition", "gpu"], "expected --partition together with --slurm"),
        (["--task", "dmc/walker_walk", "--set", "agent.behavior.discont=1", "--dry-run"], "agent.behavior.discount"),
        (["--task", "rooms/watermaze_small", "--obs", "vector"], "says itself how it is observed"),
    ],
)
def test_what_is_mistyped_is_refused(tmp_path, arguments, message):
    code, output = invoke(*arguments, "--logdir", tmp_path / "sweep")
    assert code == 2
    assert message in " ".join(output.split())
    assert not (tmp_path / "sweep").exists()


def test_the_local_executor_runs_all_and_tells_which_failed(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep, "POLL", 0.1)

    def run(name, code):
        return sweep.Run(name, tmp_path / name, (sys.executable, "-c", code))

    stamp = "import pathlib, time; time.sleep(0.3); pathlib.Path({!r}).write_text(str(time.time()))"
    runs = [
        run("good", stamp.format(str(tmp_path / "good"))),
        run("bad", "raise SystemExit(3)"),
        run("last", stamp.format(str(tmp_path / "last"))),
    ]
    lines = []
    failed = sweep.launch(runs, submitit.LocalExecutor(tmp_path / "jobs"), 1, lines.append)
    assert [run.name for run in failed] == ["bad"]
    assert float((tmp_path / "good").read_text()) < float((tmp_path / "last").read_text())
    order = [line.split(":")[0].split() for line in lines]
    verbs = [("started", "finished"), ("started", "failed"), ("started", "finished")]
    assert order == [[verb, run.name] for run, pair in zip(runs, verbs, strict=True) for verb in pair]


def test_a_job_that_is_preempted_lets_its_run_save_and_starts_again(tmp_path):
    code = (
        "import pathlib, signal, sys, time\n"
        f"saved = pathlib.Path({str(tmp_path / 'saved')!r})\n"
        "signal.signal(signal.SIGTERM, lambda *_: (saved.write_text('yes'), sys.exit(143)))\n"
        f"pathlib.Path({str(tmp_path / 'ready')!r}).touch()\n"
        "time.sleep(60)"
    )
    job, errors = sweep.Job((sys.executable, "-c", code)), []

    def work():
        try:
            job()
        except RuntimeError as error:
            errors.append(str(error))

    thread = threading.Thread(target=work)
    thread.start()
    while not (tmp_path / "ready").exists():
        time.sleep(0.05)
    again = job.checkpoint()
    thread.join()
    assert (tmp_path / "saved").read_text() == "yes"
    assert f"exit code {128 + signal.SIGTERM}" in errors[0]
    assert again.function.command == job.command


def test_a_run_sees_the_devices_that_the_sweep_sees(monkeypatch):
    """Whatever the launcher of its job hides."""
    shows = lambda devices: (
        sys.executable, "-c", f"import os; raise SystemExit(os.environ.get({sweep.GPUS!r}) != {devices!r})"
    )  # fmt: skip
    monkeypatch.setenv(sweep.GPUS, "")
    sweep.Job(shows("3"), {sweep.GPUS: "3"})()
    sweep.Job(shows(None), {sweep.GPUS: None})()
    sweep.Job(shows(""))()
    assert sweep.Job(shows("3"), {sweep.GPUS: "3"}).checkpoint().function.variables == {sweep.GPUS: "3"}
