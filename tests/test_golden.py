"""The first updates of every method are what they were, and teach it something."""

import numpy as np
import pytest

from tests.golden import run

pytestmark = pytest.mark.usefixtures("quick_compilation")


def assert_alike(got, method):
    """The first updates are the stored ones."""
    want, alike = run.stored(method), run.PARTED.get(method, run.ALIKE)
    assert got.keys() == want.keys()
    for name, x in got.items():
        stored = want[name][:alike]
        atol = run.TOLERANCE * np.abs(stored).max()
        np.testing.assert_allclose(x[:alike], stored, rtol=run.TOLERANCE, atol=atol, err_msg=name)


def test_the_first_updates_are_the_stored_ones():
    assert_alike(run.losses("r2dreamer", run.PARTED["r2dreamer"]), "r2dreamer")


@pytest.mark.slow
@pytest.mark.parametrize("method", run.METHODS)
def test_a_method_learns_and_repeats(method):
    got, want = run.losses(method), run.stored(method)
    assert_alike(got, method)
    settings = run.config(method)
    own = [f"loss/{name}" for name in ("reward", *settings.objective.losses)] if method != "drqv2" else []
    for name in got:
        assert np.isfinite(got[name]).all(), name
        np.testing.assert_allclose(got[name][-20:].mean(), want[name][-20:].mean(), rtol=0.1, atol=0.05, err_msg=name)
    for name in ["loss/critic", *own]:
        assert got[name][-20:].mean() < got[name][:20].mean(), name
    for name, x in run.losses(method, run.ALIKE).items():
        np.testing.assert_array_equal(x, got[name][: run.ALIKE], err_msg=name)
