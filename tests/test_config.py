"""Presets and methods, and that no setting is without effect."""

import itertools
import json
import typing
from dataclasses import fields, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from ne_dreamer_jax import config as configs
from ne_dreamer_jax import loop as loops
from ne_dreamer_jax import make_agent, objectives, settings
from ne_dreamer_jax.agents import drqv2, optim
from ne_dreamer_jax.agents.dreamer import world_model
from ne_dreamer_jax.agents.dreamer.agent import BASE_LOSS_SCALES
from ne_dreamer_jax.agents.dreamer.behavior import actor_critic_losses
from ne_dreamer_jax.commands import train
from ne_dreamer_jax.config import Config
from ne_dreamer_jax.envs import registry
from ne_dreamer_jax.envs.config import DmcConfig
from ne_dreamer_jax.loop import LoopConfig
from ne_dreamer_jax.objectives import DreamerPro, NextEmbedding, NoObjective, Reconstruction, SameStep
from ne_dreamer_jax.replay import ring as replay
from ne_dreamer_jax.runs import building
from ne_dreamer_jax.runs.schedule import Schedule
from ne_dreamer_jax.settings import names
from ne_dreamer_jax.types import ArraySpec, ContinuousAction, EnvSpec, ReturnScale, Rollout, TimeStep
from tests import counting, tiny
from tests.drqv2 import small
from tests.tiny import program

KEY = jax.random.key(0)

WORLD_MODEL_METHODS = [name for name in names.METHODS if name != names.DRQV2]


def test_commands_know_the_names_without_loading_the_registries():
    assert tuple(configs.PRESETS) == names.PRESETS
    assert tuple(configs.SIZES) == names.SIZES
    assert typing.get_args(typing.get_type_hints(DmcConfig)["obs"]) == names.OBSERVATIONS


@pytest.mark.parametrize("name", names.PRESETS)
def test_presets_build_at_every_size_and_survive_json(name):
    for size in (None, *names.SIZES):
        config = configs.preset(name, size)
        assert settings.from_dict(Config, json.loads(json.dumps(settings.to_dict(config)))) == config
        if size is not None:
            share = 2 if name in ("rooms_small", "laptop", "quickstart") else 1
            assert config.agent.rssm.deter == configs.SIZES[size]["deter"] // share
            assert config.agent.heads.units == config.agent.encoder.units == configs.SIZES[size]["units"]
    config = configs.preset(name)
    make_agent(config.agent, tiny.VECTORS)
    side = config.env.image_size
    pictures = EnvSpec({"image": ArraySpec((side, side, 3), jnp.dtype("uint8"))}, tiny.VECTORS.action)
    jax.eval_shape(make_agent(config.agent, pictures).init, jax.random.key(0))


ABLATIONS = [name for name in names.METHODS if name.startswith("ne_dreamer")]


@pytest.mark.parametrize("method", ABLATIONS)
def test_ablations_are_values_of_the_objective(method):
    base = configs.preset("dmc")
    config = configs.with_method(base, method)
    changed = {path for path, value in settings.paths(config).items() if value != settings.paths(base)[path]}
    ablation = {
        "ne_dreamer": set(),
        "ne_dreamer/no_transformer": {"agent.objective.predictor.layers"},
        "ne_dreamer/no_shift": {"agent.objective.shift"},
        "ne_dreamer/no_projector": {"agent.objective.predictor.projector"},
    }
    assert changed == ablation[method]


@pytest.mark.parametrize("method", WORLD_MODEL_METHODS)
def test_methods_differ_in_the_objective_and_the_weights_of_its_losses(method):
    base = configs.preset("dmc")
    config = configs.with_method(base, method)
    assert config.method == method
    stored = json.loads(json.dumps(settings.to_dict(config)))
    assert stored["agent"]["objective"]["type"] == type(config.agent.objective).__name__
    assert settings.from_dict(Config, stored) == config
    assert config.agent.loss_scales == {**BASE_LOSS_SCALES, **config.agent.objective.losses}
    shared = {"objective": NoObjective(), "loss_scales": {}}
    assert replace(config.agent, **shared) == replace(base.agent, **shared)
    for other in WORLD_MODEL_METHODS:  # by whatever way
        assert configs.with_method(configs.with_method(base, other), method) == config
    make_agent(config.agent, EnvSpec({"image": ArraySpec((64, 64, 3), jnp.uint8)}, ContinuousAction(2)))


def test_weights_of_losses_that_a_method_shares_are_kept():
    weighed = configs.override(configs.preset("dmc"), "agent.loss_scales.next_embedding=0.5")
    weighed = configs.override(weighed, "agent.loss_scales.reward=2")
    scales = configs.with_method(weighed, "ne_dreamer/no_shift").agent.loss_scales
    assert (scales["next_embedding"], scales["reward"]) == (0.5, 2)
    scales = configs.with_method(weighed, "r2dreamer").agent.loss_scales
    assert (scales["same_step"], scales["reward"]) == (0.05, 2)
    assert "next_embedding" not in scales


@pytest.mark.parametrize(
    ("assignments", "method"),
    [
        (["agent.objective.redundancy=0.1"], "ne_dreamer"),
        (["agent.objective.shift=0"], "ne_dreamer/no_shift"),
        (["agent.objective.shift=0", "agent.objective.predictor.layers=0"], "ne_dreamer/no_transformer+no_shift"),
        (["agent.objective=SameStep", "agent.objective.redundancy=0.1"], "r2dreamer"),
        (["agent.objective.alignment=cosine", "agent.objective.steps=3"], "ne_dreamer/3_steps+cosine"),
        (["agent.objective=SameStep", "agent.objective=NextEmbedding"], "ne_dreamer"),
    ],
)
def test_the_name_of_the_method_follows_the_settings(assignments, method):
    config = configs.preset("dmc")
    for assignment in assignments:
        config = configs.override(config, assignment)
    assert config.method == method
    make_agent(config.agent, tiny.VECTORS)


def test_drqv2_is_as_published_on_the_papers_budget():
    """In the paper's setting the world models learn every second agent step, as DrQ-v2 does."""
    config = configs.with_method(configs.preset("dmc"), "drqv2")
    assert config.method == "drqv2"
    assert config.agent == drqv2.for_task("dmc/walker_walk")
    assert (config.env.image_size, config.env.action_repeat, config.loop.prefill) == (84, 2, 2_000)
    assert (config.loop.replay_ratio, config.loop.write_latents) == (512 * 4 / 2, False)
    stored = json.loads(json.dumps(settings.to_dict(config)))
    assert stored["agent"]["type"] == "DrQv2Config"
    assert settings.from_dict(Config, stored) == config
    assert configs.override(config, "agent.features=10").agent.features == 10
    assert configs.with_method(config, "drqv2") == config
    with pytest.raises(ValueError, match="expected a config of a world-model method to make ne_dreamer of"):
        configs.with_method(config, "ne_dreamer")
    hard = configs.with_method(configs.override(configs.preset("dmc"), "env.task=dmc/cheetah_run"), "drqv2")
    assert (hard.agent.noise_steps, hard.agent.n_step, hard.loop.replay_ratio) == (500_000, 3, 256 * 6 / 2)


def test_drqv2s_noise_keeps_step_with_the_loop():
    config = configs.with_method(configs.preset("dmc"), "drqv2")
    for assignment, every in (("agent.batch_size=128", 0.5), ("loop.replay_ratio=512", 1.0), ("agent.n_step=5", 2.0)):
        config = configs.override(config, assignment)
        configs.check(config)
        assert config.agent.steps_per_update == every
    config = configs.override(config, "loop.prefill=3_000")
    assert config.agent.random_steps == 3_000
    with pytest.raises(ValueError, match=r"steps_per_update: expected 2, .* got 4; with loop.replay_ratio=256 it fits"):
        configs.check(configs.override(config, "agent.steps_per_update=4"))
    with pytest.raises(ValueError, match=r"random_steps: expected loop.prefill, 3,000"):
        configs.check(configs.override(config, "agent.random_steps=5"))
    many = configs.with_method(configs.override(configs.preset("dmc"), "loop.num_envs=1024"), "drqv2")
    with pytest.raises(
        ValueError, match=r"loop.prefill: expected at least 5,120, 5 steps of each of 1,024 .*got 2,000"
    ):
        configs.check(many)
    configs.check(configs.override(many, "loop.prefill=5120"))
    configs.check(configs.override(many, "loop.num_envs=499"))  # 2,000 steps begin the fifth of each
    configs.check(configs.override(many, "loop.replay_ratio=0"))
    never = configs.with_method(configs.override(configs.preset("dmc"), "loop.replay_ratio=0"), "drqv2")
    assert (never.loop.replay_ratio, never.agent.steps_per_update) == (0, 2)
    configs.check(never)


@pytest.mark.parametrize("name", names.PRESETS)
def test_drqv2_keeps_the_number_of_updates_of_a_preset(name):
    preset = configs.preset(name)
    config = configs.with_method(preset, "drqv2")
    updates = [c.loop.replay_ratio / (c.agent.batch_size * c.agent.batch_length) for c in (preset, config)]
    assert updates[1] == pytest.approx(updates[0])
    assert config.agent.steps_per_update == pytest.approx(1 / updates[1])
    assert config.agent.random_steps == config.loop.prefill <= preset.loop.prefill
    make_agent(config.agent, EnvSpec({"image": ArraySpec((84, 84, 3), jnp.uint8)}, ContinuousAction(2)))


@pytest.mark.parametrize("name", names.PRESETS)
def test_a_method_keeps_the_sizes_of_a_preset(name):
    preset = configs.preset(name)
    assert configs.with_method(preset, "ne_dreamer") == preset
    shiftless = configs.with_method(preset, "ne_dreamer/no_shift").agent.objective
    assert shiftless.predictor == preset.agent.objective.predictor


def test_the_defaults_are_the_papers():
    agent, loop = configs.preset("dmc").agent, configs.preset("dmc").loop
    assert (agent.batch_size, agent.batch_length, loop.num_envs, loop.replay_ratio) == (16, 64, 16, 512)
    assert (agent.rssm.stoch, agent.behavior.horizon, agent.behavior.lam, agent.behavior.entropy) == (
        32,
        15,
        0.95,
        3e-4,
    )
    optimizer = agent.optimizer
    assert (optimizer.name, optimizer.learning_rate, optimizer.eps, optimizer.agc) == ("adam", 4e-5, 1e-20, 0.3)
    predictor = agent.objective.predictor
    assert (predictor.layers, predictor.width, predictor.heads) == (2, 256, 4)
    assert agent.objective == NextEmbedding()
    assert agent.loss_scales == {**BASE_LOSS_SCALES, "next_embedding": 1.0}
    # "Replayed steps per policy step": what the run replays over what it acts, once it learns.
    env = counting.env()
    budget = loops.make(loop, env, counting.stub(env.spec, 16, 64), 2).budget
    acting = budget.vector_steps * 16 - budget.prefill * 16
    assert budget.updates * 16 * 64 / acting == pytest.approx(512, rel=1e-3)


def test_the_released_code_differs_where_fidelity_says_so():
    paper, code = (settings.paths(configs.preset(name, "12m")) for name in ("dmc", "released_code"))
    assert {path: value for path, value in code.items() if paper[path] != value} == {
        "agent.heads.clip_actions": False,
        "agent.world_model.kl_unimix": 0.0,
        "agent.objective.action": "previous",
        "agent.objective.masked": False,
        "agent.objective.across_episodes": True,
        "agent.objective.unshifted_token": "state",
        "agent.objective.sample_deviation": True,
        "agent.objective.predictor.discrete_action": "normalised",
        "agent.objective.predictor.attention_init": "xavier",
        "agent.behavior.percentile_method": "nearest",
        "agent.optimizer.name": "laprop_weighted",
        "loop.env_steps": 1_010_000,
        "loop.eval_every": 10_000,
        "loop.eval_episodes": 8,
        "loop.capacity": 500_000,
        "loop.write_latents": False,
        "loop.prefill": 1_056,
        "agent.behavior.discount": 1 - 1 / 333,
    }
    assert code["agent.behavior.discount_in_head"] is False, "whatever the default is"
    fidelity = (Path(__file__).parents[1] / "experiments" / "FIDELITY.md").read_text()
    for path in code:
        if paper[path] != code[path]:
            assert f"`{path}" in fidelity, path
    for released in configs.RELEASED:
        default = type(released)()
        for path in settings.paths(released):
            if settings.paths(default)[path] != settings.paths(released)[path]:
                assert f"agent.objective.{path}" in fidelity, path


@pytest.mark.parametrize("released", configs.RELEASED, ids=lambda x: type(x).__name__)
def test_the_released_code_has_its_own_baselines(released):
    method = names.method_of(released)
    assert train.configure("released_code", None, method, {}).agent.objective == released != type(released)()
    assert train.configure("dmc", None, method, {}).agent.objective == type(released)()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: configs.preset("quickstrat"), "no preset is called 'quickstrat'. Did you mean quickstart?"),
        (lambda: configs.preset("dmc", "12"), "no size is called '12'. Did you mean .*12m"),
        (lambda: configs.agent_config("13m"), "no size is called '13m'. Did you mean"),
        (
            lambda: configs.with_method(Config(), "ne_dreamer/no_transfomer"),
            "no method is called .* Did you mean ne_dreamer/no_transformer",
        ),
    ],
)
def test_unknown_names_bring_the_nearest(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# Every setting changes something.

BASE = Config(
    agent=tiny.with_objective(steps=2),
    loop=LoopConfig(env_steps=600, num_envs=3, replay_ratio=1.0, prefill=30, eval_every=200),
)

CHANGES = {
    "agent.encoder": {
        "depth": "2",
        "multipliers": "2,2",
        "kernel": "5",
        "patch": "4",
        "layers": "2",
        "units": "4",
    },
    "agent.rssm": {
        "deter": "16",
        "stoch": "3",
        "classes": "3",
        "hidden": "4",
        "blocks": "2",
        "prior_layers": "2",
        "unimix": "0.02",
    },
    "agent.heads": {
        "units": "4",
        "reward_layers": "2",
        "continue_layers": "2",
        "actor_layers": "2",
        "critic_layers": "2",
        "bins": "11",
        "actor_scale": "0.5",
        "min_std": "0.2",
        "max_std": "0.8",
        "unimix": "0.02",
        "clip_actions": "false",
    },
    "agent.world_model": {"free_nats": "0.5", "kl_unimix": "0"},
    "agent.objective": {
        "predictor.layers": "0",
        "predictor.width": "4",
        "predictor.heads": "1",
        "predictor.feedforward": "8",
        "predictor.positions": "9",
        "predictor.projector": "false",
        "predictor.discrete_action": "normalised",
        "predictor.attention_init": "xavier",
        "shift": "0",
        "steps": "3",
        "step_discount": "0.9",
        "alignment": "vicreg",
        "redundancy": "0.1",
        "action": "previous",
        "masked": "false",
        "across_episodes": "true",
        "sample_deviation": "true",
        "unshifted_token": "state",
    },
    "agent.behavior": {
        "horizon": "2",
        "imagine_last": "3",
        "discount": "0.85",
        "discount_in_head": "true",
        "lam": "0.9",
        "entropy": "0.1",
        "entropy_final": "0.01",
        "entropy_updates": "7",
        "mean_penalty": "0.1",
        "gradient": "dynamics",
        "slow_scale": "0.5",
        "return_decay": "0.9",
        "return_percentiles": "10,95",
        "percentile_method": "nearest",
        "return_floor": "2",
    },
    "agent.optimizer": {
        "name": "laprop",
        "learning_rate": "1e-4",
        "actor_rate_factor": "0.5",
        "beta1": "0.8",
        "beta2": "0.99",
        "eps": "1e-8",
        "agc": "0.2",
        "agc_pmin": "1e-2",
        "warmup": "3",
    },
    "agent": {
        "batch_size": "3",
        "batch_length": "6",
        "microbatches": "2",
        "compute_dtype": "bfloat16",
        "objective": "SameStep",
        "behavior.slow_rate": "0.1",
        **{f"loss_scales.{name}": "0.7" for name in tiny.CONFIG.loss_scales},
    },
    "loop": {
        "env_steps": "700",
        "num_envs": "4",
        "replay_ratio": "2.5",
        "capacity": "100",
        "prefill": "60",
        "chunk_steps": "5",
        "eval_every": "300",
        "eval_episodes": "3",
        "eval_max_steps": "5",
        "max_skipped": "7",
        "write_latents": "false",
        "time_limits": "unmarked",
        "latent_dtype": "bfloat16",
        "storage": "states",
    },
}

TOGETHER = {
    "agent.objective.unshifted_token": "agent.objective.shift=0",
    "agent.behavior.entropy_updates": "agent.behavior.entropy_final=0.01",
}
"""Setting -> what must be set for it to mean anything."""


def networks(config):
    """Initialisation and acting, of both kinds of policy."""
    agent = config.agent
    for spec in (tiny.BOTH, tiny.DISCRETE):
        nets = tiny.networks(spec, agent)
        yield str(jax.eval_shape(nets.init, KEY))
    yield program(tiny.networks(tiny.BOTH, agent).init, KEY)
    yield from (acting(agent, spec) for spec in (tiny.VECTORS, tiny.DISCRETE))


def acting(agent, spec):
    made, step = make_agent(agent, spec), tiny.batch(spec, (1, 1), first=[(0, 0)])
    step = jax.tree.map(lambda x: x[:, 0], step._replace(context=None))
    params = jax.eval_shape(tiny.networks(spec, agent).init, KEY)
    return program(lambda params: made.act(params, made.init_policy(1), step, KEY), params)


def rollout_of(nets):
    """A rollout made of zeros."""
    batch = tiny.batch(nets.spec)
    latent = tiny.latent((2, 5))
    action = jnp.zeros((2, 5, nets.spec.action.size))
    feature = jnp.zeros((2, 5, nets.feature))
    return Rollout(batch, jnp.zeros((2, 5, nets.embedding)), latent, feature, action, action + 1)


def world(config):
    """The model's losses."""
    nets = tiny.networks(tiny.VECTORS)
    params = jax.eval_shape(nets.init, KEY)
    rollout, logits = rollout_of(nets), jnp.zeros((2, 5, 4, 4))
    losses = lambda p: world_model.prediction_losses(nets, config.agent.world_model, p, rollout, logits, 0.9)
    yield program(losses, params)


def objective(config, *specs):
    """The objective's parameters and loss, for continuous and discrete actions."""
    for spec in specs or (tiny.VECTORS, tiny.DISCRETE):
        yield from objective_for(config, spec)


def objective_for(config, spec):
    nets = tiny.networks(spec, config.agent)
    functions = config.agent.objective.build(tiny.model(nets))
    params = {**jax.eval_shape(nets.init, KEY), "objective": jax.eval_shape(functions.init, KEY)}
    yield program(functions.init, KEY)
    target = jax.eval_shape(functions.init_target, params)
    yield program(functions.after_update, params, target, jnp.ones((), jnp.int32))
    rollout = rollout_of(nets)
    yield program(
        lambda p, t, action, prev: functions.loss(p, t, KEY, rollout._replace(action=action, prev_action=prev)),
        params,
        target,
        rollout.action,
        rollout.prev_action,
    )


def behavior(config):
    """The behaviour's losses."""
    nets = tiny.networks(tiny.VECTORS)
    params = jax.eval_shape(nets.init, KEY)
    rollout, scale = rollout_of(nets), ReturnScale(jnp.zeros(()), jnp.zeros(()))
    yield program(
        lambda p, update: actor_critic_losses(nets, config.agent.behavior, p, p["critic"], scale, KEY, rollout, update),
        params,
        jnp.ones((), jnp.int32),
    )


def optimizer(config):
    """The update rule."""
    transform = optim.make(config.agent.optimizer)
    x = {"actor": jnp.ones((2, 3))}
    yield program(lambda x: transform.update(x, transform.init(x), x), x)


def train_step(config):
    """Batches and the whole update."""
    batch = jax.eval_shape(lambda: replay.random_batch(tiny.VECTORS, config.agent, KEY))
    yield str(batch)
    agent = make_agent(config.agent, tiny.VECTORS)
    yield program(agent.train_step, jax.eval_shape(agent.init, KEY), batch)


def loop(config):
    """Sizes, the schedule and the compiled program."""
    env = counting.env()
    made = loops.make(config.loop, env, counting.stub(env.spec), 2)
    yield str(
        (made.budget, made.replay_bytes, config.loop.eval_episodes, config.loop.eval_max_steps, config.loop.max_skipped)
    )
    yield str(Schedule.of(config, made))
    state = jax.eval_shape(made.init, KEY)
    yield program(made.chunk, state, jnp.zeros((), jnp.int32))


PROBES = {
    "agent.encoder": networks,
    "agent.rssm": networks,
    "agent.heads": networks,
    "agent.world_model": world,
    "agent.objective": objective,
    "agent.behavior": behavior,
    "agent.optimizer": optimizer,
    "agent": train_step,
    "loop": loop,
}


# What the other objectives have of their own: one of the least size, and a change of every field.
OBJECTIVES: dict[type, tuple] = {
    SameStep: (SameStep(), {"redundancy": "0.1", "sample_deviation": "true"}),
    Reconstruction: (Reconstruction(blocks=1), {"blocks": "2"}),
    NoObjective: (NoObjective(), {}),
    DreamerPro: (
        DreamerPro(prototypes=7, dimension=3),
        {
            "prototypes": "8",
            "dimension": "4",
            "temperature": "0.2",
            "epsilon": "0.1",
            "iterations": "2",
            "teacher_rate": "0.1",
            "frozen_updates": "5",
            "max_shift": "1",
            "whole_shifts": "true",
            "projection_init": "uniform",
            "warm_up": "2",
        },
    ),
}


@pytest.mark.parametrize("kind", OBJECTIVES)
def test_every_setting_of_the_other_objectives_changes_something(kind):
    small, changes = OBJECTIVES[kind]
    agent = tiny.with_method(small, replace(tiny.CONFIG, encoder=replace(tiny.CONFIG.encoder, depth=2)))
    base = replace(BASE, agent=agent)
    assert set(changes) == {field.name for field in fields(kind)}
    without = list(objective(base, tiny.BOTH))
    for name, value in changes.items():
        changed = configs.override(base, f"agent.objective.{name}={value}")
        assert list(objective(changed, tiny.BOTH)) != without, name


def test_every_objective_has_been_asked():
    assert {NextEmbedding, *OBJECTIVES} == set(typing.get_args(objectives.AnyObjective))
    assert set(names.OBJECTIVES.values()) == {kind.__name__ for kind in (NextEmbedding, *OBJECTIVES)}


def test_every_setting_is_listed_above():
    listed = {f"{group}.{name}" for group, fields in CHANGES.items() for name in fields}
    assert listed == {path for path in settings.paths(BASE) if path.startswith(("agent.", "loop."))}


@pytest.mark.parametrize("group", CHANGES)
def test_every_setting_changes_something(group):
    base, known = PROBES[group](BASE), []

    def before(i):
        while len(known) <= i:
            known.append(next(base))
        return known[i]

    without_effect = []
    for name, value in CHANGES[group].items():
        together = TOGETHER.get(f"{group}.{name}")
        origin = configs.override(BASE, together) if together else BASE
        unchanged = itertools.count() if together is None else PROBES[group](origin)
        of = before if together is None else lambda i, unchanged=unchanged: next(unchanged)
        changed = configs.override(origin, f"{group}.{name}={value}")
        if all(text == of(i) for i, text in enumerate(PROBES[group](changed))):
            without_effect.append(name)
    assert without_effect == []


DRQV2_CHANGES = {
    "frame_stack": "2",
    "n_step": "2",
    "discount": "0.9",
    "batch_size": "5",
    "channels": "3",
    "features": "5",
    "units": "9",
    "learning_rate": "1e-3",
    "target_rate": "0.1",
    "shift": "3",
    "noise_first": "0.9",
    "noise_last": "0.2",
    "noise_steps": "1000",
    "noise_clip": "0.2",
    "random_steps": "11",
    "steps_per_update": "3",
}


def drqv2_programs(config):
    """The parameters, acting, and the update with its batch."""
    agent = make_agent(config.agent, small.IMAGE)
    state = jax.eval_shape(agent.init, KEY)
    yield str(state)
    batch = jax.eval_shape(lambda: replay.random_batch(small.IMAGE, config.agent, KEY))
    yield program(agent.train_step, state, batch)
    seen = TimeStep({"image": jnp.zeros((1, 16, 17, 3), jnp.uint8)}, jnp.zeros(1), *[jnp.zeros(1, bool)] * 3)
    yield program(lambda params: agent.act(params, agent.init_policy(1), seen, KEY), state.params)


def test_every_setting_of_drqv2_changes_something():
    base = replace(BASE, agent=small.CONFIG)
    assert set(DRQV2_CHANGES) == {field.name for field in fields(small.CONFIG)}
    before = list(drqv2_programs(base))
    for name, value in DRQV2_CHANGES.items():
        changed = configs.override(base, f"agent.{name}={value}")
        assert list(drqv2_programs(changed)) != before, name


def test_every_setting_of_the_environment_reaches_it(monkeypatch):
    """And the action repeat the count of environment steps, too."""
    asked = []

    def make(task, **options):
        asked.append((task, options))
        return counting.env(image=False)

    monkeypatch.setattr(registry, "make", make)
    changes = {"task": "dmc/reacher_easy", "obs": "both", "action_repeat": "3", "image_size": "48", "fast": "true"}
    assert set(changes) == {field.name for field in fields(DmcConfig)}
    base = building.build(BASE).loop
    for name, value in changes.items():
        run = building.build(configs.override(BASE, f"env.{name}={value}"))
        assert asked[-1] != asked[0], name
        assert (run.loop.budget.vector_steps != base.budget.vector_steps) == (name == "action_repeat")


def test_there_are_no_other_settings():
    """The seed is asked for where a run is trained."""
    assert {field.name for field in fields(Config)} == {"env", "agent", "loop", "seed"}
