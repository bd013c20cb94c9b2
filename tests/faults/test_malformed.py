"""Command lines and configurations that make no sense: each its message and exit code 2, and no traceback."""

import json
import random

import pytest
from click.testing import CliRunner

from ne_dreamer_jax import config as configs
from ne_dreamer_jax import settings
from ne_dreamer_jax.commands import evaluate as evaluate_command
from ne_dreamer_jax.commands import train as train_command
from ne_dreamer_jax.runs import building, run_directory
from ne_dreamer_jax.runs.run_directory import RefusedError
from ne_dreamer_jax.system import compile_cache
from tests.experiments import toy

GARBAGE = [
    "", " ", "-1", "0", "1e400", "nan", "inf", "-inf", "none", "true", "--", "-", "=", "a=b", "1,2,3", "0x10", "1_0",
    "dmc/", "dmc/../etc", "jax:", "rooms/nowhere", "a:b:c", "os:abort", "\u2028", "\u202e", "1" * 400, "x" * 5000,
    "{}", "[]", "None", "9" * 30, "3.5", "½", "\\", "%s", "${HOME}", "'; DROP TABLE", "\x7f",
]  # fmt: skip
FLAGS = [
    option for parameter in train_command.main.params for option in parameter.opts if parameter.type.name != "boolean"
]
PATHS = list(settings.paths(configs.preset("smoke")))


class Accepted(Exception):
    """The command was about to train."""


@pytest.fixture(autouse=True)
def nothing_is_trained(monkeypatch):
    def build(*_, **__):
        raise Accepted

    monkeypatch.setattr(building, "build", build)
    monkeypatch.setattr(compile_cache, "enable", lambda: "nowhere")


def misspelled(draw, word):
    """A word with a letter less, more or other."""
    at, letter = draw.randrange(len(word)), draw.choice("abz_-.=/ 0é")
    return draw.choice(
        [word[:at] + word[at + 1 :], word[:at] + letter + word[at:], word[:at] + letter + word[at + 1 :]]
    )


def argument(draw):
    """One option with a value that hardly fits."""
    kind = draw.randrange(4)
    if kind == 0:
        return [misspelled(draw, draw.choice(FLAGS)), draw.choice(GARBAGE)]
    if kind == 1:
        return [draw.choice(FLAGS), draw.choice(GARBAGE)]
    path = draw.choice(PATHS)
    return ["--set", f"{misspelled(draw, path) if kind == 2 else path}={draw.choice(GARBAGE)}"]


def refused(command, arguments):
    """Whether a command line is refused, with a message; else it is one that trains."""
    result = CliRunner().invoke(command.main, arguments)
    if isinstance(result.exception, Accepted):
        return False
    assert isinstance(result.exception, SystemExit), (arguments, result.exc_info)
    assert result.exit_code == 2, (arguments, result.output)
    assert "Traceback" not in result.output, arguments
    message = result.output.partition("Error: ")[2].strip()
    assert message, (arguments, result.output)
    return True


def check_command_lines(tmp_path, seed, count):
    """How many of so many command lines are refused."""
    draw, number = random.Random(seed), 0
    for _ in range(count):
        extra = [word for _ in range(draw.randint(1, 2)) for word in argument(draw)]
        number += refused(train_command, ["--preset", "smoke", "--logdir", str(tmp_path / "run"), *extra])
        assert not list(tmp_path.iterdir()), extra
    return number


def test_malformed_command_lines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert check_command_lines(tmp_path, 0, 20) >= 12


@pytest.mark.slow
def test_two_hundred_malformed_command_lines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    number = check_command_lines(tmp_path, 1, 300)
    print(f"of 300, {number} were refused")
    assert number >= 200


def test_malformed_evaluations(tmp_path):
    for word in [*GARBAGE, "--episodes"]:
        assert refused(evaluate_command, [str(tmp_path), "--episodes", word]), word
        assert refused(evaluate_command, ["--", str(tmp_path / "no" / word.replace("/", "_"))]), word


VALUES = [None, True, -1, 0, 10**30, 1e300, float("nan"), float("-inf"), "", "x", [], {}, [[[]]], {"type": "os"}, "1"]


def broken(draw, content):
    """The content of a configuration with one entry gone, new or other."""
    content = json.loads(json.dumps(content))
    places = [content]
    for place in places:
        places += [member for member in place.values() if isinstance(member, dict)]
    place = draw.choice([place for place in places if place])
    name = draw.choice(list(place))
    kind = draw.randrange(3)
    if kind == 0:
        place[misspelled(draw, name)] = place.pop(name)
    elif kind == 1:
        place[name] = draw.choice(VALUES)
    else:
        place[draw.choice(["type", "__class__", "new", "", "sha256"])] = draw.choice(VALUES)
    return content


def check_configurations(path, seed, count):
    """How many of so many configurations are refused; the others are whole."""
    draw, number = random.Random(seed), 0
    methods = [configs.with_method(configs.preset("smoke"), name) for name in ("ne_dreamer", "dreamerpro", "drqv2")]
    with run_directory.claim(path, methods[0]) as files:
        for _ in range(count):
            files.config.write_text(json.dumps(broken(draw, settings.to_dict(draw.choice(methods)))))
            try:
                assert isinstance(run_directory.read_config(path, configs.Config), configs.Config)
            except RefusedError as error:
                number += str(files.config) in str(error)
    return number


def test_malformed_configurations(tmp_path):
    assert check_configurations(tmp_path, 0, 20) >= 10


@pytest.mark.slow
def test_two_hundred_malformed_configurations(tmp_path):
    number = check_configurations(tmp_path, 1, 300)
    print(f"of 300, {number} were refused")
    assert number >= 150


@pytest.mark.slow
def test_whatever_a_configuration_says_is_refused_with_a_sentence_or_fits_together(monkeypatch):
    monkeypatch.undo()
    draw, built, said = random.Random(0), 0, []
    paths = [path for path in PATHS if not path.startswith("env.")]
    for _ in range(40):
        change = f"{draw.choice(paths)}={draw.choice(['0', '1', '2', '3', '7', '16', '0.5', 'none', 'true'])}"
        try:
            building.build(configs.override(toy.config(), change), toy.env())
            built += 1
        except ValueError as error:
            said.append(str(error))
    assert built > 5
    assert all(len(sentence) > 20 for sentence in said)
