"""A whole experiment as one frozen dataclass, and the named presets.

Each part's dataclass lives beside the code that reads it; this module composes them. Vary a preset with
``dataclasses.replace``, or by dotted path with `settings.override`; `settings` also takes configs to JSON and back.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

from ne_dreamer_jax import objectives, settings
from ne_dreamer_jax.agents import drqv2
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.agents.dreamer.behavior import BehaviorConfig
from ne_dreamer_jax.agents.dreamer.world_model import WorldModelConfig
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.agents.optim import OptimizerConfig
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.envs.config import DmcConfig, EnvConfig, RoomsConfig
from ne_dreamer_jax.loop import budget
from ne_dreamer_jax.loop.config import LoopConfig
from ne_dreamer_jax.nets.encoder import EncoderConfig
from ne_dreamer_jax.nets.heads import HeadsConfig
from ne_dreamer_jax.nets.predictor import PredictorConfig
from ne_dreamer_jax.nets.rssm import RSSMConfig
from ne_dreamer_jax.objectives import AnyObjective, DreamerPro, NextEmbedding, SameStep
from ne_dreamer_jax.settings import did_you_mean, names, ranges
from ne_dreamer_jax.settings.ranges import LARGEST, Range

SIZES: dict[str, dict[str, int]] = {
    # DreamerV3's sizes: deter D, hidden, classes K, encoder depth, units.
    "1m": {"deter": 512, "hidden": 64, "classes": 4, "depth": 4, "units": 64},
    "12m": {"deter": 2048, "hidden": 256, "classes": 16, "depth": 16, "units": 256},
    "25m": {"deter": 3072, "hidden": 384, "classes": 24, "depth": 24, "units": 384},
    "50m": {"deter": 4096, "hidden": 512, "classes": 32, "depth": 32, "units": 512},
    "100m": {"deter": 6144, "hidden": 768, "classes": 48, "depth": 48, "units": 768},
    "200m": {"deter": 8192, "hidden": 1024, "classes": 64, "depth": 64, "units": 1024},
    "400m": {"deter": 12288, "hidden": 1536, "classes": 96, "depth": 96, "units": 1536},
}


@dataclass(frozen=True)
class Config:
    """An experiment."""

    env: EnvConfig = field(default_factory=DmcConfig)
    agent: AgentConfig | DrQv2Config = field(default_factory=AgentConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    seed: Annotated[int, Range(0, LARGEST)] = 0

    def __post_init__(self) -> None:
        ranges.check(self)

    @property
    def method(self) -> str:
        """Name of the method, read off the agent's settings, so that it can't say anything else."""
        return self.agent.method


def _check(kind: str, name: str, known: Iterable[str]) -> None:
    if name not in (known := list(known)):
        raise ValueError(f"no {kind} is called {name!r}. {did_you_mean(name, known)}")


def agent_config(size: str) -> AgentConfig:
    """The agent of the paper at one of the sizes. Raises ValueError for an unknown one."""
    _check("size", size, SIZES)
    s = SIZES[size]
    return AgentConfig(
        encoder=EncoderConfig(depth=s["depth"], units=s["units"]),
        rssm=RSSMConfig(deter=s["deter"], hidden=s["hidden"], classes=s["classes"]),
        heads=HeadsConfig(units=s["units"]),
    )


def dmc(size: str) -> Config:
    """The paper's DeepMind Control setting: 1M environment steps, 512 replayed steps a policy step."""
    return Config(agent=agent_config(size))


def rooms(size: str) -> Config:
    """The paper's DMLab Rooms setting: 50M frames, action repeat 4, 32 replayed steps a policy step."""
    loop = LoopConfig(env_steps=50_000_000, replay_ratio=32.0, eval_every=1_000_000)
    return Config(RoomsConfig(), agent_config(size), loop)


def _small_agent(size: str, predictor_width: int) -> AgentConfig:
    """What the agents for a CPU share: half the recurrent state, sequences of 16 steps and a predictor of one layer."""
    base = agent_config(size)
    return replace(
        base,
        rssm=replace(base.rssm, deter=base.rssm.deter // 2),
        objective=NextEmbedding(PredictorConfig(layers=1, width=predictor_width, feedforward=2 * predictor_width)),
        batch_size=16,
        batch_length=16,
    )


def laptop(size: str) -> Config:
    """For an hour or two of a CPU core, from pixels or vectors: little arithmetic in an update.

    Half the recurrent state; frames of 32 x 32, encoded in patches of 4 x 4 and by one convolution; a small predictor.
    Behaviour is learned from the last four steps of each sequence alone, and the actor is trained by gradients through
    the world model (tried with continuous actions only), its means drawn away from the ends of their tanh, where it
    would stop learning. The slow critic follows five times as fast as the paper's, so that values keep up with so few
    updates. The learning rate is 25 times the paper's, and returns are divided by as little as 0.1, not 1: first
    rewards are often hundredths, and would teach the actor nothing beside its entropy, which weighs ten times the
    paper's. experiments/RESULTS.md says what this reaches, experiments/TRIALS.md what else was tried, and
    experiments/FIDELITY.md what the actor's gradient, the penalty and the slow critic's rate are worth.
    """
    small = _small_agent(size, predictor_width=64)
    agent = replace(
        small,
        encoder=replace(small.encoder, patch=4, multipliers=(8, 8)),
        behavior=BehaviorConfig(
            horizon=10,
            imagine_last=4,
            discount=0.99,
            entropy=3e-3,
            mean_penalty=3e-3,
            gradient="dynamics",
            slow_rate=0.1,
            return_floor=0.1,
        ),
        optimizer=OptimizerConfig(learning_rate=1e-3, warmup=100),
    )
    loop = LoopConfig(env_steps=800_000, num_envs=16, replay_ratio=32.0, prefill=2_000, eval_every=20_000)
    return Config(DmcConfig(image_size=32), agent, loop)


def quickstart(size: str) -> Config:
    """Solves a task from pixels in ten or twenty minutes of a CPU core: `laptop`, with a ball to catch in a cup."""
    base = laptop(size)
    return replace(
        base, env=replace(base.env, task="dmc/ball_in_cup_catch"), loop=replace(base.loop, env_steps=120_000)
    )


def rooms_small(size: str) -> Config:
    """Learns to remember in some twenty minutes of a CPU core: a small agent with half the state, on a small task.

    Frames of 24 x 24 are halved three times. A trial of the task takes some nine steps, so that most of the sequences
    of 16 hold what is to be remembered and what comes of it; returns are in tens, and need no smaller floor than 1.
    """
    small = _small_agent(size, predictor_width=128)
    agent = replace(
        small,
        encoder=replace(small.encoder, multipliers=(2, 3, 4)),
        behavior=BehaviorConfig(horizon=8, discount=0.98, discount_in_head=True, entropy=1e-3),
        optimizer=OptimizerConfig(learning_rate=4e-4, warmup=100),
    )
    loop = LoopConfig(env_steps=320_000, replay_ratio=32.0, prefill=2_000, eval_every=32_000, eval_episodes=32)
    return Config(RoomsConfig("rooms/select_nonmatching_object_small", image_size=24), agent, loop)


def smoke(size: str) -> Config:
    """A minute or two on a CPU: touches everything, learns nothing."""
    agent = replace(agent_config(size), batch_size=4, batch_length=16)
    loop = LoopConfig(
        env_steps=4_400,
        num_envs=4,
        replay_ratio=2.0,
        prefill=400,
        chunk_steps=50,
        eval_every=2_200,
        eval_episodes=1,
        max_skipped=10,  # of some fifty updates
    )
    return Config(DmcConfig("dmc/cartpole_balance"), agent, loop)


def released_code(size: str) -> Config:
    """The paper's DeepMind Control setting as the authors' published code has it; see experiments/FIDELITY.md."""
    base = agent_config(size)
    agent = replace(
        base,
        heads=replace(base.heads, clip_actions=False),
        world_model=WorldModelConfig(kl_unimix=0.0),
        behavior=BehaviorConfig(discount=1 - 1 / 333, discount_in_head=False, percentile_method="nearest"),
        objective=NextEmbedding(
            PredictorConfig(discrete_action="normalised", attention_init="xavier"),
            sample_deviation=True,
            action="previous",
            masked=False,
            across_episodes=True,
            unshifted_token="state",
        ),
        optimizer=OptimizerConfig(name="laprop_weighted"),
    )
    loop = LoopConfig(
        env_steps=1_010_000,
        capacity=500_000,
        write_latents=False,
        prefill=1_056,
        eval_every=10_000,
        eval_episodes=8,
    )
    return Config(agent=agent, loop=loop)


PRESETS = {
    "dmc": (dmc, "12m"),
    "rooms": (rooms, "12m"),
    "rooms_small": (rooms_small, "1m"),
    "released_code": (released_code, "12m"),
    "laptop": (laptop, "1m"),
    "quickstart": (quickstart, "1m"),
    "smoke": (smoke, "1m"),
}


RELEASED: tuple[AnyObjective, ...] = (
    SameStep(sample_deviation=True),
    DreamerPro(whole_shifts=True, projection_init="uniform", frozen_updates=9_999),
)
"""Objectives of the released code's other methods, where they are not the defaults."""
OBJECTIVES = {"released_code": RELEASED}
"""Preset -> objectives of other methods than its own that are not the defaults."""


def preset(name: str, size: str | None = None) -> Config:
    """A named setting, at one of `SIZES` (default: the preset's own). Raises ValueError naming close matches."""
    _check("preset", name, PRESETS)
    build, default = PRESETS[name]
    return build(size or default)


def with_method(config: Config, method: str, known: Sequence[AnyObjective] = ()) -> Config:
    """The config with another of the paper's methods; what the methods share stays as the config has it.

    Settings that made an ablation of the config's method are put back to their defaults, which may be others than a
    preset's: choose the method of a preset, not of an ablation of it.

    The weights of the method's own losses are its authors', unless the config weighs losses of these names already.

    ``drqv2`` shares the environment and the budget: it is as its authors have it for the task, at their image size
    where the config has the paper's. It learns as often for each agent step as the config's agent (in the paper's
    setting every second step, as published), and from no more steps at once, nor begins later, than that.

    Args:
      known: objectives to start from in place of their defaults, such as a preset's in `OBJECTIVES`.

    Raises:
      ValueError: an unknown method, or a world-model method for a config that has no world model to begin with.
    """
    _check("method", method, names.METHODS)
    if method == config.method:
        return config
    if isinstance(config.agent, DrQv2Config):
        raise ValueError(f"expected a config of a world-model method to make {method} of, got drqv2; take the preset's")
    if method == names.DRQV2:
        return _drqv2(config, config.agent)
    return _with_objective(config, config.agent, _objective(method, (config.agent.objective, *known)))


def override(config: Config, assignment: str) -> Config:
    """`settings.override`, where what hangs together stays together.

    Another objective (``agent.objective=SameStep``) brings the weights of its losses along, a task of another family
    (``env.task=...``) that family's settings, and what says how often DrQ-v2 learns the course of its noise.
    """
    path, _, task = assignment.partition("=")
    if path.strip() == "env.task":
        env = env_configs.for_task(task.strip(), config.env)
        if isinstance(config.agent, DrQv2Config) and drqv2.for_task(env.task) != drqv2.for_task(config.env.task):
            raise ValueError(
                f"env.task: DrQ-v2 has other settings for {env.task} than for {config.env.task}; expected the task "
                "before the method: --task on the command line"
            )
        return replace(config, env=env)
    changed = settings.override(config, assignment)
    old, new = config.agent, changed.agent
    if isinstance(new, DrQv2Config):
        return replace(changed, agent=_in_time(new, changed.loop)) if path.strip() in DRQV2_CLOCK else changed
    if isinstance(old, DrQv2Config) or type(old.objective) is type(new.objective):
        return changed
    return _with_objective(config, old, new.objective)


def _with_objective(config: Config, agent: AgentConfig, objective: AnyObjective) -> Config:
    old, new = agent.objective.losses, objective.losses
    kept = {name: scale for name, scale in agent.loss_scales.items() if name not in old or name in new}
    return replace(config, agent=replace(agent, objective=objective, loss_scales={**new, **kept}))


def _drqv2(config: Config, shared: AgentConfig) -> Config:
    env, loop = config.env, config.loop
    published = drqv2.for_task(env.task) if isinstance(env, DmcConfig) else DrQv2Config()
    every = published.steps_per_update
    if loop.replay_ratio:
        every = budget.steps_per_update(shared.batch_size, shared.batch_length, loop.replay_ratio)
    agent = replace(
        published,
        batch_size=min(published.batch_size, shared.batch_size * shared.batch_length),
        steps_per_update=every,
        random_steps=min(loop.prefill, drqv2.SEED_FRAMES // env.action_repeat),
    )
    if isinstance(env, DmcConfig) and env.image_size == DmcConfig.image_size:
        env = replace(env, image_size=drqv2.IMAGE_SIZE)
    loop = replace(
        loop,
        replay_ratio=loop.replay_ratio and budget.replay_ratio(agent.batch_size, agent.batch_length, every),
        prefill=agent.random_steps,
        write_latents=False,
    )
    return replace(config, env=env, agent=agent, loop=loop)


DRQV2_CLOCK = ("loop.replay_ratio", "loop.prefill", "agent.batch_size", "agent.frame_stack", "agent.n_step")
"""Settings from which it follows when DrQ-v2 learns."""


def _in_time(agent: DrQv2Config, loop: LoopConfig) -> DrQv2Config:
    """With the noise of its updates in step with the loop; a loop that never learns leaves it as it is."""
    every = agent.steps_per_update
    if loop.replay_ratio:
        every = budget.steps_per_update(agent.batch_size, agent.batch_length, loop.replay_ratio)
    return replace(agent, steps_per_update=every, random_steps=loop.prefill)


def check(config: Config) -> None:
    """Raises ValueError where settings of the agent and of the loop contradict each other."""
    agent, loop = config.agent, config.loop
    if not isinstance(agent, DrQv2Config):
        return
    expected = _in_time(agent, loop)
    if abs(expected.steps_per_update / agent.steps_per_update - 1) > 0.01:
        ratio = budget.replay_ratio(agent.batch_size, agent.batch_length, agent.steps_per_update)
        raise ValueError(
            f"agent.steps_per_update: expected {expected.steps_per_update:g}, as loop.replay_ratio "
            f"{loop.replay_ratio:g} has it for batches of {agent.batch_size} x {agent.batch_length} steps, got "
            f"{agent.steps_per_update:g}; with loop.replay_ratio={ratio:g} it fits"
        )
    steps, least = -(-loop.prefill // loop.num_envs), agent.batch_length + 1
    if steps < least and loop.replay_ratio:
        raise ValueError(
            f"loop.prefill: expected at least {least * loop.num_envs:,}, {least} steps of each of {loop.num_envs:,} "
            f"environments, before which there is nothing to learn from, got {loop.prefill:,}"
        )
    if agent.random_steps != loop.prefill:
        raise ValueError(
            f"agent.random_steps: expected loop.prefill, {loop.prefill:,}, with which learning begins, got "
            f"{agent.random_steps:,}; set both"
        )


def _objective(method: str, known: Iterable[AnyObjective]) -> AnyObjective:
    """A world-model method's objective, with the settings of the first of those given that is of the same kind."""
    base, _, ablation = method.partition("/")
    kind = getattr(objectives, names.OBJECTIVES[base])
    objective = next((each for each in known if type(each) is kind), kind())
    ablations = names.ABLATIONS.get(base, {})
    defaults, now = settings.paths(kind()), settings.paths(objective)
    values = {path: defaults[path] for path, ablated in ablations.values() if now[path] == ablated}
    values |= dict([ablations[ablation]] if ablation else [])
    for path, value in values.items():
        objective = settings.override(objective, f"{path}={settings.as_text(value)}")
    return objective
