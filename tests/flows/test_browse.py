"""`coslidar browse` as a process of its own, asked by an HTTP client."""

from __future__ import annotations

import asyncio
import io
import re
import shutil
import signal
import sqlite3
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import httpx
import made_products
import numpy as np
import pytest
from browsing import HOSTILE, HOSTILE_NAME, Server, hostile_catalog
from small_runs import command, environment, wait_for

from coslidar.catalog import open_catalog
from coslidar.catalog.products import open_product
from coslidar.catalog.report import BATCH_PANELS, TIME_PANELS
from coslidar.catalog.store import Catalog
from coslidar.flows.browser.pages import Pages

titles = {panel.key: panel.title for panel in (*BATCH_PANELS, *TIME_PANELS)}


class Seen(HTMLParser):
    """Links, scripts, pictures and table cells of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.scripts: list[str] = []
        self.panels: list[str] = []
        self.pictures = 0
        self.paths = 0
        self.inline = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.links += [value for name, value in attrs if name in ("href", "src") and value]
        self.inline += sum(name == "style" or name.startswith("on") for name in given)
        if tag == "script":
            self.scripts.append(given.get("src") or "inline")
        if tag == "svg":
            self.pictures += 1
        if tag == "path":
            self.paths += 1
        if "data-panel" in given:
            self.panels.append(str(given["data-panel"]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hostile_catalog(tmp_path_factory.mktemp("browse") / "results")


@pytest.fixture(scope="module")
def server(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    process = subprocess.Popen(
        command("browse", folder), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0,
        env=environment(tmp_path_factory.mktemp("cache")),
    )  # fmt: skip
    yield Server(process)
    process.kill()
    process.communicate()


def test_every_page_of_a_walk_answers_and_stays_here(server: Server) -> None:
    """Every link within the pages leads to a page; none leads elsewhere; only the report's script runs."""
    todo, seen = ["/"], set()
    while todo:
        path = todo.pop()
        if path in seen:
            continue
        seen.add(path)
        answer = server.client.get(path)
        assert answer.status_code == 200, f"{path}: {answer.status_code} {answer.text[:300]}"
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert answer.headers["referrer-policy"] == "no-referrer"
        if not answer.headers["content-type"].startswith("text/html") or "attachment" in str(answer.headers):
            continue
        page = Seen(answer.text)
        assert page.scripts == ["/static/report.js"], path
        assert page.inline == 0, path
        assert HOSTILE not in answer.text, path
        outside = [link for link in page.links if not link.startswith(("/", "#", "data:")) or link.startswith("//")]
        assert outside == [], path
        # Figures are drawn by the test of panels; here one batch of each of two products, one of them hostile, will do.
        todo += [
            link
            for link in page.links
            if link.startswith("/")
            and not link.startswith("//")
            and "/figure/" not in link
            and "panel=" not in link
            and not re.search(r"/product/2/batch|/batch/1|/download/", link)
        ]
    assert {"/", "/runs", "/product/1", "/product/1/batch/2", "/campaign/test-campaign"} <= seen
    assert "/compare?a=1&b=2" in seen


def test_every_panel_is_drawn(server: Server) -> None:
    for panel in TIME_PANELS:
        page = Seen(server.page(f"/product/1?panel={panel.key}"))
        assert page.panels == [panel.key]
        assert page.pictures == 1
        assert page.paths > 5, panel.key
    for panel in BATCH_PANELS:
        page = Seen(server.page(f"/product/1/batch/0?panel={panel.key}"))
        assert page.panels == [panel.key]
        assert page.pictures == 1
        assert page.paths > 5, panel.key


def test_panels_that_would_be_empty_are_not_offered(tmp_path: Path) -> None:
    """A batch with a profile and little else, and one that failed."""
    whole = made_products.batch()
    kept = {"cn2", "cn2_standard_error", "slope_correlation", "log_amplitude_count", "r0_profile"}
    poor = replace(whole, values={name: value for name, value in whole.values.items() if name in kept})
    poor.values["log_amplitude_count"][:] = 0
    with Catalog(tmp_path) as catalog:
        run = catalog.start_run(command="coslidar run")
        catalog.publish(made_products.product(results=[poor, made_products.failed(1)]), run)
        app = Pages(catalog, "here").app()

        async def ask(path: str) -> httpx.Response:
            async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://here") as client:
                return await client.get(path)

        def offered(path: str) -> tuple[list[str], str, str]:
            text = asyncio.run(ask(path)).text
            nav = text[text.index('<nav class="panels"') : text.index("</nav>", text.index('<nav class="panels"'))]
            absent = re.search(r'<details class="absent">.*?</details>', text, re.DOTALL)
            return re.findall(r"panel=(\w+)", nav), absent[0] if absent else "", text

        panels, absent, text = offered("/product/1/batch/0")
        assert panels == ["profile", "correlations"]
        assert "5 more panels have nothing to draw here" in absent
        assert f"{titles['criterion']} <small>There is no criterion curve: μ was given.</small>" in absent
        assert f"{titles['checks']} <small>This batch has no such checks.</small>" in absent
        assert 'figure/profile.svg?batch=0"' in text

        panels, absent, text = offered("/product/1/batch/1")
        assert panels == []
        assert "7 more panels have nothing to draw here" in absent
        assert "This batch has no profile." in text
        assert "<svg" not in text
        assert "/figure/" not in text
        answer = asyncio.run(ask("/product/1/figure/profile.svg?batch=1"))
        assert answer.status_code == 404
        assert "has nothing to draw here: This batch has no profile." in answer.text.replace("&#39;", "'")

        panels, absent, text = offered("/product/1")
        assert panels == ["map", "strength", "weights", "response", "quality"]
        assert f"{titles['heat_flux']} <small>" in absent
        # An address that names an empty panel, as the link to the next batch may, is answered.
        panels, absent, text = offered("/product/1?panel=averages")
        assert "No batch has a mean along the path." in text[text.index("<figure") :]


def test_numbers_are_those_of_the_catalog(server: Server, folder: Path) -> None:
    text = server.page("/")
    rows = re.findall(r'<tr>\s*<td data-v="(\d+)">.*?</tr>', text, re.DOTALL)
    r0 = re.findall(r'<td data-v="([^"]*)">[^<]*</td>\s*<td data-v="[^"]*">[^<]*</td>\s*<td data-v="[^"]*">[^<]*</td>'
                    r'\s*<td data-v="[^"]*">[^<]*</td>\s*</tr>', text)  # fmt: skip
    with open_catalog(folder) as catalog:
        expected = catalog.batches()
    assert [int(start) for start in rows] == [row.start for row in expected]
    assert [float(value) if value else None for value in r0] == [row.r0 for row in expected]


def test_filters_narrow_the_batches(server: Server, folder: Path) -> None:
    def count(query: str) -> int:
        return int(re.search(r"<p>(\d+) batch", server.page(f"/?{query}"))[1])  # type: ignore[index]

    assert count("") == 9
    assert count("quality=0") == 3
    assert count(f"archive={HOSTILE_NAME}") == 3
    assert count("campaign=nowhere") == 0
    # The second batch of each begins three minutes after the first, at 12:18:00 and 123 ns.
    assert count("since=2012-09-14T12:18") == 6
    assert count("since=2012-09-14T14:18%2B02:00") == 6
    assert count("until=2012-09-14T12:18") == 3
    with open_catalog(folder) as catalog:
        known = [row.r0 for row in catalog.batches() if row.r0 is not None]
    middle = float(np.median(known))
    assert count(f"r0_min={100 * middle}") == sum(value >= 100 * middle / 100 for value in known)
    for query, word in (("quality=x", "usable with care"), ("since=noon", "write a time"), ("r0_max=wide", "number")):
        assert word in server.page(f"/?{query}", 400)
    assert "whole number" in server.page("/?page=0", 400)


def test_two_lineages_are_compared(server: Server, folder: Path) -> None:
    text = server.page("/compare?a=1&b=2")
    assert Seen(text).pictures == 1
    assert re.search(r"<td>profile: seed</td><td>1</td><td>2</td>", text)
    with open_catalog(folder) as catalog:
        a, b = (catalog.open(row)["cn2"].values[0] for row in catalog.products(archive_name="2012-09-14T1415"))
    ratios = re.findall(r"<tr>(?:<td>[^<]*</td>){4}<td>([^<]*)</td><td>[^<]*</td></tr>", text)
    # Three digits are shown.
    assert [float(value) for value in ratios] == pytest.approx(list(b / a), rel=5e-3)
    assert "None: the lineages are the same" in server.page("/compare?a=1&b=1")
    assert "which products" in server.page("/compare", 400)


def test_downloads_are_the_product(server: Server, folder: Path, tmp_path: Path) -> None:
    with open_catalog(folder) as catalog:
        row = next(row for row in catalog.products() if row.id == 1)
    answer = server.client.get("/product/1/download/zarr")
    assert answer.content == row.path.read_bytes()
    assert answer.headers["content-disposition"] == f'attachment; filename="{row.path.name}"'
    (tmp_path / "a.zarr.zip").write_bytes(answer.content)
    cn2 = open_product(tmp_path / "a.zarr.zip")["cn2"].values

    tables = zipfile.ZipFile(io.BytesIO(server.client.get("/product/1/download/csv").content))
    assert any(repr(float(cn2[0, 0]))[:12] in tables.read(name).decode() for name in tables.namelist())
    netcdf = server.client.get("/product/1/download/netcdf")
    assert netcdf.content[1:4] == b"HDF"
    report = server.client.get("/product/1/download/html")
    assert "attachment" in report.headers["content-disposition"]
    assert "Content-Security-Policy" in report.text
    for form, magic in (("svg", b"<?xml"), ("png", b"\x89PNG"), ("pdf", b"%PDF")):
        assert server.client.get(f"/product/1/figure/profile.{form}?batch=1").content.startswith(magic)


def test_who_has_no_token_sees_nothing(server: Server) -> None:
    with httpx.Client(base_url=server.base, trust_env=False) as stranger:
        for path in ("/", "/product/1", "/product/1/download/zarr", "/static/report.css", "/nowhere"):
            answer = stranger.get(path)
            assert answer.status_code == 403, path
            assert "test-campaign" not in answer.text
        assert stranger.get("/?token=wrong").status_code == 403
        assert stranger.get("/?token=").status_code == 403
        assert stranger.get("/", headers={"authorization": f"Basic {server.token}"}).status_code == 403
        assert stranger.get("/", headers={"cookie": "coslidar=x; ;;=\x01"}).status_code == 403
        assert stranger.get("/", headers={"host": "evil.example"}).status_code == 400

        # The address that was printed opens the door once; the token does not stay in the address.
        opened = stranger.get(f"/?quality=0&token={server.token}")
        assert opened.status_code == 303
        assert opened.headers["location"] == "/?quality=0"
        assert "HttpOnly" in opened.headers["set-cookie"]
        assert "samesite=strict" in opened.headers["set-cookie"].lower()
        assert stranger.get("/?quality=0").status_code == 200
        assert (
            stranger.get(f"{server.base}//evil.example/?token={server.token}").headers["location"] == "/evil.example/"
        )


def test_nothing_but_reading(server: Server, folder: Path) -> None:
    before = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file() and "-" not in path.name}
    for method in ("POST", "PUT", "DELETE", "PATCH"):
        assert server.client.request(method, "/product/1").status_code == 405
    server.page("/")
    after = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file() and "-" not in path.name}
    assert after == before

    with Catalog(folder, read_only=True) as catalog:
        for statement in ("delete from batch", "update campaign set name = 'x'", "drop table failure"):
            with pytest.raises(Exception, match="readonly"), catalog.database.write() as connection:
                connection.exec_driver_sql(statement)
    assert sqlite3.connect(folder / "catalog.sqlite").execute("select count(*) from batch").fetchone() == (9,)


def test_what_is_not_there_is_said(server: Server) -> None:
    assert "has no product 99" in server.page("/product/99", 404)
    assert "there is no number 7" in server.page("/product/1/batch/7", 404)
    assert "there are profile" in server.page("/product/1/batch/0?panel=<script>", 404)
    assert "no campaign" in server.page("/campaign/none", 404)
    assert server.client.get("/static/..%2fpages.py").status_code in (403, 404)


def test_a_damaged_product_is_an_answer(
    started: Callable[..., subprocess.Popen[str]], folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(folder, tmp_path / "results")
    with open_catalog(tmp_path / "results") as catalog:
        row = next(row for row in catalog.products() if row.id == 1)
    row.path.write_bytes(row.path.read_bytes()[:1000])
    server = Server(started("browse", tmp_path / "results"))
    assert "damaged" in server.page("/product/1", 500)
    server.page("/product/2")

    # Ctrl-C is how it ends: at once, with a word and no traceback.
    server.process.send_signal(signal.SIGINT)
    assert wait_for(lambda: server.process.poll() is not None, 20)
    assert server.process.returncode == 0
    assert server.process.stderr.read() == ""  # type: ignore[union-attr]
    assert "closed" in server.process.stdout.read()  # type: ignore[union-attr]


def test_where_nothing_can_be_shown(main_here: Callable[..., object], tmp_path: Path) -> None:
    import socket

    missing = main_here("browse", tmp_path / "nowhere")
    assert missing.code == 2  # type: ignore[attr-defined]
    assert "there is no catalog" in missing.err  # type: ignore[attr-defined]
    Catalog(tmp_path / "results").close()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        refused = main_here("browse", tmp_path / "results", "--port", taken.getsockname()[1])
    assert refused.code == 1  # type: ignore[attr-defined]
    assert "without --port" in refused.err  # type: ignore[attr-defined]
    strange = main_here("browse", tmp_path / "results", "--host", "no such host")
    assert strange.code == 2  # type: ignore[attr-defined]
    assert "--host" in strange.err  # type: ignore[attr-defined]
