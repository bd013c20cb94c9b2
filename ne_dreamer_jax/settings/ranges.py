"""The range of every number in a configuration, written beside it and checked in one place.

A field of a frozen dataclass is annotated with its range, such as ``depth: Annotated[int, Range(1, 4096)]`` or one of
the names below, and the dataclass calls `check` in ``__post_init__``. Values that come as text or JSON are checked by
the same functions under their whole path (see `settings`). Standard library only.
"""

from __future__ import annotations

import collections.abc
import math
import numbers
import types
import typing
from dataclasses import dataclass
from typing import Annotated, Any

LARGEST = 2**31 - 1
"""Counts are int32 where they reach a device."""


@dataclass(frozen=True)
class Range:
    """The numbers from ``low`` to ``high``: without low itself where ``above``, without high itself where ``below``."""

    low: float
    high: float
    above: bool = False
    below: bool = False

    def __contains__(self, value: float) -> bool:
        over = value > self.low if self.above else value >= self.low
        under = value < self.high if self.below else value <= self.high
        return over and under  # a NaN is neither

    def __str__(self) -> str:
        low, high = (f"{end:,}" if isinstance(end, int) else f"{end:g}" for end in (self.low, self.high))
        if self.high == math.inf or self.high >= 1e9:
            return f"more than {low}" if self.above else f"at least {low}"
        return f"{'more than' if self.above else 'from'} {low} {'and less than' if self.below else 'to'} {high}"


Count = Annotated[int, Range(1, LARGEST)]
"""At least one of something."""
CountOrNone = Annotated[int, Range(0, LARGEST)]
"""So many of something, or none."""
Width = Annotated[int, Range(1, 1_000_000)]
"""Of a layer."""
Depth = Annotated[int, Range(0, 1_000)]
"""Layers one after another, or none."""
Positive = Annotated[float, Range(0.0, 1e30, above=True)]
"""A finite number above zero."""
NonNegative = Annotated[float, Range(0.0, 1e30)]
"""A finite number, zero or more."""
Share = Annotated[float, Range(0.0, 1.0)]
"""From nothing to all."""
ShareBelowOne = Annotated[float, Range(0.0, 1.0, below=True)]
"""A decay or a mixture that leaves something of the other side."""


def check(config: Any) -> None:
    """Checks all fields of a dataclass against their annotations; for its ``__post_init__``.

    Raises:
      ValueError: a value of another type than the annotation's, or out of its range, with what was expected and got.
    """
    for name, annotation in hints_of(type(config)).items():
        check_value(annotation, getattr(config, name), f"{type(config).__name__}.{name}")


def hints_of(cls: type) -> dict[str, Any]:
    """Field -> annotation, with its range."""
    return typing.get_type_hints(cls, include_extras=True)


def plain(annotation: Any) -> Any:
    """An annotation without its range."""
    return typing.get_args(annotation)[0] if typing.get_origin(annotation) is Annotated else annotation


def choices(annotation: Any) -> list[Any]:
    """The members of a union, or the annotation alone."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return list(typing.get_args(annotation))
    return [annotation]


def of(annotation: Any) -> Range | None:
    """The range that an annotation has beside it."""
    if typing.get_origin(annotation) is Annotated:
        return next((extra for extra in typing.get_args(annotation)[1:] if isinstance(extra, Range)), None)
    return None


def check_value(annotation: Any, value: Any, path: str) -> None:
    """Checks one value, and the members of a tuple or mapping.

    Raises:
      ValueError: as `check`.
    """
    fitting = [choice for choice in choices(annotation) if _is(plain(choice), value)]
    if not fitting:
        raise ValueError(f"{path}: expected {describe(annotation)}, got {value!r}")
    for choice in fitting:
        inner, arguments = plain(choice), typing.get_args(plain(choice))
        allowed = of(choice)
        if allowed is not None and value not in allowed:
            raise ValueError(f"{path}: expected {describe(annotation)}, got {value!r}")
        if typing.get_origin(inner) is tuple:
            members = [arguments[0]] * len(value) if arguments[1:] == (...,) else arguments
            for member, hint in zip(value, members, strict=True):
                check_value(hint, member, path)
        elif _is_mapping(inner):
            for name, member in value.items():
                check_value(arguments[1], member, f"{path}.{name}")


def describe(annotation: Any) -> str:
    """What an annotation takes, in words."""
    names = {bool: "true or false", int: "an integer", float: "a number", str: "a text", type(None): "none"}
    words = []
    for choice in choices(annotation):
        allowed, inner = of(choice), plain(choice)
        if typing.get_origin(inner) is typing.Literal:
            words += [str(member) for member in typing.get_args(inner)]
        elif typing.get_origin(inner) is tuple:
            arguments = typing.get_args(inner)
            count = "any number of" if ... in arguments else str(len(arguments))
            words.append(f"{count} values joined with commas, each {describe(arguments[0])}")
        elif _is_mapping(inner):
            words.append("a member, as path.name=value")
        else:
            word = names.get(inner, getattr(inner, "__name__", str(inner)))
            words.append(word if allowed is None else f"{word} {'of ' if str(allowed)[0] in 'am' else ''}{allowed}")
    return either(words)


def either(words: list[str]) -> str:
    """Words joined as alternatives."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


def _is_mapping(annotation: Any) -> bool:
    origin = typing.get_origin(annotation)
    return isinstance(origin, type) and issubclass(origin, collections.abc.Mapping)


def _is(annotation: Any, value: Any) -> bool:
    """Whether a value is of a type; an int serves as a float."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        return any(type(value) is type(member) and value == member for member in arguments)
    if origin is tuple:
        fixed = arguments[1:] != (...,)
        return isinstance(value, tuple) and (not fixed or len(value) == len(arguments))
    if _is_mapping(annotation):
        return isinstance(value, collections.abc.Mapping)
    if annotation is type(None):
        return value is None
    if annotation in (int, float):
        kind = numbers.Integral if annotation is int else numbers.Real
        return isinstance(value, kind) and not isinstance(value, bool)
    return not isinstance(annotation, type) or isinstance(value, annotation)
