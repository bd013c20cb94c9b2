"""Draws an episode of a Rooms task from above: ``python -m experiments.maps --help``."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ne_dreamer_jax.commands.options import Name, UserPath, find_devices, refusing, say
from ne_dreamer_jax.envs.rooms import names
from ne_dreamer_jax.runs import run_directory
from ne_dreamer_jax.settings import did_you_mean
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet

if TYPE_CHECKING:
    from ne_dreamer_jax.runs.maps import Seen

PLAYERS = ("scripted", "forgetful", "random")


class PlayerName(click.ParamType):
    """One of `PLAYERS`, or a run's directory."""

    name = "player"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The value, if somebody is called that or a run lies there."""
        if value in PLAYERS:
            return value
        path = UserPath().convert(value, param, ctx)
        if not os.path.exists(run_directory.RunDirectory(path).marker):  # False for what can be no path, too
            self.fail(
                f"no player is called {value!r}, and no run lies there. {did_you_mean(value, PLAYERS)} Or the --logdir "
                "of a run that was trained",
                param,
                ctx,
            )
        return value


@click.command(context_settings={"max_content_width": 110})
@click.argument("task", type=Name("Rooms task", names.NAMES), metavar="TASK")
@click.option(
    "--player",
    type=PlayerName(),
    default="scripted",
    show_default=True,
    metavar="PLAYER",
    help="scripted: forgets nothing, and plans; forgetful: goes by what it sees at the moment; random; or a run's "
    "directory.",
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True, help="Of the episode.")
@click.option("--image-size", type=click.IntRange(8, 4_096), default=64, show_default=True, help="But of a run's own.")
@click.option(
    "--output",
    type=UserPath(file_okay=False),
    default=Path("maps"),
    show_default=True,
    help="Directory for TASK.png and TASK.mp4.",
)
def main(task: str, player: str, seed: int, image_size: int, output: Path) -> None:
    """Play an episode of TASK (rooms/watermaze) and draw it from above, beside what the player saw.

    The picture has the whole path, stars where rewards came (red ones where they were losses), and numbers where the
    frames beside it were seen. A dotted circle is what can't be seen.
    """
    quiet()
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise click.UsageError(f"--output: {output} can't be made: {error.strerror or error}") from error
    from ne_dreamer_jax.runs import checkpoint, maps, pictures, video

    with refusing(ValueError, run_directory.RefusedError, FileNotFoundError, checkpoint.DamagedError):
        find_devices()
        seen, seconds = played(task, player, seed, image_size)
    stem, title = output / task.removeprefix("rooms/"), f"{task}, {Path(player).name}"
    draw = {
        stem.with_suffix(".png"): lambda path: maps.picture(seen, path, title),
        stem.with_suffix(".mp4"): lambda path: maps.film(seen, path, title, video.frame_rate(seconds)),
    }
    done = []
    for path, write in draw.items():
        done.append(pictures.attempt(partial(write, path), path, say))
        if done[-1]:
            say(f"{path}: return {seen.reward.sum():g} in {len(seen.yaw) - 1} steps")
    raise SystemExit(0 if all(done) else 1)


def played(task: str, player: str, seed: int, image_size: int = 64) -> tuple[Seen, float | None]:
    """An episode, and the simulated seconds of a step.

    Raises:
      ValueError: a run whose agent is not made for the task's frames and actions.
      RefusedError, FileNotFoundError, DamagedError: as of ``runs.evaluation.load``.
    """
    import jax

    from ne_dreamer_jax.envs import config as env_configs
    from ne_dreamer_jax.envs.rooms import players, tasks
    from ne_dreamer_jax.runs import evaluation, maps

    game, key = tasks.game(task), jax.random.key(seed)
    if player in PLAYERS:
        env = tasks.make(task, image_size=image_size)
        who = players.RANDOM if player == "random" else players.scripted(task, player == "scripted")
        scripted = lambda timestep, state, kept, key: who.act(state, kept, key)
        return maps.play(env, game, scripted, who.start, key, names.default_steps(task)), env.step_seconds
    loaded = evaluation.load(Path(player).expanduser())
    options = env_configs.for_task(task, loaded.config.env)
    env, agent = env_configs.make(options), loaded.agent
    if env.spec != agent.spec:
        raise ValueError(f"{player}: expected an agent for {env.spec}, got one for {agent.spec}")

    def act(timestep: Any, state: Any, kept: Any, key: Any) -> Any:
        kept, action = agent.act(loaded.state.params, kept, jax.tree.map(lambda x: x[None], timestep), key, mode="mode")
        return action[0], kept

    steps = options.length if isinstance(options.length, int) else names.NATIVE_STEPS[task]
    return maps.play(env, game, act, agent.init_policy(1), key, steps), env.step_seconds


if __name__ == "__main__":
    use_large_pages("experiments.maps")
    main()
