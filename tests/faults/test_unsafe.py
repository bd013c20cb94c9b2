"""Nothing that is read from a run directory runs, or leads out of it."""

import ast
import json
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ne_dreamer_jax
from ne_dreamer_jax import config as configs
from ne_dreamer_jax.runs import arrays, checkpoint, evaluation, metrics, run_directory
from ne_dreamer_jax.runs.run_directory import RefusedError

PACKAGE = Path(ne_dreamer_jax.__file__).parent
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "yaml", "runpy", "code"}
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__", "execfile"}
DYNAMIC_IMPORTS = {
    "envs/registry.py": 3,  # families from a table, and `--task module:function`, none of the standard library
    "envs/dmc/tasks.py": 1,
    "envs/adapters/__init__.py": 1,
    "envs/adapters/common.py": 1,
    "envs/host/names.py": 1,
    "envs/host/factories.py": 1,
}
"""Where a module is imported by a name that is computed, and how often: all are environments."""
WORKERS = {"envs/host/pool.py": ["cloudpickle", "cloudpickle"]}
"""A factory given in code goes to worker processes of the same program, and is never read from a file."""


def findings(source: str) -> list[str]:
    """What a module does that could run data."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.split(".")[0] in FORBIDDEN_MODULES]
        elif isinstance(node, ast.ImportFrom):
            found += [node.module or ""] if (node.module or "").split(".")[0] in FORBIDDEN_MODULES else []
        elif isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            plain = isinstance(node.func, ast.Name)
            keywords = {keyword.arg: keyword.value for keyword in node.keywords}
            pickles = keywords.get("allow_pickle")
            if plain and name in FORBIDDEN_CALLS:
                found.append(name)
            elif name == "import_module":
                found.append("import_module")
            elif name == "load" and not plain and getattr(node.func.value, "id", "") in ("np", "numpy", "jnp"):
                if not (isinstance(pickles, ast.Constant) and pickles.value is False):
                    found.append("numpy.load without allow_pickle=False")
            elif name in ("system", "popen") or (isinstance(keywords.get("shell"), ast.Constant)):
                found.append(f"{name}: a shell")
    return found


@pytest.mark.parametrize(
    "source",
    ["import pickle", "from yaml import load", "eval(x)", "exec(x)", "importlib.import_module(x)", "np.load(x)",
     "np.load(x, allow_pickle=True)", "os.system(x)", "subprocess.run(x, shell=True)", "__import__(x)"],
)  # fmt: skip
def test_what_could_run_data_is_found(source):
    assert len(findings(source)) == 1
    assert findings("import json; np.load(x, allow_pickle=False); self.compile(x); json.load(x)") == []


def test_nothing_in_the_package_runs_what_it_reads():
    found = {path.relative_to(PACKAGE).as_posix(): findings(path.read_text()) for path in PACKAGE.rglob("*.py")}
    found = {name: what for name, what in found.items() if what}
    assert found == {name: ["import_module"] * count for name, count in DYNAMIC_IMPORTS.items()} | WORKERS


class Evil:
    """Leaves a file where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def sealed(folder, **changes):
    """The manifest of a checkpoint with changes, and a checksum that holds."""
    content = json.loads((folder / "manifest.json").read_text())
    content |= changes
    del content["sha256"]
    digest = checkpoint._digest_json(content)
    (folder / "manifest.json").write_text(json.dumps({**content, "sha256": digest}))


LIKE = {"agent": {"x": jax.ShapeDtypeStruct((4,), jnp.float32)}}


@pytest.fixture
def folder(tmp_path):
    return checkpoint.save(tmp_path / "checkpoints", 1, {"agent": {"x": jnp.ones(4)}}).path


def test_a_pickle_in_the_place_of_an_array_is_refused_and_not_run(folder, tmp_path):
    np.save(folder / "agent" / "0.npy", np.array([Evil(tmp_path / "ran")]), allow_pickle=True)
    digest = arrays.digest_file(folder / "agent" / "0.npy")
    leaf = {"shape": [4], "dtype": "float32", "sha256": 64 * "0", "file": "0.npy"}
    sealed(folder, format=2, items={"agent": {"x": leaf}}, files={"agent": {"0.npy": digest}})
    with pytest.raises((ValueError, checkpoint.DamagedError), match=r"allow_pickle=False|damaged"):
        checkpoint.restore(tmp_path / "checkpoints", LIKE)
    (folder / "manifest.json").write_bytes(pickle.dumps(Evil(tmp_path / "ran")))
    with pytest.raises(checkpoint.DamagedError):
        checkpoint.restore(tmp_path / "checkpoints", LIKE)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["../../outside", "/outside", "a/../../outside", "..", ".", ""])
def test_names_that_lead_out_of_a_checkpoint_are_refused_and_nothing_there_is_removed(folder, tmp_path, name):
    (tmp_path / "outside").mkdir()
    leaf = {"shape": [4], "dtype": "float32", "sha256": 64 * "0", "file": name}
    for changes in (
        {"items": {name: {}}, "files": {name: {}}},
        {"items": {"agent": {"x": leaf}}},
        {"files": {"agent": {name: 64 * "0"}}},
    ):
        before = (folder / "manifest.json").read_text()
        sealed(folder, **changes)
        with pytest.raises(checkpoint.DamagedError, match="expected the name of a file in this folder"):
            checkpoint.restore(tmp_path / "checkpoints", LIKE)
        assert checkpoint.checkpoints(tmp_path / "checkpoints") == []
        (folder / "manifest.json").write_text(before)
    assert (tmp_path / "outside").exists()


def test_links_are_not_followed_where_checkpoints_are_removed(folder, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "thesis").touch()
    (tmp_path / "checkpoints" / ".partial-5").symlink_to(tmp_path / "outside")
    with pytest.raises(checkpoint.SaveError, match="symbolic link"):
        checkpoint.save(tmp_path / "checkpoints", 2, {"agent": {"x": jnp.ones(4)}})
    assert (tmp_path / "outside" / "thesis").exists()
    assert checkpoint.checkpoints(tmp_path / "checkpoints")[0].step == 1


def test_a_configuration_can_not_name_a_function_of_python_to_call(tmp_path):
    config = configs.override(configs.preset("smoke"), "env.task=mypackage.envs:make")
    with run_directory.claim(tmp_path, config) as files:
        content = json.loads(files.config.read_text())
    del content["sha256"]
    for task in ("os:abort", "os.path:expanduser", "subprocess:Popen", "antigravity:fly"):
        content["env"]["task"] = task
        files.config.write_text(json.dumps(content))
        with pytest.raises(ValueError, match="expected a function of a module of your own"):
            evaluation.load(tmp_path)


@pytest.mark.parametrize("text", ["{!r}", "!!python/object/apply:os.abort []", "__import__('os').abort()", "\x80\x04."])
def test_configurations_and_metrics_that_are_programs_are_refused(tmp_path, text):
    with run_directory.claim(tmp_path, configs.preset("smoke")) as files:
        files.config.write_text(text)
        files.metrics.write_text(text + "\n")
    with pytest.raises(RefusedError, match=r"config\.json does not fit"):
        run_directory.read_config(tmp_path, configs.Config)
    with pytest.raises(ValueError, match=r"metrics\.jsonl, line 1"):
        metrics.read(files.metrics)
