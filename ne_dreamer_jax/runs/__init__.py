"""One run on disk: its directory, metrics, checkpoints, pictures, and what trains and evaluates it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "api",
        "arrays",
        "building",
        "checkpoint",
        "decoding",
        "diagnosis",
        "endings",
        "evaluation",
        "fork",
        "maps",
        "metrics",
        "pictures",
        "plots",
        "probing",
        "progress",
        "record",
        "resume",
        "run_directory",
        "schedule",
        "signals",
        "start",
        "training",
        "video",
    ],
    submod_attrs={"api": ["Outcome", "train"], "diagnosis": ["diagnose"], "evaluation": ["Loaded", "evaluate", "load"]},
)
