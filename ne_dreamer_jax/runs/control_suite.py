"""Plays a policy in dm_control itself: C MuJoCo's physics and, for pixels, its own OpenGL pictures.

Nothing that trains imports this. It is for `commands.evaluate`, to show that a return here is a return there.
MuJoCo reads ``MUJOCO_GL`` when it loads; whoever wants pixels sets it before.
"""

from __future__ import annotations

import contextlib
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.agents.base import Agent
from ne_dreamer_jax.envs import dmc
from ne_dreamer_jax.envs.config import DmcConfig
from ne_dreamer_jax.envs.dmc import names as dmc_names
from ne_dreamer_jax.loop import Evaluation, random_action
from ne_dreamer_jax.types import Array, Params, TimeStep


class Player:
    """One environment of dm_control, stepped and observed as ours are."""

    def __init__(self, config: DmcConfig, seed: int) -> None:
        from absl import logging
        from dm_control import suite

        logging.set_verbosity(logging.ERROR)  # cheetah's file is in an older style, and MuJoCo says so each time
        domain, task = dmc_names.split(config.task)
        self._env = suite.load(domain, task, task_kwargs={"random": seed})
        self._config = config
        self._camera = dmc.load(domain, task).camera
        action = self._env.action_spec()
        self._low, self._high = action.minimum, action.maximum
        self._ended = True

    def step(self, action: np.ndarray) -> dict[str, Any]:
        """The next time step's fields; where the last ended an episode, the first of a new one."""
        first = self._ended
        if first:
            timestep, reward = self._env.reset(), 0.0
        else:
            reward = 0.0
            control = (self._high + self._low) / 2 + (self._high - self._low) / 2 * np.clip(action, -1, 1)
            for _ in range(self._config.action_repeat):
                timestep = self._env.step(control)
                reward += timestep.reward
                if timestep.last():
                    break
        self._ended = timestep.last()
        return {
            "obs": self._observe(timestep.observation),
            "reward": np.float32(reward),
            "is_first": first,
            "is_last": self._ended,
            "is_terminal": self._ended and timestep.discount == 0,
        }

    def draw(self, size: int) -> np.ndarray:
        """The agent's camera's picture, uint8 [size, size, 3]."""
        return self._env.physics.render(size, size, camera_id=self._camera)

    def close(self) -> None:
        """Frees what OpenGL holds, while its thread still runs."""
        self._env.close()
        self._env.physics.free()

    def _observe(self, vectors: Any) -> dict[str, np.ndarray]:
        obs = {}
        if self._config.obs != "vector":
            size = self._config.image_size
            obs["image"] = self.draw(size)
        if self._config.obs != "pixels":
            obs |= {name: np.asarray(value, np.float32) for name, value in vectors.items()}
        return obs


def evaluate(
    config: DmcConfig, agent: Agent, params: Params, key: Array, episodes: int, random: bool = False
) -> Evaluation:
    """As ``Loop.evaluate``, in ``episodes`` environments of dm_control: the policy's mode, or random actions.

    Raises:
      RuntimeError: pixels are to be drawn and there is no OpenGL that draws without a screen.
    """
    seed_key, key = jax.random.split(key)
    seeds = np.asarray(jax.random.randint(seed_key, (episodes,), 0, 2**31 - 1))
    with contextlib.ExitStack() as stack:
        players = [stack.enter_context(contextlib.closing(Player(config, int(seed)))) for seed in seeds]
        if config.obs != "vector":
            _check_drawing(players[0])
        return _play(players, agent, params, key, random)


def _play(players: list[Player], agent: Agent, params: Params, key: Array, random: bool) -> Evaluation:
    episodes = len(players)
    rows = [player.step(np.zeros(agent.spec.action.shape)) for player in players]
    policy = agent.init_policy(episodes)
    returns, lengths, done = np.zeros(episodes), np.zeros(episodes, np.int32), np.zeros(episodes, bool)
    frames = []
    while True:
        if "image" in agent.spec.observation and not done[0]:
            frames.append(rows[0]["obs"]["image"])
        done |= np.array([row["is_last"] for row in rows])
        if done.all():
            break
        key, act_key, random_key = jax.random.split(key, 3)
        policy, action = agent.act(params, policy, _stack(rows), act_key, mode="mode")
        if random:
            action = random_action(agent.spec.action, random_key, episodes)
            policy = policy._replace(prev_action=action)
        actions = np.asarray(action)
        for i in np.flatnonzero(~done):
            rows[i] = players[i].step(actions[i])
            returns[i] += rows[i]["reward"]
            lengths[i] += 1
    video = np.stack(frames) if frames else None
    return Evaluation(jnp.asarray(returns, jnp.float32), jnp.asarray(lengths), jnp.ones(episodes, bool), video)


def _stack(rows: list[dict[str, Any]]) -> TimeStep:
    stacked = jax.tree.map(lambda *values: jnp.asarray(np.stack(values)), *rows)
    return TimeStep(**stacked)


def _check_drawing(player: Player) -> None:
    try:
        player.draw(8)
    except Exception as error:  # each way to draw fails in its own
        chosen = os.environ.get("MUJOCO_GL")
        raise RuntimeError(
            f"expected an OpenGL that draws without a screen, got for MUJOCO_GL={chosen}: {error}. "
            "Install OSMesa (libosmesa6 on Debian) and set MUJOCO_GL=osmesa, or set MUJOCO_GL=egl where a GPU's "
            "driver has it."
        ) from error
