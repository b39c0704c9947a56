"""Canonical JSON under generated values."""

import json
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from coslidar.pipeline.lineage import canonical, make_key

numbers = st.floats(allow_nan=False, min_value=-1e308, max_value=1e308) | st.integers() | st.booleans() | st.none()
values = st.recursive(
    numbers | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(values)
def test_reading_back_changes_nothing(value):
    written = canonical(value)
    assert canonical(json.loads(written)) == written


@given(st.dictionaries(st.text(), values, min_size=2, max_size=6), st.randoms())
def test_order_of_a_mapping_does_not_matter(mapping, random):
    items = list(mapping.items())
    random.shuffle(items)
    assert str(make_key("s", 1, dict(items))) == str(make_key("s", 1, mapping))


@given(st.floats(allow_nan=False, allow_infinity=False, min_value=-1e307, max_value=1e307))
def test_last_bit_does_not_matter_but_the_14th_digit_does(value):
    read = float(json.loads(canonical(value)))
    assert math.isclose(read, value, rel_tol=5e-15, abs_tol=5e-324)
    if abs(value) > 1e-290:
        assert canonical(value * (1 + 1e-13)) != canonical(value)


@given(st.lists(st.floats(allow_nan=False, min_value=-1e300, max_value=1e300)))
def test_tuples_lists_and_arrays_are_one(items):
    assert canonical(tuple(items)) == canonical(items) == canonical(np.array(items, dtype=np.float64))
