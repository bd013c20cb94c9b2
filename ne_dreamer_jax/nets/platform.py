"""Which kind of device a function is traced for, where what is fast differs."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar

import jax

_traced_for: ContextVar[str | None] = ContextVar("traced_for", default=None)


@contextlib.contextmanager
def traced_for(platform: str) -> Iterator[None]:
    """Within the block, functions are traced for a platform, such as "cuda", that need not be there: for `jax.export`.

    What is traced already is not traced anew: make the agent or loop within the block.
    """
    token = _traced_for.set(platform)
    try:
        yield
    finally:
        _traced_for.reset(token)


def on_cpu() -> bool:
    """Whether JAX would place new arrays on a CPU while the caller is traced, or `traced_for` says so.

    A wrong guess (a program traced for another device than the default) costs speed, never correctness.
    """
    chosen = _traced_for.get()
    if chosen is not None:
        return chosen == "cpu"
    # A device, the name of a platform, or None.
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    if device is None:
        return jax.default_backend() == "cpu"
    return getattr(device, "platform", device) == "cpu"
