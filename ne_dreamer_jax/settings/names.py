"""Names that commands take, in plain Python: importing this loads nothing heavy, so that a mistyped one fails at once.

A method is a kind of objective, by the name of its class, and for the paper's ablations one changed setting of it;
DrQ-v2 is an agent without an objective. This is the only place where methods are named: a new objective is selectable
by a line here.
"""

from typing import Any

OBJECTIVES = {
    "ne_dreamer": "NextEmbedding",
    "dreamerv3": "Reconstruction",
    "r2dreamer": "SameStep",
    "dreamerpro": "DreamerPro",
    "dreamer_no_reconstruction": "NoObjective",
}
"""World-model method -> the class of its objective."""
ABLATIONS: dict[str, dict[str, tuple[str, Any]]] = {
    "ne_dreamer": {
        "no_transformer": ("predictor.layers", 0),
        "no_shift": ("shift", 0),
        "no_projector": ("predictor.projector", False),
    }
}
"""World-model method -> name of an ablation -> the objective's setting that makes it, and its value."""
DRQV2 = "drqv2"
METHODS = (
    *(f"{method}{name}" for method in OBJECTIVES for name in ("", *(f"/{n}" for n in ABLATIONS.get(method, ())))),
    DRQV2,
)
PRESETS = ("dmc", "rooms", "rooms_small", "released_code", "laptop", "quickstart", "smoke")
SIZES = ("1m", "12m", "25m", "50m", "100m", "200m", "400m")
OBSERVATIONS = ("pixels", "vector", "both")


def method_of(objective: Any) -> str:
    """Name of the method that an objective's settings make, such as ``ne_dreamer/no_shift``.

    Its ablations are named, then what the objective lists as its ``extensions``, if it has such an attribute. A class
    that is not in `OBJECTIVES`, such as a user's own, is named after itself.
    """
    kind = type(objective).__name__
    method = next((name for name, known in OBJECTIVES.items() if known == kind), kind)
    varied = [name for name, (path, value) in ABLATIONS.get(method, {}).items() if _value(objective, path) == value]
    varied += getattr(objective, "extensions", ())
    return f"{method}/{'+'.join(varied)}" if varied else method


def _value(settings: Any, path: str) -> Any:
    for name in path.split("."):
        settings = getattr(settings, name)
    return settings
