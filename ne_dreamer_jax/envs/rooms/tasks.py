"""Makes the environments of the Rooms tasks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.rooms import collect, deferred, nonmatching, watermaze
from ne_dreamer_jax.envs.rooms.game import Game, make_core
from ne_dreamer_jax.envs.rooms.names import NAMES, NATIVE_STEPS, default_steps
from ne_dreamer_jax.settings.text import did_you_mean

COLLECT = {"rooms/collect_good_objects": collect.TRAIN, "rooms/collect_good_objects_test": collect.TEST}
DEFERRED = {"rooms/exploit_deferred_effects": deferred.TRAIN, "rooms/exploit_deferred_effects_test": deferred.TEST}
"""Task -> its configurations."""
NONMATCHING = {"rooms/select_nonmatching_object": 1.0, "rooms/select_nonmatching_object_small": 0.36}
"""Task -> the size of its rooms. A random player of the small one comes to a choice four times in an episode."""
OBJECTS = {
    "rooms/select_nonmatching_object": range(nonmatching.OBJECTS),
    "rooms/select_nonmatching_object_small": nonmatching.FEW,
}
"""Task -> the objects that it draws from."""
WATERMAZE = {"rooms/watermaze": 1.0, "rooms/watermaze_small": 0.42}
"""Task -> the size of its arena. In the small one it is 2 to 3 seconds from side to side."""


def game(name: str) -> Game:
    """The task's rules and looks. Raises ValueError for a name that is none."""
    makers: dict[str, Callable[[], Game]] = {
        **{name: partial(collect.make, configs) for name, configs in COLLECT.items()},
        **{name: partial(deferred.make, configs) for name, configs in DEFERRED.items()},
        **{name: partial(nonmatching.make, scale, OBJECTS[name]) for name, scale in NONMATCHING.items()},
        **{name: partial(watermaze.make, scale) for name, scale in WATERMAZE.items()},
    }
    if name not in makers:
        raise ValueError(f"no Rooms task is called {name!r}. {did_you_mean(name, NAMES)}")
    return makers[name]()


def make(name: str, *, image_size: int = 64, length: int | Literal["native"] | None = None) -> base.Env:
    """Makes a Rooms environment: ``image``, uint8 [image_size, image_size, 3], and nine discrete actions.

    An action is held for four frames of 16 ms; rewards are summed. ``env_state.position`` ([2], engine units) and
    ``env_state.yaw`` (radians) tell where the player is.

    Args:
      name: as `names.NAMES` lists them.
      image_size: height and width in pixels, 8 at least.
      length: agent steps after which the clock ends an episode (``is_last``, not ``is_terminal``); ``"native"`` for
        DMLab's own, None for the paper's, which are at most 900.

    Raises:
      ValueError: no such task, or a size or length that is impossible; the message says what is possible.
    """
    rules = game(name)
    if not isinstance(image_size, int) or isinstance(image_size, bool) or image_size < 8:
        raise ValueError(f"image_size: expected pixels, at least 8, got {image_size!r}")
    steps = default_steps(name) if length is None else NATIVE_STEPS[name] if length == "native" else length
    if not isinstance(steps, int) or isinstance(steps, bool) or not 1 <= steps <= 1_000_000:
        raise ValueError(f"length: expected agent steps, from 1 to 1,000,000, 'native' or none, got {length!r}")
    return base.from_core(make_core(rules, steps, image_size))
