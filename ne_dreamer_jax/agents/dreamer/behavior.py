"""Learning behaviour in imagination: rollouts of the prior under the policy, actor and critic losses.

States are indexed 0 .. H: state 0 is a replayed posterior, state t + 1 follows from the action at t. The reward and
the continuation of state t + 1 were received on arrival at it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

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
from ne_dreamer_jax.nets.heads import model_action, policy, policy_noise, squared_means
from ne_dreamer_jax.nets.microbatches import in_microbatches
from ne_dreamer_jax.nets.networks import Networks
from ne_dreamer_jax.nets.rematerialise import keeping_products
from ne_dreamer_jax.nets.rssm import RSSM, feature
from ne_dreamer_jax.settings import BEFORE, ranges
from ne_dreamer_jax.settings.ranges import LARGEST, Count, NonNegative, Positive, Range, Share, ShareBelowOne
from ne_dreamer_jax.types import Array, ContinuousAction, Latent, Metrics, Params, ReturnScale, Rollout

LOSSES = ("actor", "critic", "replay_critic")


Percentile = Annotated[float, Range(0.0, 100.0)]


@dataclass(frozen=True)
class BehaviorConfig:
    """Settings of the actor-critic."""

    horizon: Annotated[int, Range(1, 10_000)] = 15
    """H, imagined steps."""
    imagine_last: Annotated[int, Range(2, LARGEST)] | None = None
    """Behaviour is learned at this many last states of each replayed sequence (imag_last in DreamerV3's code):
    imagination starts there, and the critic learns from replay there. None: at all T, and so for more than T."""
    discount: ShareBelowOne = 0.997
    """The paper's table prints 0.85, its code and DreamerV3 use 0.997 (1 - 1/333)."""
    discount_in_head: bool = field(default=False, metadata={BEFORE: True})
    """Whether the continuation head is trained towards discount * (1 - terminal), as DreamerV3, or towards 1 - terminal
    with the discount multiplied outside, as in the paper's equations and the released code."""
    lam: Share = 0.95
    """lambda of the returns."""
    entropy: NonNegative = 3e-4
    """eta, scale of the policy's entropy."""
    entropy_final: NonNegative | None = None
    """What eta falls (or rises) to, linearly over the first `entropy_updates`. None: eta stays as it is, as in the
    paper and DreamerV3."""
    entropy_updates: Count = 10_000
    """Updates until `entropy_final`, where there is one. A forked run counts its parent's updates too."""
    mean_penalty: NonNegative = 0.0
    """Weight of the squares of the policy's means before their tanh, summed over a continuous action's components. It
    keeps a policy from the ends of tanh, where next to no gradient reaches the actor (rlkit's soft actor-critic has it,
    averaged over the components, at 1e-3). 0 as in the paper and DreamerV3; discrete policies have no such means."""
    gradient: Literal["reinforce", "dynamics"] = "reinforce"
    """How the actor is trained: by the score function, or through the world model. There an action's gradient takes
    all ways to later rewards, that through the policy's later choices included (Dreamer's code leaves that one out)."""
    slow_rate: Annotated[float, Range(0.0, 1.0, above=True)] = 0.02
    """Share of the critic that moves into the slow critic at each update."""
    slow_scale: NonNegative = 1.0
    """Weight of the critic's regularisation towards the slow critic."""
    return_decay: ShareBelowOne = 0.99
    """Decay of the moving percentiles of the returns."""
    return_percentiles: tuple[Percentile, Percentile] = (5.0, 95.0)
    """The returns are normalised by the range between these."""
    percentile_method: Literal["linear", "nearest"] = "linear"
    """What a percentile that lies between two returns is: interpolated, or the nearer one (the released code)."""
    return_floor: Positive = 1.0
    """Returns are never divided by less."""

    def __post_init__(self) -> None:
        ranges.check(self)
        low, high = self.return_percentiles
        if low >= high:
            raise ValueError(f"behavior.return_percentiles: expected the first below the second, got {low} and {high}.")


class Trajectory(NamedTuple):
    """M imagined trajectories, and what was made of their states."""

    seen: Any  # [H, M, ...], what ``look`` returned at the states 0 .. H - 1
    last: Any  # [M, ...], and at state H
    policy: Array  # float32 [H, M, outputs], the actor's outputs at all states but the last
    action: Array  # float32 [H, M, A], raw samples: not clipped


class Noise(NamedTuple):
    """The random numbers of M imagined trajectories."""

    action: Array  # [H, M, ...], see `policy_noise`
    latent: Array  # [H, M, S], uniform


def entropy_scale(config: BehaviorConfig, update: Array) -> Array:
    """eta at an update (int32 [], from 0), float32 []."""
    first = jnp.float32(config.entropy)
    if config.entropy_final is None:
        return first
    share = jnp.minimum(update.astype(jnp.float32) / config.entropy_updates, 1.0)
    return first + share * (config.entropy_final - first)


def imagination_noise(nets: Networks, key: Array, rows: int, horizon: int) -> Noise:
    """Draws `Noise` for M = ``rows`` trajectories of H = ``horizon`` steps; the key is consumed."""

    def of_step(key: Array) -> Noise:
        action_key, latent_key = jax.random.split(key)
        uniform = jax.random.uniform(latent_key, (rows, nets.rssm.config.stoch))
        return Noise(policy_noise(nets.spec.action, action_key, (rows,)), uniform)

    return jax.vmap(of_step)(jax.random.split(key, horizon))


@jax.named_scope("imagination")
def imagine(
    nets: Networks,
    params: Params,
    noise: Noise,
    start: Latent,
    look: Callable[[Array], Any] = lambda state: state,
    through_model: bool = False,
) -> Trajectory:
    """H steps of the prior under the policy from ``start`` [M, ...], H being that of the noise; the models see clipped
    actions.

    ``look`` is applied to each state's feature [M, F] while it is at hand: what heads make of it is small, and all
    features of all states are not.

    Gradients of ``policy`` reach the actor's parameters. Those of states and actions do so only where
    ``through_model``; otherwise actions are constants, and the actor need not be run again for its loss.
    """

    def step(latent: Latent, noise: Noise) -> tuple[Latent, tuple[Any, Array, Array]]:
        state = feature(latent)
        outputs = keeping_products(partial(nets.apply, "actor"))({"actor": params["actor"]}, state)
        raw = policy(nets.heads, nets.spec.action, outputs).from_noise(noise.action)
        raw = raw if through_model else jax.lax.stop_gradient(raw)
        action = model_action(nets.spec.action, raw, nets.heads.clip_actions)
        after: Any = nets.rssm.apply({"params": params["rssm"]}, latent, action, noise.latent, method=RSSM.imagine_step)
        return after, (look(state), outputs, raw)

    last, (seen, outputs, actions) = jax.lax.scan(step, start, noise)
    return Trajectory(seen, look(feature(last)), outputs, actions)


def expected_discount(config: BehaviorConfig, logits: Array) -> Array:
    """What the continuation head's output [..., 1] says that the value of a state counts for, [...].

    The head's probability contains the discount already, or it is multiplied here (`BehaviorConfig.discount_in_head`).
    """
    going_on = jax.nn.sigmoid(logits[..., 0])
    return going_on if config.discount_in_head else config.discount * going_on


def head_discount(config: BehaviorConfig) -> float:
    """What the continuation head is trained towards where the episode goes on."""
    return config.discount if config.discount_in_head else 1.0


class Judgement(NamedTuple):
    """What the heads say of states [...]."""

    reward: Array  # float32 [...], received on arrival
    discount: Array  # float32 [...], the discount times the probability of going on
    value: Array  # float32 [...]
    logits: Array  # float32 [..., bins], the critic's
    slow_value: Array  # float32 [...]
    policy: Array | None  # float32 [..., outputs], the actor's with the state held fixed, where gradients pass states


@jax.named_scope("behavior")
def actor_critic_losses(
    nets: Networks,
    config: BehaviorConfig,
    params: Params,
    slow_critic: Params,
    scale: ReturnScale,
    key: Array,
    rollout: Rollout,
    update: Array,
    microbatches: int = 1,
) -> tuple[dict[str, Array], ReturnScale, Metrics]:
    """Actor and critic losses in imagination and the critic's on replay, each averaged; and the new return scale.

    All of them, the return scale and the metrics are of the rollout's last ``config.imagine_last`` steps, or of all.
    The imagined losses train the actor and the critic alone. The replayed one also trains the world model, through
    ``rollout.feature`` (DreamerV3). The trajectories may be imagined in several ``microbatches``; the percentiles of
    their returns are those of all. The entropy's weight is that of the ``update``, int32 [].
    """
    eta = entropy_scale(config, update)
    frozen = jax.lax.stop_gradient(params)
    through_model = config.gradient == "dynamics"
    bins = symexp_bins(nets.heads.bins)
    slow_value = lambda x: twohot_mean(nets.apply("critic", {"critic": slow_critic}, x), bins)

    def judge(state: Array) -> Judgement:
        apply = lambda name, params, x: keeping_products(partial(nets.apply, name))({name: params[name]}, x)
        fixed = jax.lax.stop_gradient(state)
        logits = apply("critic", params, fixed)
        seen = state if through_model else fixed
        return Judgement(
            reward=twohot_mean(apply("reward", frozen, seen), bins),
            discount=expected_discount(config, apply("continue", frozen, seen)),
            value=twohot_mean(apply("critic", frozen, seen) if through_model else jax.lax.stop_gradient(logits), bins),
            logits=logits,
            slow_value=slow_value(fixed),
            policy=apply("actor", params, fixed) if through_model else None,
        )

    acting = {**frozen, "actor": params["actor"]}
    replayed = Replayed.of(rollout, config.imagine_last)
    start = jax.lax.stop_gradient(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), replayed.latent))
    noise = imagination_noise(nets, key, start.deter.shape[0], config.horizon)
    dream = lambda start, noise: imagine(nets, acting, noise, start, judge, through_model)
    imagined = in_microbatches(dream, microbatches, (0, 1), Trajectory(1, 0, 1, 1))(start, noise)  # type: ignore[arg-type]
    seen, last = imagined.seen, imagined.last
    of_all = lambda before, last: jnp.concatenate([before, last[None]]).T  # [M, H + 1]
    reward, discount, value = (
        of_all(seen.reward, last.reward),
        of_all(seen.discount, last.discount),
        of_all(seen.value, last.value),
    )
    returns = lambda_returns(reward, value, discount, config.lam)  # [M, H]
    weight = jax.lax.stop_gradient(jnp.cumprod(discount, axis=1))[:, :-1]

    scale = ReturnScale(
        *update_percentiles(
            scale.low, scale.high, returns, config.return_decay, config.return_percentiles, config.percentile_method
        )
    )
    divisor = return_scale(scale.low, scale.high, config.return_floor)
    # The entropy's gradient goes to the actor at its own state, never through the states before.
    outputs = imagined.policy if seen.policy is None else seen.policy
    distribution = policy(nets.heads, nets.spec.action, outputs)
    entropy = distribution.entropy().T
    if through_model:
        actor = dynamics_loss(returns / divisor, entropy, weight, eta)
    else:
        advantage = (returns - value[:, :-1]) / divisor
        log_prob = distribution.log_prob(imagined.action).T
        actor = reinforce_loss(log_prob, advantage, entropy, weight, eta)
    squares = squared_means(nets.spec.action, outputs).T
    if config.mean_penalty:
        actor = actor + config.mean_penalty * weight * squares

    critic = critic_loss(seen.logits, returns.T, seen.slow_value, weight.T, bins, config.slow_scale)  # [H, M]
    replay_critic = _replay_critic_loss(nets, config, params, slow_value, replayed, returns[:, 0])
    losses = {"actor": jnp.mean(actor), "critic": jnp.mean(critic), "replay_critic": jnp.mean(replay_critic)}
    metrics = {
        "imagined/return": jnp.mean(returns),
        "imagined/reward": jnp.mean(reward[:, 1:]),
        "imagined/value": jnp.mean(value),
        "imagined/return_scale": divisor,
        "policy/entropy": jnp.mean(entropy),
    }
    if isinstance(nets.spec.action, ContinuousAction):
        metrics["policy/squared_means"] = jnp.mean(squares)
    if config.entropy_final is not None:
        metrics["policy/entropy_scale"] = eta
    return losses, scale, jax.lax.stop_gradient(metrics)


class Replayed(NamedTuple):
    """The last K steps of a rollout, of B sequences: what behaviour is learned from."""

    latent: Latent  # [B, K, ...]
    feature: Array  # float32 [B, K, F]
    reward: Array  # float32 [B, K]
    is_last: Array  # bool [B, K]
    is_terminal: Array  # bool [B, K]

    @classmethod
    def of(cls, rollout: Rollout, steps: int | None) -> Replayed:
        """All of the rollout's steps where ``steps`` is none or more than there are."""
        batch = rollout.batch
        all_of_it = cls(rollout.latent, rollout.feature, batch.reward, batch.is_last, batch.is_terminal)
        return all_of_it if steps is None else jax.tree.map(lambda x: x[:, -steps:], all_of_it)


def _replay_critic_loss(
    nets: Networks, config: BehaviorConfig, params: Params, slow_value, replayed: Replayed, imagined_return: Array
) -> Array:
    """Critic loss [B, K - 1] on replayed rewards, bootstrapped by the imagined return from each state [B*K]."""
    bootstrap = jax.lax.stop_gradient(imagined_return).reshape(replayed.reward.shape)
    discount = config.discount * (1 - replayed.is_terminal.astype(jnp.float32))
    returns = lambda_returns(replayed.reward, bootstrap, discount, config.lam, replayed.is_last)
    bins = symexp_bins(nets.heads.bins)
    logits = nets.apply("critic", params, replayed.feature[:, :-1])
    slow = slow_value(jax.lax.stop_gradient(replayed.feature[:, :-1]))
    # A last step has no return of its own: what follows it in the sequence is another episode.
    weight = 1 - replayed.is_last[:, :-1].astype(jnp.float32)
    return critic_loss(logits, returns, slow, weight, bins, config.slow_scale)
