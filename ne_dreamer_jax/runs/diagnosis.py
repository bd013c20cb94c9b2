"""What a run's agent knows, and what holds it back: its latents, its model's predictions, its critic and its policy.

Four questions about the states that its own policy visits, each answered on episodes that no fit has seen:

- Is what matters in the latent? Linear probes read off the features what the environment knows of itself as vectors;
  and a decoder, made after training and on frozen latents, draws the images (NE-Dreamer, "Representation diagnostics").
- Does the model know what follows? The same probes on latents of an open loop under the actions that were taken.
- Does the critic know what states are worth? Its values beside the discounted returns that came, and beside those of
  long imagined trajectories, which tell the critic's errors from the model's.
- Can the policy still learn? Where its mean is at an end of tanh, next to no gradient reaches the actor.

Shares are of the variance in the episodes that are told about: where little varies, as in a body that stands still,
they are low or below zero whatever the latent holds. Where every episode has a goal of its own, a probe needs many.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.agents.base import Agent, Mode
from ne_dreamer_jax.envs import config as env_configs
from ne_dreamer_jax.loop.play import Steps, make_play
from ne_dreamer_jax.nets.encoder import split_observation
from ne_dreamer_jax.runs import decoding, evaluation, pictures, plots, probing, run_directory
from ne_dreamer_jax.runs.plots import Filmstrip
from ne_dreamer_jax.runs.run_directory import RunDirectory
from ne_dreamer_jax.types import Array, ContinuousAction, EnvSpec, Latent

DIAGNOSIS = 0x64_69_61_67
"""Sets these episodes apart from those of a run with the same seed."""
COLUMNS = 10  # of a picture


def diagnose(
    run: str | Path,
    env: Any = None,
    *,
    episodes: int = 16,
    horizon: int = 15,
    decoder_updates: int = 1_000,
    prefer: Literal["best", "newest"] = "newest",
    actions: Mode = "mode",
    seed: int = 0,
    echo: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Plays episodes with a run's policy and says what its agent knows, as lines, `diagnosis.json` and `decoded.png`.

    Args:
      run: the run's directory, where both files are written.
      env: the environment, for a run that was trained on one given in code.
      episodes: half of them are for the probes and the decoder, the others for what is told.
      horizon: steps H of an open loop.
      decoder_updates: of the decoder, 64 frames each; 0 for none.
      prefer: the newest checkpoint, or that with the best evaluation.
      actions: the policy's mode, or samples: more varies then where the task is solved, and they are what the critic is
        trained to judge.
      seed: of the episodes, the open loops and the decoder.

    Returns:
      What ``diagnosis.json`` holds: ``task``, ``env_step``, ``updates``, ``episodes``, ``seed``, ``actions`` and
      ``policy`` (as of `evaluation.evaluate`); ``known`` (component -> share), where the environment has vectors;
      ``open_loop`` (steps ahead -> ``known`` and ``reward``); ``critic`` (see `probing.critic`); ``saturated``, where
      actions are continuous; ``decoded`` (``image`` and the share ``explained``), where there are images.

    Raises:
      ValueError: an agent without a world model; fewer than two episodes, no horizon, negative updates; an environment
        as of `evaluation.load`, or one in worker processes that fail.
      RefusedError, FileNotFoundError, DamagedError: as of `evaluation.load`.
    """
    least = {"episodes": (episodes, 2), "horizon": (horizon, 1), "decoder_updates": (decoder_updates, 0)}
    for what, (number, bound) in least.items():
        if number < bound:
            raise ValueError(f"{what}: expected {bound} or more, got {number}")
    path = Path(run).expanduser()
    loaded = evaluation.load(path, env, prefer)
    agent, params = loaded.agent, loaded.state.params
    if agent.inspection is None:
        raise ValueError(f"{run}: expected a run of an agent with a world model, got {agent.config.method}")
    key = jax.random.fold_in(jax.random.key(seed), DIAGNOSIS)
    play_key, loop_key, critic_key, decoder_key, draw_key = jax.random.split(key, 5)
    told = evaluation.head(loaded, episodes, seed, echo)
    told |= {"updates": int(loaded.state.update), "actions": actions}
    loaded = evaluation.in_env(loaded, env_configs.with_all(loaded.config.env))
    steps, spec, told["policy"] = _play(loaded, play_key, episodes, actions, echo)

    fit, held_out = probing.halves(steps)
    told |= _models(agent, params, loop_key, fit, held_out, spec, horizon, echo)
    told["critic"] = judged = probing.critic(agent, params, critic_key, held_out)
    echo(_critic_line(judged))
    if isinstance(agent.spec.action, ContinuousAction):
        mode = np.asarray(agent.heads(params, jnp.asarray(probing.features(held_out))).action)
        told["saturated"] = probing.saturated(mode)
        echo(f"Policy: at an end of tanh in a share of steps, by component: {_round(told['saturated'])}")
    files = RunDirectory(path)
    run_directory.write_diagnosis(files, told)  # whatever becomes of the decoder
    name = _image(agent, spec, echo) if decoder_updates else None
    if name is not None:
        decoded = decoding.post_hoc_decoder(agent, decoder_key, fit, held_out, name, decoder_updates)
        told["decoded"] = {"image": name, "explained": decoded.explained}
        echo(f"Decoded from frozen latents: {decoded.explained:.2f} of the variance of unseen frames' pixels ({name})")
        strips = filmstrips(agent, params, draw_key, held_out, name, decoded.draw, horizon)
        pictures.attempt(lambda: plots.filmstrips(strips, files.decoded), files.decoded, echo)
        run_directory.write_diagnosis(files, told)
    return told


def _play(
    loaded: evaluation.Loaded, key: Array, episodes: int, actions: Mode, echo: Callable[[str], None]
) -> tuple[Steps, EnvSpec, dict[str, Any]]:
    """The episodes' steps, what the environment shows, and the summary of what the policy got."""
    with evaluation.opened(loaded.env) as env:
        play = make_play(env, loaded.agent, loaded.config.loop.eval_max_steps, mode=actions)
        echo(f"Compiling, and playing {episodes} episodes.")
        played = play(loaded.state.params, key, episodes, steps=True)
        for line in env.host.lines() if env.host is not None else ():
            echo(line)
    echo(evaluation.line("policy", played))
    return played.steps, env.spec, evaluation.summary(played)


def _models(
    agent: Agent,
    params: Any,
    key: Array,
    fit: Steps,
    held_out: Steps,
    spec: EnvSpec,
    horizon: int,
    echo: Callable[[str], None],
) -> dict[str, Any]:
    """What latents hold and what the model predicts, as ``known`` and ``open_loop`` of `diagnose`."""
    told: dict[str, Any] = {}
    vectors = split_observation(spec.observation)[1]
    names, truth = probing.side_by_side(held_out.obs, vectors)
    probe = None
    if names:
        probe = probing.LinearProbe.fit(probing.features(fit), probing.side_by_side(fit.obs, vectors)[1][fit.counts])
        known = probe.explained(probing.features(held_out), truth[held_out.counts])
        told["known"] = dict(zip(names, known, strict=True))
        echo("Known by the latent (of the variance; below 0: worse than the mean): " + shares(told["known"]))
    predicted = probing.open_loops(agent, params, key, held_out, probe, truth, horizon)
    told["open_loop"] = {h: ahead._asdict() for h, ahead in predicted.items()}
    for h, ahead in predicted.items():
        components = f"; {shares(dict(zip(names, ahead.known, strict=True)))}" if names else ""
        echo(f"Predicted {h} steps ahead: reward {ahead.reward:.2f}{components}")
    if not predicted:
        echo(f"Predicted: nothing to tell, as no episode goes on for {horizon} steps; choose a shorter horizon")
    return told


def _critic_line(judged: Mapping[str, float]) -> str:
    if not judged["states"]:
        return "Critic: nothing to tell, as all returns hang on its own value where the time limit ended the episodes"
    return (
        f"Critic: mean value {judged['value']:.3g}, imagined return {judged['imagined']:.3g}, return that came "
        f"{judged['return']:.3g}, correlation with it {judged['correlation']:.2f} ({judged['states']:,} states)"
    )


def _image(agent: Agent, spec: EnvSpec, echo: Callable[[str], None]) -> str | None:
    """Name of the image to decode: of those that the agent sees, or of what is shown beside. None where none fits."""
    images = split_observation(spec.observation)[0]
    name = next((name for name in images if name in agent.spec.observation), images[0] if images else None)
    factor = agent.config.encoder.factor
    if name is not None and any(side % factor for side in spec.observation[name].shape[:2]):
        height, width = spec.observation[name].shape[:2]
        echo(
            f"Not decoded: {name} of {height} x {width}; a decoder that mirrors the agent's encoder draws sides that "
            f"are multiples of {factor}"
        )
        return None
    return name


def filmstrips(
    agent: Agent,
    params: Any,
    key: Array,
    steps: Steps,
    name: str,
    draw: Callable[[Latent], np.ndarray],
    horizon: int,
) -> list[Filmstrip]:
    """The first episode as it was seen and decoded, and an open loop of it as it was seen and predicted.

    ``name`` is the image's, ``draw`` decodes latents [n, ...].
    """
    one = jax.tree.map(lambda x: x[:, 0], steps)
    length = int(one.counts.sum())
    some = np.linspace(0, length - 1, min(COLUMNS, length)).round().astype(int)
    at = lambda latent, rows: jax.tree.map(lambda x: x[rows], latent)
    titles = [f"step {t}" for t in some]
    strips = [
        Filmstrip("seen", one.obs[name][some], titles),
        Filmstrip("decoded", draw(at(one.latent, some)), titles),
    ]
    if length > horizon:
        first = (length - horizon) // 2
        ahead = np.linspace(0, horizon, min(COLUMNS, horizon + 1)).round().astype(int)
        start = jax.tree.map(lambda x: jnp.asarray(x[first : first + 1]), one.latent)
        latents = agent.open_loop(params, key, start, jnp.asarray(one.action[first : first + horizon, None]))
        path = jax.tree.map(
            lambda before, after: np.concatenate([before[first][None], after[:, 0]]), one.latent, latents
        )
        titles = [f"{first} + {h}" for h in ahead]
        strips += [
            Filmstrip("seen", one.obs[name][first + ahead], titles),
            Filmstrip("predicted", draw(at(path, ahead)), titles),
        ]
    return strips


def shares(known: Mapping[str, float], most: int = 12) -> str:
    """Components and their shares in words; where there are many, the quartiles instead."""
    if len(known) <= most:
        return ", ".join(f"{name} {share:.2f}" for name, share in known.items())
    low, middle, high = np.percentile(list(known.values()), (25, 50, 75))
    return f"quartiles of {len(known)} components {low:.2f} {middle:.2f} {high:.2f}"


def _round(values: list[float]) -> str:
    return " ".join(f"{x:.2f}" for x in values)
