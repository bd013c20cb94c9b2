"""Names that commands take, in plain Python: importing this loads nothing heavy, so that a mistyped one fails at once.

``config`` gives them their meaning; a test keeps the two equal.
"""

METHODS = (
    "ne_dreamer",
    "ne_dreamer/no_transformer",
    "ne_dreamer/no_shift",
    "ne_dreamer/no_projector",
    "dreamerv3",
    "r2dreamer",
    "dreamerpro",
    "dreamer_no_reconstruction",
    "drqv2",
)
PRESETS = ("dmc", "rooms", "released_code", "quickstart", "smoke")
SIZES = ("1m", "12m", "25m", "50m", "100m", "200m", "400m")
OBSERVATIONS = ("pixels", "vector", "both")
