"""NE-Dreamer in JAX.

The submodules load when first touched, so that ``import ne_dreamer_jax.losses`` brings in neither flax nor mujoco.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "agents",
        "config",
        "envs",
        "loop",
        "losses",
        "objectives",
        "render",
        "replay",
        "runs",
        "settings",
        "types",
    ],
    submod_attrs={
        "agents": ["Agent", "AgentConfig", "make_agent"],
        "envs": ["register"],
        "version": ["__version__"],
        "runs": ["checkpoint", "diagnose", "evaluate", "load", "metrics", "run_directory", "train"],
    },
)
