"""A run leaves what it promises, and one that was stopped, killed or damaged ends with the same bits."""

import json
import os
import shutil
import signal
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from ne_dreamer_jax.runs import building, checkpoint, fork, metrics, record, run_directory, training
from tests.experiments import stub, toy

LAST = 120


class Killed(Exception):
    """Stands for the end of the process."""


def kill(_line):
    raise Killed


def terminate(_line):
    os.kill(os.getpid(), signal.SIGTERM)


def train(path, do=kill, at=None, minutes=1e9, run=None):
    """Trains in a directory; at the first line with the text ``at`` in it, does something. Returns code and lines."""
    lines, run = [], run or stub.run()

    def echo(line):
        first = at is not None and at in line and not any(at in earlier for earlier in lines)
        lines.append(line)
        if first:
            do(line)

    with run_directory.claim(path, run.config) as files:
        return training.train(run, files, checkpoint_minutes=minutes, echo=echo), lines


def measured(path):
    """Metrics lines without what depends on the clock."""
    lines = metrics.read(path / "metrics.jsonl")
    return [{name: value for name, value in line.items() if not name.startswith("time/")} for line in lines]


def last_bits(path):
    """SHA-256 of every array of the last checkpoint."""
    newest = checkpoint.checkpoints(path / "checkpoints")[0]
    assert newest.step == LAST
    assert set(newest.items) >= {"agent", "loop"}
    return {(item, name): leaf["sha256"] for item, leaves in newest.items.items() for name, leaf in leaves.items()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("finished")
    code, lines = train(path)
    assert code == 0
    return path, lines


def test_a_finished_run_leaves_its_files(finished):
    path, _ = finished
    files = [".ne_dreamer_jax", "checkpoints", "config.json", "curve.png", "metrics.jsonl", "policy.mp4"]
    assert sorted(os.listdir(path)) == files
    assert run_directory.read_config(path, type(toy.config())) == toy.config()


def test_metrics_count_steps_updates_and_episodes(finished):
    lines = measured(finished[0])
    chunks = [line for line in lines if "train/episodes" in line]
    assert all(line["train/faults"] == 0 for line in chunks)
    assert [line["env_step"] for line in chunks] == [16, 32, 48, 64, 80, 96, 112, 120]
    assert all(line["agent_step"] == line["env_step"] for line in lines)  # action repeat 1
    assert chunks[-1]["update"] == stub.run().loop.budget.updates == 50
    assert [("train/loss/total" in line) for line in chunks] == [False] + 7 * [True]  # after the prefill of 20
    assert [("train/return" in line) for line in chunks] == 7 * [True] + [False]  # no episode ends in the last chunk
    assert all(np.isfinite(value) for line in lines for value in line.values())


def test_evaluations_come_in_their_intervals_and_at_the_end(finished):
    evaluations = [line for line in measured(finished[0]) if "eval/return" in line]
    assert [line["env_step"] for line in evaluations] == [48, 96, 120]
    assert ["eval/random_return" in line for line in evaluations] == [True, False, False]
    assert len({line["eval/return"] for line in evaluations}) == 3  # each has episodes of its own


def test_a_run_says_what_it_does(finished):
    text = "\n".join(finished[1])
    for part in (
        "Compiling the training chunk",
        "Traced in",
        "updates/s",
        "left",
        "Evaluation: return",
        "Finished 120",
    ):
        assert part in text


def test_the_same_seed_gives_the_same_bits_and_another_does_not(finished, tmp_path):
    train(tmp_path)
    assert last_bits(tmp_path) == last_bits(finished[0])
    assert measured(tmp_path) == measured(finished[0])


@pytest.mark.strict
@pytest.mark.parametrize("stops", [["Compiling the training"], ["env step 48", "env step 64"]])
def test_stopping_and_going_on_changes_no_bit(finished, tmp_path, stops):
    for stop in stops:
        code, lines = train(tmp_path, terminate, stop)
        assert code == 128 + signal.SIGTERM
        assert "The same command goes on" in lines[-1]
    code, lines = train(tmp_path)
    assert code == 0
    assert any("Going on from" in line for line in lines)
    assert last_bits(tmp_path) == last_bits(finished[0])
    assert measured(tmp_path) == measured(finished[0])


@pytest.mark.strict
def test_images_on_the_host_are_saved_and_loaded_with_the_rest(tmp_path):
    run = lambda: stub.build(toy.config(storage="host"))
    code, _ = train(tmp_path / "stopped", terminate, "env step 48", run=run())
    assert code == 128 + signal.SIGTERM
    for path in (tmp_path / "stopped", tmp_path / "whole"):
        assert train(path, run=run())[0] == 0
    whole = last_bits(tmp_path / "whole")
    assert ("frames", "image") in whole
    assert last_bits(tmp_path / "stopped") == whole


@pytest.mark.strict
@pytest.mark.parametrize("at", ["env step 80", "Finished"])
def test_being_killed_and_going_on_changes_no_bit(finished, tmp_path, at):
    with pytest.raises(Killed):
        train(tmp_path, kill, at, minutes=0)
    assert train(tmp_path)[0] == 0
    assert last_bits(tmp_path) == last_bits(finished[0])
    assert measured(tmp_path) == measured(finished[0])


@pytest.mark.strict
def test_a_damaged_checkpoint_costs_only_time(finished, tmp_path):
    with pytest.raises(Killed):
        train(tmp_path, kill, "env step 80", minutes=0)
    newest = checkpoint.checkpoints(tmp_path / "checkpoints")[0]
    (newest.path / "manifest.json").write_text("{}")
    _, lines = train(tmp_path)
    assert any("Passed over a damaged checkpoint" in line for line in lines)
    assert last_bits(tmp_path) == last_bits(finished[0])
    assert measured(tmp_path) == measured(finished[0])


def damage(found, item):
    path = found.path / item / "arrays"
    path.write_bytes(bytes([path.read_bytes()[0] ^ 1]) + path.read_bytes()[1:])


@pytest.mark.strict
@pytest.mark.parametrize("item", ["agent", "loop"])
def test_a_step_whose_checkpoint_is_damaged_is_saved_again(finished, tmp_path, item):
    train(tmp_path, terminate, "env step 80", minutes=0)
    damage(checkpoint.checkpoints(tmp_path / "checkpoints")[0], item)
    with pytest.raises(Killed):
        train(tmp_path, kill, "Compiling the training")
    assert item not in checkpoint.checkpoints(tmp_path / "checkpoints")[0].items
    assert fork._newest(tmp_path).items.keys() >= {"agent"}, "what is left of it is no parent without an agent"
    train(tmp_path, terminate, "env step 80")
    _, lines = train(tmp_path)
    assert any("Going on from" in line and "000000000080" in line for line in lines)
    assert last_bits(tmp_path) == last_bits(finished[0])
    assert measured(tmp_path) == measured(finished[0])


def test_where_no_whole_checkpoint_is_left_the_best_agent_is_named(tmp_path):
    train(tmp_path, terminate, "env step 80")
    found = {entry.step: entry for entry in checkpoint.checkpoints(tmp_path / "checkpoints")}
    assert set(found) == {48, 80}
    damage(found[80], "loop")
    damage(found[80], "agent")
    with pytest.raises(checkpoint.DamagedError, match=r"000000000048 is intact: --fork .* begins a new run with it"):
        train(tmp_path)


def test_no_checkpoint_is_given_up_for_a_damaged_one_at_the_end(finished, tmp_path):
    train(tmp_path, terminate, "env step 112")
    (before,) = (tmp_path / "checkpoints").glob("*112")
    shutil.copytree(before, tmp_path / "kept")
    train(tmp_path)
    shutil.move(tmp_path / "kept", before)
    damage(checkpoint.checkpoints(tmp_path / "checkpoints")[0], "loop")
    assert train(tmp_path)[0] == 0
    _, lines = train(tmp_path)
    assert any("Going on from" in line and "000000000120" in line for line in lines)
    assert last_bits(tmp_path) == last_bits(finished[0])


def test_the_best_agent_is_kept_where_the_run_was_killed_right_after_its_evaluation(finished, tmp_path, monkeypatch):
    def die(*_):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(record.Saves, "if_best", die)
        with pytest.raises(Killed):
            train(tmp_path, minutes=0)
    train(tmp_path, minutes=0)
    best = [checkpoint.best(checkpoint.checkpoints(path / "checkpoints")) for path in (tmp_path, finished[0])]
    assert best[0].step == best[1].step
    assert best[0].score == best[1].score


def test_a_run_in_another_thread_is_a_run(finished, tmp_path):
    with ThreadPoolExecutor(1) as threads:
        assert threads.submit(train, tmp_path).result()[0] == 0
    assert last_bits(tmp_path) == last_bits(finished[0])


def test_running_a_finished_run_again_changes_nothing(finished):
    path, _ = finished
    before = {file.name: file.read_bytes() for file in path.iterdir() if file.is_file()}
    bits = last_bits(path)
    code, lines = train(path)
    assert code == 0
    assert not any("Compiling" in line for line in lines)
    assert {file: (path / file).read_bytes() for file in before} == before
    assert last_bits(path) == bits


def test_the_best_agent_is_kept(finished):
    path, _ = finished
    scores = {line["env_step"]: line["eval/return"] for line in measured(path) if "eval/return" in line}
    best = checkpoint.best(checkpoint.checkpoints(path / "checkpoints"))
    assert best is not None
    assert best.step == max(scores, key=lambda step: scores[step])
    assert best.score == scores[best.step]
    assert "agent" in best.items


def test_another_configuration_is_refused_before_anything_is_written(finished):
    path, _ = finished
    before = json.loads((path / "config.json").read_text())
    with (
        pytest.raises(run_directory.RefusedError, match=r"loop\.num_envs: 2, now 3"),
        run_directory.claim(path, toy.config(num_envs=3)),
    ):
        pass
    assert json.loads((path / "config.json").read_text()) == before


def test_a_video_that_was_not_written_is_made_up_for(finished, tmp_path):
    with pytest.raises(Killed):
        train(tmp_path, kill, "Saved the agent and the loop in")  # at the end, before the video
    assert not (tmp_path / "policy.mp4").exists()
    assert train(tmp_path)[0] == 0
    assert (tmp_path / "policy.mp4").read_bytes() == (finished[0] / "policy.mp4").read_bytes()
    assert measured(tmp_path) == measured(finished[0])


def test_an_agent_without_pixels_leaves_no_video(tmp_path):
    assert train(tmp_path, run=stub.build(toy.config(), image=False))[0] == 0
    assert (tmp_path / "curve.png").exists()
    assert not (tmp_path / "policy.mp4").exists()


@pytest.mark.parametrize("broken", ["no ffmpeg", "in the way", "no frames"])
def test_a_run_whose_pictures_fail_is_finished_all_the_same(finished, tmp_path, monkeypatch, broken):
    run = stub.run()
    do = (lambda line: (tmp_path / "curve.png").mkdir()) if broken == "in the way" else lambda line: None
    if broken == "no ffmpeg":
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/nonexistent/ffmpeg")
    if broken == "no frames":
        loop = run.loop
        evaluate = lambda *args, **options: loop.evaluate(*args, **options)._replace(frames=None)
        run = run._replace(loop=loop._replace(evaluate=evaluate))
    for _ in range(2):  # also when it is started again
        code, lines = train(tmp_path, do, "Compiling", run=run)
        assert code == 0
        assert "more episodes" in lines[-1]
    name = "curve.png" if broken == "in the way" else "policy.mp4"
    assert sum("Could not draw" in line and name in line for line in lines) == 1  # of the second start
    assert last_bits(tmp_path) == last_bits(finished[0])


def test_an_error_of_the_evaluation_is_no_missing_picture(tmp_path):
    run = stub.run()

    def evaluate(*args, **options):
        raise ValueError("from the policy")

    with pytest.raises(ValueError, match="from the policy"):
        train(tmp_path, run=run._replace(loop=run.loop._replace(evaluate=evaluate)))


def hang_up(_line):
    for _ in range(3):  # as shells and the system do, one after the other
        os.kill(os.getpid(), signal.SIGHUP)


@pytest.mark.strict
def test_a_terminal_that_is_closed_stops_the_run_where_it_can_go_on(finished, tmp_path, monkeypatch):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which nohup ignores
    code, lines = train(tmp_path, hang_up, "env step 48")
    assert code == 128 + signal.SIGHUP
    assert "The same command goes on" in lines[-1]
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_DFL
    assert train(tmp_path)[0] == 0
    assert last_bits(tmp_path) == last_bits(finished[0])


def test_a_hang_up_is_ignored_where_it_is_to_be(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        assert train(tmp_path, hang_up, "env step 48")[0] == 0
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.slow
@pytest.mark.strict
def test_the_real_loop_goes_on_to_the_same_bits(tmp_path):
    run = building.build(toy.config(), toy.env())
    assert train(tmp_path / "straight", run=run)[0] == 0
    assert train(tmp_path / "stopped", terminate, "env step 80", run=run)[0] == 128 + signal.SIGTERM
    again = building.build(toy.config(), toy.env())  # as another process would make it
    assert train(tmp_path / "stopped", run=again)[0] == 0
    assert last_bits(tmp_path / "stopped") == last_bits(tmp_path / "straight")
    assert measured(tmp_path / "stopped") == measured(tmp_path / "straight")
    assert measured(tmp_path / "straight")[-1]["update"] == run.loop.budget.updates


def test_metrics_of_a_run_whose_checkpoints_are_gone_are_kept(tmp_path):
    train(tmp_path)
    before = (tmp_path / "metrics.jsonl").read_bytes()
    shutil.rmtree(tmp_path / "checkpoints")
    code, lines = train(tmp_path)
    assert code == 0
    assert any("There is no checkpoint: beginning anew." in line for line in lines)
    assert (tmp_path / "metrics-earlier-1.jsonl").read_bytes() == before
    shutil.rmtree(tmp_path / "checkpoints")
    second = (tmp_path / "metrics.jsonl").read_bytes() + b'{"env_step": 1'  # a line that was cut short
    (tmp_path / "metrics.jsonl").write_bytes(second)
    train(tmp_path)
    assert (tmp_path / "metrics-earlier-1.jsonl").read_bytes() == before
    assert (tmp_path / "metrics-earlier-2.jsonl").read_bytes() == second
