"""POPGym Arcade: games that are seen whole or in part, from the same states.

``AutoEncodeEasy`` is seen whole, ``AutoEncodeEasy-partial`` in part: with the same keys and actions both pass through
the same states and give the same rewards. Time limits are told by ``info["truncated"]``, see `gymnax`.

The games draw 128 x 128 pixels, some of them in each branch of a step; here each is drawn once, out of the state.
"""

from __future__ import annotations

from typing import Any

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.envs.adapters import common
from ne_dreamer_jax.envs.adapters.gymnax import from_gymnax, without_drawing
from ne_dreamer_jax.system.numerics import in_32_bits

PARTIAL = "-partial"
NOISY = ("CartPole", "NoisyCartPole")  # their pictures take the step's key, with noise or without


def names() -> tuple[str, ...]:
    """The names of the library's registry, each as it is and with ``-partial``."""
    from popgym_arcade.registration import REGISTERED_ENVIRONMENTS

    return tuple(name + kind for name in REGISTERED_ENVIRONMENTS for kind in ("", PARTIAL))


@in_32_bits
def make(task: str, image_size: int | None = 64, obs_size: int = 128) -> base.Env:
    """Makes one of the games.

    Args:
      obs_size: pixels that the library draws, 128 or 256, before they become ``image_size``.

    Raises:
      ValueError: another ``obs_size``, or another version of gymnax in the place of the one that the library needs.
    """
    if obs_size not in (128, 256):
        raise ValueError(f"expected obs_size to be 128 or 256, got {obs_size!r}")
    with common.library_rules():
        from gymnax.environments.environment import Environment

        if hasattr(Environment, "is_truncated"):
            raise ValueError(
                "expected the gymnax of stable-gymnax, which popgym-arcade is written for, got gymnax 1.x in its "
                "place; run: pip uninstall -y gymnax && pip install --force-reinstall --no-deps stable-gymnax==0.0.1"
            )
        import popgym_arcade

        name, partial = task.removesuffix(PARTIAL), task.endswith(PARTIAL)
        env, params = popgym_arcade.make(name, partial_obs=partial, obs_size=obs_size)
        draw: Any = None
        if not name.startswith(NOISY):
            draw = env.get_obs
            without_drawing(env)
        return from_gymnax(env, params, image_size=image_size, draw=draw)
