"""The Control Suite's tasks, in plain Python."""

TASKS: dict[str, tuple[str, ...]] = {
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
"""Domain (a module beside this one) -> its tasks."""

NAMES = tuple(sorted(f"dmc/{domain}_{task}" for domain, tasks in TASKS.items() for task in tasks))


def split(name: str) -> tuple[str, str]:
    """``"dmc/cartpole_swingup_sparse"`` -> ``("cartpole", "swingup_sparse")``; of names among `NAMES`."""
    return next((domain, task) for domain, tasks in TASKS.items() for task in tasks if name == f"dmc/{domain}_{task}")
