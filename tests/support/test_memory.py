"""Available memory: the least of what the system, the container and the address-space limit leave."""

from __future__ import annotations

import resource
from types import SimpleNamespace

import psutil
import pytest

from calibray.support import memory
from calibray.support.memory import available_memory

FREE = 5_000_000


@pytest.fixture
def group(tmp_path, monkeypatch):
    """The folder of a control group on a system with 5 MB left."""
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=FREE))
    monkeypatch.setattr(memory, "CONTROL_GROUP", tmp_path)
    return tmp_path


def test_without_a_container_the_system_decides(group):
    assert available_memory() == FREE


@pytest.mark.parametrize(("limit", "available"), [("max", FREE), ("3000", 2000), ("500", 0)])
def test_the_limit_of_a_container_counts_without_its_file_caches(group, limit, available):
    (group / "memory.stat").write_text("anon 1000\nfile 400\n")
    (group / "memory.max").write_text(f"{limit}\n")
    assert available_memory() == available


def test_the_limit_of_the_address_space_counts(group, monkeypatch):
    used = psutil.Process().memory_info().vms
    monkeypatch.setattr(resource, "getrlimit", lambda _: (used + FREE // 2, resource.RLIM_INFINITY))
    assert 0 <= available_memory() < FREE


def test_this_machine_has_memory_left():
    assert 2**20 < available_memory() < psutil.virtual_memory().total
