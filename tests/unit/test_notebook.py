"""What notebooks show, and the profiles of a catalog as one dataset."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import archives
import made_products
import numpy as np
import pytest

from coslidar.catalog import open_archive, open_catalog
from coslidar.catalog.store import Catalog, CatalogError
from coslidar.pipeline.inversion import Profile
from coslidar.pipeline.markup import table
from coslidar.plugins import registry


def cells(html: str) -> list[list[str]]:
    return [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", html) if "<td>" in row]


def test_a_table_escapes_everything() -> None:
    html = table('<b>"', ("a & b",), [("<script>", 1)])
    assert "<script>" not in html
    assert "&lt;b&gt;" in html
    assert "a &amp; b" in html
    assert cells(html) == [["&lt;script&gt;", "1"]]


def test_plugins_are_listed_also_those_that_cannot_be_loaded() -> None:
    from importlib.metadata import EntryPoint

    group = registry.KINDS["regulariser"][0]
    broken = EntryPoint("broken", "no_such_module:Thing", group)
    found = registry.entries("regulariser", [*registry.entry_points(group=group), broken])
    shown = {row[1]: row[3] for row in cells(found._repr_html_())}
    assert shown.keys() == found.keys()
    assert shown["broken"].startswith("cannot be loaded")
    assert all(text for text in shown.values())


def test_a_profile_is_shown_with_both_bars() -> None:
    profile = SimpleNamespace(
        cn2=np.array([1.5e-14, 0.0]), error_map=np.array([2e-15, 3e-15]), error_ml=np.array([4e-15, np.inf]),
        at_bound=np.array([False, True]), estimator="map", chi2_reduced=1.03,
    )  # fmt: skip
    html = Profile._repr_html_(profile)  # type: ignore[arg-type]
    assert cells(html) == [["0", "1.50e-14", "2.0e-15", "4.0e-15", ""], ["1", "0.00e+00", "3.0e-15", "inf", "at zero"]]
    assert "1.03" in html


def test_a_catalog_is_shown_and_gives_its_profiles(tmp_path: Path) -> None:
    day = 86_400 * 10**9
    with Catalog(tmp_path) as catalog:
        catalog.publish(made_products.product(1))
        catalog.publish(made_products.product(2))
        later = [made_products.batch(n, 3) for n in range(2)]
        moved = [type(item)(item.start + day, item.stop + day, item.values, item.quality_flag) for item in later]
        catalog.publish(made_products.product(3, moved, archive="next-day", archive_identity="e" * 64))
        shown = cells(catalog._repr_html_())
        assert shown == [["test-campaign", "2", "3", "8", "2012-09-14T12:15:00", "2012-09-15T12:21:00"]]

    with open_catalog(tmp_path) as catalog:
        # The newest product of each archive; the failed batch of the first is left out.
        profiles = catalog.profiles(campaign_name="test-campaign")
        newest = catalog.open(catalog.find("2012-09-14T1415"))
        assert profiles.sizes["time"] == 4
        np.testing.assert_array_equal(profiles.cn2.values[:2], newest.cn2.values[:2])
        assert catalog.profiles(quality_level=0).sizes["time"] == 3
        assert catalog.profiles(archive_name="next-day", quality_level=2).sizes["time"] == 2
        assert np.all(np.diff(profiles.time.values.astype(np.int64)) > 0)
        with pytest.raises(CatalogError, match="no batch"):
            catalog.profiles(campaign_name="elsewhere")


def test_an_archive_is_shown(tmp_path: Path) -> None:
    archives.write_small(tmp_path / "a.zarr")
    opened = open_archive(str(tmp_path / "a.zarr"))
    shown = cells(opened._repr_html_())
    assert ["frames", str(opened.n_frames)] in shown
    assert ["archive", "small"] in shown
