"""Results kept for later runs: whole, or not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coslidar.catalog.kept import Kept
from coslidar.catalog.products import ProductError

KEY = "ab" * 32
ARRAYS = {"M": np.arange(12.0).reshape(3, 4), "n": np.asarray(3), "lags": np.array([1, -2], dtype="i8")}


def test_what_is_kept_comes_back(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    assert kept.load(KEY) is None
    assert not kept.has(KEY)
    kept.save(KEY, ARRAYS)
    kept.save(KEY, ARRAYS)
    assert kept.has(KEY)
    found = kept.load(KEY)
    assert found is not None
    assert list(found) == list(ARRAYS)
    for name, values in ARRAYS.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values)
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [f"{KEY}.npz"]


def test_no_damage_reads_as_data(tmp_path: Path) -> None:
    """Every byte changed in turn, and the file cut short: never other numbers, never an exception."""
    kept = Kept(tmp_path)
    kept.save(KEY, ARRAYS)
    path = kept.path(KEY)
    whole = path.read_bytes()
    for i in range(len(whole)):
        path.write_bytes(whole[:i] + bytes([whole[i] ^ (1 << i % 8)]) + whole[i + 1 :])
        assert kept.load(KEY) is None
        if i % 16 == 0:
            path.write_bytes(whole[:i])
            assert kept.load(KEY) is None
    path.write_bytes(whole)
    assert kept.load(KEY) is not None


def test_a_key_is_no_path(tmp_path: Path) -> None:
    for key in ("../../etc/passwd", "AB" * 32, ""):
        with pytest.raises(ProductError):
            Kept(tmp_path).path(key)


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        Kept(tmp_path).save(KEY, ARRAYS)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
