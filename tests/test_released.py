"""Losses, gradients and updates are those of the authors' released code, whose numbers are stored.

The agent, the data and the random numbers are in `released.setting`; `released.compare` ran the authors' PyTorch code
on them. Every method, with continuous and discrete actions, pictures and a vector.
"""

import pytest

from tests.released import measure, setting

pytestmark = pytest.mark.usefixtures("quick_compilation")

QUICK = ("ne_dreamer", "discrete")
LARGEST = {"losses": 1e-5, "gradients": 1e-4, "parameters": 2e-6}
"""Relative to the largest number of a loss or a tensor, in float32."""


@pytest.mark.parametrize(
    ("method", "actions"),
    [pytest.param(*case, marks=() if case == QUICK else pytest.mark.slow) for case in setting.CASES],
)
def test_an_update_is_the_authors(method, actions):
    found = measure.differences(measure.run(method, actions), measure.stored(method, actions))
    assert all(found[part][0] <= largest for part, largest in LARGEST.items()), found
