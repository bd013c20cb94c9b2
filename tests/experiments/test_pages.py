"""A command starts itself anew, once, where large pages are of use."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ne_dreamer_jax.system import pages

ROOT = Path(__file__).parents[2]
COMMAND = ["python", "-m", "experiments.train", "--settings"]


@pytest.fixture
def started(monkeypatch, tmp_path):
    """What was started anew, on a system where it is of use."""
    enabled = tmp_path / "enabled"
    enabled.write_text("always [madvise] never\n")
    calls = []
    monkeypatch.setattr(pages, "_SYSTEM", enabled)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(sys, "gettrace", lambda: None)  # the tests may be watched themselves
    monkeypatch.setattr(sys, "getprofile", lambda: None)
    monkeypatch.setattr(os, "confstr", lambda name: "glibc 2.35", raising=False)
    monkeypatch.setattr(os, "execv", lambda *command: calls.append((*command, os.environ["GLIBC_TUNABLES"])))
    monkeypatch.setattr(sys, "orig_argv", COMMAND)
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    return calls


def test_the_same_command_is_started_with_the_tunable(started, monkeypatch):
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.check=1")
    pages.use_large_pages("experiments.train")
    again = [sys.executable, "-X", "large_pages", *COMMAND[1:]]
    assert started == [(sys.executable, again, "glibc.malloc.check=1:glibc.malloc.hugetlb=1")]


def test_a_command_that_cannot_be_started_anew_goes_on(started, monkeypatch):
    def fail(*command):
        raise PermissionError

    monkeypatch.setattr(os, "execv", fail)
    pages.use_large_pages("experiments.train")
    assert "hugetlb" not in os.environ["GLIBC_TUNABLES"]


@pytest.mark.parametrize(
    "change",
    [
        lambda patch, tmp_path: patch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=0"),
        lambda patch, tmp_path: patch.setitem(sys._xoptions, "large_pages", True),
        lambda patch, tmp_path: patch.setattr(sys, "orig_argv", ["python", "-m", "pdb", *COMMAND[1:]]),
        lambda patch, tmp_path: patch.setattr(sys, "orig_argv", ["python", "host.py"]),
        lambda patch, tmp_path: patch.setattr(sys, "gettrace", lambda: print),
        lambda patch, tmp_path: patch.setattr(sys, "platform", "darwin"),
        lambda patch, tmp_path: patch.setattr(os, "confstr", lambda name: "glibc 2.31"),
        lambda patch, tmp_path: patch.setattr(os, "confstr", lambda name: None),
        lambda patch, tmp_path: (tmp_path / "enabled").write_text("[always] madvise never\n"),
        lambda patch, tmp_path: (tmp_path / "enabled").unlink(),
    ],
    ids=[
        "told not to", "started anew before", "in a debugger", "in another program", "watched", "another system",
        "an old library", "another library", "always on", "unknown",
    ],
)  # fmt: skip
def test_nothing_is_started_where_it_is_of_no_use(started, monkeypatch, tmp_path, change):
    change(monkeypatch, tmp_path)
    before = os.environ.get("GLIBC_TUNABLES")
    pages.use_large_pages("experiments.train")
    assert started == []
    assert os.environ.get("GLIBC_TUNABLES") == before


@pytest.mark.parametrize("loses_its_environment", [False, True])
def test_a_command_runs_once(tmp_path, loses_its_environment):
    """Also where what is called as the interpreter clears the variable, which would go on for ever."""
    module = tmp_path / "command.py"
    module.write_text(
        "import os, sys\n"
        "from ne_dreamer_jax.system import pages\n"
        f"if {loses_its_environment}:\n"
        f"    sys.executable = {str(tmp_path / 'wrapper')!r}\n"
        "pages.use_large_pages('command')\n"
        "print('ran', 'hugetlb' in os.environ.get('GLIBC_TUNABLES', ''), 'large_pages' in sys._xoptions)\n"
    )
    wrapper = tmp_path / "wrapper"
    wrapper.write_text(f'#!/bin/sh\nunset GLIBC_TUNABLES\nexec {sys.executable} "$@"\n')
    wrapper.chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    environment["PYTHONPATH"] = f"{tmp_path}{os.pathsep}{ROOT}"
    command = [sys.executable, "-m", "command"]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True, timeout=60)
    anew = pages._of_use()
    assert done.stdout == f"ran {anew and not loses_its_environment} {anew}\n"
