"""Runs the authors' released code on the small agent: ``python -m tests.released.compare CHECKOUT [--write]``.

CHECKOUT is a copy of https://github.com/corl-team/nedreamer; it needs PyTorch, tensordict and einops beside this
package. Its networks get our parameters, its distributions our random numbers, in float32 without mixed precision; what
it makes of them is compared with what we make of them, and stored for tests/test_released.py if asked to.
"""

from __future__ import annotations

import contextlib
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import jax
import numpy as np

try:
    import torch
    from torch import distributions as torchd
except ModuleNotFoundError:
    print(
        "The authors' code needs PyTorch: pip install torch==2.8.0 torchrl==0.9.2 tensordict==0.9.1 einops",
        file=sys.stderr,
    )
    raise SystemExit(2) from None

from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.dreamer.agent import AgentConfig
from ne_dreamer_jax.commands import train
from ne_dreamer_jax.objectives import DreamerPro, NextEmbedding, Reconstruction
from ne_dreamer_jax.types import Batch, DiscreteAction, EnvSpec
from tests.released import measure, names, setting

LOSSES = {
    "dyn": "dynamics",
    "rep": "representation",
    "rew": "reward",
    "con": "continue",
    "policy": "actor",
    "value": "critic",
    "repval": "replay_critic",
    "ne_dreamer": "next_embedding",
    "barlow": "same_step",
    "swav": "swav",
    "temp": "temporal",
    "norm": "norm",
}
METHOD = {"ne_dreamer": "ne_dreamer", "dreamerv3": "dreamer", "r2dreamer": "r2dreamer", "dreamerpro": "dreamerpro"}


class Settings(types.SimpleNamespace):
    """Settings by attribute and by name, as the authors' code reads them."""

    def __getitem__(self, name: str) -> Any:
        return getattr(self, name)

    def __iter__(self) -> Iterator[str]:
        return iter(vars(self))

    def keys(self) -> Any:
        return vars(self).keys()


def settings(config: AgentConfig, method: str) -> Settings:
    """Their settings of our agent; those that say nothing at this size are as in their configuration files."""
    rssm, heads, encoder, behavior, optimizer = (
        config.rssm,
        config.heads,
        config.encoder,
        config.behavior,
        config.optimizer,
    )
    common = {"act": "SiLU", "norm": True, "device": "cpu", "units": heads.units, "symlog_inputs": False}
    twohot = Settings(name="symexp_twohot", bin_num=heads.bins)

    def head(name: str, layers: int, shape: Any, dist: Settings, scale: float) -> Settings:
        return Settings(**common, name=name, layers=layers, shape=shape, dist=dist, outscale=scale)

    vectors = Settings(**{**common, "units": encoder.units}, name="mlp_encoder", layers=encoder.layers)
    vectors.symlog_inputs = True
    decoded = head("mlp_decoder", encoder.layers, None, Settings(name="identity"), 1.0)
    decoded.units = encoder.units
    pictures = {"act": "SiLU", "norm": True, "kernel_size": encoder.kernel, "depth": encoder.depth}
    keys = {"mlp_keys": ".*", "cnn_keys": ".*"}  # vectors and pictures are told apart by their shapes
    blocks = config.objective.blocks if isinstance(config.objective, Reconstruction) else 1
    world_model = Settings(
        rssm=Settings(
            stoch=rssm.stoch,
            deter=rssm.deter,
            hidden=rssm.hidden,
            discrete=rssm.classes,
            img_layers=rssm.prior_layers,
            obs_layers=1,
            dyn_layers=1,
            blocks=rssm.blocks,
            act="SiLU",
            unimix_ratio=rssm.unimix,
            initial="learned",
            device="cpu",
        ),
        encoder=Settings(**keys, mlp=vectors, cnn=Settings(**pictures, mults=list(encoder.multipliers))),
        decoder=Settings(
            **keys,
            mlp=decoded,
            cnn=Settings(**pictures, mults=list(encoder.multipliers), units=encoder.units, bspace=blocks),
            mlp_dist=Settings(name="symlog_mse"),
            cnn_dist=Settings(name="mse"),
        ),
        reward_head=head("reward", heads.reward_layers, [heads.bins], twohot, 0.0),
        cont_head=head("cont", heads.continue_layers, [1], Settings(name="binary"), 1.0),
    )
    dists = Settings(
        cont=Settings(name="bounded_normal", min_std=heads.min_std, max_std=heads.max_std),
        disc=Settings(name="onehot", unimix_ratio=heads.unimix),
    )
    return Settings(
        device="cpu",
        compile=False,
        log_grads=False,
        rep_loss=METHOD[method.partition("/")[0]],
        act_entropy=behavior.entropy,
        kl_free=config.world_model.free_nats,
        imag_horizon=behavior.horizon,
        horizon=round(1 / (1 - behavior.discount)),
        lamb=behavior.lam,
        lr=optimizer.learning_rate,
        agc=optimizer.agc,
        pmin=optimizer.agc_pmin,
        eps=optimizer.eps,
        beta1=optimizer.beta1,
        beta2=optimizer.beta2,
        warmup=optimizer.warmup,
        loss_scales=_loss_scales(config),
        world_model=world_model,
        behavior=Settings(
            slow_target_update=1,
            slow_target_fraction=behavior.slow_rate,
            actor=head("actor", heads.actor_layers, None, dists, heads.actor_scale),
            critic=head("value", heads.critic_layers, [heads.bins], twohot, 0.0),
        ),
        **_objective(config.objective),
    )


def _loss_scales(config: AgentConfig) -> dict[str, float]:
    scales = {theirs: config.loss_scales[ours] for theirs, ours in LOSSES.items() if ours in config.loss_scales}
    return {**scales, "recon": 1.0}


def _objective(objective: Any) -> dict[str, Settings]:
    predictor = objective.predictor if isinstance(objective, NextEmbedding) else NextEmbedding().predictor
    shift = objective.shift if isinstance(objective, NextEmbedding) else 1
    pro = objective if isinstance(objective, DreamerPro) else DreamerPro()
    return {
        "r2dreamer": Settings(lambd=5e-4),
        "ne_dreamer": Settings(
            hidden_dim=predictor.width,
            num_layers=predictor.layers,
            num_heads=predictor.heads,
            dropout=0.0,
            use_actions=True,
            use_projector=predictor.projector,
            use_same=shift == 0,
            use_next=shift == 1,
            predict_horizon=1,
            horizon_discount=0.9,
            loss_type="barlow",
            lambd=5e-4,
            weight_same=1.0,
            weight_next=1.0,
        ),
        "dreamer_pro": Settings(
            warm_up=pro.warm_up,
            num_prototypes=pro.prototypes,
            proto_dim=pro.dimension,
            temperature=pro.temperature,
            sinkhorn_eps=pro.epsilon,
            sinkhorn_iters=pro.iterations,
            ema_update_every=1,
            ema_update_fraction=pro.teacher_rate,
            freeze_prototypes_iters=pro.frozen_updates,
            aug=Settings(max_delta=pro.max_shift, same_across_time=True, bilinear=True),
        ),
    }


def load(checkout: Path) -> Any:
    """Their module ``dreamer``. What it logs and stores with is put aside; what PyTorch has dropped is back."""
    for name in ("wandb", "boto3", "dotenv"):
        module = types.ModuleType(name)
        module.load_dotenv = lambda *_: None  # type: ignore[attr-defined]
        sys.modules.setdefault(name, module)
    torch.Tensor.add_ = _old_add  # type: ignore[method-assign, assignment]
    sys.path.insert(0, str(checkout))
    import dreamer

    return dreamer


@contextlib.contextmanager
def given(dists: Any, queue: list[np.ndarray]) -> Iterator[None]:
    """Their distributions draw by these random numbers, in this order."""

    def onehot(self: Any, sample_shape: Any = ()) -> torch.Tensor:
        uniform = torch.from_numpy(queue.pop(0))
        probs = self.probs
        place = (probs.detach().cumsum(-1)[..., :-1] <= uniform[..., None]).sum(-1)
        sample = torch.nn.functional.one_hot(place, probs.shape[-1]).to(probs)
        return sample + (probs - probs.detach())

    def normal(self: Any, sample_shape: Any = ()) -> torch.Tensor:
        return self.mean + self.stddev * torch.from_numpy(queue.pop(0))

    before = dists.OneHotDist.rsample, torchd.Normal.rsample
    dists.OneHotDist.rsample, torchd.Normal.rsample = onehot, normal
    try:
        yield
    finally:
        dists.OneHotDist.rsample, torchd.Normal.rsample = before


def in_order(config: AgentConfig, method: str, draws: setting.Draws) -> list[np.ndarray]:
    """The random numbers in the order in which their update draws them, zeros where it uses none of what it draws."""
    rows = list(np.moveaxis(draws.observe, 1, 0))
    queue = [*rows, np.zeros_like(draws.observe)]
    if method == "dreamerpro":
        queue += list(np.moveaxis(draws.views, 1, 0))
    for action, latent in zip(draws.action, draws.imagine, strict=True):
        queue += [action, latent]
    return [*queue, np.zeros_like(draws.action[0]), np.zeros_like(draws.imagine[0])]


def data_of(spec: EnvSpec, batch: Batch) -> Any:
    """A batch as their update takes it."""
    from tensordict import TensorDict

    lift = lambda x: torch.from_numpy(np.asarray(x, np.float32))[..., None]
    flag = lambda x: torch.from_numpy(np.asarray(x))[..., None]
    action = np.asarray(batch.prev_action)
    if isinstance(spec.action, DiscreteAction):
        action = np.eye(spec.action.size, dtype=np.float32)[action]
        action[np.asarray(batch.is_first)] = 0.0
    fields = {
        "image": torch.from_numpy(np.asarray(batch.obs["image"], np.float32) / np.float32(255)),
        "vector": torch.from_numpy(np.asarray(batch.obs["vector"])),
        "action": torch.from_numpy(action),
        "reward": lift(batch.reward),
        **{name: flag(getattr(batch, name)) for name in ("is_first", "is_last", "is_terminal")},
    }
    return TensorDict(fields, batch_size=batch.reward.shape)


def run(dreamer: Any, method: str, actions: str) -> setting.Run:
    """Their run on our small agent."""
    config, spec, _, state = setting.start(method, actions)
    theirs = _make(dreamer, config, spec, method)
    _give(theirs, config, state)
    key, losses, gradients = state.key, [], {}
    for update in range(setting.UPDATES):
        draws = setting.draws(config, spec.action, key)
        key, _ = jax.random.split(key)
        batch = setting.batch(config, spec, update)
        initial = tuple(torch.from_numpy(np.array(x)) for x in (batch.context.stoch, batch.context.deter))
        theirs._ac._update_slow_target()
        if method == "dreamerpro":
            theirs.ema_update()
        queue = in_order(config, method, draws)
        with given(sys.modules["distributions"], queue):
            _, metrics = theirs._cal_grad(data_of(spec, batch), initial)
        assert not queue, f"{len(queue)} random numbers were not drawn"
        losses.append({name: float(x.detach()) for name, x in metrics.items() if name.startswith("loss/")})
        found = {name: p.grad.numpy().copy() for name, p in theirs._named_params.items() if p.grad is not None}
        if method == "dreamerpro":
            theirs._prototypes.grad.zero_()
            found["prototypes"] = np.zeros_like(found["prototypes"])
        gradients = gradients or found
        theirs._agc(theirs._named_params.values())
        theirs._optimizer.step()
        theirs._scheduler.step()
        theirs._optimizer.zero_grad(set_to_none=True)
    after = {name: p.detach().numpy().copy() for name, p in theirs._named_params.items() if name in gradients}
    by_name: dict[str, list[float]] = {}
    for line in losses:
        reconstruction = sum(x for name, x in line.items() if name[5:] not in LOSSES)
        line = {LOSSES[name[5:]]: x for name, x in line.items() if name[5:] in LOSSES}
        line |= {"reconstruction": reconstruction} if method == "dreamerv3" else {}
        for name, x in line.items():
            by_name.setdefault(name, []).append(x)
    return setting.Run({name: np.asarray(x, np.float32) for name, x in by_name.items()}, gradients, setting.some(after))


def initial_deviations(dreamer: Any, method: str) -> dict[str, tuple[float, float]]:
    """Tensor -> standard deviation of its first values in our agent and in theirs, at the size 1m."""
    config = train.configure("released_code", "1m", method, {}).agent
    assert isinstance(config, AgentConfig)
    spec = setting.spec("continuous", side=64)
    params = make_agent(config, spec).init(jax.random.key(0)).params
    ours = names.to_theirs(config, 64, params)
    theirs = _make(dreamer, config, spec, method)._named_params
    return {name: (float(x.std()), float(theirs[name].detach().numpy().std())) for name, x in ours.items()}


def _make(dreamer: Any, config: AgentConfig, spec: EnvSpec, method: str) -> Any:
    """Their agent, of our settings."""
    shapes = {name: types.SimpleNamespace(shape=s.shape) for name, s in spec.observation.items()}
    size = spec.action.size
    space = types.SimpleNamespace(shape=(size,), low=-np.ones(size), high=np.ones(size))
    if isinstance(spec.action, DiscreteAction):
        space.discrete = True
    with contextlib.redirect_stdout(None):
        return dreamer.Dreamer(settings(config, method), types.SimpleNamespace(spaces=shapes), space)


def _give(theirs: Any, config: AgentConfig, state: Any) -> None:
    """Sets their parameters to ours."""
    ours = names.to_theirs(config, setting.SIDE, state.params)
    known = dict(theirs._named_params)
    missing = {name for name, p in known.items() if p.requires_grad} - set(ours)
    assert not missing, f"no parameters of ours for {sorted(missing)}"
    assert not (extra := set(ours) - set(known)), f"parameters that they have not: {sorted(extra)}"
    with torch.no_grad():
        for name, value in ours.items():
            assert known[name].shape == value.shape, (name, known[name].shape, value.shape)
            known[name].copy_(torch.from_numpy(np.array(value)))
        for slow, fast in zip(theirs._ac._slow_value.parameters(), theirs._ac.value.parameters(), strict=True):
            slow.copy_(fast)
    theirs.clone_and_freeze()


def _old_add(self: torch.Tensor, *args: Any, **options: Any) -> torch.Tensor:
    """``add_(alpha, other)``, which their optimiser calls and PyTorch has dropped."""
    if len(args) == 2:
        return _add(self, args[1], alpha=args[0])
    return _add(self, *args, **options)


_add = torch.Tensor.add_


@click.command()
@click.argument("checkout", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--case", "cases", type=(str, str), multiple=True, help="METHOD ACTIONS; may be repeated.")
@click.option("--initial", is_flag=True, help="Compare the networks' first values only, at the size 1m.")
@click.option("--write", is_flag=True, help="Store their numbers for the tests.")
def main(checkout: Path, cases: tuple[tuple[str, str], ...], initial: bool, write: bool) -> None:
    """Compare this package with a checkout of the authors' code."""
    torch.set_num_threads(1)
    jax.config.update("jax_disable_most_optimizations", True)  # as the tests do
    dreamer = load(checkout)
    if initial:
        for method in setting.METHODS:
            for name, (mine, other) in initial_deviations(dreamer, method).items():
                if abs(mine - other) > 0.1 * max(mine, other):
                    click.echo(f"{method}: {name} starts with a deviation of {mine:.4f}, theirs with {other:.4f}")
        return
    stored: dict[str, np.ndarray] = {}
    for method, actions in cases or setting.CASES:
        theirs = run(dreamer, method, actions)
        ours = measure.run(method, actions)
        found = measure.differences(ours, theirs).items()
        parts = ", ".join(f"{part} {largest:.1e} ({name})" for part, (largest, name) in found)
        click.echo(f"{method}, {actions}: largest differences: {parts}")
        stored |= measure.flat(method, actions, theirs)
    if write:
        np.savez_compressed(setting.STORED, **stored)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
