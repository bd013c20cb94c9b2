"""Environments of other libraries on the host: any ``gymnasium.Env`` or ``dm_env.Environment``, in worker processes.

By name (``make("gym:CartPole-v1")``, ``dm_env:mymodule:make``, ``dm_control:walker_walk``, ``memory_maze:9x9``) or by a
factory (`from_gymnasium`, `from_dm_env`). To the training loop they are N environments like any others: the compiled
program calls back for each step, and workers step while the agent learns. `spaces` says what an agent sees of a space
and how its actions become the environment's, `pool` what becomes of workers that die, hang or raise.

Workers load neither JAX nor this module's `tasks` and `vector`: `worker`, `players`, `spaces` and `factories` are
theirs.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["dmlab", "factories", "names", "opengl", "players", "pool", "spaces", "tasks", "vector", "worker"],
    submod_attrs={
        "players": ["Options"],
        "pool": ["Workers"],
        "tasks": ["from_dm_env", "from_gymnasium", "make"],
    },
)
