"""Trains the authors' released code from vectors: ``python -m tests.released.learn CHECKOUT OUT --task TASK --seed N``.

CHECKOUT is a copy of https://github.com/corl-team/nedreamer (commit 11cd3a97), which is run from where it lies; it
needs what `compare` needs and torchrl. Agent, replay, trainer and the environments' wrappers are theirs, with fresh
weights, in float32 without mixed precision or compilation, on one core; environments are stepped in this process, and
nothing is drawn. OUT/metrics.jsonl has the names that our own runs write. The command that trains this package at the
same setting is printed first, and `curves` lays the runs of both over each other.

What is mended: their replay moves each sequence's actions by one step in place, between overlapping slices, which
leaves wrong actions behind on a CPU. With --as-published it stays as it is.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import re
import shlex
import sys
import time
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from ne_dreamer_jax import settings
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.commands import train
from ne_dreamer_jax.commands.options import Task, refusing
from ne_dreamer_jax.config import Config
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs.config import DmcConfig
from ne_dreamer_jax.loop.budget import Budget
from ne_dreamer_jax.objectives import NextEmbedding
from ne_dreamer_jax.runs import metrics
from tests.released import compare, curves
from tests.released.compare import torch

METHOD = "ne_dreamer"
SMALL = (
    "agent.rssm.deter=256",
    "agent.objective.predictor.layers=1",
    "agent.objective.predictor.width=64",
    "agent.objective.predictor.feedforward=256",
    "agent.behavior.horizon=10",
    "agent.behavior.discount=0.99",
    "agent.optimizer.learning_rate=0.001",
    "agent.optimizer.warmup=100",
    "agent.batch_size=16",
    "agent.batch_length=16",
    "loop.num_envs=8",
    "loop.replay_ratio=64",
    "loop.prefill=1048",
    "loop.env_steps=32000",
    "loop.capacity=32000",
    "loop.eval_every=4000",
    "loop.eval_episodes=10",
)
"""What makes ``released_code`` at the size 1m small enough to learn from vectors in minutes of a core."""
TAKEN = re.compile(
    r"seed|env\.(task|obs)|agent\.(batch_size|batch_length|encoder\.(layers|units))"
    r"|agent\.rssm\.(deter|stoch|classes|hidden|blocks|prior_layers|unimix)"
    r"|agent\.heads\.(units|(reward|continue|actor|critic)_layers|bins|actor_scale|min_std|max_std)"
    r"|agent\.world_model\.free_nats|agent\.behavior\.(horizon|discount|lam|entropy|slow_rate)"
    r"|agent\.optimizer\.(learning_rate|beta1|beta2|eps|agc|agc_pmin|warmup)|agent\.loss_scales.*"
    r"|agent\.objective\.predictor\.(layers|width|heads|feedforward)"
    r"|loop\.(env_steps|num_envs|replay_ratio|capacity|prefill|eval_every|eval_episodes|chunk_steps|max_skipped)"
)
"""Settings that their code takes, or that change nothing of what is learned."""
EVALUATED = 1_000
"""Environments of evaluations are seeded from here on, after those of training."""
APART = 10_000
"""Between the environments' seeds of one run and those of the next: theirs lie side by side, and would be shared."""
LOG_EVERY = 1_000
"""Environment steps between lines about training."""
NAMES = {
    "opt/loss": "loss/total",
    "ent/action": "policy/entropy",
    "rew": "imagined/reward",
    "val": "imagined/value",
    "tar": "imagined/return",
} | {f"loss/{theirs}": f"loss/{ours}" for theirs, ours in compare.LOSSES.items()}
"""Their names of what an update measures -> ours."""


def configure(task: str, seed: int, assignments: Sequence[str] = ()) -> Config:
    """The setting of both: `SMALL`, with other settings after it.

    Raises ValueError for what their code can't be given.
    """
    flags = {"env.task": task, "env.obs": "vector", "seed": seed}
    config = train.configure("released_code", "1m", METHOD, flags, (*SMALL, *assignments))
    published, now = (settings.paths(c) for c in (train.configure("released_code", "1m", METHOD, flags), config))
    if refused := [path for path, value in now.items() if value != published[path] and not TAKEN.fullmatch(path)]:
        raise ValueError(f"expected settings that the released code takes, got others for {', '.join(refused)}")
    agent, loop = config.agent, config.loop
    assert isinstance(agent, AgentConfig)
    assert isinstance(agent.objective, NextEmbedding)
    predictor = agent.objective.predictor
    if predictor.feedforward != 4 * predictor.width:
        raise ValueError(f"expected a feedforward of four widths, got {predictor.feedforward} and {predictor.width}")
    if abs(1 / (1 - agent.behavior.discount) % 1 - 0.5) < 0.499:
        raise ValueError(f"expected a discount of 1 - 1/n with a whole n, got {agent.behavior.discount}")
    vector_step = loop.num_envs * config.env.action_repeat
    if loop.eval_every is None or loop.eval_every % vector_step or loop.env_steps % loop.eval_every:
        raise ValueError(
            f"expected evaluations every so many times {vector_step} environment steps, the last one at the end, got "
            f"loop.eval_every {loop.eval_every} and loop.env_steps {loop.env_steps}"
        )
    if loop.capacity is None or loop.capacity < loop.env_steps:
        raise ValueError(
            f"expected a replay that holds the whole run, got loop.capacity {loop.capacity} for {loop.env_steps} steps"
        )
    trainer_length(config)
    return config


def command(config: Config, assignments: Sequence[str], logdir: str) -> str:
    """The command that trains this package at the setting."""
    options = ["--preset", "released_code", "--size", "1m", "--task", config.env.task, "--obs", "vector"]
    options += ["--seed", str(config.seed)]
    for assignment in (*SMALL, *assignments):
        options += ["--set", assignment]
    return shlex.join(["python", "-m", "experiments.train", *options, "--logdir", logdir])


def trainer_length(config: Config) -> int:
    """What their trainer is told a sequence's length is.

    It learns from the vector step on that comes three after so many; replay and losses do not ask it. Raises ValueError
    for a prefill that no length gives: it has to divide the steps of a batch, which the trainer computes from it.
    """
    steps, extra = config.agent.batch_size * config.agent.batch_length, 3
    length, rest = divmod(config.loop.prefill, config.loop.num_envs)
    length -= extra
    if rest or length < (least := config.agent.batch_length) or steps % length:
        fitting = [config.loop.num_envs * (n + extra) for n in range(least, steps + 1) if steps % n == 0]
        raise ValueError(f"loop.prefill: expected one of {fitting}, got {config.loop.prefill}")
    return length


class Log:
    """Takes what their trainer says, and writes it as our runs do."""

    def __init__(self, writer: metrics.Writer, action_repeat: int) -> None:
        self.updates, self._seconds, self._before = 0, 0.0, 0
        self._writer, self._action_repeat = writer, action_repeat
        self._said: dict[str, float] = {}
        self._returns: list[float] = []

    def scalar(self, name: str, value: Any) -> None:
        """A number that belongs to the next line."""
        self._said[name] = float(value)

    def write(self, step: int, fps: bool = False) -> None:
        """A line; the ends of episodes wait for the next one about something else."""
        said, self._said = self._said, {}
        if "episode/score" in said:
            self._returns.append(said["episode/score"])
            return
        values: dict[str, float] = {}
        if "episode/eval_score" in said:
            values["eval/return"] = said["episode/eval_score"]
            click.echo(f"{step:9,} environment steps, {self.updates:6,} updates: return {values['eval/return']:.1f}")
        if self._returns:
            values |= {"train/return": float(np.mean(self._returns)), "train/episodes": len(self._returns)}
            self._returns.clear()
        values |= {f"train/{NAMES[name[6:]]}": x for name, x in said.items() if name[6:] in NAMES}
        if fps and self.updates > self._before:
            values["time/cpu_seconds_per_update"] = self._seconds / (self.updates - self._before)
            self._seconds, self._before = 0.0, self.updates
        self._writer.write(metrics.StepCounts(step, step // self._action_repeat, self.updates), values)

    def counted(self, update: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Their agent's ``update``, counted and timed."""

        def counting(replay: Any) -> Any:
            began = time.process_time()
            found = update(replay)
            self._seconds += time.process_time() - began
            self.updates += 1
            return found

        return counting


class Wrapper:
    """As much of gym's as their wrappers use."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)


class Box:
    """As much of gym's as is read."""

    def __init__(self, low: Any, high: Any, shape: Any = None, dtype: Any = None) -> None:
        self.low, self.high, self.dtype = low, high, dtype
        self.shape = np.shape(low) if shape is None else shape


class InProcess:
    """One of their environments in this process, in place of one in another; without its picture."""

    def __init__(self, constructor: Callable[[], Any], strategy: str) -> None:
        self.env = constructor()
        self.action_space = self.env.action_space
        spaces = {name: space for name, space in self.env.observation_space.spaces.items() if name != "image"}
        self.observation_space = types.SimpleNamespace(spaces=spaces)

    def reset(self) -> Callable[[], Any]:
        """Begins an episode; what comes back says what is seen."""
        obs = self.env.reset()
        return lambda: _blind(obs)

    def step(self, action: np.ndarray) -> Callable[[], Any]:
        """A step; what comes back says what is seen, the reward, and whether the episode has ended."""
        obs, *rest = self.env.step(action)
        return lambda: (_blind(obs), *rest)


def _blind(obs: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in obs.items() if name != "image"}


def put_aside() -> None:
    """Stands in for what their environments import and draw with, and for what a CPU alone has not."""
    import tensordict

    gym: Any = types.ModuleType("gym")
    gym.Wrapper = Wrapper
    gym.spaces = types.SimpleNamespace(Box=Box, Dict=lambda spaces: types.SimpleNamespace(spaces=spaces))
    sys.modules["gym"] = gym
    parallel: Any = importlib.import_module("envs.parallel")
    control: Any = importlib.import_module("envs.dmc")
    del sys.modules["gym"]  # torchrl, too, looks for it
    parallel.Parallel = InProcess
    control.DeepMindControl.render = lambda self, *_, **__: np.zeros((1, 1, 3), np.uint8)
    tensors: Any = tensordict.TensorDict
    tensors.pin_memory = lambda self, *_, **__: self
    compiler: Any = torch.compiler
    compiler.cudagraph_mark_step_begin = lambda: None
    torch.distributions.Distribution.set_default_validate_args(False)  # a fifth of an update's time


def environments(config: Config, count: int, first: int = 0) -> Any:
    """So many of their environments, with the seeds from ``APART * seed + first`` on."""
    theirs = importlib.import_module("envs")
    asked = compare.Settings(
        task=config.env.task.replace("/", "_", 1),
        action_repeat=config.env.action_repeat,
        time_limit=1_000,
        size=(1, 1),
        seed=APART * config.seed,
    )

    def constructor(place: int) -> Callable[[], Any]:
        return lambda: theirs.make_env(asked, first + place)

    return importlib.import_module("envs.parallel").ParallelEnv(constructor, count, "cpu")


def check_observed(config: Config, environments: Any) -> None:
    """Raises ValueError where theirs and ours do not see vectors of the same names and sizes."""
    ours = {name: int(np.prod(s.shape)) for name, s in env_configs.make(config.env).spec.observation.items()}
    theirs = {name: int(np.prod(s.shape)) for name, s in environments.observation_space.spaces.items()}
    if ours != theirs:
        raise ValueError(f"expected the same observations, got {ours} of ours and {theirs} of theirs")


def mend(replay: Any) -> None:
    """Their replay, with each sequence's actions moved by one step as meant: copied before they are written over."""
    draw, sample = replay._buffer.sample, replay.sample
    drawn: list[torch.Tensor] = []

    def keep(*arguments: Any, **options: Any) -> Any:
        found = draw(*arguments, **options)
        drawn.append(found[0]["action"].clone())
        return found

    def mended() -> Any:
        data, index, initial = sample()
        data["action"] = drawn.pop().view(len(data), replay.batch_length + 1, -1)[:, :-1]
        return data, index, initial

    replay._buffer.sample, replay.sample = keep, mended


def agent_of(dreamer: Any, config: Config, environments: Any) -> Any:
    """Their agent with fresh weights, in float32 throughout."""
    dreamer.autocast = lambda **_: contextlib.nullcontext()
    dreamer.GradScaler = lambda: torch.amp.GradScaler("cpu", enabled=False)
    assert isinstance(config.agent, AgentConfig)
    asked = compare.settings(config.agent, METHOD)
    with contextlib.redirect_stdout(None):
        return dreamer.Dreamer(asked, environments.observation_space, environments.action_space)


def learn(dreamer: Any, config: Config, log: Log, out: Path, as_published: bool) -> None:
    """Trains their agent with their trainer."""
    importlib.import_module("tools").set_seed_everywhere(config.seed)
    training = environments(config, config.loop.num_envs)
    evaluation = environments(config, config.loop.eval_episodes, EVALUATED)
    agent = agent_of(dreamer, config, training)
    agent.update = log.counted(agent.update)
    batch = {"batch_size": config.agent.batch_size, "batch_length": config.agent.batch_length}
    asked = compare.Settings(**batch, device="cpu", storage_device="cpu", max_size=config.loop.capacity)
    replay = importlib.import_module("buffer").Buffer(asked)
    if not as_published:
        mend(replay)
    trainer = importlib.import_module("trainer")
    asked = trainer_settings(config)
    trainer.OnlineTrainer(asked, replay, log, out, training, evaluation, agent.act_dim).begin(agent)


def trainer_settings(config: Config) -> compare.Settings:
    """Their trainer's settings of ours; nothing is drawn or sent anywhere."""
    loop, length = config.loop, trainer_length(config)
    return compare.Settings(
        steps=loop.env_steps + 1,  # it evaluates before a step, and so at the end only if there is one more
        pretrain=0,
        eval_every=loop.eval_every,
        eval_episode_num=loop.eval_episodes,
        batch_length=length,
        batch_size=config.agent.batch_size * config.agent.batch_length // length,
        train_ratio=loop.replay_ratio,
        action_repeat=config.env.action_repeat,
        update_log_every=LOG_EVERY,
        video_pred_log=False,
        params_hist_log=False,
        eval_video_every=0,
        s3_bucket=None,
        s3_prefix=None,
    )


@click.command()
@click.argument("checkout", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.option("--task", type=Task(), default="dmc/walker_stand", show_default=True)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True)
@click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="For both, as experiments.train.")
@click.option("--as-published", is_flag=True, help="Leave the actions of their replay as they are.")
@click.option("--show", is_flag=True, help="Print the command that trains this package, and exit.")
def main(
    checkout: Path, out: Path, task: str, seed: int, assignments: tuple[str, ...], as_published: bool, show: bool
) -> None:
    """Train the authors' code in CHECKOUT; OUT is a new directory for what is measured."""
    os.environ["MUJOCO_GL"] = "disabled"
    with refusing(ValueError):
        config = configure(task, seed, assignments)
    if not isinstance(config.env, DmcConfig):
        raise click.UsageError(f"expected a task of DeepMind Control, got {task}")
    click.echo(command(config, assignments, f"{out}-ours" if not show else str(out)))
    if show:
        return
    if out.exists() and any(out.iterdir()):
        raise click.UsageError(f"expected a new directory, got {out} with something in it")
    agent, repeat = config.agent, config.env.action_repeat
    budget = Budget.of(config.loop, agent.batch_size, agent.batch_length, repeat)
    click.echo(f"{config.loop.env_steps:,} environment steps, {budget.updates:,} updates of ours")
    torch.set_num_threads(1)
    dreamer = compare.load(checkout)
    put_aside()
    with refusing(ValueError):
        check_observed(config, environments(config, 1))
    out.mkdir(parents=True, exist_ok=True)
    said = {"as_published": as_published, "config": settings.to_dict(config)}
    (out / curves.MARKER).write_text(json.dumps(said, indent=2) + "\n", encoding="utf-8")
    with metrics.Writer(out / "metrics.jsonl") as writer:
        learn(dreamer, config, Log(writer, repeat), out, as_published)


if __name__ == "__main__":
    main()
