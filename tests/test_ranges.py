"""Every number of every configuration has a range beside it, and is checked there: for code and command line alike."""

import dataclasses
import math
import typing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ne_dreamer_jax import config as configs
from ne_dreamer_jax import settings
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.settings import ranges


def classes(cls=configs.Config):
    """All dataclasses that a configuration may be made of."""
    found = {cls}
    for annotation in ranges.hints_of(cls).values():
        for choice in ranges.choices(ranges.plain(annotation)):
            if dataclasses.is_dataclass(choice):
                found |= classes(choice)
    return found


def numbers(annotation):
    """The annotations of the numbers in a field: the field's own, or its members'."""
    found = []
    for choice in ranges.choices(annotation):
        inner = ranges.plain(choice)
        if inner in (int, float):
            found.append(choice)
        found += [hint for member in typing.get_args(inner) if member is not ... for hint in numbers(member)]
    return found


CLASSES = sorted(classes(), key=lambda cls: cls.__name__)
FIELDS = [
    pytest.param(cls, name, id=f"{cls.__name__}.{name}")
    for cls in CLASSES
    for name, annotation in ranges.hints_of(cls).items()
    if numbers(annotation)
]
ODD = [0, -1, 1, 2, 0.0, 0.5, 1.0, -0.5, 1e-30, 1e30, 10**30, -(10**30), 2**31, 5e-324, 1.7e308]
ODD += [math.nan, math.inf, -math.inf, True, None, "7", (), (0,), (3, -1)]


def test_all_classes_are_found():
    assert {"Config", "LoopConfig", "AgentConfig", "DrQv2Config", "OptimizerConfig"} <= {c.__name__ for c in CLASSES}
    assert len(FIELDS) > 60


@pytest.mark.parametrize(("cls", "name"), FIELDS)
def test_every_number_has_a_range_and_nan_is_in_none(cls, name):
    for annotation in numbers(ranges.hints_of(cls)[name]):
        allowed = ranges.of(annotation)
        assert allowed is not None
        assert math.nan not in allowed
        assert -math.inf not in allowed


@given(st.sampled_from([field.values for field in FIELDS]), st.sampled_from(ODD) | st.integers() | st.floats())
def test_a_value_is_in_its_range_or_refused_by_name(field, value):
    cls, name = field
    try:
        made = cls(**{name: value})
    except ValueError as error:
        said = str(error)
    else:
        said = None
    if said is not None:
        assert name in said
        assert "got" in said
        return
    for annotation in numbers(ranges.hints_of(cls)[name]):
        members = value if isinstance(value, tuple) else (value,)
        assert all(member is None or member in ranges.of(annotation) for member in members)
    assert getattr(made, name) == value


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("loop.eval_every=0", r"loop.eval_every: expected an integer of at least 1 or none, got 0"),
        ("loop.num_envs=0", r"loop.num_envs: expected an integer from 1 to 10,000,000, got 0"),
        ("loop.eval_episodes=0", r"loop.eval_episodes: expected an integer from 1 to"),
        ("loop.replay_ratio=-1", r"loop.replay_ratio: expected a number from 0 to 1e\+06, got -1.0"),
        ("loop.replay_ratio=nan", r"loop.replay_ratio: .*got nan"),
        ("loop.env_steps=1e30", r"loop.env_steps: expected an integer of at least 1, got 1000000000000"),
        ("loop.prefill=-1", r"loop.prefill: expected an integer of at least 0, got -1"),
        ("agent.encoder.depth=0", r"agent.encoder.depth: expected an integer from 1"),
        ("agent.encoder.multipliers=2,0", r"agent.encoder.multipliers: expected an integer from 1 to 1,000,000, got 0"),
        ("agent.heads.bins=1", r"agent.heads.bins: expected an integer from 2"),
        ("agent.behavior.horizon=0", r"agent.behavior.horizon: expected an integer from 1"),
        ("agent.behavior.discount=1", r"agent.behavior.discount: expected a number from 0 and less than 1, got 1.0"),
        ("agent.optimizer.agc=0", r"agent.optimizer.agc: expected a number of more than 0, got 0.0"),
        ("agent.loss_scales.reward=-1", r"agent.loss_scales.reward: expected a number of at least 0, got -1.0"),
        ("env.image_size=0", r"env.image_size: expected an integer from 1"),
        ("env.action_repeat=0", r"env.action_repeat: expected an integer from 1"),
        ("seed=-1", r"seed: expected an integer of at least 0, got -1"),
    ],
)
def test_the_command_line_is_told_the_whole_path(assignment, message):
    with pytest.raises(ValueError, match=message):
        settings.override(configs.preset("smoke"), assignment)


def test_json_is_told_the_whole_path():
    data = settings.to_dict(configs.preset("smoke"))
    data["agent"]["rssm"]["stoch"] = 0
    with pytest.raises(ValueError, match=r"Config.agent.rssm.stoch: expected an integer from 1 to 1,000,000, got 0"):
        settings.from_dict(configs.Config, data)


def test_other_kinds_of_values_are_told_apart():
    with pytest.raises(ValueError, match=r"LoopConfig.num_envs: expected an integer .* got 2.5"):
        configs.LoopConfig(num_envs=2.5)
    with pytest.raises(ValueError, match=r"LoopConfig.storage: expected pixels, states or host, got 'disk'"):
        configs.LoopConfig(storage="disk")
    with pytest.raises(ValueError, match=r"DrQv2Config.frame_stack: expected an integer .* got 0"):
        DrQv2Config(frame_stack=0)
    assert configs.LoopConfig(replay_ratio=2).replay_ratio == 2
