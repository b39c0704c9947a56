"""Scratch store: finished batches come back exactly, and anything else is not there."""

from __future__ import annotations

import os
import pickle
import time
from dataclasses import replace

import numpy as np
import pytest
from made_products import batch, failed

from coslidar.catalog.products import ProductError
from coslidar.catalog.scratch import Scratch
from coslidar.pipeline.lineage import make_key

KEY = make_key("batch", 1, {"number": 0})
OTHER = make_key("batch", 1, {"number": 1})


@pytest.fixture
def scratch(tmp_path):
    return Scratch(tmp_path / "scratch")


def test_a_batch_comes_back_exactly(scratch):
    saved = batch(0, flag=6)
    scratch.save(KEY, saved)
    loaded = scratch.load(KEY)
    assert (loaded.start, loaded.stop, loaded.quality_flag, loaded.reason) == (saved.start, saved.stop, 6, "")
    assert set(loaded.values) == set(saved.values)
    for name, value in saved.values.items():
        assert loaded.values[name].dtype == value.dtype
        np.testing.assert_array_equal(loaded.values[name], value)


def test_a_failed_batch_keeps_its_reason(scratch):
    scratch.save(KEY, replace(failed(0), reason="no light: ' \" é \x00"))
    assert scratch.load(KEY).reason == "no light: ' \" é \x00"


def test_what_was_never_saved_is_not_there(scratch):
    assert scratch.load(KEY) is None
    scratch.remove([KEY])
    assert scratch.sweep() == 0


def test_remove(scratch):
    scratch.save(KEY, batch(0))
    scratch.save(OTHER, batch(1))
    scratch.remove([KEY])
    assert scratch.load(KEY) is None
    assert scratch.load(OTHER) is not None


@pytest.mark.parametrize("place", [0.0, 0.3, 0.6, 0.9, 0.999])
def test_a_truncated_file_is_not_there(scratch, place):
    scratch.save(KEY, batch(0))
    path = scratch.path(KEY)
    data = path.read_bytes()
    path.write_bytes(data[: int(place * len(data))])
    assert scratch.load(KEY) is None


def test_a_flipped_bit_in_any_array_is_noticed(scratch):
    saved = batch(0)
    scratch.save(KEY, saved)
    path = scratch.path(KEY)
    data = bytearray(path.read_bytes())
    data[data.index(saved.values["cn2"].tobytes())] ^= 4
    path.write_bytes(bytes(data))
    assert scratch.load(KEY) is None


def test_a_file_under_the_wrong_key_is_not_there(scratch):
    scratch.save(KEY, batch(0))
    scratch.path(OTHER).parent.mkdir(parents=True, exist_ok=True)
    os.rename(scratch.path(KEY), scratch.path(OTHER))
    assert scratch.load(OTHER) is None


def test_pickles_are_neither_written_nor_read(scratch):
    with pytest.raises(ValueError, match="plain arrays"):
        scratch.save(KEY, replace(batch(0), values={"cn2": np.array([print], dtype=object)}))
    path = scratch.path(KEY)
    path.parent.mkdir(parents=True)
    np.savez(path, __batch__=np.array([{"format": 1}], dtype=object))
    assert scratch.load(KEY) is None
    path.write_bytes(pickle.dumps({"format": 1}))
    assert scratch.load(KEY) is None


def test_a_variable_that_no_product_has_is_not_there(scratch):
    scratch.save(KEY, replace(batch(0), values={"old_name": np.zeros(3)}))
    assert scratch.load(KEY) is None


@pytest.mark.parametrize("key", ["../../x", "", "A" * 64, "a" * 63, "a" * 64 + "\n"])
def test_keys_are_no_paths(scratch, key):
    for call in (lambda: scratch.save(key, batch(0)), lambda: scratch.load(key), lambda: scratch.remove([key])):
        with pytest.raises(ProductError, match="key of a batch"):
            call()
    assert not scratch.folder.exists()


def test_half_a_file_is_never_seen(scratch, monkeypatch):
    scratch.save(KEY, batch(0))

    def stop(*_):
        raise OSError("killed")

    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises(OSError, match="killed"):
        scratch.save(KEY, batch(1))
    monkeypatch.undo()
    assert scratch.load(KEY).start == batch(0).start
    assert len(list(scratch.folder.rglob("*.*"))) == 1


def test_sweep_takes_only_what_is_old(scratch):
    scratch.save(KEY, batch(0))
    scratch.save(OTHER, batch(1))
    part = scratch.path(KEY).parent / ".0123456789abcdef.host.1.part"
    part.write_bytes(b"")
    old = time.time() - 3 * 86400
    os.utime(scratch.path(KEY), (old, old))
    os.utime(part, (old, old))
    assert scratch.sweep(older_than=2 * 86400) == 2
    assert scratch.load(KEY) is None
    assert scratch.load(OTHER) is not None
    assert not part.exists()


def test_it_travels(scratch):
    scratch.save(KEY, batch(0))
    assert pickle.loads(pickle.dumps(scratch)).load(KEY) is not None
