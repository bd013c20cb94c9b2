"""Frozen dataclasses as text: one field set by its path, a whole tree to JSON and back, and how two trees differ.

Configurations are frozen dataclasses whose fields are annotated with plain types: bool, int, float, str, ``Literal``,
``X | None``, ``tuple[X, ...]``, ``tuple[X, Y]``, ``Mapping[str, X]``, a dataclass, or a union of dataclasses. The
annotations are all that the functions here go by. Standard library only, so that a command can use this before it
loads JAX.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import difflib
import typing
from collections.abc import Iterable, Mapping
from typing import Any, TypeGuard, TypeVar

from ne_dreamer_jax.settings import ranges

T = TypeVar("T")
TAG = "type"  # the key of the class name in JSON, where a field may hold one of several dataclasses
BEFORE = "before"
"""Key of a dataclass field's metadata: what data without the field means, where that is not the field's default."""


def nearest(word: str, known: Iterable[str], count: int = 3) -> list[str]:
    """The names most like a mistyped word, best first, then those that contain it."""
    names = list(dict.fromkeys(known))
    matches = difflib.get_close_matches(word.lower(), names, n=count, cutoff=0.5)
    contained = [name for name in names if word and word.lower() in name.lower() and name not in matches]
    return (matches + contained)[:count]


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The end of an error message for an unknown name: its nearest matches, or all names where none is near."""
    names = list(known)
    near = nearest(word, names)
    return f"Did you mean {ranges.either(near)}?" if near else f"Known: {', '.join(names)}."


def override(config: T, assignment: str) -> T:
    """A copy of a configuration with one field changed.

    Args:
      config: a frozen dataclass.
      assignment: ``path=value``: field names joined with dots, and the value as its annotation reads it: ``true`` or
        ``false``, a number (an integer may be written 5e6), ``none``, members of a tuple joined with commas, or the
        class name of a dataclass, which is then made with its defaults, unless it stands there already.

    Raises:
      ValueError: no such field, or a value that does not fit it, with what was expected and what was got.
    """
    path, separator, text = assignment.partition("=")
    path = path.strip()
    if not separator or not path:
        raise ValueError(f"expected path=value, such as {_example(config)}, got {assignment!r}")
    return _replace(config, type(config), path.split("."), text.strip(), [], config)


def paths(config: Any) -> dict[str, Any]:
    """Every field that `override` can set, by its path, with its value.

    A dataclass counts by its fields alone, and by its class name too where the field may hold one of several.
    """
    return dict(_walk(config, type(config), ""))


def as_text(value: Any) -> str:
    """A value of `paths` as `override` takes it."""
    if isinstance(value, tuple):
        return ",".join(as_text(member) for member in value)
    return str(value).lower() if isinstance(value, bool) or value is None else str(value)


def to_dict(config: Any) -> dict[str, Any]:
    """A configuration as what `json.dumps` takes."""
    return _encode(type(config), config)


def from_dict(cls: type[T], data: Mapping[str, Any]) -> T:
    """What `to_dict` gave, as a configuration again.

    A field that is missing has its default, or the value under `BEFORE` in its metadata: an older version, which had no
    such field, wrote the data.

    Raises:
      ValueError: an unknown field, a missing one without a default, or a value that does not fit its annotation.
    """
    return _decode(cls, data, cls.__name__)


def differences(old: Any, new: Any) -> list[str]:
    """The fields in which two configurations differ, one line each: ``path: old value, now new value``."""
    before, after = paths(old), paths(new)
    missing = object()
    return [
        f"{path}: {_show(before.get(path, missing), missing)}, now {_show(after.get(path, missing), missing)}"
        for path in dict.fromkeys([*before, *after])
        if before.get(path, missing) != after.get(path, missing)
    ]


def _show(value: Any, missing: object) -> str:
    return "absent" if value is missing else repr(value)


def _example(config: Any) -> str:
    path, value = next(iter(paths(config).items()), ("field", "value"))
    return f"{path}={as_text(value)}"


def _fields(cls: type) -> dict[str, Any]:
    hints = ranges.hints_of(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls) if field.init}


def _required(cls: type) -> set[str]:
    """The fields without a default."""
    none = dataclasses.MISSING
    return {
        field.name
        for field in dataclasses.fields(cls)
        if field.init and field.default is none and field.default_factory is none
    }


def _choices(annotation: Any) -> list[Any]:
    """The members of a union, or the annotation alone, without their ranges."""
    return [ranges.plain(choice) for choice in ranges.choices(ranges.plain(annotation))]


def _dataclasses(annotation: Any) -> dict[str, type]:
    return {choice.__name__: choice for choice in _choices(annotation) if _is_dataclass(choice)}


def _is_dataclass(annotation: Any) -> TypeGuard[type[Any]]:
    return isinstance(annotation, type) and dataclasses.is_dataclass(annotation)


def _is_mapping(annotation: Any) -> bool:
    return typing.get_origin(annotation) in (dict, collections.abc.Mapping)


def _walk(value: Any, annotation: Any, path: str) -> Iterable[tuple[str, Any]]:
    if dataclasses.is_dataclass(value):
        if len(_dataclasses(annotation)) > 1:
            yield path, type(value).__name__
        for name, hint in _fields(type(value)).items():
            yield from _walk(getattr(value, name), hint, f"{path}.{name}" if path else name)
    elif isinstance(value, Mapping):
        for name, member in value.items():
            yield from _walk(member, typing.get_args(annotation)[1], f"{path}.{name}")
    else:
        yield path, value


def _replace(value: Any, annotation: Any, names: list[str], text: str, done: list[str], root: Any) -> Any:
    if not names:
        if dataclasses.is_dataclass(value) and text == type(value).__name__:
            return value
        return _parse(annotation, text, ".".join(done))
    name, rest = names[0], names[1:]
    if dataclasses.is_dataclass(value):
        hints = _fields(type(value))
        if name in hints:
            member = _replace(getattr(value, name), hints[name], rest, text, [*done, name], root)
            return dataclasses.replace(value, **{name: member})  # type: ignore[type-var]
    elif isinstance(value, Mapping) and name in value:
        hint = typing.get_args(annotation)[1]
        return {**value, name: _replace(value[name], hint, rest, text, [*done, name], root)}
    path = ".".join([*done, *names])
    raise ValueError(f"no setting is called {path!r}. {did_you_mean(path, paths(root))}")


def _parse(annotation: Any, text: str, path: str) -> Any:
    for choice in sorted(_choices(annotation), key=lambda choice: choice is str):  # str takes anything: ask it last
        try:
            value = _parse_one(choice, text, path)
        except _Unfit:
            continue
        ranges.check_value(annotation, value, path)
        return value
    raise ValueError(f"{path}: expected {ranges.describe(annotation)}, got {text!r}")


class _Unfit(Exception):
    """A text or a JSON value that is not of the annotation's kind."""


def _parse_one(annotation: Any, text: str, path: str) -> Any:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is type(None) and text.lower() == "none":
        return None
    if annotation is bool and text.lower() in ("true", "false"):
        return text.lower() == "true"
    if annotation is int:
        return _integer(text)
    if annotation is float:
        return _number(text)
    if annotation is str:
        return text
    if origin is typing.Literal:
        for member in arguments:
            if str(member) == text:
                return member
    if origin is tuple:
        parts = [part.strip() for part in text.strip("()[]").split(",") if part.strip()]
        return tuple(_parse(hint, part, path) for hint, part in zip(_members(arguments, parts), parts, strict=True))
    if _is_dataclass(annotation) and text == annotation.__name__:
        return annotation()
    raise _Unfit


def _members(arguments: tuple[Any, ...], parts: typing.Sequence[Any]) -> list[Any]:
    """The annotation of each member of a tuple with as many members as there are parts."""
    if len(arguments) == 2 and arguments[1] is ...:
        return [arguments[0]] * len(parts)
    if len(arguments) != len(parts):
        raise _Unfit
    return list(arguments)


def _integer(text: str) -> int:
    number = _number(text)
    if not number.is_integer():
        raise _Unfit
    return int(number) if any(mark in text.lower() for mark in ".e") else int(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise _Unfit from None


def _encode(annotation: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        tag = {TAG: type(value).__name__} if len(_dataclasses(annotation)) > 1 else {}
        return tag | {name: _encode(hint, getattr(value, name)) for name, hint in _fields(type(value)).items()}
    if isinstance(value, Mapping):
        hint = typing.get_args(annotation)[1]
        return {name: _encode(hint, member) for name, member in value.items()}
    if isinstance(value, tuple):
        return [_encode(None, member) for member in value]
    return value


def _decode(annotation: Any, data: Any, path: str) -> Any:
    tagged = len(_dataclasses(annotation)) > 1
    for choice in _choices(annotation):
        try:
            value = _decode_one(choice, data, path, default=next(iter(_dataclasses(annotation)), None), tagged=tagged)
        except _Unfit:
            continue
        ranges.check_value(annotation, value, path)
        return value
    raise ValueError(f"{path}: expected {ranges.describe(annotation)}, got {data!r}")


def _decode_one(annotation: Any, data: Any, path: str, *, default: str | None, tagged: bool) -> Any:
    """``default`` is the class of data without a tag, from before there was more than one to choose from."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if _is_dataclass(annotation) and isinstance(data, Mapping):
        if tagged and data.get(TAG, default) != annotation.__name__:
            raise _Unfit
        given = {name: value for name, value in data.items() if not (tagged and name == TAG)}
        hints = _fields(annotation)
        missing, unknown = sorted(_required(annotation) - given.keys()), sorted(given.keys() - hints.keys())
        if missing or unknown:
            raise ValueError(f"{path}: expected the fields {sorted(hints)}; missing {missing}, unknown {unknown}")
        before = {
            field.name: field.metadata[BEFORE]
            for field in dataclasses.fields(annotation)
            if BEFORE in field.metadata and field.name not in given
        }
        return annotation(**before, **{name: _decode(hints[name], given[name], f"{path}.{name}") for name in given})
    if _is_mapping(annotation) and isinstance(data, Mapping):
        return {name: _decode(arguments[1], value, f"{path}.{name}") for name, value in data.items()}
    if origin is tuple and isinstance(data, list):
        return tuple(_decode(hint, value, path) for hint, value in zip(_members(arguments, data), data, strict=True))
    if origin is typing.Literal and data in arguments:
        return data
    if annotation is type(None) and data is None:
        return None
    if annotation is float and isinstance(data, int | float) and not isinstance(data, bool):
        try:
            return float(data)
        except OverflowError as error:  # of a whole number
            raise _Unfit from error
    if annotation in (bool, int, str) and type(data) is annotation:
        return data
    raise _Unfit
