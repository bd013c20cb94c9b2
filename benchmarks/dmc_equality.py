"""Are our Control Suite tasks dm_control's? One row a task, measured against dm_control on C MuJoCo.

Columns of the table:
  reward, obs     largest error of one step's reward and observation, when every step starts from the state that
                  dm_control's simulation is in; relative to the value where that is above 1
  free run        steps for which ours, started once from dm_control's state, stays within 1e-3 of it (median of runs)
  reset           smallest p-value of the Kolmogorov-Smirnov tests on each dimension that a reset draws, and how many
  return          mean return of the uniformly random policy here and there, and their distance in standard errors

Usage: ``python -m benchmarks.dmc_equality --task dmc/walker_walk``; without ``--task``, all twenty.
"""

from __future__ import annotations

import os
from typing import Any, NamedTuple

os.environ.setdefault("MUJOCO_GL", "disable")

import click
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from ne_dreamer_jax.envs import base, dmc, registry
from ne_dreamer_jax.envs.dmc import Task, environment
from ne_dreamer_jax.envs.dmc import names as dmc_names
from ne_dreamer_jax.envs.dmc.common import Episode

Arrays = dict[str, np.ndarray]

_INTEGRATED = ("time", "qpos", "qvel", "act", "qacc_warmstart")
_DERIVED = ("ctrl", "xpos", "xmat", "xipos", "xanchor", "geom_xpos", "site_xpos", "subtree_com", "sensordata")


class Recording(NamedTuple):
    """K steps of dm_control with uniformly random actions."""

    start: Arrays  # [K, ...], the integrated fields of MuJoCo's data before each step
    end: Arrays  # [K, ...], and what else rewards and observations are made of, after it
    action: np.ndarray  # [K, A], in [-1, 1]
    episode: Episode  # [K, ...], what the episode drew besides its state
    reward: np.ndarray  # [K]
    obs: Arrays  # [K, ...]


def load_dm_control(name: str, seed: int) -> Any:
    """dm_control's own environment of that name."""
    from dm_control import suite

    return suite.load(*dmc_names.split(name), task_kwargs={"random": seed})


def load_task(name: str, fast: bool = False) -> Task:
    """Ours, as it is or with the shorter line search."""
    task = dmc.load(*dmc_names.split(name))
    return task._replace(simulation=task.simulation.fast()) if fast else task


def drawn_episode(name: str, physics: Any) -> Any:
    """What dm_control's task has written into its model for this episode, as our task keeps it."""
    domain, task = dmc_names.split(name)
    if domain == "reacher":
        return np.array(physics.named.model.geom_pos["target", :2])
    if domain == "finger" and task != "spin":
        return physics.named.model.site_pos["target", ["x", "z"]] - physics.named.data.xanchor["hinge", ["x", "z"]]
    return ()


def fields(data: Any, names: tuple[str, ...]) -> Arrays:
    """Copies of fields of MuJoCo's data, in the shapes that MJX has."""
    values = {name: np.array(getattr(data, name)) for name in names}
    return {name: value.reshape(-1, 3, 3) if name == "xmat" else value for name, value in values.items()}


def record(name: str, num_steps: int, seed: int = 0, action_repeat: int = 2, restart_every: int = 100) -> Recording:
    """Runs dm_control, from a new reset every ``restart_every`` steps."""
    env = load_dm_control(name, seed)
    low, high = env.action_spec().minimum, env.action_spec().maximum
    rng = np.random.default_rng(seed)
    rows = []
    for number in range(num_steps):
        if number % restart_every == 0:
            env.reset()
        data = env.physics.data
        start, episode = fields(data, _INTEGRATED), drawn_episode(name, env.physics)
        action = rng.uniform(-1, 1, low.shape).astype(np.float32)
        reward = 0.0
        for _ in range(action_repeat):
            timestep = env.step((low + high) / 2 + (high - low) / 2 * action)
            reward += timestep.reward
        obs = {key: np.array(value) for key, value in timestep.observation.items()}
        rows.append(Recording(start, fields(data, _INTEGRATED + _DERIVED), action, episode, np.array(reward), obs))
    return jax.tree.map(lambda *values: np.stack(values).astype(np.float64), *rows)


class Player:
    """A task of ours over a batch of states, with each of its compiled functions made once."""

    def __init__(self, task: Task):
        self.task = task
        self._advance = jax.jit(jax.vmap(task.simulation.advance))
        self._read = jax.jit(jax.vmap(lambda data, episode: (task.reward(data, episode), task.observe(data, episode))))
        self._low, self._high = task.simulation.mj_model.actuator_ctrlrange.T

    def place(self, start: Arrays) -> Any:
        """``mjx.Data`` [K], settled at the given states."""
        count = len(start["time"])
        blank = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), self.task.simulation.initial())
        control = jnp.zeros((count, len(self._low)), blank.ctrl.dtype)
        return self._advance(blank, control, jnp.ones(count, bool), start)

    def read(self, data: Any, episode: Episode) -> tuple[np.ndarray, Arrays]:
        """Reward [K] and observation [K, ...] of ``mjx.Data`` [K]."""
        return jax.tree.map(np.asarray, self._read(data, episode))

    def play(
        self, start: Arrays, episode: Episode, actions: np.ndarray, action_repeat: int = 2
    ) -> tuple[np.ndarray, Arrays]:
        """Rewards [T, K] and observations [T, K, ...] of actions [T, K, A] from states [K]."""
        start, episode = jax.tree.map(jnp.asarray, (start, episode))
        data, never = self.place(start), jnp.zeros(len(start["time"]), bool)
        rewards, observations = [], []
        for action in actions:
            control = jnp.asarray((self._low + self._high) / 2 + (self._high - self._low) / 2 * action, data.ctrl.dtype)
            total = np.zeros(len(never))
            for _ in range(action_repeat):
                data = self._advance(data, control, never, start)
                reward, obs = self.read(data, episode)
                total += reward
            rewards.append(total)
            observations.append(obs)
        return np.stack(rewards), jax.tree.map(lambda *values: np.stack(values), *observations)


class TrainingPlayer(Player):
    """The same through the environment, from where training begins: ``prepare`` and ``step``. Of 32 bits."""

    def __init__(self, task: Task, action_repeat: int = 2):
        super().__init__(task)
        env = base.from_core(environment.make_core(task, "vector", action_repeat, image_size=64))
        self._prepare, self._step = jax.vmap(env.prepare), jax.jit(jax.vmap(env.step))

    def play(
        self, start: Arrays, episode: Episode, actions: np.ndarray, action_repeat: int = 2
    ) -> tuple[np.ndarray, Arrays]:
        """As `Player.play`; the states are put in the place of those that the environments' first step has drawn."""
        count = len(start["time"])
        first, none = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (start, np.zeros(actions.shape[1:])))
        state, _ = self._step(self._prepare(jax.random.split(jax.random.key(0), count)), none)
        control = jnp.zeros((count, len(self._low)), jnp.float32)
        physics = self._advance(state.physics, control, jnp.ones(count, bool), first)
        episode = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), episode)
        longest = jnp.full((count,), 2**30, jnp.int32)
        state = state._replace(core=state.core._replace(physics=physics, episode=episode, steps_left=longest))
        rewards, observations = [], []
        for action in actions:
            state, timestep = self._step(state, jnp.asarray(action, jnp.float32))
            rewards.append(np.asarray(timestep.reward))
            observations.append(jax.tree.map(np.asarray, dict(timestep.obs)))
        return np.stack(rewards), jax.tree.map(lambda *values: np.stack(values), *observations)


def error(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Absolute error where ``theirs`` is below 1, relative error above; the largest over all but the first axis."""
    ours, theirs = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
    errors = np.abs(ours - theirs) / np.maximum(1, np.abs(theirs))
    return errors.reshape(len(errors), -1).max(-1)


def one_step_errors(player: Player, recording: Recording, batch: int | None = None) -> tuple[np.ndarray, Arrays]:
    """Errors of reward [K] and of each observation [K], each step started from dm_control's state.

    Args:
      batch: how many steps are played together, where that isn't all; what is compiled depends on it.
    """
    batch = batch or len(recording.reward)
    parts = []
    for begin in range(0, len(recording.reward), batch):
        part = jax.tree.map(lambda x, begin=begin: x[begin : begin + batch], recording)
        parts.append(jax.tree.map(lambda x: x[0], player.play(part.start, part.episode, part.action[None])))
    reward, obs = jax.tree.map(lambda *values: np.concatenate(values), *parts)
    return error(reward, recording.reward), {key: error(obs[key], recording.obs[key]) for key in recording.obs}


def free_run(name: str, player: Player, num_steps: int, num_runs: int, tolerance: float = 1e-3) -> np.ndarray:
    """Steps until an observation first differs by more than ``tolerance``, for each of some runs from a reset."""
    runs = [record(name, num_steps, seed, restart_every=num_steps + 1) for seed in range(num_runs)]
    together = jax.tree.map(lambda *values: np.stack(values, 1), *runs)  # [T, runs, ...]
    start, episode = jax.tree.map(lambda x: x[0], (together.start, together.episode))
    _, obs = player.play(start, episode, together.action)
    agrees = np.ones((num_steps, num_runs), bool)
    for key, value in obs.items():
        flat = (num_steps * num_runs, -1)
        agrees &= (error(value.reshape(flat), together.obs[key].reshape(flat)) <= tolerance).reshape(agrees.shape)
    return np.where(agrees.all(0), num_steps, agrees.argmin(0))


def our_resets(task: Task, num_resets: int, seed: int = 0) -> np.ndarray:
    """First states by our environment: [num_resets, positions, velocities and what the episode draws]."""
    core = environment.make_core(task, "vector", action_repeat=2, image_size=64)

    def draw(key: jax.Array) -> jax.Array:
        if task.coast:
            state = core.reset(key)
            data, episode = state.physics, state.episode
        else:  # an episode begins in the state that is drawn, which compiles no physics
            data, episode = task.reset(key)
        return jnp.concatenate([data.qpos, data.qvel, *map(jnp.ravel, jax.tree.leaves(episode))])

    return np.asarray(jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(seed), num_resets)))


def their_resets(name: str, num_resets: int, seed: int = 0) -> np.ndarray:
    """The same by dm_control."""
    env, rows = load_dm_control(name, seed), []
    for _ in range(num_resets):
        env.reset()
        episode = drawn_episode(name, env.physics)
        rows.append(np.concatenate([env.physics.data.qpos, env.physics.data.qvel, *map(np.ravel, [episode])]))
    return np.stack(rows).astype(np.float32)


def reset_p_values(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Two-sample Kolmogorov-Smirnov p-values of the dimensions that vary.

    Raises:
      AssertionError: a dimension is constant on one side, and differs on the other.
    """
    varies = np.maximum(np.ptp(ours, axis=0), np.ptp(theirs, axis=0)) > 1e-5
    np.testing.assert_allclose(ours[:, ~varies].mean(0), theirs[:, ~varies].mean(0), atol=1e-5)
    return np.array([stats.ks_2samp(a, b).pvalue for a, b in zip(ours[:, varies].T, theirs[:, varies].T, strict=True)])


def our_returns(task: Task, num_episodes: int, seed: int = 0) -> np.ndarray:
    """Returns of the uniformly random policy in our environment."""
    env = base.from_core(environment.make_core(task, "vector", action_repeat=2, image_size=64))
    num_steps = round(task.time_limit / task.simulation.control_timestep / 2)

    def episode(key: jax.Array) -> jax.Array:
        reset_key, action_key = jax.random.split(key)
        state = env.prepare(reset_key)  # the first step begins the episode

        def step(state: base.EnvState, key: jax.Array) -> tuple[base.EnvState, tuple[jax.Array, jax.Array]]:
            state, timestep = env.step(state, jax.random.uniform(key, env.spec.action.shape, jnp.float32, -1.0, 1.0))
            return state, (timestep.reward, timestep.is_last)

        _, (rewards, is_last) = jax.lax.scan(step, state, jax.random.split(action_key, 1 + num_steps))
        return jnp.where(is_last[-1] & ~is_last[:-1].any(), rewards.sum(), jnp.nan)

    returns = np.asarray(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(seed), num_episodes)))
    if np.isnan(returns).any():
        raise AssertionError(f"expected is_last after {num_steps} steps and not before")
    return returns


def their_returns(name: str, num_episodes: int, seed: int = 0) -> np.ndarray:
    """Returns of the uniformly random policy in dm_control."""
    env, returns = load_dm_control(name, seed), []
    low, high = env.action_spec().minimum, env.action_spec().maximum
    rng = np.random.default_rng(seed)
    for _ in range(num_episodes):
        timestep, total = env.reset(), 0.0
        while not timestep.last():
            action = rng.uniform(low, high)
            for _ in range(2):
                timestep = env.step(action)
                total += timestep.reward
        returns.append(total)
    return np.array(returns)


class Row(NamedTuple):
    """One task's line of the table; None where not measured."""

    task: str
    reward_error: float
    obs_error: float
    worst_obs: str
    free_run: int | None
    p_values: tuple[float, ...] | None  # of each dimension that a reset draws
    our_return: float | None
    their_return: float | None
    standard_errors: float | None


def measure(name: str, steps: int, free_steps: int, runs: int, resets: int, episodes: int, fast: bool = False) -> Row:
    """All of one task; a size of 0 skips that column."""
    task = load_task(name, fast)
    # Compiles its physics once, for batches of as many as there are free runs. Environments are of 32 bits.
    player = Player(task) if jax.config.read("jax_enable_x64") else TrainingPlayer(task)
    reward_errors, obs_errors = one_step_errors(player, record(name, steps), runs or None)
    if not all(np.isfinite(errors).all() for errors in (reward_errors, *obs_errors.values())):
        raise AssertionError(f"{name}: expected finite rewards and observations")
    worst = max(obs_errors, key=lambda key: obs_errors[key].max())
    # The environment itself, as training steps it.
    agreement = int(np.median(free_run(name, player, free_steps, runs))) if free_steps and runs else None
    p_values = reset_p_values(our_resets(task, resets), their_resets(name, resets)) if resets else None
    ours = our_returns(task, episodes) if episodes else None
    theirs = their_returns(name, episodes) if episodes else None
    distance = None
    if ours is not None and theirs is not None:
        spread = np.sqrt((ours.var() + theirs.var()) / episodes)
        distance = (
            float(abs(ours.mean() - theirs.mean()) / spread) if spread > 0 else float(ours.mean() != theirs.mean())
        )
    return Row(
        name,
        float(reward_errors.max()),
        float(obs_errors[worst].max()),
        worst,
        agreement,
        None if p_values is None else tuple(map(float, p_values)),
        None if ours is None else float(ours.mean()),
        None if theirs is None else float(theirs.mean()),
        distance,
    )


def format_row(row: Row) -> str:
    """A row of a Markdown table."""

    def show(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    cells = (
        row.task,
        f"{row.reward_error:.1e}",
        f"{row.obs_error:.1e} ({row.worst_obs})",
        show(row.free_run, "d"),
        "-" if row.p_values is None else f"{min(row.p_values):.3f} ({len(row.p_values)})",
        f"{show(row.our_return, '.2f')} / {show(row.their_return, '.2f')} ({show(row.standard_errors, '.1f')})",
    )
    return "| " + " | ".join(cells) + " |"


HEADER = """\
| task | reward | obs (worst) | free run | reset p (dims) | return: ours / dm_control (s.e.) |
| --- | --- | --- | --- | --- | --- |"""


@click.command(help=__doc__, context_settings={"show_default": True})
@click.option("--task", "tasks", multiple=True, help="A name such as dmc/walker_walk; may be repeated. Default: all.")
@click.option(
    "--float64",
    is_flag=True,
    help="Compute ours in 64 bits: what then is left of the errors isn't rounding. No resets, no returns.",
)
@click.option("--fast", is_flag=True, help="Ours with a shorter line search, as env.fast.")
@click.option("--steps", default=500, help="Steps that each start from dm_control's state.")
@click.option("--free-steps", default=500, help="Steps of a free run; 0 skips it.")
@click.option("--runs", default=5, help="Free runs.")
@click.option("--resets", default=1000, help="Resets in each; 0 skips them.")
@click.option("--episodes", default=100, help="Episodes of the random policy in each; 0 skips them.")
def main(
    tasks: tuple[str, ...],
    float64: bool,
    fast: bool,
    steps: int,
    free_steps: int,
    runs: int,
    resets: int,
    episodes: int,
) -> None:
    """Prints the table, one row as soon as it is measured."""
    for name in tasks:
        registry.check(name)
    jax.config.update("jax_enable_x64", float64)
    if float64:  # environments are of 32 bits
        resets = episodes = 0
    click.echo(HEADER)
    for name in tasks or [name for name in registry.names() if name.startswith("dmc/")]:
        row = measure(name, steps, free_steps, runs, resets, episodes, fast)
        click.echo(format_row(row))
        if row.p_values is not None:
            click.echo(f"{name}, reset p: " + " ".join(f"{p:.3f}" for p in row.p_values), err=True)


if __name__ == "__main__":
    main()
