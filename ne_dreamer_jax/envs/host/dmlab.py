"""DMLab itself, where a user has built ``deepmind_lab``: ``dmlab:rooms_watermaze``.

Its module is not on PyPI, and was not at hand when this was written: tested against a stand-in with its interface.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ne_dreamer_jax.envs.host.players import Options, Seen
from ne_dreamer_jax.envs.host.spaces import Described

LEVELS = "contributed/dmlab30/"
"""Where levels are that are named without a folder."""
ACTIONS = np.array(
    [  # look left or right, look up or down, strafe, move, fire, jump, crouch
        [0, 0, 0, 1, 0, 0, 0],
        [0, 0, 0, -1, 0, 0, 0],
        [0, 0, -1, 0, 0, 0, 0],
        [0, 0, 1, 0, 0, 0, 0],
        [-20, 0, 0, 0, 0, 0, 0],
        [20, 0, 0, 0, 0, 0, 0],
        [-20, 0, 0, 1, 0, 0, 0],
        [20, 0, 0, 1, 0, 0, 0],
        [0, 0, 0, 0, 1, 0, 0],
    ],
    np.intc,
)
"""The paper's nine, as of `envs.rooms`."""
_FRAME = "RGB_INTERLEAVED"
_FRAMES_PER_SECOND = 60


class LabPlayer:
    """A level seen as RGB frames.

    DMLab does not tell a time limit from any other end, so that no end is terminal, and it shows nothing once an
    episode has ended: its last observation is the one before.
    """

    def __init__(self, level: str, options: Options) -> None:
        import deepmind_lab

        size = options.image_size or 64
        settings = {"width": str(size), "height": str(size), "fps": str(_FRAMES_PER_SECOND)}
        if level.endswith("_test"):
            settings["allowHoldOutLevels"] = "true"  # without which such levels do not load
        self._lab: Any = deepmind_lab.Lab(
            level if "/" in level else LEVELS + level, [_FRAME], config=settings, renderer="software"
        )
        self._repeat = options.action_repeat
        self.described = Described(
            {"image": ((size, size, 3), "uint8")}, len(ACTIONS), True, options.action_repeat / _FRAMES_PER_SECOND
        )
        self._last: dict[str, np.ndarray] = {}

    def reset(self, seed: int | None) -> dict[str, np.ndarray]:
        """Begins an episode."""
        self._lab.reset(seed=seed)
        return self._look()

    def step(self, action: np.ndarray) -> Seen:
        """Takes one of `ACTIONS` for as many frames as are to be one step."""
        reward = float(self._lab.step(ACTIONS[int(action)], num_steps=self._repeat))
        ended = not self._lab.is_running()
        return Seen(self._last if ended else self._look(), reward, ended, False)

    def close(self) -> None:
        """Closes it."""
        self._lab.close()

    def _look(self) -> dict[str, np.ndarray]:
        self._last = {"image": np.array(self._lab.observations()[_FRAME], np.uint8)}
        return self._last
