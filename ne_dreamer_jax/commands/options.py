"""What the commands share: names that are checked before anything heavy loads, and errors that end with exit code 2."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from ne_dreamer_jax import envs, settings
from ne_dreamer_jax.runs import run_directory


class Name(click.ParamType):
    """One of a list of names; a mistyped one brings the nearest."""

    def __init__(self, kind: str, known: Sequence[str]) -> None:
        self.name = kind
        self.known = known

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The value, if it is a known name."""
        if value not in self.known:
            self.fail(f"no {self.name} is called {value!r}. {settings.did_you_mean(value, self.known)}", param, ctx)
        return value

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """What stands for the value in the help."""
        return self.name.upper()


class Task(click.ParamType):
    """The name of an environment, or a ``module:function`` that makes one."""

    name = "task"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The value, if there is such an environment; modules are not imported for that."""
        try:
            envs.check(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)
        return value

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str:
        """What stands for the value in the help."""
        return "TASK"


class UserPath(click.Path):
    """A path as people write it: ``~`` is the home directory, also where the shell leaves it (``--logdir=~/run``)."""

    def __init__(self, file_okay: bool = True) -> None:
        super().__init__(path_type=Path, file_okay=file_okay)

    def convert(self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; what is most likely no name at all is refused."""
        text = os.path.expanduser(value)
        if text.startswith("~"):
            name = text.split("/")[0]
            self.fail(f"there is no home directory {name!r}; a folder of that name is './{name}'", param, ctx)
        if text != text.encode("utf-8", "replace").decode():  # the libraries that store checkpoints take no other
            self.fail(f"expected a path in UTF-8, got {os.fsencode(text)!r}", param, ctx)
        if not text or text != text.strip() or any(ord(letter) < 32 for letter in text):
            self.fail(f"expected a path without line breaks, and without blanks at its ends, got {text!r}", param, ctx)
        return super().convert(text, param, ctx)


class Run(UserPath):
    """The directory of a run that was trained."""

    def convert(self, value: str | os.PathLike[str], param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path, if a run lies there."""
        path = super().convert(value, param, ctx)
        if not os.path.exists(run_directory.RunDirectory(path).marker):  # False for what can be no path, too
            marker = run_directory.MARKER
            self.fail(f"expected the --logdir of a run, got {path}: there is no {marker} in it", param, ctx)
        return path


def say(line: str) -> None:
    """Prints a line, as far as there is somebody to read it.

    Where the reader has gone (``| head``, a terminal that was closed, a full disk), this and all later lines are lost,
    and the program goes on. Characters that the terminal's encoding lacks become question marks.
    """
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    try:
        click.echo(line.encode(encoding, "replace").decode(encoding))
    except OSError:
        with open(os.devnull, "wb") as silence:
            os.dup2(silence.fileno(), sys.stdout.fileno())  # what stands in buffers goes there, too


@contextlib.contextmanager
def refusing(*errors: type[Exception]) -> Iterator[None]:
    """Turns these errors, whose messages say what to do, into the end of the command with exit code 2."""
    try:
        yield
    except errors as error:
        raise click.UsageError(str(error)) from error


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Ends the command with exit code 130 on a Ctrl-C for which nothing was prepared, where click's is 1."""
    try:
        yield
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGINT) from None


def find_devices() -> None:
    """Starts what JAX computes with.

    Raises:
      ValueError: there is none, such as for a name in ``JAX_PLATFORMS`` that no platform has.
    """
    import jax

    try:
        jax.devices()
    except RuntimeError as error:
        asked = os.environ.get("JAX_PLATFORMS")
        hint = "" if asked is None else f" JAX_PLATFORMS is {asked!r}; 'cpu' is always there, or unset it."
        raise ValueError(f"JAX has nothing to compute with: {' '.join(str(error).split())}.{hint}") from error
