"""What a diagnosis says is so: on numbers that are known, and on a small run from beginning to end."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import ne_dreamer_jax as nedreamer
from experiments import diagnose as command
from ne_dreamer_jax import config as configs
from ne_dreamer_jax import make_agent
from ne_dreamer_jax.agents.drqv2 import DrQv2Config
from ne_dreamer_jax.envs.config import DmcConfig, OwnConfig, RoomsConfig, with_all
from ne_dreamer_jax.loop.play import Steps
from ne_dreamer_jax.runs import decoding, diagnosis, plots, probing
from ne_dreamer_jax.types import ContinuousAction, EnvSpec, Latent
from tests import tiny
from tests.experiments import toy
from tests.experiments.test_commands import invoke


def random() -> np.random.Generator:
    return np.random.default_rng(0)


def episodes(lengths, *, terminal=(), **fields) -> Steps:
    """Steps of episodes of these lengths; those in ``terminal`` end for good."""
    rng = random()
    counts = np.arange(max(lengths) + 2)[:, None] < np.array(lengths)
    is_terminal = np.zeros_like(counts)
    for m in terminal:
        is_terminal[lengths[m] - 1, m] = True
    shape = counts.shape
    given = {
        "obs": {},
        "action": rng.uniform(-1, 1, (*shape, 2)),
        "reward": rng.normal(size=shape),
        "latent": Latent(np.zeros((*shape, 1)), np.zeros((*shape, 1, 1))),
    }
    return Steps(**(given | fields), is_terminal=is_terminal, counts=counts)


def test_linear_functions_of_features_are_known_and_noise_is_not():
    rng = random()
    x = rng.normal(size=(4_000, 6))
    y = np.stack([x @ np.arange(6.0) + 3, 1e3 * x[:, 0], rng.normal(size=4_000)], 1)
    fitted = probing.LinearProbe.fit(x[::2], y[::2])
    known = fitted.explained(x[1::2], y[1::2])
    assert min(known[:2]) > 0.99
    assert abs(known[2]) < 0.05


def test_a_unit_that_hardly_varied_says_nothing_where_it_varies_more():
    rng = random()
    x = rng.normal(size=(4_000, 2))
    y = x[:, :1] + 0.1 * rng.normal(size=(4_000, 1))
    x[:, 1] = 1e-5 * (0.3 * y[:, 0] + x[:, 1])
    fitted = probing.LinearProbe.fit(x[::2], y[::2])
    assert fitted.explained(x[1::2], y[1::2])[0] > 0.97
    assert fitted.explained(x[1::2] + np.array([0.0, 1e-3]), y[1::2])[0] > 0.8


@pytest.mark.parametrize("number", [7.0, 1.3, 0.1, -0.05, 24.6])
def test_of_what_is_constant_nothing_is_explained(number):
    y = np.full((4_000, 1), number, np.float32)
    assert probing.explained(y, y) == probing.explained(y + np.float32(1e-3), y) == [0.0]


def test_a_prediction_worse_than_the_mean_explains_less_than_nothing():
    y = random().normal(size=(1_000, 1))
    y -= y.mean()
    assert probing.explained(y, y) == [1.0]
    assert probing.explained(-y, y)[0] == pytest.approx(-3.0, abs=1e-6)


def test_returns_that_came_are_discounted_sums_to_the_episodes_end():
    steps = episodes([5, 3], terminal=[1])
    value = random().normal(size=steps.counts.shape)
    came, weight = probing.returns_that_came(steps, value, 0.9)
    for m, length in enumerate((5, 3)):
        end, goes_on = (0.0, 0.0) if m == 1 else (value[length - 1, m], 1.0)
        for t in range(length):
            rest = sum(0.9 ** (k - t - 1) * steps.reward[k, m] for k in range(t + 1, length))
            np.testing.assert_allclose(came[t, m], rest + 0.9 ** (length - 1 - t) * end, rtol=1e-6)
            np.testing.assert_allclose(weight[t, m], 0.9 ** (length - 1 - t) * goes_on, rtol=1e-6)


def judging(value, reward: float = 0.0) -> Any:
    """An agent whose critic says ``value(feature)``, and whose model expects this reward at every step."""
    behavior = SimpleNamespace(discount=0.9)
    heads = lambda params, x: SimpleNamespace(value=value(np.asarray(x)))

    def imagine(params, key, latent, horizon) -> Any:
        numbers = np.full((horizon + 1, len(latent.deter)), 1.0, np.float32)
        expected = SimpleNamespace(reward=reward * numbers, value=0 * numbers, discount=0.9 * numbers)
        return SimpleNamespace(heads=expected)

    return SimpleNamespace(heads=heads, imagine=imagine, config=SimpleNamespace(behavior=behavior))


def test_the_critic_is_not_judged_by_its_own_values():
    steps, key = episodes([60, 40]), jax.random.key(0)
    judged = probing.critic(judging(lambda x: np.full(x.shape[:-1], 1e3)), None, key, steps)
    assert judged["value"] == pytest.approx(1e3)
    assert judged["return"] < 0.31e3  # a time limit ends both episodes, with a value of 1,000
    assert judged["states"] == 48 + 28  # 0.9 ** 12 is below 0.3, 0.9 ** 11 is not
    first = judging(lambda x: x[..., 0])
    assert probing.critic(first, None, key, episodes([9, 5])) == {"states": 0}
    assert probing.critic(first, None, key, episodes([9, 5], terminal=[0]))["states"] == 8


def test_what_the_model_expects_is_its_rewards_for_as_long_as_they_count():
    """1 + 0.9 + 0.9 ** 2 + ..., where what follows the end is worth nothing to the critic."""
    agent = judging(lambda x: x[..., 0], reward=1.0)
    judged = probing.critic(agent, None, jax.random.key(0), episodes([60, 40]))
    assert judged["imagined"] == pytest.approx((1 - 0.9**12) / 0.1, rel=1e-5)


def test_open_loops_start_where_the_same_episode_goes_on():
    steps = episodes([9, 4, 2])
    t, m = probing.starts(jax.random.key(0), steps, 3)
    assert sorted(zip(t.tolist(), m.tolist(), strict=True)) == sorted([(i, 0) for i in range(6)] + [(0, 1)])
    assert not len(probing.starts(jax.random.key(0), steps, 30)[0])


def test_open_loops_are_laid_beside_what_came_at_the_same_step():
    """In a world that adds up actions, whose reward is the sum on arrival, a model that does so predicts everything."""
    lengths = [30, 11, 23]
    action = random().uniform(-1, 1, (32, 3, 1)).astype(np.float32)
    place = np.concatenate([np.zeros((1, 3, 1), np.float32), np.cumsum(action, axis=0)[:-1]])
    latent = Latent(place, np.zeros((32, 3, 1, 1), np.float32))
    steps = episodes(lengths, action=action, reward=place[..., 0], latent=latent, obs={"place": place})
    _, truth = probing.side_by_side(steps.obs, ["place"])
    probe = probing.LinearProbe.fit(probing.features(steps), truth[steps.counts])

    def adds(params, key, start, actions) -> Latent:
        deter = np.asarray(start.deter) + np.cumsum(np.asarray(actions), axis=0)
        return Latent(deter, np.zeros((*deter.shape, 1), np.float32))

    agent: Any = SimpleNamespace(open_loop=adds, heads=lambda params, x: SimpleNamespace(reward=np.asarray(x).sum(-1)))
    for horizon in (1, 5, 8):
        told = probing.open_loops(agent, None, jax.random.key(0), steps, probe, truth, horizon)
        assert sorted(told) == {1: [1], 5: [1, 2, 4, 5], 8: [1, 2, 4, 8]}[horizon]
        for ahead in told.values():
            assert ahead.reward == pytest.approx(1.0, abs=1e-6)
            assert ahead.known[0] == pytest.approx(1.0, abs=1e-3)
    alone = probing.open_loops(agent, None, jax.random.key(0), steps, None, np.zeros((0, 0, 0)), 5)
    assert alone[5] == probing.Ahead([], pytest.approx(1.0, abs=1e-6))


def test_saturated_components_are_counted():
    assert probing.saturated(np.array([[-1.0, 0.5], [-0.99, 0.0], [0.96, -0.9], [1.0, 1.0]])) == [1.0, 0.25]


def test_components_are_named():
    obs = {"b": np.zeros((3, 2, 2), np.float32), "a": np.zeros((3, 2), np.float32)}
    names, values = probing.side_by_side(obs, ["a", "b"])
    assert names == ["a", "b[0]", "b[1]"]
    assert values.shape == (3, 2, 3)


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
    fit, held_out = probing.halves(steps)
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
    assert told["policy"]["mean"] <= 0  # minus a distance
    assert "decoded" not in told  # no images
    assert [line.split(" ")[0] for line in lines] == [
        "an",  # environment given in code
        "Compiling,",
        "policy",
        "Known",
        "Predicted",
        "Predicted",
        "Predicted",
        "Critic:",
        "Policy:",
    ]


@pytest.mark.usefixtures("quick_compilation")
def test_the_command_draws_what_the_latents_hold_and_what_was_predicted(tmp_path, monkeypatch):
    """As a user types it; the picture's rows are of the episode, and as many as they should be."""
    drawn: list[plots.Filmstrip] = []
    config = configs.override(toy.config(), "agent.encoder.multipliers=2,2")
    config = replace(config, env=OwnConfig("tests.experiments.toy:seen"))
    nedreamer.train(config, tmp_path / "run", echo=lambda line: None)
    draw = plots.filmstrips
    monkeypatch.setattr(plots, "filmstrips", lambda strips, path: (drawn.extend(strips), draw(strips, path)))
    arguments = ("--episodes", 2, "--horizon", 3, "--decoder-updates", 5, "--actions", "sample")
    code, output = invoke(command, tmp_path / "run", *arguments)
    assert code == 0, output
    told = json.loads((tmp_path / "run" / "diagnosis.json").read_text())
    assert (told["task"], told["decoded"]["image"], told["actions"]) == (config.env.task, "image", "sample")
    assert (tmp_path / "run" / "decoded.png").stat().st_size > 1_000
    assert [strip.name for strip in drawn] == ["seen", "decoded", "seen", "predicted"]
    assert drawn[0].titles == [f"step {t}" for t in range(toy.LENGTH + 1)]
    assert drawn[3].titles == ["2 + 0", "2 + 1", "2 + 2", "2 + 3"]
    assert all(strip.frames.shape == (len(strip.titles), 4, 4, 3) for strip in drawn)


@pytest.mark.usefixtures("quick_compilation")
def test_sampled_actions_are_not_the_mode_and_saturation_is_that_of_the_mode(run):
    """The policy of a run this short is all noise: its samples reach the ends, its mode does not."""
    quiet = lambda line: None
    told = {
        actions: nedreamer.diagnose(run, toy.env(), episodes=4, horizon=3, actions=actions, echo=quiet)
        for actions in ("mode", "sample")
    }
    assert told["sample"]["actions"] == "sample"
    assert told["sample"]["policy"]["returns"] != told["mode"]["policy"]["returns"]
    assert told["sample"]["saturated"] == told["mode"]["saturated"] == [0.0]


def test_the_command_refuses_what_is_no_run(tmp_path):
    code, output = invoke(command, tmp_path)
    assert code == 2
    assert "expected the --logdir of a run" in output


def test_what_cant_be_diagnosed_is_refused(run, monkeypatch):
    for name, number in (("episodes", 1), ("horizon", 0), ("decoder_updates", -1)):
        with pytest.raises(ValueError, match=f"{name}: expected {number + 1} or more, got {number}"):
            nedreamer.diagnose(run, toy.env(), **{name: number})
    spec = EnvSpec(tiny.VECTORS.observation, ContinuousAction(2))
    blind = SimpleNamespace(agent=make_agent(DrQv2Config(), spec), state=SimpleNamespace(params=None))
    monkeypatch.setattr(diagnosis.evaluation, "load", lambda *_: blind)
    with pytest.raises(ValueError, match="expected a run of an agent with a world model, got drqv2"):
        nedreamer.diagnose(run, toy.env())
