"""A run is the same on any number of devices and processes. Computed on virtual CPU devices, in other processes."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.loop import placement
from ne_dreamer_jax.runs import metrics
from ne_dreamer_jax.system import parallel
from tests import counting

ROOT = Path(__file__).parents[1]


def start(*command, devices):
    """A Python process with so many virtual devices."""
    flags = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(
        [sys.executable, "-m", *map(str, command)], env={**os.environ, **flags}, cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def compute(*parts):
    process = start("tests.devices", *parts, devices=8)
    out, err = process.communicate(timeout=800)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])


@pytest.fixture(scope="module")
def computed():
    return compute("environments_and_replay", "images_on_the_host", "collectives", "moved", "model_free")


@pytest.mark.strict
def test_environments_and_replay_are_the_same_to_the_bit_on_any_number_of_devices(computed):
    got = computed["environments_and_replay"]
    for storage in ("pixels", "states", "host"):
        assert set(got[f"equal, {storage}"]) == {True}
        assert set(got[f"placed, {storage}"]) == {True}
        assert got[f"share, {storage}"] == 8
    assert got["frames, host"] == 2
    assert got["updates"] > 10
    assert got["evaluation"]


def test_images_go_to_the_host_and_back_from_any_device(computed):
    assert computed["images_on_the_host"] == 0


def test_no_pixels_travel(computed):
    """All that devices tell each other while collecting and sampling are the sums that a chunk reports."""
    counts = computed["collectives"]
    assert counts.pop("all-reduce") <= 8
    assert not any(counts.values()), counts


@pytest.mark.strict
def test_checkpoints_move_between_numbers_of_devices(computed):
    assert computed["moved"] == {"1 to 8": True, "8 to 1": True, "8 to 2": True}


def test_the_model_free_baselines_losses_are_those_of_one_device(computed):
    one, eight = computed["model_free"]
    assert one.keys() == eight.keys() > {"loss/critic", "loss/actor"}
    assert one["policy steps"] > 0
    for name in one:
        np.testing.assert_allclose(eight[name], one[name], rtol=1e-4, atol=1e-5, err_msg=name)


@pytest.mark.slow
def test_the_whole_agents_losses_are_those_of_one_device():
    """Barlow Twins standardises over the global batch, or its loss would differ by far more."""
    computed = compute("whole_agent")
    one, eight, in_parts = (computed["whole_agent"][devices] for devices in ("1 in 1", "8 in 1", "8 in 2"))
    learned = 0
    for a, b, c in zip(one, eight, in_parts, strict=True):
        assert set(a) == set(b) == set(c)
        for name in a:
            np.testing.assert_allclose(b[name], a[name], rtol=1e-4, atol=1e-5, err_msg=name)
            np.testing.assert_allclose(c[name], a[name], rtol=1e-4, atol=1e-5, err_msg=name)
        learned += "loss/next_embedding" in a
    assert learned > 10


def trained(logdir, processes, *stop_at):
    """Exit codes of the processes of a toy run."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    group = [start("tests.processes", logdir, processes, i, port, *stop_at, devices=1) for i in range(processes)]
    try:
        ends = [process.communicate(timeout=600) for process in group]
    finally:
        for process in group:
            process.kill()
    codes = [process.returncode for process in group]
    assert len(set(codes)) == 1, ends
    return codes[0], ends


@pytest.mark.slow
def test_two_processes_train_as_one_does_and_one_goes_on_from_their_checkpoint(tmp_path):
    code, ends = trained(tmp_path / "one", 1)
    assert code == 0, ends
    code, ends = trained(tmp_path / "two", 2, "env step 80")
    assert code == 128 + signal.SIGTERM, ends
    assert {line["env_step"] for line in metrics.read(tmp_path / "two" / "metrics.jsonl")} >= {16, 48, 80}
    code, ends = trained(tmp_path / "two", 1)
    assert code == 0, ends
    assert "Going on from" in ends[0][0]
    one, two = (metrics.read(tmp_path / name / "metrics.jsonl") for name in ("one", "two"))
    assert len(one) == len(two) > 8
    for a, b in zip(one, two, strict=True):
        assert set(a) == set(b)
        for name in a:
            if not name.startswith("time/"):
                np.testing.assert_allclose(b[name], a[name], rtol=1e-3, atol=1e-4, err_msg=name)


@pytest.mark.slow
def test_processes_with_other_settings_are_all_refused(tmp_path):
    code, ends = trained(tmp_path, 2, "never", "other seeds")
    assert code == 1
    assert all("expected the same options in all processes that train together" in err for _, err in ends)


@pytest.mark.parametrize("changes", [{"num_envs": 3}, {"batch_size": 3}])
def test_shares_must_be_equal(changes):
    class TwoDevices:
        size = 2

    env = counting.env()
    agent = counting.stub(env.spec, changes.get("batch_size", 2))
    config = loops.LoopConfig(num_envs=changes.get("num_envs", 2))
    with pytest.raises(ValueError, match=r"expected a multiple of the 2 devices, got 3"):
        loops.make(config, env, agent, 1, TwoDevices())


def test_every_device_has_its_share_of_every_microbatch():
    class TwoDevices:
        size = 2

    assert placement.check_divisible(TwoDevices(), 2, 8, 4) == 2
    with pytest.raises(ValueError, match=r"expected 4 parts of agent\.batch_size 4 that the 2 devices divide"):
        placement.check_divisible(TwoDevices(), 2, 4, 4)


def test_devices_that_are_not_there_are_refused():
    with pytest.raises(ValueError, match="expected 1 to 1 devices, as many as each process has, got 2"):
        parallel.make_mesh(2)


def test_one_process_agrees_with_itself():
    assert parallel.agreed(3, True) == (3, True)
