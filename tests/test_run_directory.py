"""A run directory belongs to one run; nothing else is ever touched."""

import dataclasses
import errno
import fcntl
import json
import math
import os
import subprocess
import sys

import pytest

from ne_dreamer_jax import config as configs
from ne_dreamer_jax.runs import run_directory
from ne_dreamer_jax.runs.run_directory import RefusedError


@dataclasses.dataclass(frozen=True)
class Config:
    task: str = "dmc/walker_walk"
    seed: int = 0


def listing(path):
    return {entry.name: entry.read_bytes() for entry in path.iterdir()}


def test_the_same_configuration_goes_on_and_finds_everything_as_it_was(tmp_path):
    path = tmp_path / "runs" / "a"
    with run_directory.claim(path, Config()) as files:
        files.metrics.write_text("kept\n")
    before = listing(path)
    with run_directory.claim(path, Config()):
        assert listing(path) == before
    assert set(before) == {".ne_dreamer_jax", "config.json", "metrics.jsonl"}
    assert run_directory.read_config(path, Config) == Config()


def test_an_empty_directory_is_taken(tmp_path):
    with run_directory.claim(tmp_path, Config(seed=3)):
        content = json.loads((tmp_path / "config.json").read_text())
        assert len(content.pop("sha256")) == 64
        assert content == {"task": "dmc/walker_walk", "seed": 3}


def test_another_run_is_refused_with_what_differs(tmp_path):
    with run_directory.claim(tmp_path, Config()):
        pass
    before = listing(tmp_path)
    with (
        pytest.raises(RefusedError, match=r"holds another run(.|\n)*seed: 0, now 1"),
        run_directory.claim(tmp_path, Config(seed=1)),
    ):
        pass
    assert listing(tmp_path) == before


def test_what_is_not_a_run_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(RefusedError, match=r"not a run \(thesis.tex\)"), run_directory.claim(tmp_path, Config()):
        pass
    assert listing(tmp_path) == {"thesis.tex": b"mine"}
    with pytest.raises(RefusedError, match="expected a directory, got a file"):
        run_directory.check(tmp_path / "thesis.tex")
    with pytest.raises(RefusedError, match="can't be made a run directory"):
        run_directory.claim(tmp_path / "thesis.tex" / "below", Config()).__enter__()


def test_two_processes_do_not_share_a_run(tmp_path):
    code = (
        "import sys, time, pathlib; from tests.test_run_directory import Config; "
        "from ne_dreamer_jax import run_directory\n"
        "with run_directory.claim(pathlib.Path(sys.argv[1]), Config()): print('held', flush=True); sys.stdin.read()"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=os.getcwd()
    )
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        with (
            pytest.raises(RefusedError, match="another process trains in"),
            run_directory.claim(tmp_path, Config()),
        ):
            pass
        holder.communicate(b"")
    with run_directory.claim(tmp_path, Config()):
        pass


def test_a_file_system_without_locks_is_refused(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.raises(RefusedError, match=r"can't be locked .*Choose a --logdir on another file system"):
        run_directory.claim(tmp_path / "run", Config()).__enter__()
    assert not (tmp_path / "run" / "config.json").exists()


def test_a_crash_before_the_configuration_was_written_starts_anew(tmp_path):
    (tmp_path / ".ne_dreamer_jax").touch()
    (tmp_path / "config.json.partial").write_text('{"ta')
    with run_directory.claim(tmp_path, Config()):
        assert run_directory.read_config(tmp_path, Config) == Config()


@pytest.mark.parametrize("left", ["checkpoints", "metrics.jsonl"])
def test_a_run_whose_configuration_is_gone_is_refused(tmp_path, left):
    with run_directory.claim(tmp_path, Config()):
        (tmp_path / left).mkdir()
    (tmp_path / "config.json").unlink()
    with (
        pytest.raises(RefusedError, match=f"holds {left} of a run whose config.json is gone"),
        run_directory.claim(tmp_path, Config()),
    ):
        pass


def test_reading_what_is_no_run_or_of_another_version(tmp_path):
    with pytest.raises(RefusedError, match="expected a run directory"):
        run_directory.read_config(tmp_path, Config)
    with run_directory.claim(tmp_path, Config()):
        pass
    (tmp_path / "config.json").write_text('{"task": "dmc/walker_walk", "old": 1}')
    with pytest.raises(RefusedError, match=r"does not fit this version.*missing \[\], unknown \['old'\]"):
        run_directory.read_config(tmp_path, Config)
    for text in ("{", "[]", "[" * 100_000, '"task"', "\x00", '{"seed": 1e400}'):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(RefusedError, match="does not fit this version of the program, or is damaged"):
            run_directory.read_config(tmp_path, Config)


def test_a_field_that_an_older_version_did_not_write_has_its_default(tmp_path):
    (tmp_path / ".ne_dreamer_jax").touch()
    (tmp_path / "config.json").write_text('{"task": "dmc/walker_run"}')
    assert run_directory.read_config(tmp_path, Config) == Config("dmc/walker_run", seed=0)


def test_a_configuration_that_was_edited_is_refused_by_its_checksum(tmp_path):
    with run_directory.claim(tmp_path, Config(seed=3)):
        pass
    text = (tmp_path / "config.json").read_text()
    (tmp_path / "config.json").write_text(text.replace('"seed": 3', '"seed": 2'))
    for call in (
        lambda: run_directory.read_config(tmp_path, Config),
        lambda: run_directory.claim(tmp_path, Config(seed=2)).__enter__(),
    ):
        with pytest.raises(RefusedError, match=r"config.json is not as it was written: its checksum does not hold"):
            call()


def test_what_may_differ_is_let_through_and_stored(tmp_path):
    only_task = lambda stored, asked: [] if stored.task == asked.task else ["task"]
    with run_directory.claim(tmp_path, Config()):
        pass
    with run_directory.claim(tmp_path, Config(seed=5), only_task):
        assert run_directory.read_config(tmp_path, Config) == Config(seed=5)
    with pytest.raises(RefusedError, match="holds another run"):
        run_directory.claim(tmp_path, Config("dmc/walker_run"), only_task).__enter__()


def test_an_evaluation_replaces_the_one_before(tmp_path):
    with run_directory.claim(tmp_path, Config()) as files:
        run_directory.write_evaluation(files, {"return": 1.0})
        run_directory.write_evaluation(files, {"return": 2.0})
        assert json.loads(files.evaluation.read_text()) == {"return": 2.0}


@pytest.mark.parametrize("name", [300 * "x", "file/run", "file/a/run", "loop/run"])
def test_what_can_be_no_directory_is_refused_at_once(tmp_path, name):
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(run_directory.RefusedError, match="--logdir"):
        run_directory.check(tmp_path / name)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "loop"]


def test_a_directory_behind_a_link_is_a_directory(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "there")
    (tmp_path / "there").mkdir()
    run_directory.check(tmp_path / "link" / "run")
    run_directory.check(tmp_path / "link")


def test_a_setting_that_is_infinite_is_read_back(tmp_path):
    config = configs.override(configs.preset("smoke"), "agent.optimizer.agc=inf")
    with run_directory.claim(tmp_path / "run", config):
        pass
    assert run_directory.read_config(tmp_path / "run", configs.Config) == config


def test_results_that_are_not_finite_are_null(tmp_path):
    files = run_directory.RunDirectory(tmp_path)
    run_directory.write_evaluation(files, {"return": math.inf, "returns": (1.0, math.nan), "episodes": 2})
    stored = json.loads(files.evaluation.read_text(), parse_constant=pytest.fail)
    assert stored == {"return": None, "returns": [1.0, None], "episodes": 2}
