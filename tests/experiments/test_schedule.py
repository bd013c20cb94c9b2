"""Chunks and evaluations fall where the step alone says, and people read what it means."""

import os
import signal
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ne_dreamer_jax.runs import progress, signals
from ne_dreamer_jax.runs.metrics import StepCounts
from ne_dreamer_jax.runs.schedule import Schedule
from ne_dreamer_jax.runs.signals import Stop

schedules = st.builds(
    Schedule,
    total=st.integers(1, 300),
    chunk=st.integers(1, 50),
    evaluation=st.integers(1, 90),
    num_envs=st.integers(1, 8),
    action_repeat=st.integers(1, 4),
)


def ends(schedule, step=0):
    found = []
    while step < schedule.total:
        step = schedule.end_of_chunk(step)
        found.append(step)
    return found


@given(schedules)
def test_chunks_are_short_and_meet_every_evaluation_and_the_end(schedule):
    found = ends(schedule)
    assert found[-1] == schedule.total
    assert all(0 < after - before <= schedule.chunk for before, after in zip([0, *found], found, strict=False))
    due = {step for step in range(1, schedule.total + 1) if schedule.evaluates(step)}
    assert due == {*range(schedule.evaluation, schedule.total + 1, schedule.evaluation), schedule.total}
    assert due <= set(found)
    for step in found:
        assert ends(schedule, step) == [later for later in found if later > step]
        assert schedule.evaluations_after(step) == len([later for later in due if later > step])


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.4, "0 s"), (59.6, "1 min 0 s"), (200, "3 min 20 s"), (18_730, "5 h 12 min")]
)
def test_durations_read_well(seconds, words):
    assert progress.duration(seconds) == words


def test_the_time_left_counts_chunks_that_learned_and_evaluations_to_come():
    schedule = Schedule(total=100, chunk=10, evaluation=50, num_envs=2, action_repeat=2)
    pace = progress.Pace(schedule)
    counters = [StepCounts(40 * n, 20 * n, max(0, n - 1)) for n in range(4)]
    first = pace.line(counters[0], counters[1], {}, seconds=1.0)
    assert first.split("  ") == [
        " 10.0 %",
        "env step 40",
        "update 0",
        "40 env steps/s",
        "collecting before the first update",
    ]
    pace.evaluated(7.0)
    second = pace.line(counters[1], counters[2], {"train/return": 3.0, "train/loss/total": 2.5}, seconds=4.0)
    assert second.split("  ")[2:] == [
        "update 1",
        "10 env steps/s",
        "0.25 updates/s",
        "return 3.0",
        "loss 2.5",
        "46 s left",  # 80 steps of 0.4 s and two evaluations
    ]
    third = pace.line(counters[2], counters[3], {"train/faults": 2.0}, seconds=4.0)
    assert "episodes cut by faults of the environment: 2" in third.split("  ")
    assert "broken" not in pace.line(counters[2], counters[3], {"train/faults": 0.0}, seconds=4.0)


def test_one_signal_asks_and_the_second_insists():
    said = []
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job starts with it ignored
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with Stop(said.append) as stop:
        assert stop.signal is None
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.signal == signal.SIGINT
        assert "Stopping" in said[0]
        time.sleep(2 * signals.TOGETHER)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
