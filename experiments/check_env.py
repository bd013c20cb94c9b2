"""Checks an environment: ``python -m experiments.check_env --help``."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from ne_dreamer_jax.commands.options import find_devices, refusing, say
from ne_dreamer_jax.system.pages import use_large_pages
from ne_dreamer_jax.system.quiet import quiet

if TYPE_CHECKING:
    from ne_dreamer_jax.envs.base import Env
    from ne_dreamer_jax.envs.conformance import Finding
    from ne_dreamer_jax.envs.vector import VectorEnv


class Option(click.ParamType):
    """``NAME=VALUE``, the value in JSON or, where it is none, as it stands."""

    name = "NAME=VALUE"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, Any]:
        """Name and value."""
        name, equals, text = value.partition("=")
        if not (name and equals):
            self.fail(f"expected NAME=VALUE, got {value!r}", param, ctx)
        name = name.removeprefix("env.")  # as the training command has it
        try:
            return name, json.loads(text)
        except json.JSONDecodeError:
            return name, text


@click.command(context_settings={"max_content_width": 110})
@click.argument("name")
@click.option("--set", "options", type=Option(), multiple=True, help="An option of the environment, image_size=32.")
@click.option("--envs", type=click.IntRange(1), default=2, show_default=True, help="Environments side by side.")
@click.option("--steps", type=click.IntRange(1), default=5, show_default=True, help="Before and after a restart.")
@click.option("--compare", type=click.IntRange(0), default=50, show_default=True, help="Steps of episodes compared.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True, help="Of all that is random.")
def main(name: str, options: tuple[tuple[str, Any], ...], envs: int, steps: int, compare: int, seed: int) -> None:
    """Step the environment NAME (dmc/walker_walk, jax:gymnax/Pong-misc) and say what a learner can't rely on.

    Each finding names what is at fault (the key, dtype, shape, bound, flag or determinism of what), what was expected
    and what was got. The exit code is 0 where there is none, 1 where there are some.
    """
    quiet()
    with refusing(ValueError, TypeError):
        find_devices()
        found = inspect(name, dict(options), num_envs=envs, num_steps=steps, beginning_steps=compare, seed=seed)
    for finding in found:
        say(str(finding))
    say(f"{name}: {len(found)} findings" if found else f"{name}: nothing is at fault")
    raise SystemExit(1 if found else 0)


def inspect(
    name: str,
    options: dict[str, Any] | None = None,
    *,
    resolve: Callable[..., Env | VectorEnv] | None = None,
    echo: Callable[[str], None] = say,
    seed: int = 0,
    **sizes: int,
) -> list[Finding]:
    """What is at fault with the environment called ``name``.

    Args:
      options: of the environment.
      resolve: (name, **options) -> environment; none: ``resolved``.
      echo: takes a line on the environment, and on each part of the check before it begins.
      sizes: of the check, as of ``conformance.findings``.

    Raises:
      ValueError: as ``resolve`` raises it.
    """
    import jax

    from ne_dreamer_jax.envs import conformance
    from ne_dreamer_jax.envs.vector import VectorEnv

    env = (resolve or resolved)(name, **(options or {}))
    for key, spec in sorted(env.spec.observation.items()):
        echo(f"obs[{key!r}]: {jax.numpy.dtype(spec.dtype).name}{list(spec.shape)}")
    echo(f"action: {env.spec.action}")
    try:
        return conformance.findings(env, jax.random.key(seed), echo=echo, **sizes)
    finally:
        if isinstance(env, VectorEnv) and env.host is not None:
            env.host.close()


def resolved(name: str, **options: Any) -> Env | VectorEnv:
    """The environment called ``name``, of another library (``jax:...``) or of this package; errors as of theirs."""
    from ne_dreamer_jax import envs

    return envs.make(name, **options)


if __name__ == "__main__":
    use_large_pages("experiments.check_env")
    main()
