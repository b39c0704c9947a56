"""Report and browser as a reader has them: opened in Chromium, over a catalog of several products."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import Server, hostile_catalog
from chromium import Chromium
from selenium.webdriver import Keys
from small_runs import Finished, command, environment, wait_for

from coslidar.catalog import open_catalog
from coslidar.catalog.report import BATCH_PANELS, TIME_PANELS, write_report


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hostile_catalog(tmp_path_factory.mktemp("pages") / "results")


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    browser = Chromium(tmp_path_factory.mktemp("chromium"))
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def server(chromium: Chromium, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A running `coslidar browse` whose token the browser has been given."""
    process = subprocess.Popen(
        command("browse", folder), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0,
        env=environment(tmp_path_factory.mktemp("cache")),
    )  # fmt: skip
    served = Server(process)
    chromium.open(served.address)
    yield served
    process.kill()
    process.communicate()


@pytest.fixture(scope="module")
def report(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Address of a report of both archives, four batches of which have a profile."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    with open_catalog(folder) as catalog:
        write_report([catalog.open(row) for row in catalog.products() if row.id != 2], path, most_batches=2)
    return path.as_uri()


@pytest.fixture
def queried(main_here: Callable[..., Finished], folder: Path) -> list[dict[str, Any]]:
    """Every batch of the catalog, as `coslidar catalog query` tells it."""
    done = main_here("catalog", "query", "--out", folder, "--format", "json")
    assert done.code == 0, done.err
    return json.loads(done.out)["batches"]


def is_drawn(picture: np.ndarray) -> bool:
    """Whether a picture has lines and letters: many colours, and not nearly all of it one of them."""
    counts = np.bincount((picture // 16 @ [256, 16, 1]).ravel())
    return np.count_nonzero(counts) > 8 and counts.max() < 0.99 * counts.sum()


def same(shown: list[str], expected: list[float | None], factor: float = 1) -> bool:
    """Whether the cells of a column are the numbers of a query; empty ones are unknown there too."""
    if [cell == "" for cell in shown] != [value is None for value in expected]:
        return False
    pairs = [(float(cell), factor * value) for cell, value in zip(shown, expected, strict=True) if value is not None]
    return len(pairs) > 0 and all(cell == pytest.approx(value, rel=1e-12) for cell, value in pairs)


def sorts_by_keyboard(chromium: Chromium, column: int) -> None:
    """Enter on a heading sorts the table of batches by it, again the other way, with unknown values last."""
    before = [row[column] for row in chromium.rows("#batches")]
    chromium.tab_to(f"e.closest('#batches th')?.cellIndex === {column}")
    known = sorted((cell for cell in before if cell), key=float)
    rest = [""] * (len(before) - len(known))
    for expected, direction in ((known, "ascending"), (known[::-1], "descending")):
        chromium.press(Keys.ENTER)
        assert [row[column] for row in chromium.rows("#batches")] == expected + rest
        heading = "return document.querySelectorAll('#batches th')[arguments[0]].getAttribute('aria-sort')"
        assert chromium.run(heading, column) == direction
    assert len(set(known)) > 1
    assert rest


def test_the_report_is_whole_and_stays_by_itself(chromium: Chromium, report: str) -> None:
    chromium.complaints(), chromium.requests()
    chromium.open(report)
    expected = {panel.key for panel in (*BATCH_PANELS, *TIME_PANELS)} | {"geometry"}
    panels = "return [...document.querySelectorAll('[data-panel]')].map(e => e.dataset.panel)"
    assert set(chromium.run(panels)) == expected
    pictures = chromium.pictures(f"[data-panel={key}]" for key in sorted(expected))
    assert [name for name, picture in pictures.items() if not is_drawn(picture)] == []
    assert chromium.run("return getComputedStyle(document.body).backgroundColor") == "rgb(244, 246, 248)"
    assert chromium.requests() == [report]
    assert chromium.complaints() == []


def nanoseconds(row: dict[str, Any]) -> str:
    return str(np.datetime64(row["start"].removesuffix("Z"), "ns").astype(np.int64))


def test_numbers_of_the_report_are_those_of_a_query(
    chromium: Chromium, report: str, folder: Path, queried: list[dict[str, Any]]
) -> None:
    with open_catalog(folder) as catalog:
        keys = [row.lineage_key for row in catalog.products() if row.id != 2]
    expected = [row for key in keys for row in queried if row["lineage_key"] == key]
    chromium.open(report)
    rows = chromium.rows("#batches")
    assert [row[0] for row in rows] == [nanoseconds(row) for row in expected]
    assert [row[3] for row in rows] == [str(["good", "usable", "bad"].index(row["quality"])) for row in expected]
    columns = {2: ("frames", 1), 5: ("r0", 100), 6: ("scint", 1), 7: ("scint_profile", 1), 8: ("scint_point", 1),
               9: ("log_mu", 1), 10: ("chi2", 1)}  # fmt: skip
    for column, (name, factor) in columns.items():
        assert same([row[column] for row in rows], [row[name] for row in expected], factor), name


def test_the_report_by_keyboard(chromium: Chromium, report: str) -> None:
    chromium.open(report)
    seen = "return [...document.querySelectorAll('article[data-batch]')].map(e => e.checkVisibility())"
    assert chromium.run(seen) == [True, False]
    chromium.tab_to("e.id === 'pick'")
    chromium.press(Keys.ARROW_DOWN)
    assert chromium.run(seen) == [False, True]
    assert chromium.run("return document.getElementById('picked').textContent").startswith("Showing batch 2012-09-14")
    # The button for what comes next is disabled at the end, so that Tab would pass it.
    chromium.press(Keys.SHIFT, Keys.TAB, Keys.SHIFT)
    chromium.tab_to("e.id === 'previous'")
    chromium.press(Keys.SPACE)
    assert chromium.run(seen) == [True, False]
    sorts_by_keyboard(chromium, 5)
    assert chromium.complaints() == []


def test_the_report_has_no_barriers(chromium: Chromium, report: str) -> None:
    chromium.open(report)
    assert chromium.barriers() == []


def test_the_browser_is_whole_and_stays_by_itself(chromium: Chromium, server: Server) -> None:
    chromium.complaints(), chromium.requests()
    for path in ("/", "/runs", "/product/1", "/campaign/test-campaign", "/compare?a=1&b=2"):
        chromium.open(server.base + path)
        assert chromium.run("return document.querySelector('main').innerText.length") > 20, path
    for panels, page in ((TIME_PANELS, "/product/1"), (BATCH_PANELS, "/product/1/batch/0")):
        chromium.open(server.base + page)
        links = chromium.run("return [...document.querySelectorAll('nav.panels a')].map(a => a.getAttribute('href'))")
        assert [link.rpartition("=")[2] for link in links] == [panel.key for panel in panels]
        for panel, link in zip(panels, links, strict=True):
            chromium.open(server.base + link)
            (picture,) = chromium.pictures([f"[data-panel={panel.key}] svg"]).values()
            assert is_drawn(picture), panel.key
    asked = chromium.requests()
    assert f"{server.base}/static/report.js" in asked
    assert [address for address in asked if not address.startswith(server.base + "/")] == []
    assert chromium.complaints() == []


def test_numbers_of_the_browser_are_those_of_a_query(
    chromium: Chromium, server: Server, queried: list[dict[str, Any]]
) -> None:
    chromium.open(server.base)
    rows = chromium.rows("#batches")
    assert [row[0] for row in rows] == [nanoseconds(row) for row in queried]
    for column, name in {4: "frames", 5: "r0", 6: "scint", 7: "scint_profile", 8: "chi2"}.items():
        assert same([row[column] for row in rows], [row[name] for row in queried]), name


def test_the_browser_by_keyboard(chromium: Chromium, server: Server) -> None:
    """From the catalog over a filter and a batch to another of its panels."""
    chromium.open(server.base)
    sorts_by_keyboard(chromium, 5)
    chromium.open(server.base)
    chromium.tab_to("e.name === 'quality'")
    chromium.press(Keys.ARROW_DOWN, Keys.ENTER)
    chromium.tab_to("e.type === 'submit'")
    chromium.press(Keys.ENTER)
    assert wait_for(lambda: "quality=0" in chromium.driver.current_url, 20)
    assert {row[3] for row in chromium.rows("#batches")} == {"0"}
    chromium.tab_to("e.closest('#batches td')")
    chromium.press(Keys.ENTER)
    assert wait_for(lambda: "/batch/0" in chromium.driver.current_url, 20)
    chromium.tab_to("e.closest('nav.panels') && e.getAttribute('href').endsWith('kernels')")
    chromium.press(Keys.ENTER)
    assert wait_for(lambda: "panel=kernels" in chromium.driver.current_url, 20)
    assert chromium.run("return document.querySelector('[data-panel]').dataset.panel") == "kernels"
    assert chromium.complaints() == []


@pytest.mark.parametrize("path", ["/", "/runs", "/product/1", "/product/1/batch/0", "/compare?a=1&b=2"])
def test_the_browser_has_no_barriers(chromium: Chromium, server: Server, path: str) -> None:
    chromium.open(server.base + path)
    assert chromium.barriers() == []
