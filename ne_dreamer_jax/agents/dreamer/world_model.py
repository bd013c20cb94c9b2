"""The world model: the posterior along replayed sequences, and the losses that train it.

``L_wm = L_rew + L_cont + beta_dyn L_dyn + beta_rep L_rep + beta L_objective`` (the paper's world-model objective, with
DreamerV3's two-sided KL).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from ne_dreamer_jax.losses import balanced_kl, symexp_bins, twohot_loss
from ne_dreamer_jax.nets.heads import encode_action
from ne_dreamer_jax.nets.microbatches import in_microbatches
from ne_dreamer_jax.nets.networks import Networks
from ne_dreamer_jax.nets.rssm import RSSM, feature, mask_first, observe
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import NonNegative, Share
from ne_dreamer_jax.types import Array, Batch, Latent, Metrics, Params, PolicyState, Rollout, TimeStep

LOSSES = ("dynamics", "representation", "reward", "continue")


@dataclass(frozen=True)
class WorldModelConfig:
    """Settings of the world-model losses."""

    free_nats: NonNegative = 1.0
    """Below this KL, summed over the latents, neither side is trained by it."""
    kl_unimix: Share = 0.01
    """Share of the uniform distribution mixed into both sides of the KL; 0 is the released code."""

    def __post_init__(self) -> None:
        ranges.check(self)


@jax.named_scope("posterior")
def posterior_rollout(
    nets: Networks, params: Params, key: Array, batch: Batch, microbatches: int = 1
) -> tuple[Rollout, Array]:
    """Encodes a batch and unrolls the posterior along it: the rollout, and the posterior's logits [B, T, S, K].

    The sequences may go through the networks in several ``microbatches``; the result is the same.
    """
    encode = lambda action: encode_action(nets.spec.action, action, nets.heads.clip_actions)
    action, prev_action = encode(batch.action), encode(batch.prev_action)
    prev_action = mask_first(prev_action, batch.is_first)
    uniform = jax.random.uniform(key, (*batch.is_first.shape, nets.rssm.config.stoch))

    def unroll(obs: Any, uniform: Array, context: Latent, prev_action: Array, is_first: Array) -> Any:
        embedding = nets.apply("encoder", params, obs)
        return embedding, *observe(nets.rssm, params["rssm"], uniform, context, embedding, prev_action, is_first)

    in_parts = in_microbatches(unroll, microbatches)
    embedding, latent, logits = in_parts(batch.obs, uniform, batch.context, prev_action, batch.is_first)
    return Rollout(batch, embedding, latent, feature(latent), action, prev_action), logits


def posterior_step(nets: Networks, params: Params, key: Array, policy: PolicyState, timestep: TimeStep) -> Latent:
    """The posterior after one more observation of N environments, for acting."""
    rssm = nets.rssm
    call = lambda method, *args: rssm.apply({"params": params["rssm"]}, *args, method=method)
    prev_action = mask_first(
        encode_action(nets.spec.action, policy.prev_action, nets.heads.clip_actions), timestep.is_first
    )
    uniform = jax.random.uniform(key, (*timestep.is_first.shape, rssm.config.stoch))
    observation_in = call(RSSM.embed_observation, nets.apply("encoder", params, timestep.obs))
    action_in = call(RSSM.embed_action, prev_action)
    latent, _ = call(RSSM.observe_step, policy.latent, observation_in, action_in, timestep.is_first, uniform)
    return latent


def binary_cross_entropy(logit: Array, target: Array) -> Array:
    """``-(y log p + (1 - y) log(1 - p))`` with p = sigmoid(logit) and any target y in [0, 1], elementwise."""
    return -(target * jax.nn.log_sigmoid(logit) + (1 - target) * jax.nn.log_sigmoid(-logit))


@jax.named_scope("predictions")
def prediction_losses(
    nets: Networks, config: WorldModelConfig, params: Params, rollout: Rollout, posterior: Array, discount: float
) -> tuple[dict[str, Array], Metrics]:
    """KL (eq. for L_kl, balanced), reward and continuation losses, each averaged over B and T.

    The continuation's target is ``discount * (1 - is_terminal)``: the head's probability contains the discount, unless
    it is given as 1.
    """
    prior: Any = nets.rssm.apply({"params": params["rssm"]}, rollout.latent.deter, method=RSSM.prior)
    dynamics, representation = balanced_kl(posterior, prior, config.free_nats, config.kl_unimix)
    bins = symexp_bins(nets.heads.bins)
    reward = twohot_loss(nets.apply("reward", params, rollout.feature), rollout.batch.reward, bins)
    target = discount * (1 - rollout.batch.is_terminal.astype(jnp.float32))
    cont = binary_cross_entropy(nets.apply("continue", params, rollout.feature)[..., 0], target)
    values = {"dynamics": dynamics, "representation": representation, "reward": reward, "continue": cont}
    raw, _ = balanced_kl(posterior, prior, 0.0, config.kl_unimix)
    return {name: jnp.mean(x) for name, x in values.items()}, {"kl": jnp.mean(raw)}
