"""Libraries' own log lines, silenced."""

import logging
import os


def quiet() -> None:
    """Silences what the libraries log about themselves; best called before JAX loads."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    logging.getLogger("absl").setLevel(logging.ERROR)
    logging.getLogger("jax._src.xla_bridge").setLevel(logging.ERROR)
