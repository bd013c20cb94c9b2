"""What the commands that train many runs have in common: options of `experiments.train` that hold for all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import click

from ne_dreamer_jax.commands.options import Name
from ne_dreamer_jax.settings import names

if TYPE_CHECKING:
    from ne_dreamer_jax.config import Config

Command = TypeVar("Command", bound=Callable)


class Common(NamedTuple):
    """Settings of all runs; None leaves one as the preset has it."""

    preset: str
    size: str | None = None
    obs: str | None = None
    assignments: Sequence[str] = ()

    def with_settings(self, assignments: Sequence[str]) -> Common:
        """The same with further settings, applied last."""
        return self._replace(assignments=(*self.assignments, *assignments))

    def options(self, task: str | None, method: str, seed: int) -> list[str]:
        """One run's options of `experiments.train`, as they are typed, without its directory."""
        options = ["--preset", self.preset]
        for option, value in (("--task", task), ("--size", self.size), ("--obs", self.obs)):
            options += [] if value is None else [option, value]
        for assignment in self.assignments:
            options += ["--set", assignment]
        return [*options, "--method", method, "--seed", str(seed)]

    def config(self, task: str | None, method: str, seed: int) -> Config:
        """One run's settings. Raises ValueError where they do not fit together."""
        from experiments.train import configure

        values = {"env.task": task, "env.obs": self.obs, "seed": seed}
        return configure(self.preset, self.size, method, values, self.assignments)


def common(preset: str) -> Callable[[Command], Command]:
    """Gives a command the options ``--preset``, with this default, ``--size``, ``--obs`` and ``--set``."""

    def add(command: Command) -> Command:
        for option in (
            click.option("--set", "assignments", metavar="PATH=VALUE", multiple=True, help="As for experiments.train."),
            click.option("--obs", type=Name("observation", names.OBSERVATIONS), help="pixels, vector or both."),
            click.option("--size", type=Name("size", names.SIZES), help="Parameters, roughly; drqv2 has one size."),
            click.option("--preset", type=Name("preset", names.PRESETS), default=preset, show_default=True),
        ):
            command = option(command)
        return command

    return add
