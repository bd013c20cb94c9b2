"""From another library's environment to one of this package: observations, actions, and states of settled dtypes.

Spaces are known by what they have, as each library brings its own classes: ``n`` makes a space discrete, ``low`` and
``high`` a box, ``spaces`` a dict or tuple. Shapes and dtypes of observations are those that the environment returns,
not those that its space declares: the two differ here and there.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax.envs import base
from ne_dreamer_jax.system.numerics import in_32_bits
from ne_dreamer_jax.types import ActionSpec, Array, ArraySpec, ContinuousAction, DiscreteAction, EnvSpec

Space = Any  # of another library, or None where it tells nothing


class Box(NamedTuple):
    """A box for environments that have no spaces."""

    low: Any
    high: Any
    shape: tuple[int, ...]
    dtype: Any


class Discrete(NamedTuple):
    """{0, ..., n - 1}, for environments that have no spaces."""

    n: int


class Outcome(NamedTuple):
    """What a step of another library's environment gave, of whatever dtypes it has."""

    state: Any
    obs: Any
    reward: Any
    is_last: Any
    is_terminal: Any


class State(NamedTuple):
    """State of an adapted environment."""

    env: Any  # the library's own
    obs: dict[str, Array]  # as the specification says


@contextlib.contextmanager
def library_rules() -> Iterator[None]:
    """JAX's standard promotion, which other libraries are written for, where a program asks for stricter rules."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@in_32_bits
def imported(package: str) -> Any:
    """A library's module. Libraries compute tables while they are loaded, which thereby are of 32 bits."""
    with library_rules():
        return importlib.import_module(package)


def adapt(
    reset: Callable[[Array], tuple[Any, Any]],
    step: Callable[[Any, Array, Array], Outcome],
    observation_space: Space,
    action_space: Space,
    image_size: int | None,
    draw: Callable[[Any], Any] | None = None,
) -> base.Env:
    """Makes an environment out of another library's functions.

    Args:
      reset: key -> the library's state and observation.
      step: (state, action in the library's own bounds and dtype, a new key) -> what came of it; at the end of an
        episode the state and observation are the last ones, not those of the next episode.
      image_size: height and width of images in pixels; None leaves them as they are.
      draw: state -> observation, where that is all there is to it. It is then called once a step, and what ``reset``
        and ``step`` return as observations is not looked at.

    Raises:
      ValueError: an action space that is neither discrete nor a bounded box of floats, a state whose structure or
        shapes change from step to step, or a bad ``image_size``.
    """
    if image_size is not None and (type(image_size) is not int or image_size < 1):
        raise ValueError(f"expected image_size to be a positive int or None, got {image_size!r}")
    action_spec, to_library = actions(action_space)
    reset, step = _by_library_rules(reset), _by_library_rules(step)
    shapes = settled(
        reset, step, jax.eval_shape(to_library, jax.ShapeDtypeStruct(action_spec.shape, action_spec.dtype))
    )
    if draw is not None:
        draw = _by_library_rules(draw)
        seen = jax.eval_shape(draw, shapes)
    else:
        seen = jax.eval_shape(reset, _key_shape())[1]
    spec, convert = observations(seen, observation_space, image_size)

    def begin(key: Array) -> State:
        state, obs = reset(key)
        return State(cast(state, shapes), convert(obs) if draw is None else {})

    def advance(state: State, action: Array, key: Array) -> tuple[State, base.Progress]:
        out = step(state.env, to_library(action), key)
        is_sound = jnp.ones((), bool)
        for leaf in jax.tree.leaves(out.obs):
            if jnp.issubdtype(leaf.dtype, jnp.floating):
                is_sound &= jnp.isfinite(leaf).all()
        progress = base.Progress(
            scalar("the reward", out.reward, jnp.float32),
            scalar("is_last", out.is_last, jnp.bool_),
            scalar("is_terminal", out.is_terminal, jnp.bool_),
            is_sound,
        )
        return State(cast(out.state, shapes), convert(out.obs) if draw is None else {}), progress

    def drawn(state: State) -> State:
        return state if draw is None else State(state.env, convert(draw(state.env)))

    restart_or_advance = base.restart_or_step(begin, advance, stochastic=True)

    def core_step(state: State, action: Array, restart: Array, key: Array) -> tuple[State, base.Progress]:
        state, progress = restart_or_advance(state if draw is None else state._replace(obs={}), action, restart, key)
        return drawn(state), progress

    core = base.Core(EnvSpec(spec, action_spec), lambda key: drawn(begin(key)), core_step, lambda state: state.obs)
    return base.from_core(core)


# Actions.


def actions(space: Space) -> tuple[ActionSpec, Callable[[Array], Array]]:
    """The specification of a space's actions, and the function from an action to the library's.

    Raises:
      ValueError: the space is neither discrete nor a box of floats with finite bounds.
    """
    if hasattr(space, "n"):
        dtype = getattr(space, "dtype", None) or jnp.int32
        return DiscreteAction(int(space.n)), lambda action: action.astype(dtype)
    if not (hasattr(space, "low") and hasattr(space, "high")):
        raise ValueError(f"expected a discrete action space or a box, got {space}")
    if not jnp.issubdtype(space.dtype, jnp.floating):
        raise ValueError(f"expected a box of floats as action space, got one of {jnp.dtype(space.dtype).name}: {space}")
    low, high = (
        np.broadcast_to(np.asarray(bound, np.float32), space.shape).copy() for bound in (space.low, space.high)
    )
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (low <= high).all()):
        raise ValueError(f"expected an action space with finite bounds, got low {low} and high {high}")
    dtype = space.dtype

    def scaled(action: Array) -> Array:
        value = low + 0.5 * (action.reshape(low.shape) + 1.0) * (high - low)
        return jnp.clip(value, low, high).astype(dtype)  # at the edges, rounding would step over a bound

    return ContinuousAction(low.size), scaled


# Observations.


def observations(
    shapes: Any, space: Space, image_size: int | None
) -> tuple[dict[str, ArraySpec], Callable[[Any], dict[str, Array]]]:
    """The specification of what an environment shows, and the function from its observation to ours.

    Args:
      shapes: shapes and dtypes of an observation, a pytree.
    """
    readers: dict[str, Callable[[Array], Array]] = {}
    specs = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(shapes)[0]:
        leaf_space = _at(space, path)
        scale = image_scale(leaf, leaf_space)
        read: Callable[[Array], Array]
        if scale is not None:
            read = functools.partial(as_image, scale=scale, size=image_size)
        elif hasattr(leaf_space, "n") and leaf.shape == () and jnp.issubdtype(leaf.dtype, jnp.integer):
            read = functools.partial(jax.nn.one_hot, num_classes=int(leaf_space.n), dtype=jnp.float32)
        else:
            read = _as_vector
        name = "/".join(map(str, map(_part, path))) or ("vector" if scale is None else "image")
        shape = jax.eval_shape(read, leaf)
        readers[name], specs[name] = read, ArraySpec(tuple(shape.shape), shape.dtype)

    def convert(obs: Any) -> dict[str, Array]:
        return {name: read(leaf) for (name, read), leaf in zip(readers.items(), jax.tree.leaves(obs), strict=True)}

    return specs, convert


def image_scale(leaf: Any, space: Space) -> float | None:
    """What an image's values are multiplied by to lie in [0, 255], or None for what is no image."""
    if len(leaf.shape) != 3:
        return None
    if leaf.dtype == jnp.bool_:
        return 255.0
    low, high = getattr(space, "low", None), getattr(space, "high", None)
    if low is None or high is None:
        return 1.0 if leaf.dtype == jnp.uint8 else None
    bounds = float(np.min(low)), float(np.max(high))
    if bounds == (0.0, 1.0):
        return 255.0
    return 1.0 if leaf.dtype == jnp.uint8 and bounds == (0.0, 255.0) else None


def as_image(image: Array, scale: float, size: int | None) -> Array:
    """[H, W, C] to uint8 ``[size, size, C]``; the aspect ratio gives way."""
    if image.dtype == jnp.uint8 and scale == 1.0 and (size is None or image.shape[:2] == (size, size)):
        return image
    if image.dtype == jnp.uint8 and scale == 1.0 and size is not None:
        (fold, rest), (other, remainder) = (divmod(side, size) for side in image.shape[:2])
        if fold == other > 0 and rest == remainder == 0:
            # Whole blocks of pixels: their means in integers, which round alike in every program.
            blocks = image.reshape(size, fold, size, fold, -1).astype(jnp.int32)
            return ((blocks.sum((1, 3)) + fold * fold // 2) // (fold * fold)).astype(jnp.uint8)
    image = jnp.nan_to_num(image.astype(jnp.float32)) * scale
    if size is not None:
        image = resized(image, size)
    return jnp.round(jnp.clip(image, 0.0, 255.0)).astype(jnp.uint8)


def resized(image: Array, size: int) -> Array:
    """float32 [H, W, C] to ``[size, size, C]``: smoothed where a side shrinks, pixels repeated where it grows."""
    height, width, channels = image.shape
    shrunk = (min(height, size), min(width, size), channels)
    if shrunk != image.shape:
        image = jax.image.resize(image, shrunk, "linear", antialias=True)
    if shrunk[:2] != (size, size):
        image = jax.image.resize(image, (size, size, channels), "nearest")
    return image


def _as_vector(leaf: Array) -> Array:
    return leaf.astype(jnp.float32).reshape(-1)


def _part(entry: Any) -> Any:
    """A key, index or name out of a pytree's path."""
    return next(getattr(entry, kind) for kind in ("key", "idx", "name") if hasattr(entry, kind))


def _at(space: Space, path: Any) -> Space:
    for entry in path:
        inner, part = getattr(space, "spaces", None), _part(entry)
        if isinstance(inner, Mapping):
            space = inner.get(part)
        else:
            space = inner[part] if isinstance(inner, list | tuple) and isinstance(part, int) else None
    return space


# States.


def settled(reset: Callable[..., Any], step: Callable[..., Any], action: Any) -> Any:
    """Shapes and dtypes of a state that is the same after ``reset`` and after any number of steps.

    Many environments begin with Python numbers, or with an int that a step turns into a float: each leaf gets the
    dtype that holds what either gives.

    Raises:
      ValueError: structure or shapes differ, or dtypes that don't go together.
    """
    state, _ = jax.eval_shape(reset, _key_shape())
    state = jax.tree.map(_strong, state)
    for _ in range(4):  # dtypes only grow, bool to int to float; a leaf may pass its own on to others
        stepped = jax.eval_shape(step, state, action, _key_shape()).state
        structures: list[Any] = [jax.tree.structure(tree) for tree in (state, stepped)]
        if structures[0] != structures[1]:
            raise ValueError(
                f"the environment's state: expected the structure of reset's, {structures[0]}, got from step "
                f"{structures[1]}"
            )
        joint = jax.tree_util.tree_map_with_path(_joint, state, stepped)
        if all(a.dtype == b.dtype for a, b in zip(jax.tree.leaves(joint), jax.tree.leaves(state), strict=True)):
            return state
        state = joint
    raise ValueError("the environment's state: expected dtypes that settle after some steps, got ever others")


def cast(state: Any, shapes: Any) -> Any:
    """The state in these dtypes, none of them weak."""
    return jax.tree.map(lambda x, shape: x if _is_key(shape) else jnp.asarray(x, shape.dtype), state, shapes)


def scalar(what: str, value: Any, dtype: Any) -> Array:
    """A number or flag, [], out of whatever array has just one."""
    value = jnp.asarray(value)
    if value.size != 1:
        raise ValueError(f"{what}: expected one number, got an array of shape {list(value.shape)}")
    return value.reshape(()).astype(dtype)


def _joint(path: Any, first: Any, other: Any) -> Any:
    what = f"the environment's state{jax.tree_util.keystr(path)}"
    if first.shape != other.shape:
        raise ValueError(
            f"{what}: expected the shape of reset's, {list(first.shape)}, got {list(other.shape)} from step"
        )
    if _is_key(first) or _is_key(other):
        if first.dtype != other.dtype:
            raise ValueError(f"{what}: expected the dtype of reset's, {first.dtype}, got {other.dtype} from step")
        return first
    with library_rules():
        return jax.ShapeDtypeStruct(first.shape, jnp.promote_types(first.dtype, other.dtype))


def _strong(leaf: Any) -> Any:
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)


def _is_key(leaf: Any) -> bool:
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _key_shape() -> Any:
    return jax.eval_shape(lambda: jax.random.key(0))


def _by_library_rules(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*args: Any) -> Any:
        with library_rules():
            return function(*args)

    return call
