"""Settings of environments: a frozen dataclass for each family, in plain Python."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

from ne_dreamer_jax.envs import registry
from ne_dreamer_jax.settings import ranges
from ne_dreamer_jax.settings.ranges import Range

Repeat = Annotated[int, Range(1, 1_000_000)]
ImageSize = Annotated[int, Range(1, 4_096)]

GIVEN = "an environment given in code"
"""The task of an environment that was passed as an object, and has no name."""


@dataclass(frozen=True)
class DmcConfig:
    """A task of the Control Suite, and how it is observed."""

    task: str = "dmc/walker_walk"
    obs: Literal["pixels", "vector", "both"] = "pixels"
    """pixels, vector or both."""
    action_repeat: Repeat = 2
    """Environment steps for which each action is held; rewards are summed."""
    image_size: ImageSize = 64
    """Height and width of the frames."""
    fast: bool = False
    """Whether contacts are solved with a shorter line search than MuJoCo's; benchmarks/DMC.md measures the error."""

    def __post_init__(self) -> None:
        ranges.check(self)


@dataclass(frozen=True)
class RoomsConfig:
    """A Rooms task; each of its actions is held for four frames."""

    task: str = "rooms/watermaze"
    image_size: Annotated[int, Range(8, 4_096)] = 64
    """Height and width of the frames."""
    length: Annotated[int, Range(1, 1_000_000)] | Literal["native"] | None = None
    """Agent steps of an episode; native: DMLab's own; none: the paper's, at most 900."""

    def __post_init__(self) -> None:
        ranges.check(self)

    @property
    def action_repeat(self) -> int:
        """Environment steps (frames) of an agent step."""
        return 4


@dataclass(frozen=True)
class JaxConfig:
    """An environment of another library that is written in JAX, see `envs.adapters`."""

    task: str = "jax:gymnax/CartPole-v1"
    image_size: ImageSize = 64
    """Height and width of the frames, where it observes images."""

    def __post_init__(self) -> None:
        ranges.check(self)

    @property
    def action_repeat(self) -> int:
        """Environment steps of an agent step."""
        return 1


@dataclass(frozen=True, kw_only=True)
class WorkersConfig:
    """Processes in which environments run, see `envs.host.Workers`; what is learned does not depend on them."""

    workers: Annotated[int, Range(1, 65_536)] | None = None
    """At most one an environment; none: as many as there are processors."""
    step_seconds: Annotated[float, Range(0.001, 1e6)] = 60.0
    """What a step may take. A worker counts as hung after as many times that as it has environments."""
    on_failure: Literal["restart", "stop"] = "restart"
    """Whether the run goes on with a new worker in place of one that failed, or is saved and stopped."""

    def __post_init__(self) -> None:
        ranges.check(self)


@dataclass(frozen=True)
class HostConfig(WorkersConfig):
    """An environment of another library in worker processes, see `envs.host`."""

    task: str = "gym:CartPole-v1"
    obs: Literal["own", "pixels", "both"] = "own"
    """What it observes itself, a picture of it, or both."""
    action_repeat: Repeat = 1
    """Environment steps for which each action is held; rewards are summed."""
    image_size: ImageSize = 64
    """Height and width of images, to which others are scaled."""


@dataclass(frozen=True)
class DmControlConfig(WorkersConfig):
    """A task of dm_control itself, with C MuJoCo's physics and OpenGL pictures, in worker processes."""

    task: str = "dm_control:walker_walk"
    obs: Literal["pixels", "vector", "both"] = "pixels"
    """pixels, vector or both."""
    action_repeat: Repeat = 2
    """Environment steps for which each action is held; rewards are summed."""
    image_size: ImageSize = 64
    """Height and width of the frames."""


@dataclass(frozen=True)
class OwnConfig:
    """An environment of one's own, which says itself how it is observed."""

    task: str = GIVEN
    """A name given to ``envs.register``, a ``module:function``, or that it is passed as an object."""
    action_repeat: Repeat = 1
    """Environment steps that one of its steps counts for."""

    def __post_init__(self) -> None:
        ranges.check(self)


EnvConfig = DmcConfig | RoomsConfig | JaxConfig | HostConfig | DmControlConfig | OwnConfig
"""The settings that a configuration may choose from: which, the task's name decides."""

_OF_FAMILY: dict[str | None, type] = {
    "dmc/": DmcConfig,
    "rooms/": RoomsConfig,
    "jax:": JaxConfig,
    "gym:": HostConfig,
    "dm_env:": HostConfig,
    "dmlab:": HostConfig,
    "memory_maze:": HostConfig,
    "dm_control:": DmControlConfig,
    None: OwnConfig,
}
_SAME_CONTROL = (DmcConfig, DmControlConfig)
"""Families with the same tasks, whose settings mean the same."""


def for_task(task: str, like: Any) -> Any:
    """The settings of a task: ``like``, where they are of its family, else its family's with the fields they share.

    Raises:
      ValueError: no environment is called that, with close matches.
    """
    registry.check(task)
    kind = _OF_FAMILY[registry.family_of(task)]
    known = {field.name for field in fields(kind)} - {"task", "action_repeat", "obs"}
    if isinstance(like, kind) or (isinstance(like, _SAME_CONTROL) and kind in _SAME_CONTROL):
        known |= {"action_repeat", "obs"}
    shared = {field.name: getattr(like, field.name) for field in fields(like) if field.name in known}
    return kind(**{**shared, "task": task})


def with_images(config: Any) -> Any:
    """The settings of the same environment with images of 64 x 64 or more beside its vectors, for people to look at.

    ``config`` itself where it has images, or no setting makes them.
    """
    if isinstance(config, _SAME_CONTROL) and config.obs == "vector":
        return replace(config, obs="both", image_size=max(64, config.image_size))
    return config


def with_all(config: Any) -> Any:
    """The settings of the same task of DeepMind Control with images and vectors; of others, ``config`` itself."""
    return replace(with_images(config), obs="both") if isinstance(config, _SAME_CONTROL) else config


def make(config: Any) -> Any:
    """The environment of these settings.

    Raises:
      ValueError: as ``envs.make``; or for an environment that was given as an object, and has to be given again.
    """
    if isinstance(config, OwnConfig):
        if config.task == GIVEN:
            raise ValueError(
                "this run was made with an environment given in code, which no command can make: give it again, as "
                "ne_dreamer_jax.evaluate(run, env=...) or train(..., env=...) in Python. A run that was trained with "
                "--task module:function, or under a name given to register, remembers its environment"
            )
        return registry.make(config.task)
    options = {field.name: getattr(config, field.name) for field in fields(config) if field.name != "task"}
    return registry.make(config.task, **options)
