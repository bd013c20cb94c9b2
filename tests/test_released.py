"""Losses, gradients and updates are those of the authors' released code, whose numbers are stored.

The agent, the data and the random numbers are in `released.setting`; `released.compare` ran the authors' PyTorch code
on them. Every method, with continuous and discrete actions, pictures and a vector.
"""

import pytest

from ne_dreamer_jax import config as configs
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("actions", "change"),
    [
        ("continuous", "rssm.unimix=0.02"),
        ("continuous", "world_model.free_nats=0.5"),
        ("continuous", "world_model.kl_unimix=0.01"),
        ("continuous", "heads.clip_actions=true"),
        ("continuous", "loss_scales.dynamics=0.9"),
        ("continuous", "loss_scales.representation=0.2"),
        ("continuous", "loss_scales.replay_critic=0.2"),
        ("continuous", "behavior.discount=0.99"),
        ("continuous", "behavior.discount_in_head=true"),
        ("continuous", "behavior.lam=0.9"),
        ("continuous", "behavior.entropy=0.1"),
        ("continuous", "behavior.gradient=dynamics"),
        ("continuous", "behavior.mean_penalty=1e-3"),
        ("continuous", "behavior.percentile_method=linear"),
        ("continuous", "behavior.return_floor=1e9"),
        ("continuous", "behavior.slow_rate=0.5"),
        ("continuous", "objective.action=current"),
        ("continuous", "objective.across_episodes=false"),
        ("continuous", "objective.masked=true"),
        ("continuous", "objective.sample_deviation=false"),
        ("continuous", "optimizer.agc=0.2"),
        ("continuous", "optimizer.agc_pmin=1.0"),
        ("continuous", "optimizer.beta1=0.8"),
        ("continuous", "optimizer.beta2=0.99"),
        ("continuous", "optimizer.name=adam"),
        ("continuous", "optimizer.name=laprop"),
        ("continuous", "optimizer.warmup=3"),
        ("discrete", "objective.action=current"),
    ],
)
def test_any_other_setting_is_not(actions, change, monkeypatch):
    """The comparison sees each of them: what is equal is not so because the data never ask."""

    def changed(method):
        return configs.override(configs.Config(agent=released(method)), f"agent.{change}").agent

    released = setting.config
    monkeypatch.setattr(setting, "config", changed)
    found = measure.differences(measure.run("ne_dreamer", actions), measure.stored("ne_dreamer", actions))
    print(change, found)
    assert any(found[part][0] > 3 * largest for part, largest in LARGEST.items()), found
