"""A command starts itself anew, once, where large pages are of use."""

import os
import subprocess
import sys

import pytest

from experiments import pages


@pytest.fixture
def started(monkeypatch, tmp_path):
    """What was started anew, on a system where it is of use."""
    enabled = tmp_path / "enabled"
    enabled.write_text("always [madvise] never\n")
    calls = []
    monkeypatch.setattr(pages, "_SYSTEM", enabled)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(os, "confstr", lambda name: "glibc 2.35", raising=False)
    monkeypatch.setattr(os, "execv", lambda *command: calls.append(command))
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", "-m", "experiments.train", "--settings"])
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    return calls


def test_the_same_command_is_started_with_the_tunable(started, monkeypatch):
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.check=1")
    pages.use_large_pages()
    assert started == [(sys.executable, [sys.executable, "-X", "dev", "-m", "experiments.train", "--settings"])]
    assert os.environ["GLIBC_TUNABLES"] == "glibc.malloc.check=1:glibc.malloc.hugetlb=1"
    pages.use_large_pages()
    assert len(started) == 1


@pytest.mark.parametrize(
    "change",
    [
        lambda patch, tmp_path: patch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=0"),
        lambda patch, tmp_path: patch.setattr(sys, "platform", "darwin"),
        lambda patch, tmp_path: patch.setattr(os, "confstr", lambda name: "glibc 2.31"),
        lambda patch, tmp_path: patch.setattr(os, "confstr", lambda name: None),
        lambda patch, tmp_path: (tmp_path / "enabled").write_text("[always] madvise never\n"),
        lambda patch, tmp_path: (tmp_path / "enabled").unlink(),
    ],
    ids=["told not to", "another system", "an old library", "another library", "always on", "unknown"],
)
def test_nothing_is_started_where_it_is_of_no_use(started, monkeypatch, tmp_path, change):
    change(monkeypatch, tmp_path)
    before = os.environ.get("GLIBC_TUNABLES")
    pages.use_large_pages()
    assert started == []
    assert os.environ.get("GLIBC_TUNABLES") == before


def test_a_command_runs_once():
    code = "from experiments.pages import use_large_pages; use_large_pages(); print('ran')"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "ran\n"
