"""What the commands share: names that are checked before anything heavy loads, and errors that end with exit code 2."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence

import click

from ne_dreamer_jax import settings


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


@contextlib.contextmanager
def refusing(*errors: type[Exception]) -> Iterator[None]:
    """Turns these errors, whose messages say what to do, into the end of the command with exit code 2."""
    try:
        yield
    except errors as error:
        raise click.UsageError(str(error)) from error


def quiet() -> None:
    """Silences what the libraries log about themselves; call before JAX loads."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
