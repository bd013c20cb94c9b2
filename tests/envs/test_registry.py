"""The list of environments, and what a mistyped name gets."""

import subprocess
import sys

import pytest

from ne_dreamer_jax import envs
from ne_dreamer_jax.envs.dmc import names as dmc_names

TWENTY_TASKS = {
    "dmc/acrobot_swingup",
    "dmc/ball_in_cup_catch",
    "dmc/cartpole_balance",
    "dmc/cartpole_balance_sparse",
    "dmc/cartpole_swingup",
    "dmc/cartpole_swingup_sparse",
    "dmc/cheetah_run",
    "dmc/finger_spin",
    "dmc/finger_turn_easy",
    "dmc/finger_turn_hard",
    "dmc/hopper_hop",
    "dmc/hopper_stand",
    "dmc/pendulum_swingup",
    "dmc/quadruped_run",
    "dmc/quadruped_walk",
    "dmc/reacher_easy",
    "dmc/reacher_hard",
    "dmc/walker_run",
    "dmc/walker_stand",
    "dmc/walker_walk",
}


def test_the_papers_twenty_control_suite_tasks_are_registered():
    assert {name for name in envs.names() if name.startswith("dmc/")} == TWENTY_TASKS


def test_a_dmc_name_splits_into_domain_and_task():
    assert dmc_names.split("dmc/ball_in_cup_catch") == ("ball_in_cup", "catch")
    assert dmc_names.split("dmc/cartpole_swingup_sparse") == ("cartpole", "swingup_sparse")


def test_a_mistyped_name_is_refused_with_close_matches():
    with pytest.raises(ValueError, match=r"'dmc/waker_walk'.*Did you mean.*dmc/walker_walk"):
        envs.make("dmc/waker_walk")


def test_a_name_like_no_other_is_refused_with_the_list():
    with pytest.raises(ValueError, match=r"Known: .*dmc/cartpole_balance"):
        envs.make("zzz")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obs": "pixel"}, r"obs to be one of pixels, vector, both, got 'pixel'"),
        ({"action_repeat": 0}, r"action_repeat to be a positive int, got 0"),
        ({"image_size": 64.0}, r"image_size to be a positive int, got 64\.0"),
        ({"fast": 1}, r"fast to be True or False, got 1"),
        ({"image_sise": 64}, r"dmc/pendulum_swingup has no option 'image_sise'. Did you mean image_size"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        envs.make("dmc/pendulum_swingup", **options)


def test_names_are_known_without_loading_jax_or_mujoco():
    code = (
        "import sys; from ne_dreamer_jax import envs\n"
        "assert 'dmc/walker_walk' in envs.names()\n"
        "try: envs.check('dmc/walker_wlak')\n"
        "except ValueError as error: assert 'dmc/walker_walk' in str(error)\n"
        "else: raise AssertionError\n"
        "loaded = {'jax', 'mujoco', 'dm_control', 'numpy'} & set(sys.modules); assert not loaded, loaded"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
