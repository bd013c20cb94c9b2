"""NE-Dreamer in JAX.

The submodules load when first touched, so that ``import ne_dreamer_jax.losses`` brings in neither flax nor mujoco.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["config", "envs", "losses", "objectives", "render", "replay", "types"],
    submod_attrs={"agent": ["Agent", "AgentConfig", "make_agent"]},
)
