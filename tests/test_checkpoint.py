"""A checkpoint comes back bit for bit, or is noticed not to."""

import json
import os
import resource
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ne_dreamer_jax.runs import checkpoint
from tests.runs import old_format


class State(NamedTuple):
    params: dict[str, Any]
    key: jax.Array
    keys: jax.Array
    ring: jax.Array
    extra: Any = ()


def make(seed: int = 0) -> State:
    key = jax.random.key(seed)
    return State(
        params={"layer/0": {"kernel": jax.random.normal(key, (3, 4)), "half": jnp.full((3,), seed, jnp.bfloat16)}},
        key=key,
        keys=jax.random.split(jax.random.key(seed, impl="rbg"), 5),
        ring=jax.random.bits(key, (2, 8, 16, 16, 3), jnp.uint8),
        extra=[jnp.array([jnp.nan, -0.0, 1e-42, jnp.inf]), jnp.bool_(True), (jnp.zeros((0, 3)), jnp.int32(7)), None],
    )


def bits(tree: Any) -> list[tuple[Any, ...]]:
    leaves = jax.tree.leaves(tree)
    data = [jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf for leaf in leaves]
    return [(leaf.shape, leaf.dtype, np.asarray(array).tobytes()) for leaf, array in zip(leaves, data, strict=True)]


def save(directory, step, score=None):
    return checkpoint.save(directory, step, {"agent": make(step).params, "loop": make(step)}, score=score)


LIKE = {"agent": make().params, "loop": make()}


def files(item_path):
    return [path for path in item_path.rglob("*") if path.is_file()]


def data_file(item_path):
    """The largest file of an item: where its arrays' bytes are."""
    return max(files(item_path), key=lambda path: path.stat().st_size)


@pytest.mark.strict
@pytest.mark.parametrize("abstract", [False, True])
def test_every_bit_comes_back(tmp_path, abstract):
    save(tmp_path, 3)
    like = jax.eval_shape(lambda: {"loop": make()}) if abstract else {"loop": make()}
    restored = checkpoint.restore(tmp_path, like)
    assert bits(restored.items["loop"]) == bits(make(3))
    assert jax.tree.structure(restored.items["loop"]) == jax.tree.structure(make(3))
    assert restored.skipped == []
    assert restored.checkpoint.step == 3


def test_restored_arrays_may_be_donated(tmp_path):
    save(tmp_path, 3)
    state = checkpoint.restore(tmp_path, {"loop": make()}).items["loop"]
    add = jax.jit(lambda state: jax.tree.map(lambda x: x + x, state), donate_argnums=0)
    np.testing.assert_array_equal(add(state.params)["layer/0"]["kernel"], 2 * make(3).params["layer/0"]["kernel"])
    assert bits(checkpoint.restore(tmp_path, {"loop": make()}).items["loop"]) == bits(make(3))


def test_one_item_loads_without_the_other(tmp_path):
    saved = save(tmp_path, 3)
    shutil.rmtree(saved.path / "loop")
    assert bits(checkpoint.restore(tmp_path, {"agent": make().params}).items["agent"]) == bits(make(3).params)


def test_newest_first_and_best_by_score(tmp_path):
    for step, score in [(1, 5.0), (2, 9.0), (3, float("nan")), (4, 9.0), (5, None)]:
        save(tmp_path, step, score)
    assert [found.step for found in checkpoint.checkpoints(tmp_path)] == [5, 4, 3, 2, 1]
    assert checkpoint.restore(tmp_path, LIKE).checkpoint.step == 5
    assert checkpoint.restore(tmp_path, LIKE, prefer="best").checkpoint.step == 2, "the earlier of equals"


def test_pruning_keeps_the_newest_whole_and_the_agent_of_the_best(tmp_path):
    for step, score in [(1, 5.0), (2, 9.0), (3, 1.0), (4, None), (5, 2.0)]:
        save(tmp_path, step, score)
        checkpoint.prune(tmp_path, whole=("agent", "loop"))
    kept = {found.step: (set(found.items), found.score) for found in checkpoint.checkpoints(tmp_path)}
    assert kept == {5: ({"agent", "loop"}, 2.0), 4: ({"agent", "loop"}, None), 2: ({"agent"}, 9.0)}
    assert sorted(os.listdir(tmp_path / f"{2:012d}")) == ["agent", "manifest.json"]
    assert checkpoint.restore(tmp_path, {"agent": make().params}, prefer="best").checkpoint.step == 2
    assert checkpoint.restore(tmp_path, LIKE, prefer="best").checkpoint.step == 5  # the best that has both items


def test_pruning_counts_only_checkpoints_from_which_a_run_can_go_on(tmp_path):
    save(tmp_path, 1)
    for step, score in [(2, 3.0), (3, 1.0)]:
        checkpoint.save(tmp_path, step, {"agent": make(step).params}, score=score)
        checkpoint.prune(tmp_path, whole=("agent", "loop"), keep=1)
    assert [found.step for found in checkpoint.checkpoints(tmp_path)] == [2, 1]
    assert checkpoint.restore(tmp_path, LIKE).checkpoint.step == 1


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def truncate(path):
    os.truncate(path, path.stat().st_size // 2)


DAMAGE = {
    "a flipped bit in the data": lambda path: flip(data_file(path / "loop")),
    "data cut in the middle": lambda path: truncate(data_file(path / "loop")),
    "data gone": lambda path: data_file(path / "loop").unlink(),
    "a small file gone": lambda path: min(files(path / "loop"), key=lambda file: file.stat().st_size).unlink(),
    "an item gone": lambda path: shutil.rmtree(path / "loop"),
    "a flipped bit in the manifest": lambda path: flip(path / "manifest.json"),
    "an edited manifest": lambda path: (path / "manifest.json").write_text(
        (path / "manifest.json").read_text().replace('"step": 2', '"step": 3')
    ),
    "an empty manifest": lambda path: truncate(path / "manifest.json"),
    "no manifest": lambda path: (path / "manifest.json").unlink(),
    "a manifest of another kind": lambda path: (path / "manifest.json").write_text("[]"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_newest_is_passed_over(tmp_path, damage):
    save(tmp_path, 1)
    newest = save(tmp_path, 2)
    DAMAGE[damage](newest.path)
    restored = checkpoint.restore(tmp_path, LIKE)
    assert restored.checkpoint.step == 1
    assert bits(restored.items["loop"]) == bits(make(1))
    assert len(restored.skipped) == 1
    assert str(newest.path) in restored.skipped[0]
    save(tmp_path, 2)  # the run comes to that step again
    assert checkpoint.restore(tmp_path, LIKE).checkpoint.step == 2


def test_numpys_arrays_stay_numpys(tmp_path):
    tree = {"a/b": np.arange(24, dtype=np.uint8).reshape(2, 3, 4), "half": np.full((3,), 2.5, jnp.bfloat16)}
    saved = checkpoint.save(tmp_path, 1, {"frames": tree, "mixed": {"host": tree["a/b"], "device": jnp.ones(2)}})
    like = {"frames": tree, "mixed": {"host": tree["a/b"], "device": jnp.zeros(2)}}
    restored = checkpoint.restore(tmp_path, like).items
    assert bits(restored["frames"]) == bits(tree)
    assert isinstance(restored["mixed"]["device"], jax.Array)
    for array in jax.tree.leaves(restored["frames"]):
        assert isinstance(array, np.ndarray)
        assert array.flags.writeable
    (saved.path / "frames" / ".left-behind-by-a-file-system").write_bytes(b"more")
    assert checkpoint.restore(tmp_path, like).skipped == []
    flip(data_file(saved.path / "frames"))
    with pytest.raises(checkpoint.DamagedError, match="not as it was saved"):
        checkpoint.restore(tmp_path, like)


def test_any_flipped_byte_is_noticed(tmp_path):
    saved = save(tmp_path, 1)
    for path in files(saved.path / "loop"):
        original = path.read_bytes()
        for place in np.linspace(0, len(original) - 1, 25).astype(int) if original else []:
            changed = bytearray(original)
            changed[place] ^= 0x10
            path.write_bytes(changed)
            with pytest.raises(checkpoint.DamagedError, match=f"{path.name} is not as it was saved"):
                checkpoint.restore(tmp_path, LIKE)
        path.write_bytes(original)
    assert bits(checkpoint.restore(tmp_path, LIKE).items["loop"]) == bits(make(1))


def test_a_checkpoint_of_format_2_still_loads_bit_for_bit():
    """Orbax wrote its arrays, and numpy those that lay on the host."""
    restored = checkpoint.restore(Path(__file__).parent / "runs" / "format_2", jax.eval_shape(old_format.make))
    assert bits(restored.items["agent"]) == bits(old_format.make()["agent"])
    assert bits(restored.items["loop"]) == bits(old_format.make()["loop"])
    like = {"frames": old_format.make()["frames"]}
    restored = checkpoint.restore(Path(__file__).parent / "runs" / "format_2", like)
    assert bits(restored.items) == bits(like)
    assert isinstance(restored.items["frames"]["image"], np.ndarray)
    assert restored.checkpoint.score == 1.5


def test_nothing_intact_and_nothing_at_all(tmp_path):
    with pytest.raises(FileNotFoundError, match="has no checkpoint with agent and loop"):
        checkpoint.restore(tmp_path, LIKE)
    truncate(data_file(save(tmp_path, 1).path / "agent"))
    with pytest.raises(checkpoint.DamagedError, match=r"no checkpoint in .* is intact"):
        checkpoint.restore(tmp_path, LIKE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"ring": jnp.zeros((2, 8, 16, 16, 1), jnp.uint8)},
            r"ring: expected uint8\[2, 8, 16, 16, 1\], got uint8\[2, 8",
        ),
        (
            {"ring": jnp.zeros((2, 8, 16, 16, 3))},
            r"ring: expected float32\[2, 8, 16, 16, 3\], got uint8\[2, 8, 16, 16, 3\]",
        ),
        ({"params": {}}, r"params\.layer/0\.half: expected nothing, got bfloat16\[3\]"),
        ({"extra": {"more": jnp.zeros(2)}}, r"extra\.more: expected float32\[2\], got nothing"),
        ({"key": jax.random.key(0, impl="rbg")}, r"key: expected key<rbg>\[\], got key<fry>\[\]"),
        ({"key": jnp.zeros((2,), jnp.uint32)}, r"key: expected uint32\[2\], got key<fry>\[\]"),
    ],
)
def test_another_structure_shape_or_dtype_is_refused(tmp_path, change, message):
    save(tmp_path, 1)
    with pytest.raises(ValueError, match=message):
        checkpoint.restore(tmp_path, {"loop": make()._replace(**change)})


def test_a_leaf_that_is_no_array_is_refused(tmp_path):
    with pytest.raises(TypeError, match="step: expected an array, got 3 of type int"):
        checkpoint.save(tmp_path, 1, {"loop": {"step": 3}})
    assert checkpoint.checkpoints(tmp_path) == []


def test_a_full_disk_leaves_the_last_checkpoint(tmp_path):
    save(tmp_path, 1)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))  # no file may grow longer
    try:
        with pytest.raises(Exception, match=r"(?i)too large|write|resource"):
            checkpoint.save(tmp_path, 2, {"loop": {"ring": jax.random.bits(jax.random.key(0), (1 << 20,), jnp.uint8)}})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert checkpoint.restore(tmp_path, LIKE).checkpoint.step == 1
    save(tmp_path, 2)
    assert checkpoint.restore(tmp_path, LIKE).checkpoint.step == 2
    assert sorted(os.listdir(tmp_path)) == [f"{1:012d}", f"{2:012d}"]


def test_the_manifest_is_readable_json(tmp_path):
    saved = save(tmp_path, 1, 3.5)
    content = json.loads((saved.path / "manifest.json").read_text())
    assert (content["step"], content["score"]) == (1, 3.5)
    assert content["items"]["loop"]["ring"]["dtype"] == "uint8"


def test_a_folder_that_cant_be_read_is_not_an_empty_one(tmp_path):
    (tmp_path / "checkpoints").write_text("no folder")
    with pytest.raises(checkpoint.DamagedError, match="checkpoints can't be read: Not a directory"):
        checkpoint.restore(tmp_path / "checkpoints", {"agent": make()})
    (tmp_path / "link").symlink_to(tmp_path / "not mounted")
    with pytest.raises(checkpoint.DamagedError, match="link can't be read: No such file or directory"):
        checkpoint.restore(tmp_path / "link", {"agent": make()})
    with pytest.raises(FileNotFoundError):
        checkpoint.restore(tmp_path / "nothing", {"agent": make()})
