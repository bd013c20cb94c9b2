"""The directory of one run, which belongs to that run alone.

=====================  ==================================================================
``.ne_dreamer_jax``    the marker that says so; locked while a process trains here
``config.json``        the configuration, whole, and its checksum
``parent.json``        of a run that began with another's agent: which, see `ne_dreamer_jax.runs.fork`
``metrics.jsonl``      see `ne_dreamer_jax.metrics`
``metrics-earlier-N``  ``.jsonl``: those of starts that left no checkpoint to go on from
``checkpoints/``       see `ne_dreamer_jax.checkpoint`
``evaluation.json``    what the last evaluation found
``diagnosis.json``     what the last diagnosis found
``curve.png``          learning curves
``policy.mp4``         one evaluation episode
``decoded.png``        frames, and what a decoder made after training draws of the latents
=====================  ==================================================================

The same configuration on the same directory goes on, wherever the directory was moved or copied to; another one (but
for what `runs.resume` lets change), and a directory with anything else in it, is refused, so that nothing is ever
overwritten but by the run that wrote it. Standard library only.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import itertools
import json
import math
import os
import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from ne_dreamer_jax import settings
from ne_dreamer_jax.files import write_text

C = TypeVar("C")
MARKER = ".ne_dreamer_jax"
_CHECKSUM = "sha256"  # the key in config.json, beside the settings
_MARKER_TEXT = "A run directory of ne_dreamer_jax. The same command on this directory goes on with the run.\n"


class RefusedError(Exception):
    """The directory can't be used for this run; the message says why and what to do."""


class RunDirectory(NamedTuple):
    """Where the files of a run lie."""

    path: Path

    @property
    def config(self) -> Path:
        """The configuration as JSON."""
        return self.path / "config.json"

    @property
    def parent(self) -> Path:
        """Which run the agent was taken over from, as JSON; see `runs.fork`."""
        return self.path / "parent.json"

    @property
    def metrics(self) -> Path:
        """Metrics, one JSON object a line."""
        return self.path / "metrics.jsonl"

    @property
    def earlier_metrics(self) -> Path:
        """A name that is free for the metrics of a start that left no checkpoint to go on from."""
        paths = (self.path / f"metrics-earlier-{number}.jsonl" for number in itertools.count(1))
        return next(path for path in paths if not path.exists())

    @property
    def checkpoints(self) -> Path:
        """The folder of checkpoints."""
        return self.path / "checkpoints"

    @property
    def evaluation(self) -> Path:
        """Result of the last evaluation as JSON."""
        return self.path / "evaluation.json"

    @property
    def diagnosis(self) -> Path:
        """Result of the last diagnosis as JSON."""
        return self.path / "diagnosis.json"

    @property
    def decoded(self) -> Path:
        """Frames, and what a decoder made after training draws of the latents."""
        return self.path / "decoded.png"

    @property
    def curve(self) -> Path:
        """Learning curves."""
        return self.path / "curve.png"

    @property
    def video(self) -> Path:
        """One evaluation episode."""
        return self.path / "policy.mp4"

    @property
    def marker(self) -> Path:
        """What says that the directory is ours."""
        return self.path / MARKER


def as_argument(path: Path) -> str:
    """The path as a command takes it for the same; ``-x`` and ``~`` may be names of folders."""
    text = str(path)
    return f"./{text}" if text.startswith(("-", "~")) else text


def typed(path: Path) -> str:
    """The path as it is typed in a shell."""
    return shlex.quote(as_argument(path))


def check(path: Path) -> None:
    """Refuses a path that can't be a run directory, whatever the configuration; touches nothing.

    Raises:
      RefusedError: it is a file, a directory that holds something else, or nowhere that could be read and written.
    """
    try:
        if path.exists() and not path.is_dir():
            raise RefusedError(f"expected a directory, got a file: {path}. Choose another --logdir")
        contents = sorted(entry.name for entry in path.iterdir()) if path.exists() else []
        nearest = next(place for place in (path, *path.absolute().parents) if os.path.lexists(place))
    except OSError as error:
        raise RefusedError(f"{path} can't be made a run directory: {error}. Choose another --logdir") from error
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise RefusedError(
            f"{path} can't be made a run directory: expected {nearest} to be one that can be written to. "
            "Choose another --logdir"
        )
    if contents and MARKER not in contents:
        shown = ", ".join(contents[:3] + (["..."] if len(contents) > 3 else []))
        raise RefusedError(
            f"{path} holds something that is not a run ({shown}). "
            "Nothing was touched; choose an empty directory or a new one"
        )


Differences = Callable[[Any, Any], list[str]]
"""(a run's configuration, the one that is asked for) -> what differs and may not, a line each."""


def check_same(path: Path, config: Any, differences: Differences = settings.differences) -> None:
    """Refuses a directory that holds a run of another configuration; touches nothing.

    Raises:
      RefusedError: what differs, one line each; or a run without its configuration.
    """
    files = RunDirectory(path)
    if not files.config.exists():
        if left := [place.name for place in (files.checkpoints, files.metrics) if place.exists()]:
            raise RefusedError(
                f"{path} holds {' and '.join(left)} of a run whose config.json is gone. Restore that, or choose "
                "another --logdir"
            )
        return
    different = differences(read_config(path, type(config)), config)
    if different:
        raise RefusedError(
            f"{path} holds another run, or one with other settings. Give it the same options to go on, choose another "
            f"directory, or begin a new run in another one from its agent with --fork {typed(path)}. They differ "
            "in\n  " + "\n  ".join(different)
        )


@contextlib.contextmanager
def claim(path: Path, config: Any, differences: Differences = settings.differences) -> Iterator[RunDirectory]:
    """Holds a run directory for training, made if need be; nobody else gets it meanwhile.

    Args:
      config: a frozen dataclass (see `ne_dreamer_jax.settings`): everything that decides what the run computes. It
        takes the place of the one that stands there, where what differs may change.
      differences: which differences from that one may not be.

    Raises:
      RefusedError: as `check` says, or it holds a run of another configuration, or a process trains in it.
    """
    check(path)
    files = RunDirectory(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        marker = files.marker.open("ab", buffering=0)
    except OSError as error:
        raise RefusedError(f"{path} can't be made a run directory: {error.strerror or error}") from error
    with marker:
        try:
            fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RefusedError(f"another process trains in {path}. Wait for it, or choose another --logdir") from None
        except OSError as error:  # some network mounts have no locks
            raise RefusedError(
                f"{path} can't be locked ({error.strerror or error}), so that two processes could train there at once. "
                "Choose a --logdir on another file system, such as a local disk, and copy it when the run has ended"
            ) from error
        check_same(path, config, differences)
        try:
            if not files.config.exists():
                marker.write(_MARKER_TEXT.encode())
                store_config(files, config)
            elif read_config(path, type(config)) != config:
                store_config(files, config)
        except OSError as error:
            raise RefusedError(f"{path} can't be written to: {error.strerror or error}") from error
        yield files


def store_config(files: RunDirectory, config: Any) -> None:
    """Writes the configuration, in place of what stood there."""
    content = settings.to_dict(config)
    _write_json(files.config, content | {_CHECKSUM: _digest(content)})


def read_config(path: Path, cls: type[C]) -> C:
    """The configuration of a run.

    Raises:
      RefusedError: there is no run, or its configuration can't be read, is damaged, or is of another version of this
        program. One of an older version, which has no checksum or lacks a field, is taken; see `settings.from_dict`.
    """
    files = RunDirectory(path)
    try:
        if not files.marker.exists() or not files.config.exists():
            raise RefusedError(f"expected a run directory, with {MARKER} and config.json in it, got {path}")
        content = json.loads(files.config.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError(f"expected a JSON object, got {str(content)[:80]!r}")
        checksum = content.pop(_CHECKSUM, None)
        config = settings.from_dict(cls, content)
    except OSError as error:
        raise RefusedError(f"{files.config} can't be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise RefusedError(
            f"{files.config} does not fit this version of the program, or is damaged: {str(error)[:500]}"
        ) from error
    if checksum is not None and checksum != _digest(content):
        raise RefusedError(
            f"{files.config} is not as it was written: its checksum does not hold. Restore it from a copy; to go on "
            "with other settings, give them as options, or begin a new run with --fork"
        )
    return config


def write_parent(files: RunDirectory, origin: Mapping[str, Any]) -> None:
    """Stores which run this one's agent is from."""
    _write_json(files.parent, origin)


def write_evaluation(files: RunDirectory, result: Mapping[str, Any]) -> None:
    """Stores what an evaluation found, in place of the one before. Raises RefusedError where that can't be written."""
    _write_result(files.evaluation, result)


def write_diagnosis(files: RunDirectory, result: Mapping[str, Any]) -> None:
    """Stores what a diagnosis found, in place of the one before. Raises RefusedError where that can't be written."""
    _write_result(files.diagnosis, result)


def _write_result(path: Path, result: Mapping[str, Any]) -> None:
    try:
        _write_json(path, _finite(result))
    except OSError as error:
        raise RefusedError(f"{path} can't be written: {error.strerror or error}") from error


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    write_text(path, json.dumps(content, indent=2) + "\n", sync=True)


def _finite(content: Any) -> Any:
    """The content with null for numbers that are not finite, for which JSON has no word."""
    if isinstance(content, Mapping):
        return {name: _finite(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
