"""The DeepMind Control Suite on MJX, stepped, rewarded and observed as dm_control does it.

Each domain is a module whose ``load(task)`` gives a ``common.Task``; ``environment`` makes an environment of it. A task
of one's own is a ``Task`` too: ``from_task`` makes its environment. MuJoCo loads when one of these is first touched.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=["environment", "names", "simulation", "support", "tasks"],
    submod_attrs={"common": ["Task"], "simulation": ["Simulation"], "tasks": ["from_task", "load", "make"]},
)
