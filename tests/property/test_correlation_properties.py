"""The sums of correlations form a commutative monoid, whatever is missing and however a record is cut."""

import functools
import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from coslidar.pipeline import correlation
from coslidar.pipeline.correlation import CorrelationSums
from coslidar.pipeline.geometry import Geometry

GEOMETRY = Geometry(((1, 1, 0), (1, 1, 1)), 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))

#: Offsets are at most 1000 times the fluctuations: one rounding of a mean then costs 1e-13 of a covariance.
TOLERANCE = 1e-12


@st.composite
def records(draw, least=1, most=60):
    """Slopes and fluxes with some or no samples missing, offsets up to 1000 standard deviations."""
    frames = draw(st.integers(least, most))
    seed = draw(st.integers(0, 2**32 - 1))
    missing = draw(st.sampled_from([0.0, 0.0, 0.05, 0.5, 1.0]))
    offset = draw(st.sampled_from([0.0, 1.0, 30.0, 1000.0]))
    rng = np.random.default_rng(seed)
    shape = (frames, 3, GEOMETRY.n_sources, GEOMETRY.n_subapertures)
    samples = rng.standard_normal(shape) + rng.standard_normal((frames, 1, 1, 1))
    samples += offset * rng.standard_normal(shape[1:])
    samples[rng.random(shape) < missing] = np.nan
    scale = 10.0 ** draw(st.integers(-7, 4))
    return scale * samples[:, :2], 1e4 * (1 + 1e-4 * samples[:, 2])


def assert_equal(one: CorrelationSums, other: CorrelationSums):
    assert one.n_frames == other.n_frames
    np.testing.assert_array_equal(one.count, other.count)
    np.testing.assert_allclose(one.mean, other.mean, rtol=TOLERANCE, atol=TOLERANCE * np.abs(other.mean).max())
    spread = np.sqrt(np.maximum(np.diagonal(other.comoment), 0))
    # One spread per kind: a channel measured twice may have next to none of its own.
    spread = np.repeat(spread.reshape(3, -1).max(axis=1), spread.size // 3)
    spread[spread == 0] = 1.0
    unit = np.outer(spread, spread)
    offset = np.abs(other.mean).max(axis=1) / spread
    # A mean is known to eps of itself; a step between the means of two parts enters a comoment once.
    allowed = TOLERANCE * np.maximum(1, other.n_frames * np.maximum(offset[:, None], offset[None, :]))
    assert np.all(np.abs(one.comoment - other.comoment) / unit <= allowed)


@settings(max_examples=60, deadline=None)
@given(records(), st.lists(st.integers(0, 60), max_size=8))
def test_any_chunking_gives_the_same_maps(record, cuts):
    slopes, flux = record
    edges = [0, *sorted(min(cut, len(slopes)) for cut in cuts), len(slopes)]
    parts = [correlation.accumulate(slopes[a:b], flux[a:b]) for a, b in itertools.pairwise(edges)]
    whole = correlation.finalise(correlation.accumulate(slopes, flux), GEOMETRY)
    merged = correlation.finalise(functools.reduce(correlation.merge, parts), GEOMETRY)
    np.testing.assert_array_equal(whole.pair_count, merged.pair_count)
    np.testing.assert_array_equal(np.isnan(whole.maps), np.isnan(merged.maps))
    variance = np.diagonal(whole.covariance).reshape(3, -1)
    with np.errstate(all="ignore"):
        unit = np.fmax.reduce(variance, axis=1)[[0, 1, 0, 1, 2, 2], None, None]
    unit = np.where(unit > 0, unit, 1.0)
    difference = np.nan_to_num((merged.maps - whole.maps) / unit)
    assert np.abs(difference).max() <= TOLERANCE


@settings(max_examples=40, deadline=None)
@given(records(), records(), records())
def test_merge_is_associative_and_commutative(one, two, three):
    a, b, c = (correlation.accumulate(*record) for record in (one, two, three))
    assert_equal(correlation.merge(correlation.merge(a, b), c), correlation.merge(a, correlation.merge(b, c)))
    assert_equal(correlation.merge(a, b), correlation.merge(b, a))


@settings(max_examples=30, deadline=None)
@given(records())
def test_empty_is_the_identity(record):
    sums = correlation.accumulate(*record)
    empty = CorrelationSums.empty(GEOMETRY.n_sources, GEOMETRY.n_subapertures)
    for merged in (correlation.merge(sums, empty), correlation.merge(empty, sums)):
        for name in ("count", "mean", "comoment"):
            np.testing.assert_array_equal(getattr(merged, name), getattr(sums, name))
    nothing = correlation.accumulate(np.empty((0, 2, 2, 5)), np.empty((0, 2, 5)))
    for name in ("n_frames", "count", "mean", "comoment"):
        np.testing.assert_array_equal(getattr(nothing, name), getattr(empty, name))


@settings(max_examples=30, deadline=None)
@given(records(least=5), st.integers(0, 2**32 - 1))
def test_a_sample_missing_nowhere_takes_the_same_path(record, seed):
    """One missing sample moves all channels to the pairwise sums; the others must not notice."""
    slopes, flux = record
    slopes, flux = np.nan_to_num(slopes), np.nan_to_num(flux, nan=1e4)
    complete = correlation.finalise(correlation.accumulate(slopes, flux), GEOMETRY).covariance
    holed = slopes.copy()
    holed[0, 0, 0, 0] = np.nan
    pairwise = correlation.finalise(correlation.accumulate(holed, flux), GEOMETRY).covariance
    unit = np.sqrt(np.diagonal(complete).reshape(3, -1).max(axis=1))
    unit = np.repeat(np.where(unit > 0, unit, 1.0), len(complete) // 3)
    difference = (pairwise - complete) / np.outer(unit, unit)
    assert np.abs(difference[1:, 1:]).max() <= TOLERANCE
