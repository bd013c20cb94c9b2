"""DrQ-v2's hyper-parameters, and which of them the authors chose by task.

Figures are those of the paper's tables and, where the two differ or the paper is silent, of the authors' released
configuration (github.com/facebookresearch/drqv2, ``cfgs/``), which the published curves come from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from ne_dreamer_jax.settings import names, ranges
from ne_dreamer_jax.settings.ranges import Count, CountOrNone, NonNegative, Positive, Range, Share, Width

DIFFICULTY = {
    "dmc/acrobot_swingup": "medium",
    "dmc/ball_in_cup_catch": "easy",
    "dmc/cartpole_balance": "easy",
    "dmc/cartpole_balance_sparse": "easy",
    "dmc/cartpole_swingup": "easy",
    "dmc/cartpole_swingup_sparse": "medium",
    "dmc/cheetah_run": "medium",
    "dmc/finger_spin": "easy",
    "dmc/finger_turn_easy": "medium",
    "dmc/finger_turn_hard": "medium",
    "dmc/hopper_hop": "medium",
    "dmc/hopper_stand": "easy",
    "dmc/pendulum_swingup": "easy",
    "dmc/quadruped_run": "medium",
    "dmc/quadruped_walk": "medium",
    "dmc/reacher_easy": "medium",
    "dmc/reacher_hard": "medium",
    "dmc/walker_run": "medium",
    "dmc/walker_stand": "easy",
    "dmc/walker_walk": "easy",
}
"""Task -> the authors' class of it; their hard ones are humanoid's."""

NOISE_STEPS = {"easy": 100_000, "medium": 500_000, "hard": 2_000_000}
"""Difficulty -> agent steps over which the exploration noise falls."""

SEED_FRAMES = 4_000
"""Environment steps of uniformly random actions, before the first update."""

IMAGE_SIZE = 84
"""Height and width of the frames."""


@dataclass(frozen=True)
class DrQv2Config:
    """Everything that defines a DrQ-v2 agent and its update."""

    frame_stack: Annotated[int, Range(1, 1_000)] = 3
    """Observations that the agent sees together: the last of the episode; at its start its first one, repeated."""
    n_step: Annotated[int, Range(1, 10_000)] = 3
    """Rewards in a target before it bootstraps."""
    discount: Share = 0.99
    batch_size: Annotated[int, Range(1, 1_000_000)] = 256
    """B, transitions in an update."""
    channels: Width = 32
    """Channels of each of the four convolutions."""
    features: Width = 50
    """Width of the normalised bottleneck between encoder and heads."""
    units: Width = 1024
    """Width of the heads' two hidden layers."""
    learning_rate: Positive = 1e-4
    """Of Adam, for encoder, actor and critic alike."""
    target_rate: Share = 0.01
    """Share of the critic that its moving average takes over at each update."""
    shift: Annotated[int, Range(0, 10_000)] = 4
    """Images are shifted by up to this many pixels in each direction, as a random crop of the padded image."""
    noise_first: NonNegative = 1.0
    """Standard deviation of the policy at the start."""
    noise_last: NonNegative = 0.1
    """Standard deviation of the policy once `noise_steps` have passed."""
    noise_steps: Count = NOISE_STEPS["easy"]
    """Agent steps over which the standard deviation falls linearly."""
    noise_clip: NonNegative = 0.3
    """Bound of the noise in the actions of an update (not in those of acting)."""
    random_steps: CountOrNone = SEED_FRAMES // 2
    """Agent steps of uniformly random actions; the first update comes right after them, so that ``loop.prefill`` is the
    same."""
    steps_per_update: Positive = 2.0
    """Agent steps that go by for each update, from which the noise in an update follows. How often the loop learns is
    ``loop.replay_ratio`` = batch_size * (frame_stack + n_step) / steps_per_update: `config.override` keeps the two in
    step, and `config.check` refuses a run in which they are not."""

    def __post_init__(self) -> None:
        ranges.check(self)

    @property
    def batch_length(self) -> int:
        """T, steps that a transition is cut from: the frames before it, itself, and the n steps after it."""
        return self.frame_stack + self.n_step

    @property
    def latent_sizes(self) -> tuple[int, int, int]:
        """D, S, K of what replay stores beside a step: nothing."""
        return (0, 0, 1)

    @property
    def method(self) -> str:
        """Name of the method that these settings are."""
        return names.DRQV2


def for_task(task: str) -> DrQv2Config:
    """The authors' settings for a task; those of medium difficulty for one that they did not have."""
    config = DrQv2Config(noise_steps=NOISE_STEPS[DIFFICULTY.get(task, "medium")])
    if task.startswith("dmc/walker_"):
        return replace(config, n_step=1, batch_size=512)
    return config
