"""What `test_parallel` has computed on 8 virtual devices, in a process of its own: ``python -m tests.devices PART...``.

Prints one JSON object: the name of each part, and what it found.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ne_dreamer_jax import agents
from ne_dreamer_jax import loop as loops
from ne_dreamer_jax.loop import LoopConfig
from ne_dreamer_jax.replay.host_frames import HostFrames
from ne_dreamer_jax.runs import checkpoint
from ne_dreamer_jax.system import parallel
from ne_dreamer_jax.types import ArraySpec
from tests import counting, tiny
from tests.drqv2 import small

N, B, STEPS = 16, 8, 20
CONFIG = LoopConfig(
    env_steps=N * STEPS,
    num_envs=N,
    replay_ratio=2.0,
    capacity=12 * N,  # the ring wraps
    prefill=0,
    chunk_steps=4,
    eval_every=60,
    eval_episodes=3,
)


@functools.cache
def stub_loop(devices: int, storage: str = "pixels") -> loops.Loop:
    """A loop whose learner is a stub, on so many devices; 1 is without a mesh. Compiled once for all that is asked."""
    env = counting.env()
    mesh = None if devices == 1 else parallel.make_mesh(devices)
    agent = counting.stub(env.spec, B)
    loop = loops.make(dataclasses.replace(CONFIG, storage=storage), env, agent, action_repeat=1, mesh=mesh)
    jitted: Any = loop.chunk
    return loop._replace(chunk=jitted.lower(loop.state_shapes(), jax.ShapeDtypeStruct((), jnp.int32)).compile())


def ran(loop: loops.Loop, state: Any, steps: int) -> Any:
    """The state after some steps."""
    return loop.chunk(state, np.asarray(steps, np.int32))[0]  # type: ignore[arg-type]


def arrays(tree: Any) -> list[np.ndarray]:
    """All leaves on the host, keys as their data."""
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return [np.asarray(jax.random.key_data(x) if is_key(x) else x) for x in jax.tree.leaves(tree)]


def same(a: Any, b: Any) -> bool:
    """Whether all bits are equal."""
    return all(x.dtype == y.dtype and x.tobytes() == y.tobytes() for x, y in zip(arrays(a), arrays(b), strict=True))


def placed(loop: loops.Loop, state: Any) -> bool:
    """Whether every array lies where the loop says."""
    pairs = zip(jax.tree.leaves(state), jax.tree.leaves(loop.state_shapes()), strict=True)
    return all(x.sharding.is_equivalent_to(want.sharding, x.ndim) for x, want in pairs)


def environments_and_replay() -> dict[str, Any]:
    """The whole state of runs on 1, 2 and 8 devices, with pixels, states and the host's tickets in replay."""
    out: dict[str, Any] = {}
    for storage, counts in (("pixels", (1, 2, 8)), ("states", (1, 8)), ("host", (1, 8))):
        loops_ = {devices: stub_loop(devices, storage) for devices in counts}
        states = {devices: ran(loop, loop.init(jax.random.key(0)), STEPS) for devices, loop in loops_.items()}
        out[f"equal, {storage}"] = [same(states[1], states[devices]) for devices in counts[1:]]
        out[f"placed, {storage}"] = [placed(loops_[devices], states[devices]) for devices in counts[1:]]
        kept = [loop.frames.arrays for loop in loops_.values() if loop.frames is not None]
        out[f"frames, {storage}"] = sum(same(kept[0], other) and any(map(np.any, kept[0].values())) for other in kept)
        out["updates"] = int(states[1].train.update)
        shard = states[8].replay.data.obs["image"].addressable_shards[0].data
        out[f"share, {storage}"] = states[8].replay.data.obs["image"].shape[1] / shard.shape[1]
    returns = [np.asarray(loops_[d].evaluate(states[d].train.params, jax.random.key(1)).returns) for d in (1, 8)]
    out["evaluation"] = bool((returns[0] == returns[1]).all())
    return out


def images_on_the_host() -> int:
    """Wrong pixels of images that go to the host and back, of sizes at which a callback's arguments can deadlock."""
    return _sent(128, 64) + _sent(2**19, 1)  # many pixels, or many tickets


def _sent(envs: int, side: int) -> int:
    split = parallel.SPLIT
    frames = HostFrames(4, envs, {"image": ArraySpec((side, side, 3), jnp.uint8)})
    put = parallel.per_shard(functools.partial(frames.put, "image"), (split, split), split)
    get = parallel.per_shard(functools.partial(frames.get, "image"), (split,), split)

    def run(images: jax.Array) -> jax.Array:
        def step(i: Any, carry: Any) -> Any:
            images, wrong = carry
            back = get(put(frames.tickets(i % 4), images))
            return images + jnp.uint8(1), wrong + jnp.sum((back != images).astype(jnp.int32))

        return jax.lax.fori_loop(0, 10, step, (images, jnp.zeros((), jnp.int32)))[1]

    mesh = parallel.make_mesh(8)
    images = jax.device_put(
        jax.random.bits(jax.random.key(0), (envs, side, side, 3), jnp.uint8), parallel.NamedSharding(mesh, split)
    )
    return int(jax.jit(parallel.traced_on(mesh, run))(images))


def collectives() -> dict[str, int]:
    """How often each collective stands in the program that collects and samples on 8 devices."""
    compiled: Any = stub_loop(8).chunk
    text = compiled.as_text()
    names = ("all-gather", "all-reduce", "all-to-all", "collective-permute", "reduce-scatter")
    return {name: sum(f" {name}(" in line or f" {name}-start(" in line for line in text.splitlines()) for name in names}


def moved() -> dict[str, bool]:
    """Runs that change the number of devices at a checkpoint, against one that does not."""
    straight = stub_loop(1)
    want = ran(straight, straight.init(jax.random.key(0)), STEPS)
    out = {}
    for before, after in ((1, 8), (8, 1), (8, 2)):
        old, new = stub_loop(before), stub_loop(after)
        state = ran(old, old.init(jax.random.key(0)), 9)
        with tempfile.TemporaryDirectory() as folder:
            checkpoint.save(Path(folder), 9, {"all": state})
            restored = checkpoint.restore(Path(folder), {"all": new.state_shapes()}).items["all"]
        state = parallel.move(restored, new.state_shapes())
        out[f"{before} to {after}"] = same(ran(new, state, STEPS - 9), want) and (after == 1 or placed(new, state))
    return out


def whole_agent() -> dict[str, Any]:
    """Losses of the whole agent's updates in the loop, on 1 and on 8 devices, and on 8 in two microbatches."""
    env = counting.env(image=True)
    out: dict[str, Any] = {}
    for devices, parts in ((1, 1), (8, 1), (8, 2)):
        config = dataclasses.replace(tiny.CONFIG, batch_size=2 * B, batch_length=4, microbatches=parts)
        agent = agents.make_agent(config, env.spec)
        mesh = None if devices == 1 else parallel.make_mesh(devices)
        loop = loops.make(dataclasses.replace(CONFIG, replay_ratio=4.0), env, agent, 1, mesh)
        # The parameters come from numpy; compiling their initialisation would take longer than all the rest.
        rest = stub_loop(1).init(jax.random.key(0))
        shapes = loop.state_shapes()
        replay = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes.replay)
        start = rest._replace(train=tiny.state(agent), policy=agent.init_policy(N), replay=replay)
        state, curve = parallel.move(start, shapes), []
        for _ in range(STEPS):
            state, report = loop.chunk(state, np.asarray(1, np.int32))
            means = jax.device_get(report).means()
            curve.append({name: value for name, value in means.items() if name.startswith("loss/")})
        out[f"{devices} in {parts}"] = curve
    return out


def model_free() -> list[dict[str, float]]:
    """DrQ-v2's losses, whose policy state has a count that all environments share, on 1 and on 8 devices."""
    env = counting.env(image=False)
    config = dataclasses.replace(small.CONFIG, batch_size=B, random_steps=4 * N)
    agent, out = agents.make_agent(config, env.spec), []
    for devices in (1, 8):
        mesh = None if devices == 1 else parallel.make_mesh(devices)
        changed = dataclasses.replace(CONFIG, replay_ratio=1.0, prefill=4 * N, write_latents=False)
        loop = loops.make(changed, env, agent, 1, mesh)
        state, report = loop.chunk(loop.init(jax.random.key(0)), np.asarray(STEPS, np.int32))
        assert mesh is None or placed(loop, state)
        out.append({**jax.device_get(report).means(), "policy steps": int(state.policy.step)})
    return out


def main(*names: str) -> None:
    """Computes the parts of these names."""
    jax.config.update("jax_disable_most_optimizations", True)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")
    all_parts = (environments_and_replay, images_on_the_host, collectives, moved, model_free, whole_agent)
    parts = {part.__name__: part for part in all_parts}
    print(json.dumps({name: parts[name]() for name in names}))


if __name__ == "__main__":
    main(*sys.argv[1:])
