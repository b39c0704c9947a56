"""Ten thousand batches through one run on a cluster: nothing grows with them, and each is right."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from small_clusters import Cluster

from coslidar.catalog import open_catalog, open_product

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

BATCHES = 10_000


@pytest.mark.slow
@pytest.mark.cluster
def test_ten_thousand_batches(tmp_path: Path, cache: Path) -> None:
    from bench_scaling import in_a_process, show
    from recordings import PERIOD

    cluster = Cluster(tmp_path, cache)
    try:
        for _ in range(2):
            cluster.worker(DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED="false")
        assert cluster.ready(2)
        points = in_a_process(BATCHES, tmp_path, scheduler=cluster.address, pid=cluster.scheduler.pid)
    finally:
        cluster.close()
    show(points)
    # From a tenth of the way on: 9,000 batches may leave 2 kB each, which a result of 19 kB that is kept would not.
    tenth, whole = points[0], points[-2]
    assert whole.driver - tenth.driver < 18
    assert whole.scheduler - tenth.scheduler < 18
    with open_catalog(tmp_path / f"results-{BATCHES}") as catalog:
        (row,) = catalog.products()
        assert row.batches == BATCHES
        with open_product(row.path if row.path.is_absolute() else catalog.root / row.path) as product:
            for name in ("slope_correlation", "intensity_correlation", "cn2", "mu"):
                values = product[name].values
                assert np.isfinite(values[:PERIOD]).all()
                # The frames repeat after so many batches, and so must all that follows from them.
                repeated = np.resize(values[:PERIOD], values.shape)
                np.testing.assert_allclose(values, repeated, rtol=1e-10, atol=0)
