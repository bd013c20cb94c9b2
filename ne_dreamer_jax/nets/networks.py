"""All networks of an agent, built once from their configs, and the initialisation of their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from ne_dreamer_jax.nets import heads
from ne_dreamer_jax.nets.encoder import Encoder, EncoderConfig, embedding_size
from ne_dreamer_jax.nets.heads import HeadsConfig
from ne_dreamer_jax.nets.rssm import RSSM, RSSMConfig, initial_latent
from ne_dreamer_jax.types import Array, EnvSpec, Params


@dataclass(frozen=True)
class Networks:
    """The modules (no parameters) and the sizes they agree on."""

    spec: EnvSpec
    encoder: Encoder
    rssm: RSSM
    reward: nn.Module
    cont: nn.Module
    actor: nn.Module
    critic: nn.Module
    heads: HeadsConfig
    dtype: Any

    @staticmethod
    def build(spec: EnvSpec, encoder: EncoderConfig, rssm: RSSMConfig, head: HeadsConfig, dtype: Any) -> Networks:
        """Modules for an environment. Raises ValueError where an observation fits no encoder."""
        return Networks(
            spec=spec,
            encoder=Encoder(encoder, spec.observation, dtype),
            rssm=RSSM(rssm, embedding_size(encoder, spec.observation), spec.action.size, dtype),
            reward=heads.reward_head(head, dtype),
            cont=heads.continue_head(head, dtype),
            actor=heads.actor_head(head, spec.action, dtype),
            critic=heads.critic_head(head, dtype),
            heads=head,
            dtype=dtype,
        )

    @property
    def feature(self) -> int:
        """F, the size of a feature."""
        return self.rssm.config.feature

    @property
    def embedding(self) -> int:
        """E, the size of an embedding."""
        return self.rssm.embedding

    def init(self, key: Array) -> dict[str, Params]:
        """Fresh parameters by name: encoder, rssm, reward, continue, actor, critic."""
        keys = dict(
            zip(("encoder", "rssm", "reward", "continue", "actor", "critic"), jax.random.split(key, 6), strict=True)
        )
        obs = {name: jnp.zeros((1, *s.shape), s.dtype) for name, s in self.spec.observation.items()}
        step = (
            initial_latent(self.rssm.config, (1,)),
            jnp.zeros((1, self.embedding)),
            jnp.zeros((1, self.rssm.action)),
        )
        inputs: Mapping[str, tuple[nn.Module, tuple[Any, ...]]] = {
            "encoder": (self.encoder, (obs,)),
            "rssm": (self.rssm, step),
        }
        on_feature = {"reward": self.reward, "continue": self.cont, "actor": self.actor, "critic": self.critic}
        inputs = {**inputs, **{name: (module, (jnp.zeros((1, self.feature)),)) for name, module in on_feature.items()}}
        return {name: module.init(keys[name], *args)["params"] for name, (module, args) in inputs.items()}

    def apply(self, name: str, params: dict[str, Params], *args: Any) -> Any:
        """Applies the module called as its parameters are: ``apply("reward", params, feature)``."""
        module = {"continue": self.cont}.get(name) or getattr(self, name)
        return module.apply({"params": params[name]}, *args)
