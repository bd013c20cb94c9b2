"""A finished or stopped run, loaded again: to act with it, and to play episodes with its policy."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from ne_dreamer_jax.agents import make_agent
from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.config import Config
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs.config import EnvConfig, OwnConfig
from ne_dreamer_jax.envs.vector import VectorEnv, as_vector, check_env
from ne_dreamer_jax.loop.play import Evaluation, make_play
from ne_dreamer_jax.runs import checkpoint, pictures, run_directory, video
from ne_dreamer_jax.runs.run_directory import RunDirectory
from ne_dreamer_jax.types import Array

Prefer = Literal["best", "newest"]
EVALUATION = 0x65_76_61_6C
"""Sets these episodes apart from those of a run with the same seed."""


class Loaded(NamedTuple):
    """A run's agent with what it learned, and its environment."""

    config: Config
    env: Any  # `envs.base.Env` or `VectorEnv`
    agent: Agent
    state: Any  # the agent's train state; ``state.params`` is what ``agent.act`` takes
    checkpoint: checkpoint.Checkpoint
    skipped: tuple[str, ...]  # damaged checkpoints that were passed over, a reason each


def load(run: str | Path, env: Any = None, prefer: Prefer = "best") -> Loaded:
    """The agent of a run directory. Neither replay nor the environments' states are read.

    Args:
      run: the run's directory.
      env: the environment, for a run that was trained on one given in code.
      prefer: the checkpoint with the best evaluation during training, or the newest.

    Raises:
      RefusedError: there is no run, or one of another version.
      ValueError: the run's environment has no name and none is given, or the one that is given does not fit the agent.
      FileNotFoundError, DamagedError: there is no checkpoint, or none that can be used.
    """
    path = Path(run).expanduser()
    config = run_directory.read_config(path, Config)
    if env is None:
        env = env_configs.make(config.env)
    elif not isinstance(config.env, OwnConfig):
        raise ValueError(
            f"{path} is a run of {config.env.task}; expected no other environment for it. To see how its agent does "
            "elsewhere, load it without env, and step the other environment with loaded.agent.act"
        )
    check_env(env)
    agent = make_agent(config.agent, env.spec)
    like = jax.eval_shape(agent.init, jax.random.key(0))
    restored = checkpoint.restore(RunDirectory(path).checkpoints, {"agent": like}, prefer=prefer)
    return Loaded(config, env, agent, restored.items["agent"], restored.checkpoint, tuple(restored.skipped))


def evaluate(
    run: str | Path,
    env: Any = None,
    *,
    episodes: int = 10,
    prefer: Prefer = "best",
    seed: int = 0,
    with_video: bool = False,
    also: str | None = None,
    echo: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Plays episodes with the policy of a run, beside a random policy's, and stores what came out.

    Args:
      run, env, prefer: as for `load`, with its errors.
      episodes: M, played together.
      seed: of the episodes' beginnings.
      with_video: whether to write the first episode to ``policy.mp4``. Where the agent sees vectors alone, DeepMind
        Control's tasks are drawn for that.
      also: name of an environment to play as many episodes in, too: another with the same observations and actions.
      echo: takes the lines for people.

    Returns:
      What ``evaluation.json`` holds: ``task``, ``env_step``, ``episodes``, ``seed``, and for ``policy`` and ``random``
      the ``mean``, ``std``, ``returns`` and ``lengths``, the number ``unfinished`` at ``loop.eval_max_steps`` and the
      number ``cut`` by faults of the environment;
      ``also`` holds the same of the other environment.

    Raises:
      ValueError: as `load`; or the other environment is observed or acted in otherwise; or environments in worker
        processes fail.
    """
    path = Path(run).expanduser()
    loaded = load(path, env, prefer)
    if with_video and env is None:
        loaded = in_env(loaded, env_configs.with_images(loaded.config.env))  # the agent does not see them
    with opened(loaded.env) as venv, contextlib.ExitStack() as stack:
        other = None if also is None else stack.enter_context(opened(_other(also, loaded)))
        return _evaluate(path, loaded, venv, other, also, episodes, seed, with_video, echo)


@contextlib.contextmanager
def opened(env: Any) -> Iterator[VectorEnv]:
    """Environments at once of ``env``, closed at the end of the block.

    Raises:
      ValueError: they are in worker processes that fail within the block.
    """
    venv = as_vector(env)
    try:
        yield venv
    except jax.errors.JaxRuntimeError as error:
        if venv.host is None or venv.host.failure is None:
            raise
        raise ValueError(f"the environments failed: {venv.host.failure}") from error
    finally:
        if venv.host is not None:
            venv.host.close()


def _evaluate(
    path: Path,
    loaded: Loaded,
    venv: VectorEnv,
    other: VectorEnv | None,
    also: str | None,
    episodes: int,
    seed: int,
    with_video: bool,
    echo: Callable[[str], None],
) -> dict[str, Any]:
    content = head(loaded, episodes, seed, echo)
    play = make_play(venv, loaded.agent, loaded.config.loop.eval_max_steps)
    echo(f"Compiling, and playing {episodes} episodes with the policy, then {episodes} at random.")
    files = RunDirectory(path)
    for name, key in keys(seed).items():
        evaluation = play(loaded.state.params, key, episodes, random=name == "random", frames=with_video)
        content[name] = summary(evaluation)
        for told in venv.host.lines() if venv.host is not None else ():
            echo(told)
        echo(line(name, evaluation))
        if with_video and name == "policy":
            _video(evaluation, files, venv.step_seconds, echo)
    if also is not None and other is not None:
        run_directory.write_evaluation(files, content)  # whatever becomes of the other
        content["also"] = {"task": also} | _play_also(also, other, loaded, episodes, seed, echo)
    run_directory.write_evaluation(files, content)
    return content


def in_env(loaded: Loaded, config: EnvConfig) -> Loaded:
    """With an environment of these settings, which shows at least what the agent sees, in place of its own."""
    if config == loaded.config.env:
        return loaded
    replaced = as_vector(loaded.env)
    if replaced.host is not None:
        replaced.host.close()
    return loaded._replace(env=env_configs.make(config))


def _other(task: str, loaded: Loaded) -> VectorEnv:
    """The environment of this name, with the run's settings where it has such. Raises ValueError as `evaluate`."""
    env = as_vector(env_configs.make(env_configs.for_task(task, loaded.config.env)))
    for what, expected, got in zip(("observations", "actions"), loaded.agent.spec, env.spec, strict=True):
        if expected != got:
            if env.host is not None:
                env.host.close()
            raise ValueError(f"{task}: expected the {what} of {loaded.config.env.task}, {expected}, got {got}")
    return env


def _play_also(
    task: str, env: VectorEnv, loaded: Loaded, episodes: int, seed: int, echo: Callable[[str], None]
) -> dict[str, Any]:
    play = make_play(env, loaded.agent, loaded.config.loop.eval_max_steps)
    content = {}
    for name, key in keys(seed).items():
        evaluation = play(loaded.state.params, key, episodes, random=name == "random")
        content[name] = summary(evaluation)
        echo(line(name, evaluation, f" in {task}"))
    return content


def head(loaded: Loaded, episodes: int, seed: int, echo: Callable[[str], None]) -> dict[str, Any]:
    """Says which checkpoint is evaluated; the result's first entries."""
    for reason in loaded.skipped:
        echo(f"Passed over a damaged checkpoint: {reason}")
    config, found = loaded.config, loaded.checkpoint
    scored = "" if found.score is None else f", where its evaluation returned {found.score:.1f}"
    echo(f"{config.env.task}, {config.method}, after {found.step:,} environment steps{scored} ({found.path})")
    return {"task": config.env.task, "env_step": found.step, "episodes": episodes, "seed": seed}


def keys(seed: int) -> dict[str, Array]:
    """The keys of the policy's episodes, and of the random policy's."""
    policy_key, random_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), EVALUATION))
    return {"policy": policy_key, "random": random_key}


def summary(evaluation: Evaluation) -> dict[str, Any]:
    """Returns and lengths as what `json.dumps` takes."""
    returns = np.asarray(evaluation.returns, np.float64)
    mean, deviation = mean_and_deviation(returns)
    return {
        "mean": mean,
        "std": deviation,
        "returns": [float(value) for value in returns],
        "lengths": [int(value) for value in evaluation.lengths],
        "unfinished": evaluation.unfinished,
        "cut": int((~np.asarray(evaluation.complete)).sum()),
    }


def mean_and_deviation(returns: np.ndarray) -> tuple[float, float]:
    """Of returns [M], some of which may have overflown."""
    with np.errstate(invalid="ignore", over="ignore"):
        return float(returns.mean()), float(returns.std())


def line(name: str, evaluation: Evaluation, where: str = "") -> str:
    """An evaluation in words."""
    returns = np.asarray(evaluation.returns, np.float64)
    open_end = f", {evaluation.unfinished} of them not ended" if evaluation.unfinished else ""
    cut = int((~np.asarray(evaluation.complete)).sum())
    open_end += f", {cut} of them CUT SHORT by faults of the environment or its actions" if cut else ""
    mean, deviation = mean_and_deviation(returns)
    return f"{name:7} return {mean:8.1f} ± {deviation:.1f} over {len(returns)} episodes{open_end}{where}"


def _video(
    evaluation: Evaluation, files: RunDirectory, step_seconds: float | None, echo: Callable[[str], None]
) -> None:
    if evaluation.frames is None:
        echo("no video: this environment has no images")
        return
    write = lambda: video.write(evaluation.frames, files.video, fps=video.frame_rate(step_seconds))
    if pictures.attempt(write, files.video, echo):
        echo(f"{files.video} shows the first episode")
