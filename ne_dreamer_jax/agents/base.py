"""What an agent is to the loop and to its users: pure functions, whatever the method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

from ne_dreamer_jax.types import Array, Batch, EnvSpec, Latent, Metrics, Params, PolicyState, Rollout, TimeStep

Mode = Literal["sample", "mode"]


class Act(Protocol):
    """Chooses the actions of N environments."""

    def __call__(
        self, params: Params, state: Any, timestep: TimeStep, key: Array, mode: str = "sample"
    ) -> tuple[Any, Array]:
        """(params, policy state [N, ...], time step [N, ...], key) -> the new policy state, and actions [N, ...].

        ``mode="mode"`` takes the policy's mode, for evaluation. Latents are sampled in both.
        """
        ...


class TrainStep(Protocol):
    """One update. Jitted; donates the state."""

    def __call__(self, state: Any, batch: Batch) -> tuple[Any, Latent, Metrics]:
        """(train state, batch) -> new state, the posterior latents [B, T, ...] for replay, and metrics, float32 []."""
        ...


class Heads(NamedTuple):
    """What the heads say of features [..., F]."""

    reward: Array  # float32 [...], expected on arrival
    discount: Array  # float32 [...], discount times the probability that the episode goes on
    value: Array  # float32 [...], the critic's
    action: Array  # the policy's mode, [..., *action.shape], as an environment takes it


class Imagined(NamedTuple):
    """M imagined trajectories of H steps under the policy."""

    feature: Array  # float32 [H + 1, M, F]; the first is the start's
    action: Array  # [H, M, *action.shape], taken from the first H, as an environment takes them
    heads: Heads  # [H + 1, M, ...]


class Inspection(NamedTuple):
    """A world model from inside, for diagnostics and plots. Jitted."""

    posterior: Callable[[Params, Array, Batch], Rollout]
    """(params, key, batch) -> embeddings, latents and features along a batch [B, T, ...]."""
    imagine: Callable[[Params, Array, Latent, int], Imagined]
    """(params, key, latent [M, ...], horizon) -> what the model expects under the policy from these states."""
    open_loop: Callable[[Params, Array, Latent, Array], Latent]
    """(params, key, latent [M, ...], actions [H, M, ...], as an environment takes them) -> the latents [H, M, ...] that
    the model expects after each, without a look at what came. With `imagine`'s key and actions they are its latents."""
    heads: Callable[[Params, Array], Heads]
    """(params, feature [..., F]) -> reward, discount, value and action."""


class Agent(NamedTuple):
    """Pure functions. N environments act together; a batch has B sequences of T steps."""

    init: Callable[[Array], Any]
    """key -> fresh train state; the key is consumed, the state holds another. All have ``params`` and ``update``."""
    init_policy: Callable[[int], PolicyState]
    """num_envs -> what acting carries, before the first observation."""
    act: Act
    train_step: TrainStep
    config: Any
    spec: EnvSpec
    working_bytes: Callable[[Params], int] = lambda params: 0
    """params (shapes suffice) -> about what an update allocates beside state and batch, which benchmarks.memory
    measures; 0 where that is little."""
    inspection: Inspection | None = None
    """None for agents without a world model."""

    @property
    def posterior(self) -> Callable[[Params, Array, Batch], Rollout]:
        """`Inspection.posterior`. Raises AttributeError for agents without a world model."""
        return self._inspect().posterior

    @property
    def imagine(self) -> Callable[[Params, Array, Latent, int], Imagined]:
        """`Inspection.imagine`, likewise."""
        return self._inspect().imagine

    @property
    def open_loop(self) -> Callable[[Params, Array, Latent, Array], Latent]:
        """`Inspection.open_loop`, likewise."""
        return self._inspect().open_loop

    @property
    def heads(self) -> Callable[[Params, Array], Heads]:
        """`Inspection.heads`, likewise."""
        return self._inspect().heads

    def _inspect(self) -> Inspection:
        if self.inspection is None:
            raise AttributeError(f"expected an agent with a world model, got {self.config.method}, which has none")
        return self.inspection
