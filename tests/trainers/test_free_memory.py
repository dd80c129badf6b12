"""What a container or a batch system allows is what is free."""

import pytest

pytest.importorskip("torch")  # the folder's fixtures are the trainers'

from trainers import free_memory


def test_the_least_bound_counts(tmp_path, monkeypatch):
    """Of this process's group and those above it; a group without a bound says so by a word."""
    monkeypatch.setattr(free_memory, "GROUPS", tmp_path)
    everything = free_memory.free_bytes()
    assert everything > 1 << 26
    monkeypatch.setattr(free_memory, "_groups", lambda: ["0::/job/step"])
    (tmp_path / "job" / "step").mkdir(parents=True)
    (tmp_path / "job" / "step" / "memory.max").write_text("max\n")
    assert free_memory.free_bytes() > 1 << 26
    (tmp_path / "job" / "memory.max").write_text("1000000\n")
    assert free_memory.free_bytes() == 1_000_000
    monkeypatch.setattr(free_memory, "_groups", lambda: ["5:memory:/old", "3:cpu:/x", "0::/"])
    (tmp_path / "memory" / "old").mkdir(parents=True)
    (tmp_path / "memory" / "old" / "memory.limit_in_bytes").write_text("2000000\n")
    assert free_memory.free_bytes() == 2_000_000


@pytest.mark.parametrize(
    ("line", "folder", "bound", "used", "idle"),
    [
        ("0::/job", "job", "memory.max", "memory.current", "inactive_file"),
        ("5:memory:/job", "memory/job", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ],
)
def test_what_a_group_uses_is_not_free(tmp_path, monkeypatch, line, folder, bound, used, idle):
    """Less the pages of files that are given back on demand, in both versions of control groups; never below nothing."""
    monkeypatch.setattr(free_memory, "GROUPS", tmp_path)
    monkeypatch.setattr(free_memory, "_groups", lambda: [line])
    (tmp_path / folder).mkdir(parents=True)
    (tmp_path / folder / bound).write_text("5000000\n")
    (tmp_path / folder / used).write_text("4000000\n")
    assert free_memory.free_bytes() == 1_000_000
    (tmp_path / folder / "memory.stat").write_text(f"anon 7\n{idle} 2500000\n")
    assert free_memory.free_bytes() == 3_500_000
    (tmp_path / folder / used).write_text("9000000\n")
    assert free_memory.free_bytes() == 0
