"""Paths as people write them, and lines that nobody reads."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from experiments import ablations, compare, evaluate, sweep, train
from ne_dreamer_jax.commands.options import UserPath
from ne_dreamer_jax.runs.run_directory import as_argument, typed


@click.command()
@click.argument("path", type=UserPath())
def show(path):
    click.echo(repr(path))


def taken(text):
    return CliRunner().invoke(show, ["--", text])


def test_home_is_a_directory_wherever_it_is_written(monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    assert "'/home/somebody/run'" in taken("~/run").output
    assert "'/home/somebody'" in taken("~").output
    assert "'a/~/run'" in taken("a/~/run").output
    monkeypatch.delenv("HOME")
    assert repr(Path.home() / "run") in taken("~/run").output


@pytest.mark.parametrize("text", ["", " run", "run ", "run\n", "a\nb", "~nobody-of-this-name/run", "r\udcff"])
def test_what_is_hardly_meant_as_a_path_is_refused(text):
    result = taken(text)
    assert result.exit_code == 2
    assert "expected a path" in result.output or "there is no home directory '~nobody-of-this-name'" in result.output


@pytest.mark.parametrize("command", [train, evaluate, sweep, compare, ablations])
def test_all_paths_of_commands_are_such(command):
    kinds = [option.type for option in command.main.params]
    assert any(isinstance(kind, UserPath) for kind in kinds)
    assert all(isinstance(kind, UserPath) for kind in kinds if isinstance(kind, click.Path))


@pytest.mark.parametrize("name", ["run", "my run", "~", "~/run", "-x", "it's", "$HOME", "a;b", "über"])
def test_a_path_comes_back_from_the_shell_and_the_next_command(name):
    (word,) = shlex.split(typed(Path(name)))
    assert word == as_argument(Path(name))
    assert repr(Path(name)) in CliRunner().invoke(show, [word]).output


def test_a_reader_that_has_gone_does_not_end_the_program(tmp_path):
    """With a line left in the buffer, and an exit code that is the program's own."""
    code = (
        "import sys, time; from ne_dreamer_jax.commands.options import say\n"
        "for _ in range(200): say('line ± ' + 1000 * '.'); time.sleep(0.001)\n"
        "open('reached', 'w').close(); raise SystemExit(7)"
    )
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "PYTHONIOENCODING": "ascii"}
    program = subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert program.stdout.readline().startswith(b"line ? ")
    program.stdout.close()
    errors = program.stderr.read()
    program.stderr.close()
    assert program.wait() == 7
    assert errors == b""
    assert (tmp_path / "reached").exists()


@pytest.mark.parametrize("where", [">&-", "> /dev/full"])
def test_a_program_without_a_place_to_print_to_goes_on(tmp_path, where):
    code = "from ne_dreamer_jax.commands.options import say; say('x'); say('y'); raise SystemExit(7)"
    line = f"{shlex.quote(sys.executable)} -c {shlex.quote(code)} {where}"
    done = subprocess.run(["sh", "-c", line], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (7, b"")
