"""The README's commands are the ones that are checked."""

import re
from pathlib import Path

from experiments import train
from ne_dreamer_jax.settings import names

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_check_is_what_the_clean_clone_runs():
    commands = re.findall(r"^python3 -m venv .*$", README, re.MULTILINE)
    assert len(commands) == 2
    assert (ROOT / ".ci" / "run").read_text().splitlines()[-1] == commands[1]


def test_every_option_and_preset_in_the_readme_exists():
    options = {name for option in train.main.params for name in option.opts}
    for command in re.findall(r"experiments\.train (.*)$", README, re.MULTILINE):
        assert set(re.findall(r"--[a-z-]+", command)) <= options
        assert set(re.findall(r"--preset (\S+)", command)) <= set(names.PRESETS)


def test_every_path_in_the_readme_exists():
    for row in re.findall(r"^\| (`.*?`) \|", README.split("## Where things are")[1], re.MULTILINE):
        for path in re.findall(r"`([^`]+)`", row):
            assert (ROOT / path).exists() or (ROOT / "ne_dreamer_jax" / path).exists(), path
