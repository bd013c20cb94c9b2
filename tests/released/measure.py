"""Our run on the small agent, and how far it is from the authors'."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import optax

from ne_dreamer_jax.agents import optim
from tests.released import names, setting

ROUND_OFF = 1e-4
"""Gradients below this are round-off, beside the largest of some tens."""


def run(method: str, actions: str) -> setting.Run:
    """The losses of the first updates, the first's gradients, and the parameters after them, by the authors' names."""
    with mock.patch.object(optim, "make", _recording(optim.make)):
        config, spec, agent, state = setting.start(method, actions)
    losses: dict[str, list[float]] = {}
    gradients: dict[str, np.ndarray] = {}
    for update in range(setting.UPDATES):
        state, _, metrics = agent.train_step(state, setting.batch(config, spec, update))
        gradients = gradients or names.to_theirs(config, setting.SIDE, state.optimizer.gradients)
        for name in config.loss_scales:
            losses.setdefault(name, []).append(float(metrics[f"loss/{name}"]))
    parameters = setting.some(names.to_theirs(config, setting.SIDE, state.params))
    return setting.Run({name: np.asarray(x, np.float32) for name, x in losses.items()}, gradients, parameters)


class Recorded(NamedTuple):
    """State of an optimiser, and the last gradients that it was given."""

    state: Any
    gradients: Any


def _recording(make: Callable[[Any], optax.GradientTransformation]) -> Callable[[Any], optax.GradientTransformation]:
    """`optim.make` whose optimisers keep the gradients, so that one compiled update gives all that is compared."""

    def made(config: Any) -> optax.GradientTransformation:
        optimizer = make(config)

        def init(params: Any) -> Recorded:
            return Recorded(optimizer.init(params), params)

        def update(gradients: Any, recorded: Recorded, params: Any = None) -> Any:
            updates, state = optimizer.update(gradients, recorded.state, params)
            return updates, Recorded(state, gradients)

        return optax.GradientTransformation(init, update)  # type: ignore[arg-type]

    return made


def differences(ours: setting.Run, theirs: setting.Run) -> dict[str, tuple[float, str]]:
    """Part -> largest difference, relative to the largest number of its loss or tensor, and which one that is.

    Some parameters change nothing, such as attention's key biases and, before a standardisation, the predictor's last
    bias. Their gradients are round-off, of which the optimiser makes whole steps all the same: what it does with
    gradients below `ROUND_OFF` is not compared.
    """
    largest = {}
    for part in setting.Run._fields:
        mine, other = getattr(ours, part), getattr(theirs, part)
        assert mine.keys() == other.keys(), sorted(mine.keys() ^ other.keys())
        if part == "parameters":
            felt = {name: np.abs(gradient) > ROUND_OFF for name, gradient in setting.some(theirs.gradients).items()}
            mine, other = ({name: x[felt[name]] for name, x in run.items()} for run in (mine, other))
        largest[part] = max((_relative(mine[name], other[name]), name) for name in mine)
    return largest


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    assert a.shape == b.shape
    size = max(np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0))
    return float(np.abs(a - b).max() / size) if size > ROUND_OFF else 0.0


def flat(method: str, actions: str, run: setting.Run) -> dict[str, np.ndarray]:
    """A run as arrays to store."""
    prefix = f"{method}|{actions}"
    return {f"{prefix}|{part}|{name}": x for part, named in run._asdict().items() for name, x in named.items()}


def stored(method: str, actions: str) -> setting.Run:
    """The authors' run as stored. Raises KeyError where there is none."""
    prefix = f"{method}|{actions}|"
    parts: dict[str, dict[str, np.ndarray]] = {part: {} for part in setting.Run._fields}
    with np.load(setting.STORED) as file:
        for path in file.files:
            if path.startswith(prefix):
                part, name = path.removeprefix(prefix).split("|")
                parts[part][name] = file[path]
    if not parts["losses"]:
        raise KeyError(f"no run of {method} with {actions} actions is stored; see tests/released/compare.py")
    return setting.Run(**parts)
