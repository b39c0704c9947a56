"""How many heaps a process has."""

from __future__ import annotations

import subprocess
import sys

import pytest

#: Threads that hold memory at the same time, and how many heaps there are then (malloc_info of glibc tells).
_CODE = """
import ctypes, sys, threading
from coslidar.flows.memory import few_heaps
if sys.argv[1] == "few":
    few_heaps(2)
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
together = threading.Barrier(7)
def hold():
    libc.malloc(1000)
    together.wait()
for _ in range(6):
    threading.Thread(target=hold).start()
together.wait()
libc.fopen.restype = ctypes.c_void_p
sink = ctypes.c_void_p(libc.fopen(sys.argv[2].encode(), b"w"))
libc.malloc_info(0, sink)
libc.fclose(sink)
"""


@pytest.mark.skipif(sys.platform != "linux" or sys.maxsize < 2**32, reason="heaps of glibc")
def test_threads_share_heaps(tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("MALLOC_ARENA_MAX", raising=False)
    heaps = {}
    for which in ("few", "many"):
        subprocess.run([sys.executable, "-c", _CODE, which, tmp_path / which], check=True, timeout=60)
        heaps[which] = (tmp_path / which).read_text().count("<heap ")
    assert heaps["few"] == 2
    assert heaps["many"] > 2
