"""Shapes that have to agree, checked before anything is computed."""

import jax


def expect_same(**arrays: jax.Array) -> None:
    """Raises ValueError unless all have one shape; the message has the caller's names for them, and their shapes."""
    shapes = {name: tuple(array.shape) for name, array in arrays.items()}
    if len(set(shapes.values())) > 1:
        got = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"expected {', '.join(shapes)} of one shape, got {got}")


def expect_leading(like: str, shape: tuple[int, ...], **arrays: jax.Array) -> None:
    """Raises ValueError unless all have the shape that ``like`` has but for its last axis."""
    for name, array in arrays.items():
        if tuple(array.shape) != shape[:-1]:
            raise ValueError(
                f"expected {name} of shape {shape[:-1]}, that of {like} {shape} without its last axis, got "
                f"{tuple(array.shape)}"
            )
