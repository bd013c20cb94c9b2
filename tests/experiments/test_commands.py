"""The commands refuse what is mistyped before JAX loads, and anything that is not theirs."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

from experiments import evaluate, train
from ne_dreamer_jax import config as configs
from ne_dreamer_jax import envs, settings
from ne_dreamer_jax.commands.train import FLAGS
from ne_dreamer_jax.runs import checkpoint, evaluation, run_directory, training
from ne_dreamer_jax.settings import names
from tests.experiments import stub, toy


def invoke(command, *arguments):
    result = CliRunner().invoke(command.main, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, " ".join(result.output.split())


MISTYPED = {
    ("--task", "dmc/walker_wlak"): "no environment is called 'dmc/walker_wlak'. Did you mean dmc/walker_walk",
    ("--method", "ne_dreamr"): "no method is called 'ne_dreamr'. Did you mean ne_dreamer",
    ("--preset", "quickstrat"): "no preset is called 'quickstrat'. Did you mean quickstart?",
    ("--size", "12"): "no size is called '12'. Did you mean 12m",
    ("--obs", "pixel"): "no observation is called 'pixel'. Did you mean pixels?",
    ("--replay-ration", "1"): "No such option '--replay-ration'. Did you mean '--replay-ratio'?",
    ("--env-steps", "0"): "Invalid value for '--env-steps'",
    ("--checkpoint-minutes", "nan"): "expected a number of minutes, got 'nan'",
}


@pytest.mark.parametrize("arguments", MISTYPED)
def test_a_mistyped_name_brings_the_nearest_and_exit_code_2(tmp_path, arguments):
    code, output = invoke(train, "--logdir", tmp_path / "run", *arguments)
    assert code == 2
    assert MISTYPED[arguments] in output
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("arguments", [["--task", "dmc/walker_wlak", "--logdir", "x"], ["--help"], []])
def test_names_are_checked_before_jax_loads(arguments):
    code = (
        "import sys; from experiments.train import main\n"
        f"try: main({arguments!r})\n"
        "finally: print('loaded' if {'jax', 'numpy', 'mujoco'} & set(sys.modules) else 'light')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == (0 if arguments == ["--help"] else 2)
    assert done.stdout.split()[-1] == "light"


def test_a_mistyped_setting_is_refused(tmp_path):
    code, output = invoke(train, "--logdir", tmp_path / "run", "--set", "agent.optimizer.learning_rat=1")
    assert code == 2
    assert "no setting is called 'agent.optimizer.learning_rat'. Did you mean agent.optimizer.learning_rate" in output
    assert not (tmp_path / "run").exists()


def test_directories_that_are_not_this_run_are_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    code, output = invoke(train, "--logdir", tmp_path)
    assert (code, "holds something that is not a run (thesis.tex)" in output) == (2, True)
    code, output = invoke(evaluate, tmp_path)
    assert (code, "expected the --logdir of a run" in output) == (2, True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]

    run = tmp_path / "run"
    with run_directory.claim(run, configs.preset("smoke")):
        pass
    before = (run / "config.json").read_text()
    code, output = invoke(train, "--preset", "smoke", "--seed", 1, "--logdir", run)
    assert (code, "They differ in seed: 0, now 1" in output) == (2, True)
    assert (run / "config.json").read_text() == before


def test_what_does_not_fit_memory_leaves_no_directory(tmp_path):
    code, output = invoke(
        train, "--preset", "smoke", "--obs", "vector", "--env-steps", 10**12, "--set", "loop.capacity=2e9",
        "--logdir", tmp_path / "run",
    )  # fmt: skip
    assert code == 2
    assert "expected a capacity of at most" in output
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "arguments",
    [["--processes", 2], ["--coordinator", "localhost:1"], ["--coordinator", "x:1", "--processes", 2, "--process", 2]],
)
def test_processes_need_a_coordinator_and_a_number_each(tmp_path, arguments):
    code, output = invoke(train, "--logdir", tmp_path / "run", *arguments)
    assert (code, "expected --coordinator, --processes and --process together" in output) == (2, True)
    assert not (tmp_path / "run").exists()


def test_more_devices_than_there_are_leave_no_directory(tmp_path):
    code, output = invoke(train, "--preset", "smoke", "--devices", 1024, "--logdir", tmp_path / "run")
    assert (code, "as many as each process has, got 1024" in output) == (2, True)
    assert not (tmp_path / "run").exists()


def test_determinism_is_asked_of_xla_beside_what_the_user_asks(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert invoke(train, "--settings", "--deterministic")[0] == 0
    assert os.environ["XLA_FLAGS"] == "--xla_cpu_enable_fast_math=false --xla_gpu_deterministic_ops=true"


def test_options_and_settings_shape_the_configuration():
    config = train.configure(
        "smoke", None, "ne_dreamer/no_shift", {"env.task": "dmc/reacher_easy", "seed": 3, "loop.num_envs": None},
        ["loop.num_envs=5", "agent.rssm.deter=64"],
    )  # fmt: skip
    assert (config.env.task, config.seed, config.method) == ("dmc/reacher_easy", 3, "ne_dreamer/no_shift")
    assert (config.loop.num_envs, config.agent.rssm.deter, config.agent.objective.shift) == (5, 64, 0)
    assert config.loop.replay_ratio == configs.preset("smoke").loop.replay_ratio


def test_drqv2_is_set_up_for_the_task():
    """Whichever of the two is said first: its authors chose some settings by task."""
    config = train.configure("dmc", None, "drqv2", {"env.task": "dmc/cheetah_run", "seed": 1})
    assert (config.method, config.agent.n_step, config.agent.noise_steps) == ("drqv2", 3, 500_000)
    assert config.loop.replay_ratio == 256 * 6 / 2


def test_every_option_names_a_setting():
    flags = {option.name for option in train.main.params} & set(FLAGS)
    assert flags == set(FLAGS)
    assert set(FLAGS.values()) <= set(settings.paths(configs.preset("dmc")))


def test_help_names_every_preset_method_size_and_task():
    _, output = invoke(train, "--help")
    for name in (*names.PRESETS, *names.METHODS, *names.SIZES, *names.OBSERVATIONS, *envs.names()):
        assert name in output.replace("- ", "-")


def test_light_names_are_those_of_the_configuration():
    assert set(names.PRESETS) == set(configs.PRESETS)
    assert set(names.SIZES) == set(configs.SIZES)


@pytest.mark.parametrize("preset", names.PRESETS)
@pytest.mark.parametrize("method", names.METHODS)
def test_every_configuration_survives_json_and_its_own_settings(preset, method):
    config = train.configure(preset, None, method, {})
    assert settings.from_dict(type(config), json.loads(json.dumps(settings.to_dict(config)))) == config
    rebuilt = config
    for path, value in settings.paths(config).items():
        rebuilt = settings.override(rebuilt, f"{path}={settings.as_text(value)}")
    assert rebuilt == config


def test_settings_are_printed_as_they_are_taken():
    code, output = invoke(train, "--preset", "smoke", "--settings", "--set", "agent.batch_size=3")
    assert code == 0
    assert "agent.batch_size=3 " in output
    assert f"loop.env_steps={configs.preset('smoke').loop.env_steps} " in output


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    run = stub.run()
    with run_directory.claim(path, run.config) as files:
        training.train(run, files, echo=lambda line: None)
    return path


def play_as(monkeypatch, run):
    """Has the policies of stored runs played as this run plays."""

    def load(path, env=None, prefer="best"):
        found = checkpoint.restore(path / "checkpoints", {"agent": run.shapes.train}, prefer=prefer)
        return evaluation.Loaded(run.config, toy.env(), run.agent, found.items["agent"], found.checkpoint, ())

    monkeypatch.setattr(evaluation, "load", load)
    monkeypatch.setattr(evaluation, "make_play", lambda env, agent, max_steps: run.loop.evaluate)


@pytest.mark.parametrize("which", ["best", "newest"])
def test_evaluate_plays_a_stored_policy_beside_a_random_one(trained, monkeypatch, which):
    play_as(monkeypatch, stub.run())
    code, output = invoke(evaluate, trained, "--episodes", 3, "--video", "--checkpoint", which)
    assert code == 0
    assert "policy return" in output
    assert "random return" in output
    assert "policy.mp4 shows the first episode" in output
    result = json.loads((trained / "evaluation.json").read_text())
    assert len(result["policy"]["returns"]) == len(result["random"]["returns"]) == result["episodes"] == 3
    np.testing.assert_allclose(result["policy"]["mean"], np.mean(result["policy"]["returns"]))
    assert result["policy"]["returns"] != result["random"]["returns"]
    first = (trained / "evaluation.json").read_text()
    play_as(monkeypatch, stub.build(toy.config(), image=False))
    _, output = invoke(evaluate, trained, "--episodes", 3, "--video", "--checkpoint", which)
    assert "no video: this environment has no images" in output
    assert (trained / "evaluation.json").read_text() == first  # the same seed, the same episodes


@pytest.mark.slow
def test_the_smoke_preset_trains_from_pixels_and_is_evaluated(tmp_path):
    path = tmp_path / "run"

    def run(module, *arguments):
        command = [sys.executable, "-m", f"experiments.{module}", *map(str, arguments)]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    output = run("train", "--preset", "smoke", "--logdir", path)
    assert "Finished" in output
    assert {"curve.png", "policy.mp4", "metrics.jsonl", "config.json", "checkpoints"} <= {
        entry.name for entry in path.iterdir()
    }
    output = run("evaluate", path, "--episodes", 2, "--video")
    assert "policy" in output
    assert json.loads((path / "evaluation.json").read_text())["random"]["mean"] > 0
