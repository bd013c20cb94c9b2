"""The names of all environments, in plain Python: importing this loads neither JAX nor MuJoCo."""

import difflib

DMC: dict[str, tuple[str, ...]] = {
    "acrobot": ("swingup",),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse"),
    "cheetah": ("run",),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "hopper": ("hop", "stand"),
    "pendulum": ("swingup",),
    "quadruped": ("run", "walk"),
    "reacher": ("easy", "hard"),
    "walker": ("stand", "walk", "run"),
}
"""Domain (a module of ``envs/dmc/`` of that name) -> its tasks."""


def names() -> tuple[str, ...]:
    """All names that ``make`` takes, sorted."""
    return tuple(sorted(f"dmc/{domain}_{task}" for domain, tasks in DMC.items() for task in tasks))


def split_dmc(name: str) -> tuple[str, str]:
    """``"dmc/cartpole_swingup_sparse"`` -> ``("cartpole", "swingup_sparse")``."""
    check(name)
    return next((domain, task) for domain, tasks in DMC.items() for task in tasks if name == f"dmc/{domain}_{task}")


def check(name: str) -> None:
    """Raises ValueError, naming the closest matches, unless ``name`` is registered."""
    known = names()
    if name in known:
        return
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {', '.join(close)}?" if close else f"registered are: {', '.join(known)}"
    raise ValueError(f"no environment is called {name!r}; {hint}")
