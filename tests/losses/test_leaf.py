"""The losses can be used without the rest of the package and its dependencies."""

import subprocess
import sys

import ne_dreamer_jax.losses as losses

PROBE = """
import sys
import ne_dreamer_jax.losses as losses
losses.barlow_twins
print("\\n".join(sys.modules))
"""


def test_importing_the_losses_loads_jax_and_nothing_of_the_rest():
    loaded = subprocess.run(
        [sys.executable, "-c", PROBE], capture_output=True, text=True, check=True, timeout=120
    ).stdout.split()
    assert "jax" in loaded
    unwanted = {"flax", "optax", "mujoco", "dm_control", "orbax", "matplotlib", "imageio", "chex"}
    assert not unwanted & {name.split(".")[0] for name in loaded}
    ours = {name for name in loaded if name.startswith("ne_dreamer_jax.")}
    assert {name for name in ours if not name.startswith("ne_dreamer_jax.losses")} == set()


def test_every_public_name_is_there_and_documented():
    for name in losses.__all__:
        assert getattr(losses, name).__doc__, name
