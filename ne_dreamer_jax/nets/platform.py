"""Which kind of device a function is traced for, where what is fast differs."""

import jax


def on_cpu() -> bool:
    """Whether JAX would place new arrays on a CPU while the caller is traced.

    A wrong guess (a program traced for another device than the default) costs speed, never correctness.
    """
    # A device, the name of a platform, or None.
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    if device is None:
        return jax.default_backend() == "cpu"
    return getattr(device, "platform", device) == "cpu"
