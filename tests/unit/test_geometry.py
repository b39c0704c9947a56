from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from coslidar.pipeline.geometry import MAP_KINDS, Geometry, SliceGrid

SCINDAR = ((0, 1, 1, 1, 0), (1, 1, 1, 1, 1), (1, 1, 0, 1, 1), (1, 1, 1, 1, 1), (0, 1, 1, 1, 0))


def geometry(mask: tuple[tuple[int, ...], ...] = SCINDAR, sources: int = 2) -> Geometry:
    return Geometry(mask, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4))[:sources])


def test_counts_of_the_five_by_five_instrument() -> None:
    """12 of the 81 separations have no pair; 486 rows carry 312 independent numbers."""
    g = geometry()
    assert g.n_subapertures == 20
    assert (g.pair_count == 0).sum() == 12
    assert g.pair_count.sum() == 400
    assert len(g.valid) == 486
    assert len(g.independent) == 312


@pytest.mark.parametrize("mask", [SCINDAR, ((1, 1, 0), (0, 1, 1)), ((1,),), ((1, 0, 1, 1),)])
def test_pairs_against_a_double_loop(mask: tuple[tuple[int, ...], ...]) -> None:
    g = geometry(mask)
    lenslets = [(i, j) for i, j in product(range(g.p), range(g.q)) if mask[i][j]]
    for dy, dx in product(range(1 - g.p, g.p), range(1 - g.q, g.q)):
        count = sum((a[0] - b[0], a[1] - b[1]) == (dy, dx) for a, b in product(lenslets, lenslets))
        assert g.pair_count[dy + g.p - 1, dx + g.q - 1] == count


def test_rows_name_their_separation() -> None:
    g = geometry(((1, 1, 0), (0, 1, 1)))
    rows = g.separation_vectors.reshape(len(MAP_KINDS), *g.map_shape, 2)
    assert rows[0, 0, 0] == pytest.approx([-2 * 0.07, -1 * 0.07])
    assert rows[5, 2, 4] == pytest.approx([2 * 0.07, 1 * 0.07])


def test_mirror_images_share_an_independent_row() -> None:
    g = geometry()
    vectors = g.separation_vectors
    size = len(vectors) // 6
    kept = set(g.independent.tolist())
    for row in np.flatnonzero(g.valid):
        twin = g.mirror[row]
        assert twin in kept
        assert row // size == twin // size
        sign = 1 if row == twin else -1
        assert vectors[twin] == pytest.approx(sign * vectors[row])


def test_one_source_has_no_cross_rows() -> None:
    g = geometry(sources=1)
    assert g.separation == (0.0, 0.0)
    assert len(g.independent) == 3 * 35


def test_axes() -> None:
    """x runs along columns, y along rows; the first lenslet of the mask is at -x, -y."""
    g = geometry()
    assert g.subaperture_position[0] == pytest.approx([-0.07, -0.14])
    assert g.separation == (0.0, 0.8)


def test_path() -> None:
    g = geometry()
    assert g.magnification(890.0) == pytest.approx(0.5)
    assert g.scaling(890.0) == pytest.approx(1.5)
    far = Geometry(SCINDAR, 0.07, float("inf"), 5e-7, ((0.0, 0.0),))
    assert (far.magnification(5000.0), far.scaling(5000.0)) == (5000.0, 1.0)


def test_slices() -> None:
    grid = SliceGrid.uniform(2670.0, 12)
    assert grid.k == 12
    assert grid.thickness == pytest.approx(np.full(12, 222.5))
    assert grid.centres[0] == pytest.approx(111.25)
    for edges in ((0.0,), (1.0, 0.5), (-1.0, 1.0), (0.0, float("inf"))):
        with pytest.raises(ValueError, match="slice edges"):
            SliceGrid(edges)
