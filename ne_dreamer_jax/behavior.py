"""Learning behaviour in imagination: rollouts of the prior under the policy, actor and critic losses.

States are indexed 0 .. H: state 0 is a replayed posterior, state t + 1 follows from the action at t. The reward and
the continuation of state t + 1 were received on arrival at it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from ne_dreamer_jax.losses import (
    critic_loss,
    dynamics_loss,
    lambda_returns,
    reinforce_loss,
    return_scale,
    symexp_bins,
    twohot_mean,
    update_percentiles,
)
from ne_dreamer_jax.nets.heads import model_action, policy
from ne_dreamer_jax.nets.networks import Networks
from ne_dreamer_jax.nets.rssm import RSSM, feature
from ne_dreamer_jax.types import Array, Latent, Metrics, Params, ReturnScale, Rollout

LOSSES = ("actor", "critic", "replay_critic")


@dataclass(frozen=True)
class BehaviorConfig:
    """Settings of the actor-critic."""

    horizon: int = 15
    """H, imagined steps."""
    discount: float = 0.997
    """The paper's table prints 0.85, its code and DreamerV3 use 0.997 (1 - 1/333)."""
    lam: float = 0.95
    """lambda of the returns."""
    entropy: float = 3e-4
    """eta, scale of the policy's entropy."""
    gradient: Literal["reinforce", "dynamics"] = "reinforce"
    """How the actor is trained: by the score function, or through the world model."""
    slow_rate: float = 0.02
    """Share of the critic that moves into the slow critic at each update."""
    slow_scale: float = 1.0
    """Weight of the critic's regularisation towards the slow critic."""
    return_decay: float = 0.99
    """Decay of the moving percentiles of the returns."""
    return_percentiles: tuple[float, float] = (5.0, 95.0)
    """The returns are normalised by the range between these."""
    return_floor: float = 1.0
    """Returns are never divided by less."""

    def __post_init__(self) -> None:
        if self.gradient not in ("reinforce", "dynamics"):
            raise ValueError(f"behavior.gradient: expected 'reinforce' or 'dynamics', got {self.gradient!r}.")


class Trajectory(NamedTuple):
    """M imagined trajectories."""

    feature: Array  # float32 [H + 1, M, F]
    policy: Array  # float32 [H, M, outputs], the actor's outputs at all states but the last
    action: Array  # float32 [H, M, A], raw samples: not clipped


def imagine(
    nets: Networks, params: Params, key: Array, start: Latent, horizon: int, through_model: bool = False
) -> Trajectory:
    """H steps of the prior under the policy from ``start`` [M, ...]; the models see clipped actions.

    Gradients of ``policy`` reach the actor's parameters. Those of states and actions do so only where
    ``through_model``; otherwise actions are constants, and the actor need not be run again for its loss.
    """

    def step(latent: Latent, key: Array) -> tuple[Latent, tuple[Array, Array, Array]]:
        action_key, latent_key = jax.random.split(key)
        state = feature(latent)
        outputs = nets.apply("actor", params, state)
        raw = policy(nets.heads, nets.spec.action, outputs).sample(action_key)
        raw = raw if through_model else jax.lax.stop_gradient(raw)
        uniform = jax.random.uniform(latent_key, (state.shape[0], nets.rssm.config.stoch))
        action = model_action(nets.spec.action, raw, nets.heads.clip_actions)
        after: Any = nets.rssm.apply({"params": params["rssm"]}, latent, action, uniform, method=RSSM.imagine_step)
        return after, (state, outputs, raw)

    last, (states, outputs, actions) = jax.lax.scan(step, start, jax.random.split(key, horizon))
    return Trajectory(jnp.concatenate([states, feature(last)[None]]), outputs, actions)


def actor_critic_losses(
    nets: Networks,
    config: BehaviorConfig,
    params: Params,
    slow_critic: Params,
    scale: ReturnScale,
    key: Array,
    rollout: Rollout,
) -> tuple[dict[str, Array], ReturnScale, Metrics]:
    """Actor and critic losses in imagination and the critic's on replay, each averaged; and the new return scale.

    The imagined losses train the actor and the critic alone. The replayed one also trains the world model, through
    ``rollout.feature`` (DreamerV3).
    """
    frozen = jax.lax.stop_gradient(params)
    through_model = config.gradient == "dynamics"
    acting = {**frozen, "actor": params["actor"]}
    start = jax.lax.stop_gradient(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout.latent))
    imagined = imagine(nets, acting, key, start, config.horizon, through_model)
    states = jax.lax.stop_gradient(imagined.feature)

    bins = symexp_bins(nets.heads.bins)
    steps_last = lambda x: jnp.swapaxes(x, 0, 1)  # [H + 1, M] -> [M, H + 1]
    evaluated = imagined.feature if through_model else states
    reward = steps_last(twohot_mean(nets.apply("reward", frozen, evaluated), bins))
    # The head's probability already contains the discount (see world_model.prediction_losses).
    discount = steps_last(jax.nn.sigmoid(nets.apply("continue", frozen, evaluated)[..., 0]))
    logits = nets.apply("critic", params, states)
    value = steps_last(twohot_mean(nets.apply("critic", frozen, evaluated) if through_model else logits, bins))
    if not through_model:
        value = jax.lax.stop_gradient(value)
    returns = lambda_returns(reward, value, discount, config.lam)  # [M, H]
    weight = jax.lax.stop_gradient(jnp.cumprod(discount, axis=1))[:, :-1]

    scale = ReturnScale(
        *update_percentiles(scale.low, scale.high, returns, config.return_decay, config.return_percentiles)
    )
    divisor = return_scale(scale.low, scale.high, config.return_floor)
    # The entropy's gradient goes to the actor at its own state, never through the states before.
    outputs = nets.apply("actor", params, states[:-1]) if through_model else imagined.policy
    distribution = policy(nets.heads, nets.spec.action, outputs)
    entropy = steps_last(distribution.entropy())
    if through_model:
        actor = dynamics_loss(returns / divisor, entropy, weight, config.entropy)
    else:
        advantage = (returns - value[:, :-1]) / divisor
        log_prob = steps_last(distribution.log_prob(imagined.action))
        actor = reinforce_loss(log_prob, advantage, entropy, weight, config.entropy)

    slow_value = lambda x: twohot_mean(nets.apply("critic", {"critic": slow_critic}, x), bins)
    logits = jnp.swapaxes(logits, 0, 1)[:, :-1]
    critic = critic_loss(logits, returns, steps_last(slow_value(states[:-1])), weight, bins, config.slow_scale)

    replay_critic = _replay_critic_loss(nets, config, params, slow_value, rollout, returns[:, 0])
    losses = {"actor": jnp.mean(actor), "critic": jnp.mean(critic), "replay_critic": jnp.mean(replay_critic)}
    metrics = {
        "imagined/return": jnp.mean(returns),
        "imagined/reward": jnp.mean(reward[:, 1:]),
        "imagined/value": jnp.mean(value),
        "imagined/return_scale": divisor,
        "policy/entropy": jnp.mean(entropy),
    }
    return losses, scale, jax.lax.stop_gradient(metrics)


def _replay_critic_loss(
    nets: Networks, config: BehaviorConfig, params: Params, slow_value, rollout: Rollout, imagined_return: Array
) -> Array:
    """Critic loss [B, T - 1] on replayed rewards, bootstrapped by the imagined return from each state [B*T]."""
    batch = rollout.batch
    bootstrap = jax.lax.stop_gradient(imagined_return).reshape(batch.reward.shape)
    discount = config.discount * (1 - batch.is_terminal.astype(jnp.float32))
    returns = lambda_returns(batch.reward, bootstrap, discount, config.lam, batch.is_last)
    bins = symexp_bins(nets.heads.bins)
    logits = nets.apply("critic", params, rollout.feature[:, :-1])
    slow = slow_value(jax.lax.stop_gradient(rollout.feature[:, :-1]))
    # A last step has no return of its own: what follows it in the sequence is another episode.
    weight = 1 - batch.is_last[:, :-1].astype(jnp.float32)
    return critic_loss(logits, returns, slow, weight, bins, config.slow_scale)
