"""What is free, by the system's own files."""

from types import SimpleNamespace

import jax
import pytest

from ne_dreamer_jax.system import memory


def test_the_host_can_give_something_and_not_more_than_it_has():
    assert 2**20 < memory.available() < 2**50


def test_an_accelerator_answers_for_itself():
    stats = {"bytes_limit": 1000, "bytes_in_use": 300}
    assert memory.available(SimpleNamespace(platform="gpu", memory_stats=lambda: stats)) == 700
    unknown = SimpleNamespace(platform="other", memory_stats=lambda: None)
    assert memory.available(unknown) == pytest.approx(memory.available(jax.devices("cpu")[0]), rel=0.5)


@pytest.mark.parametrize("path", ["memory.max", "memory/memory.limit_in_bytes"])
def test_the_smaller_of_free_memory_and_the_containers_limit_counts(tmp_path, path):
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:   5000 kB\nHugePages_Total: 0\n")
    assert memory.host_available(tmp_path) == 5000 * 1024
    limit = tmp_path / "sys/fs/cgroup" / path
    limit.parent.mkdir(parents=True)
    for text, expected in (("max", 5000 * 1024), ("4096", 4096), (str(2**60), 5000 * 1024)):
        limit.write_text(text + "\n")
        assert memory.host_available(tmp_path) == expected


@pytest.mark.parametrize(
    ("size", "text"),
    [(0, "0 B"), (1023, "1023 B"), (1536, "1.5 KiB"), (3 * 2**30, "3.0 GiB"), (5 * 2**50, "5120.0 TiB")],
)
def test_bytes_are_printed_with_a_unit(size, text):
    assert memory.readable(size) == text
