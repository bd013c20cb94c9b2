"""One run on disk: its directory, metrics, checkpoints, pictures, and the service that trains it."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "api",
        "checkpoint",
        "decoding",
        "diagnosis",
        "evaluation",
        "fork",
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
        "training",
        "video",
    ],
    submod_attrs={"api": ["Outcome", "train"], "diagnosis": ["diagnose"], "evaluation": ["Loaded", "evaluate", "load"]},
)
