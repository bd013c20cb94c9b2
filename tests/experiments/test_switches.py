"""Variants of a configuration side by side: what is trained, what is kept, and what is said of their difference."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from experiments import switches
from ne_dreamer_jax.system import memory

VARIANTS = ["agent.behavior.lam=0.95", "agent.behavior.lam=0.9,agent.behavior.horizon=5"]
RETURNS = {VARIANTS[0]: [[1.0, 10.0], [2.0, 12.0], [0.0, 11.0]], VARIANTS[1]: [[5.0, 20.0], [4.0, 24.0], [6.0, 22.0]]}


@pytest.fixture
def invoke(monkeypatch, tmp_path):
    trained = []
    stopping_at = {}

    def train(config, variant, seeds, before=None):
        trained.append((config.env.task, variant, config.agent.behavior.horizon))
        for seed in seeds:
            assert before is None or seed == before["seeds"] or seed > seeds[0]
            if seed == stopping_at.get(variant):
                raise KeyboardInterrupt
            plain = switches.plain(config)
            yield {"task": config.env.task, "variant": variant, "seeds": seed + 1, "config": plain} | {
                "env_steps": [50, 100],
                "curves": RETURNS[variant][: seed + 1],
                "minutes": 1.0,
            }

    monkeypatch.setattr(switches, "train", train)

    def call(*arguments):
        done = CliRunner().invoke(switches.main, [str(tmp_path / "out.jsonl"), *arguments])
        return done.exit_code, done.output, trained

    call.stopping_at = stopping_at
    return call


def test_variants_are_trained_once_and_compared(invoke, tmp_path):
    code, output, trained = invoke(*VARIANTS, "--seeds", "3", "--task", "dmc/cartpole_swingup")
    assert code == 0, output
    assert [(task, horizon) for task, _, horizon in trained] == [("dmc/cartpole_swingup", h) for h in (10, 5)]
    assert "| 20 24 22 | 22.0 | 13.5 | +11.0 (" in output
    assert "+7.5 (" in output
    code, again, trained = invoke(*VARIANTS, "--seeds", "3", "--task", "dmc/cartpole_swingup")
    assert len(trained) == 2, "what is there is not trained again"
    assert again.splitlines()[-2:] == output.splitlines()[-2:]
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 2
    other = ["--seeds", "3", "--task", "dmc/cartpole_swingup", "--set", "agent.behavior.discount=0.9"]
    _, output, trained = invoke(VARIANTS[1], *other)
    assert len(trained) == 3, "another configuration is another line"
    assert "| 20 24 22 | 22.0 | 13.5 |  |  |" in output, "and compared with none of an earlier command"
    assert VARIANTS[0] not in output


def test_a_variant_may_be_the_preset_itself(invoke, monkeypatch):
    monkeypatch.setitem(RETURNS, "default", RETURNS[VARIANTS[0]])
    code, output, trained = invoke("default", VARIANTS[1], "--seeds", "3", "--task", "dmc/cartpole_swingup")
    assert code == 0, output
    assert [horizon for _, _, horizon in trained] == [10, 5]
    assert "| `default` | 10 12 11 |" in output


def test_results_are_found_again_however_the_variant_is_spelt(invoke):
    invoke("agent.behavior.lam=0.95", "--seeds", "3")
    code, output, trained = invoke("agent.behavior.lam=0.950", "--seeds", "3")
    assert (code, len(trained)) == (0, 1)
    assert "| `agent.behavior.lam=0.950` | 10 12 11 |" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["defualt"], "expected 'default' or PATH=VALUE as a variant, got 'defualt'"),
        (["default", "--set", "loop.env_steps=100"], "loop.env_steps: expected enough for an update"),
    ],
)
def test_what_can_tell_nothing_is_refused(invoke, tmp_path, arguments, message):
    code, output, trained = invoke(*arguments)
    assert (code, trained, list(tmp_path.iterdir())) == (2, [], [])
    assert message in " ".join(output.split())


def test_seeds_that_are_there_are_kept_whatever_ends_the_command(invoke, tmp_path):
    invoke.stopping_at[VARIANTS[0]] = 1
    code, _, _ = invoke(VARIANTS[0], "--seeds", "3")
    assert code != 0
    (line,) = map(json.loads, (tmp_path / "out.jsonl").read_text().splitlines())
    assert line["seeds"] == 1
    invoke.stopping_at.clear()
    code, output, trained = invoke(VARIANTS[0], "--seeds", "3")
    assert code == 0
    assert "seed 0:" not in output
    (line,) = map(json.loads, (tmp_path / "out.jsonl").read_text().splitlines())
    assert line["curves"] == RETURNS[VARIANTS[0]]
    switches._keep(tmp_path / "out.jsonl", line | {"seeds": 1}, lambda _: True)  # of a command that is behind
    assert json.loads((tmp_path / "out.jsonl").read_text())["seeds"] == 3
    _, output, again = invoke(VARIANTS[0], "--seeds", "2")
    assert len(again) == len(trained) == 2, "fewer seeds are there already"
    assert "| 10 12 | 11.0 |" in output


@pytest.mark.parametrize("text", ["{", '{"config": 1}\n', "3\n", "\xff"])
def test_a_file_with_something_else_in_it_is_refused_and_left_alone(invoke, tmp_path, text):
    path = tmp_path / "out.jsonl"
    path.write_bytes(text.encode("latin-1"))
    code, output, trained = invoke(VARIANTS[0], "--seeds", "2")
    assert (code, trained, path.read_bytes()) == (2, [], text.encode("latin-1"))
    assert "out.jsonl" in output


def test_a_variant_may_be_of_another_method_and_have_values_with_commas(invoke, monkeypatch):
    variant = "agent.behavior.return_percentiles=10,95,agent.behavior.lam=0.9"
    monkeypatch.setitem(RETURNS, variant, RETURNS[VARIANTS[0]])
    code, output, trained = invoke(variant, "--small", "--method", "r2dreamer", "--seeds", "2")
    assert (code, len(trained)) == (0, 1), output


def test_an_interval_holds_the_difference_that_there_is():
    """Of 400 pairs of samples whose means differ by one, about 95 in 100."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(400):
        text = switches.difference(rng.normal(1.0, 1.0, 5), rng.normal(0.0, 3.0, 8))
        low, high = (float(x) for x in text.split("(")[1].rstrip(")").split(" to "))
        held += low <= 1.0 <= high
    assert 0.91 < held / 400 < 0.985


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["agent.behavior.lamda=0.9"], "lam"),
        ([VARIANTS[0], "--task", "dmc/cartpole_swingpu"], "cartpole_swingup"),
        ([], "Missing argument"),
        ([VARIANTS[0], VARIANTS[0]], "expected variants that differ"),
        (["agent.behavior.lam=0.9,seed=1"], "of which --seeds says how many"),
        ([VARIANTS[0], "--set", "seed =1"], "of which --seeds says how many"),
    ],
)
def test_what_does_not_fit_is_said_before_anything_trains(invoke, arguments, message):
    code, output, trained = invoke(*arguments)
    assert code == 2
    assert message in output
    assert trained == []


def test_what_does_not_fit_into_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: 10**9)
    out = str(tmp_path / "out.jsonl")
    options = ["--small", "--obs", "vector", "--set", "loop.env_steps=1e12", "--set", "loop.capacity=2e9"]
    done = CliRunner().invoke(switches.main, [out, VARIANTS[0], *options])
    assert done.exit_code == 2, done.output
    assert "expected a capacity of at most" in done.output


def test_a_file_that_cant_be_written_is_refused_before_anything_trains(invoke, tmp_path):
    (tmp_path / "file").touch()
    done = CliRunner().invoke(switches.main, [str(tmp_path / "file" / "out.jsonl"), VARIANTS[0]])
    assert done.exit_code == 2, done.output
    assert "can't be written" in done.output


def test_seeds_without_spread_have_no_interval():
    assert switches.difference(np.full(3, 1000.0), np.zeros(3)) == "+1000.0 (no spread)"


@pytest.mark.slow
def test_a_variant_trains_each_seed_for_itself(tmp_path):
    out = tmp_path / "out.jsonl"
    small = ["--small", "--obs", "vector", "--preset", "smoke", "--task", "dmc/cartpole_balance"]
    steps = ["--set", "loop.env_steps=2000", "--set", "loop.eval_every=1000"]
    done = CliRunner().invoke(switches.main, [str(out), VARIANTS[0], *small, *steps, "--seeds", "2"])
    assert done.exit_code == 0, done.output
    (line,) = map(json.loads, out.read_text().splitlines())
    curves = np.asarray(line["curves"])
    assert line["env_steps"] == [1000, 2000]
    assert curves.shape == (2, 2)
    assert (curves > 0).all()
    assert (curves[0] != curves[1]).any()
