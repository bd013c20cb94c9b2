"""Kernels are counted where the program runs them."""

import jax
import jax.numpy as jnp
import pytest

from benchmarks import launches

pytestmark = pytest.mark.usefixtures("quick_compilation")


def hlo(function, *args):
    return jax.jit(function).lower(*args).compile().as_text()


def test_a_loops_kernels_count_for_each_of_its_steps():
    def step(x, _):
        return jnp.sort(jnp.sin(x @ x)), None

    def program(x):
        return jax.lax.scan(step, x, length=7)[0]

    x = jnp.ones((16, 16))
    found = launches.parts(hlo(program, x))
    assert max(found, key=lambda part: part.launches).steps == 7
    once = sum(part.launches for part in launches.parts(hlo(lambda x: step(x, None)[0], x)))
    in_all = sum(part.launches for part in found)
    assert 7 * once <= in_all <= 7 * (once + 3), "besides, a loop counts its steps"


def test_both_branches_are_counted():
    def program(x, which):
        return jax.lax.cond(which, lambda x: jnp.sort(x), lambda x: jnp.sort(jnp.sin(x @ x), axis=0), x)

    found = launches.parts(hlo(program, jnp.ones((16, 16)), jnp.array(True)))
    assert [part.name.split(":")[0] for part in found if "sort" in part.kernels] == ["branch 0", "branch 1"]


TEXT = """
%body (p: (s32[], f32[4])) -> (s32[], f32[4]) {
  %p = (s32[], f32[4]{0}) parameter(0)
  %a = f32[4]{0} get-tuple-element(%p), index=1
  %sin = f32[4]{0} fusion(%a), kind=kLoop, calls=%fused
  %copy = f32[4]{0} copy(%sin)
  ROOT %out = (s32[], f32[4]{0}) tuple(%i, %copy)
}

ENTRY %main (x: f32[4]) -> f32[4] {
  %x = f32[4]{0} parameter(0)
  %loop = (s32[], f32[4]{0}) while(%t), condition=%cond, body=%body, metadata={op_name="jit(f)/here/while"}, \
backend_config={"known_trip_count":{"n":"5"}}
  ROOT %y = f32[4]{0} custom-call(%x), custom_call_target="__cudnn$convForward"
}
"""


def test_a_programs_text_is_read():
    loop, outside = launches.parts(TEXT)
    assert (loop.name, loop.steps, loop.certain) == ("loop: here/while", 5, True)
    assert (dict(loop.kernels), loop.launches) == ({"fusion": 1, "copy": 1}, 10)
    assert (outside.steps, dict(outside.kernels)) == (1, {"custom-call": 1})


def test_of_a_loop_that_ends_by_its_values_one_step_is_counted():
    def program(x):
        return jax.lax.while_loop(lambda x: x.sum() < 100, lambda x: jnp.sort(jnp.sin(x @ x)) + 2, x)

    assert [part.certain for part in launches.parts(hlo(program, jnp.ones((16, 16)))) if "sort" in part.kernels] == [
        False
    ]


def test_what_is_begun_and_waited_for_is_one_launch():
    text = TEXT.replace(
        "%copy = f32[4]{0} copy(%sin)", "%copy = f32[4]{0} copy-start(%sin)\n  %d = f32[4]{0} copy-done(%copy)"
    )
    assert launches.parts(text)[0].launches == 10
