"""The Rooms tasks, in plain Python."""

AGENT_STEPS = 900
"""Length of an episode in the paper's experiments, in agent steps of four frames; but for nonmatching's own 180."""

NATIVE_STEPS = {
    "rooms/collect_good_objects": 900,
    "rooms/collect_good_objects_test": 900,
    "rooms/exploit_deferred_effects": 900,
    "rooms/exploit_deferred_effects_test": 900,
    "rooms/select_nonmatching_object": 180,
    "rooms/select_nonmatching_object_small": 120,
    "rooms/watermaze": 1800,
    "rooms/watermaze_small": 300,
}
"""Task -> agent steps of an episode in DMLab, or here where the task is ours."""

NAMES = tuple(sorted(NATIVE_STEPS))


def default_steps(name: str) -> int:
    """Agent steps of an episode: the paper's, where that is shorter than the task's own."""
    return min(AGENT_STEPS, NATIVE_STEPS[name])
