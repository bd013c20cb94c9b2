"""What a diagnosis says is so: on numbers that are known, and on a small run from beginning to end."""

import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from experiments import diagnose as command
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.envs.config import DmcConfig, RoomsConfig, with_all
from ne_dreamer_jax.loop.play import Steps
from ne_dreamer_jax.runs import decoding, diagnosis
from ne_dreamer_jax.types import ContinuousAction, EnvSpec, Latent
from tests import tiny
from tests.experiments import toy
from tests.experiments.test_commands import invoke

RNG = np.random.default_rng(0)


def episodes(lengths, *, terminal=(), **fields) -> Steps:
    """Steps of episodes of these lengths; those in ``terminal`` end for good."""
    counts = np.arange(max(lengths) + 2)[:, None] < np.array(lengths)
    is_terminal = np.zeros_like(counts)
    for m in terminal:
        is_terminal[lengths[m] - 1, m] = True
    shape = counts.shape
    given = {
        "obs": {},
        "action": RNG.uniform(-1, 1, (*shape, 2)),
        "reward": RNG.normal(size=shape),
        "latent": Latent(np.zeros((*shape, 1)), np.zeros((*shape, 1, 1))),
    }
    return Steps(**(given | fields), is_terminal=is_terminal, counts=counts)


def test_linear_functions_of_features_are_known_and_noise_is_not():
    x = RNG.normal(size=(4_000, 6))
    y = np.stack([x @ np.arange(6.0) + 3, 1e3 * x[:, 0], RNG.normal(size=4_000), np.full(4_000, 7.0)], 1)
    fitted = diagnosis.Regression.fit(x[::2], y[::2])
    known = fitted.explained(x[1::2], y[1::2])
    assert min(known[:2]) > 0.99
    assert abs(known[2]) < 0.05
    assert known[3] == 0  # nothing varies


def test_a_prediction_worse_than_the_mean_explains_less_than_nothing():
    y = RNG.normal(size=(1_000, 1))
    y -= y.mean()
    assert diagnosis.explained(y, y) == [1.0]
    assert diagnosis.explained(-y, y)[0] == pytest.approx(-3.0, abs=1e-6)


def test_returns_that_came_are_discounted_sums_to_the_episodes_end():
    steps = episodes([5, 3], terminal=[1])
    value = RNG.normal(size=steps.counts.shape)
    came = diagnosis.returns_that_came(steps, value, 0.9)
    for m, length in enumerate((5, 3)):
        end = 0.0 if m == 1 else value[length - 1, m]
        for t in range(length):
            rest = sum(0.9 ** (k - t - 1) * steps.reward[k, m] for k in range(t + 1, length))
            np.testing.assert_allclose(came[t, m], rest + 0.9 ** (length - 1 - t) * end, rtol=1e-6)


def test_open_loops_start_where_the_same_episode_goes_on():
    steps = episodes([9, 4, 2])
    t, m = diagnosis.starts(jax.random.key(0), steps, 3)
    assert sorted(zip(t.tolist(), m.tolist(), strict=True)) == sorted([(i, 0) for i in range(6)] + [(0, 1)])
    assert not len(diagnosis.starts(jax.random.key(0), steps, 30)[0])


def test_saturated_components_are_counted():
    assert diagnosis.saturated(np.array([[-1.0, 0.5], [-0.99, 0.0], [0.96, -0.9], [1.0, 1.0]])) == [1.0, 0.25]


def test_components_are_named():
    obs = {
        "b": np.zeros((3, 2, 2), np.float32),
        "a": np.zeros((3, 2), np.float32),
        "i": np.zeros((3, 2, 4, 4, 3), np.uint8),
    }
    names, values = diagnosis.vectors(obs)
    assert names == ["a", "b[0]", "b[1]"]
    assert values.shape == (3, 2, 3)
    assert diagnosis.images(obs) == ["i"]


@pytest.mark.usefixtures("quick_compilation")
def test_the_decoder_draws_what_the_latents_hold_and_no_more():
    """Of two images, one a function of the latent and one of nothing, it learns the first alone."""
    rng = np.random.default_rng(1)
    agent = make_agent(tiny.CONFIG, tiny.VECTORS)
    rssm = tiny.CONFIG.rssm
    deter = rng.uniform(-1, 1, (64, 4, rssm.deter)).astype(np.float32)
    latent = Latent(deter, np.zeros((64, 4, rssm.stoch, rssm.classes), np.float32))
    side = tiny.CONFIG.encoder.factor
    shade = lambda x: np.broadcast_to((127 + 120 * x)[..., None, None, None], (64, 4, side, side, 1)).astype(np.uint8)
    obs = {"held": shade(deter[..., 0]), "lost": shade(rng.uniform(-1, 1, (64, 4)))}
    steps = episodes([64] * 4)
    steps = jax.tree.map(lambda x: x[:64], steps._replace(obs=obs, latent=latent))
    fit, held_out = diagnosis.halves(steps)
    share = {
        name: decoding.post_hoc_decoder(agent, jax.random.key(0), fit, held_out, name, updates=800, batch=16).explained
        for name in obs
    }
    assert share["held"] > 0.5
    assert share["lost"] < 0.1


def test_the_same_control_shows_both_and_others_what_they_show():
    assert with_all(DmcConfig(image_size=32)) == DmcConfig(image_size=32, obs="both")
    assert with_all(DmcConfig(obs="vector", image_size=32)) == DmcConfig(obs="both", image_size=64)
    assert with_all(RoomsConfig()) == RoomsConfig()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "run"
    nedreamer.train(toy.config(), path, env=toy.env(), echo=lambda line: None)
    return path


@pytest.mark.usefixtures("quick_compilation")
def test_a_run_is_diagnosed_and_the_result_kept(run):
    lines: list[str] = []
    told = nedreamer.diagnose(run, toy.env(), episodes=4, horizon=3, echo=lines.append)
    assert json.loads((run / "diagnosis.json").read_text())["known"] == told["known"]
    assert list(told["known"]) == ["position[0]"]
    assert sorted(told["open_loop"]) == [1, 2, 3]
    assert len(told["saturated"]) == 1
    assert told["return"] <= 0  # minus a distance
    assert "decoded" not in told  # no images
    assert [line.split(" ")[0] for line in lines] == [
        "4",
        "Known",
        "Predicted",
        "Predicted",
        "Predicted",
        "Critic:",
        "Policy:",
    ]


@pytest.mark.usefixtures("quick_compilation")
def test_sampled_actions_are_not_the_mode_and_saturation_is_that_of_the_mode(run):
    """The policy of a run this short is all noise: its samples reach the ends, its mode does not."""
    quiet = lambda line: None
    told = {
        actions: nedreamer.diagnose(run, toy.env(), episodes=4, horizon=3, actions=actions, echo=quiet)
        for actions in ("mode", "sample")
    }
    assert told["sample"]["actions"] == "sample"
    assert told["sample"]["return"] != told["mode"]["return"]
    assert told["sample"]["saturated"] == told["mode"]["saturated"] == [0.0]


def test_the_command_refuses_what_is_no_run(tmp_path):
    code, output = invoke(command, tmp_path)
    assert code == 2
    assert "expected the --logdir of a run" in output


def test_what_cant_be_diagnosed_is_refused(run, monkeypatch):
    with pytest.raises(ValueError, match="episodes: expected two or more"):
        nedreamer.diagnose(run, toy.env(), episodes=1)
    spec = EnvSpec(tiny.VECTORS.observation, ContinuousAction(2))
    blind = SimpleNamespace(agent=make_agent(DrQv2Config(), spec), state=SimpleNamespace(params=None))
    monkeypatch.setattr(diagnosis.evaluation, "load", lambda *_: blind)
    with pytest.raises(ValueError, match="expected a run of an agent with a world model, got drqv2"):
        nedreamer.diagnose(run, toy.env())
