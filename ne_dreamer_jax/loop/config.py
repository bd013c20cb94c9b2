"""Settings of the training loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import Count, CountOrNone, Range


@dataclass(frozen=True)
class LoopConfig:
    """Settings of the training loop. One agent step is ``env.action_repeat`` environment steps of one environment."""

    env_steps: Annotated[int, Range(1, 10**15)] = 1_000_000
    """Environment steps in all, over all environments."""
    num_envs: Annotated[int, Range(1, 10_000_000)] = 16
    """N, environments stepped together."""
    replay_ratio: Annotated[float, Range(0.0, 1e6)] = 512.0
    """Replayed steps for each agent step; an update replays B * T. 0 never learns."""
    capacity: Annotated[int, Range(1, 10**15)] | None = None
    """Transitions that replay holds; none: what the run can fill, at most the paper's 5e6."""
    prefill: CountOrNone = 4_096
    """Agent steps before the first update; at least a sequence of each environment, of agent.batch_length + 1 steps."""
    chunk_steps: Count = 64
    """Vector steps (agent steps of each environment) of one call to the device, unless that is too many updates."""
    eval_every: Annotated[int, Range(1, 10**15)] | None = 50_000
    """Environment steps between evaluations, of which there is one at the end too; none: no evaluation at all."""
    eval_episodes: Annotated[int, Range(1, 1_000_000)] = 10
    """Episodes of an evaluation, on environments of their own."""
    eval_max_steps: Count = 30_000
    """Agent steps after which an episode of an evaluation that has not ended is left; the result says so."""
    max_skipped: Count = 50
    """Updates in a row that may be skipped because their numbers are not finite; then the run stops."""
    write_latents: bool = True
    """Whether the posterior latents of an update replace those in replay."""
    time_limits: Literal["marked", "unmarked", "terminal"] = "marked"
    """How replay holds an episode that a time limit cut: ``is_last`` without ``is_terminal``, as the released code for
    DeepMind Control; neither, as its own limit of 900 steps for DeepMind Lab, so that a world model's replayed returns
    go on into the next episode (DrQ-v2's end there all the same); or both, as DeepMind Lab's own limits there. What a
    fault of the environment cut stays last and not terminal."""
    latent_dtype: Literal["float32", "bfloat16"] = "float32"
    """In which replay stores the deterministic latents; bfloat16 halves their share of the memory."""
    storage: Literal["pixels", "states", "host"] = "pixels"
    """What replay keeps of an image: its pixels; its state, which takes a fraction of the memory and is drawn again, to
    the same bits, whenever it is sampled; or its pixels in the host's memory, from where they travel to the device."""

    def __post_init__(self) -> None:
        ranges.check(self)
