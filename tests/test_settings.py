"""A configuration can be set, stored and compared by the paths of its fields."""

import dataclasses
import json
import subprocess
import sys
from collections.abc import Mapping
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ne_dreamer_jax import settings


@dataclasses.dataclass(frozen=True)
class Predictor:
    layers: int = 2
    scale: float = 0.5


@dataclasses.dataclass(frozen=True)
class Nothing:
    pass


@dataclasses.dataclass(frozen=True)
class Optimizer:
    name: Literal["adam", "laprop"] = "adam"
    rate: float = 4e-5
    clip: float | None = 0.3


@dataclasses.dataclass(frozen=True)
class Run:
    steps: int = 100
    obs: str = "pixels"
    bfloat16: bool = False
    size: tuple[int, int] = (64, 64)
    widths: tuple[int, ...] = (2, 3, 4, 4)
    scales: Mapping[str, float] = dataclasses.field(default_factory=lambda: {"reward": 1.0, "kl": 0.1})
    optimizer: Optimizer = Optimizer()
    objective: Predictor | Nothing = Predictor()


@pytest.mark.parametrize(
    ("assignment", "path", "value"),
    [
        ("steps=7", "steps", 7),
        ("steps=5e6", "steps", 5_000_000),
        ("steps=1_000", "steps", 1000),
        ("obs=a=b", "obs", "a=b"),
        ("bfloat16=true", "bfloat16", True),
        ("size=84,84", "size", (84, 84)),
        ("widths=(1, 2)", "widths", (1, 2)),
        ("widths=", "widths", ()),
        ("scales.kl=2", "scales.kl", 2.0),
        ("optimizer.name=laprop", "optimizer.name", "laprop"),
        ("optimizer.clip=none", "optimizer.clip", None),
        ("optimizer.clip=1", "optimizer.clip", 1.0),
        ("objective.layers=0", "objective.layers", 0),
    ],
)
def test_a_field_is_set_by_its_path_in_its_own_type(assignment, path, value):
    before = settings.paths(Run())
    after = settings.paths(settings.override(Run(), assignment))
    assert after[path] == value
    assert type(after[path]) is type(value)
    assert {name for name in before if before[name] != after[name]} <= {path}


def test_every_setting_is_taken_back_as_it_is_shown():
    changed = dataclasses.replace(Run(), steps=3, bfloat16=True, widths=(), objective=Nothing())
    for config in (Run(), changed, settings.override(Run(), "optimizer.clip=none")):
        rebuilt = config
        for path, value in settings.paths(config).items():
            rebuilt = settings.override(rebuilt, f"{path}={settings.as_text(value)}")
        assert rebuilt == config


def test_a_dataclass_is_chosen_by_its_name():
    assert settings.override(Run(), "objective=Nothing") == dataclasses.replace(Run(), objective=Nothing())
    assert settings.paths(Run())["objective"] == "Predictor"


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("stps=3", "no setting is called 'stps'. Did you mean steps?"),
        ("optimiser.rate=3", "no setting is called 'optimiser.rate'. Did you mean optimizer.rate"),
        ("objective.layer=3", "Did you mean objective.layers"),
        ("layers=3", "Did you mean objective.layers"),
        ("steps.more=3", "no setting is called 'steps.more'"),
        ("scales.rewrd=3", "Did you mean scales.reward"),
        ("steps=3.5", "steps: expected an integer, got '3.5'"),
        ("steps=many", "steps: expected an integer, got 'many'"),
        ("bfloat16=1", "bfloat16: expected true or false, got '1'"),
        ("size=64", "size: expected 2 values joined with commas, each an integer, got '64'"),
        ("size=64,x", "size: expected an integer, got 'x'"),
        ("optimizer.name=adm", "optimizer.name: expected adam or laprop, got 'adm'"),
        ("optimizer.clip=off", "optimizer.clip: expected a number or none, got 'off'"),
        ("objective=Everything", "objective: expected Predictor or Nothing, got 'Everything'"),
        ("scales=3", "scales: expected a member, as path.name=value, got '3'"),
        ("steps", "expected path=value, such as steps=100, got 'steps'"),
        ("=3", "expected path=value"),
    ],
)
def test_what_does_not_fit_is_refused_with_expected_and_got(assignment, message):
    with pytest.raises(ValueError, match=r".") as error:
        settings.override(Run(), assignment)
    assert message in str(error.value)


@given(
    steps=st.integers(),
    obs=st.text(),
    size=st.tuples(st.integers(), st.integers()),
    widths=st.lists(st.integers()).map(tuple),
    scales=st.dictionaries(st.text(), st.floats(allow_nan=False)),
    clip=st.none() | st.floats(allow_nan=False),
    objective=st.builds(Predictor, st.integers(), st.floats(allow_nan=False)) | st.just(Nothing()),
)
def test_a_configuration_survives_json(clip, **fields: Any):
    config = Run(**fields, optimizer=Optimizer(clip=clip))
    restored = settings.from_dict(Run, json.loads(json.dumps(settings.to_dict(config))))
    assert restored == config
    assert settings.differences(config, restored) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": "7"}, "Run.steps: expected an integer, got '7'"),
        ({"steps": True}, "Run.steps: expected an integer, got True"),
        ({"extra": 1}, "unknown ['extra']"),
        ({"optimizer": {"nam": "adam"}}, "missing [], unknown ['nam']"),
        ({"objective": {"type": "Lost"}}, "Run.objective: expected Predictor or Nothing"),
    ],
)
def test_json_that_does_not_fit_is_refused(change, message):
    with pytest.raises(ValueError, match=r".") as error:
        settings.from_dict(Run, settings.to_dict(Run()) | change)
    assert message in str(error.value)


def test_differences_name_every_changed_path():
    new = dataclasses.replace(Run(), steps=3, objective=Nothing())
    assert settings.differences(Run(), new) == [
        "steps: 100, now 3",
        "objective: 'Predictor', now 'Nothing'",
        "objective.layers: 2, now absent",
        "objective.scale: 0.5, now absent",
    ]


def test_unknown_names_bring_the_nearest():
    tasks = ["dmc/walker_walk", "dmc/walker_run", "dmc/pendulum_swingup", "rooms/watermaze"]
    assert settings.nearest("dmc/walker_wlak", tasks)[0] == "dmc/walker_walk"
    assert settings.nearest("watermaze", tasks)[0] == "rooms/watermaze"
    assert settings.did_you_mean("zzz", tasks) == f"Known: {', '.join(tasks)}."


def test_loads_nothing_heavy():
    code = "import sys, ne_dreamer_jax.settings; sys.exit(any(name in sys.modules for name in ('jax', 'numpy')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
