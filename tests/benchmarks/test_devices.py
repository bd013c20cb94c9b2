"""Collectives are read off a compiled program."""

import pytest

from benchmarks import devices

LINES = {
    "  %r = (f32[8,4]{1,0}, u8[3]{0}) all-reduce(%a, %b), channel_id=1": ("all-reduce", 8 * 4 * 4 + 3),
    "  ROOT %g = f32[15,1024]{1,0} all-gather-start(%a), dimensions={1}": ("all-gather", 15 * 1024 * 4),
    "  %s = bf16[] reduce-scatter(%a)": ("reduce-scatter", 2),
}


@pytest.mark.parametrize("line", LINES)
def test_kind_and_bytes(line):
    match = devices._COLLECTIVE.search(line)
    assert match is not None
    assert (match["kind"], devices.result_bytes(match["result"])) == LINES[line]


@pytest.mark.parametrize("line", ["  %x = f32[3]{0} add(%all-reduce.1, %b)", "%c = f32[3] all-reduce-done(%r)"])
def test_what_only_uses_one_is_none(line):
    assert devices._COLLECTIVE.search(line) is None
