"""The pages: what a catalog holds, its products and batches, and two lineages beside each other."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache, wraps
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse, HTMLResponse, Response
from starlette.routing import Route

from ...catalog import export
from ...catalog.database import DatabaseError
from ...catalog.products import ProductError
from ...catalog.report import BATCH_PANELS, TIME_PANELS, BatchPanel, TimePanel, nothing_to_draw, render
from ...catalog.report.batch_panels import profile_rows
from ...catalog.report.reading import LEVELS, bounds, flag_names, flags, levels
from ...catalog.report.two_lineages import differences, slice_rows, summary_rows, two_profiles_markup
from ...catalog.report.words import clean, clock, interval, mapping, number, raised_units
from ...catalog.store import CatalogError
from .panels import FORMATS, PANELS, PEN, Dataset, Kept, Offer, figure_bytes, panel_markup

if TYPE_CHECKING:
    from starlette.requests import Request

    from ...catalog.store import BatchRow, Catalog, ProductRow

#: Rows of a table on one page.
ROWS = 200
#: Products that are kept in memory, and pages.
_OPEN, _SHOWN = 16, 64


class Refusal(Exception):
    """A request that cannot be answered: status and sentence."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


@dataclass(frozen=True)
class Filters:
    """What the table of batches is narrowed to, as it stands in the address."""

    campaign: str = ""
    archive: str = ""
    settings: str = ""
    quality: str = ""
    since: str = ""
    until: str = ""
    r0_min: str = ""
    r0_max: str = ""

    @classmethod
    def of(cls, query: Mapping[str, str]) -> Filters:
        """Those of a query string; unknown keys are ignored."""
        return cls(**{name: query.get(name, "").strip()[:200] for name in cls.__dataclass_fields__})

    def query(self) -> dict[str, str]:
        """Those that are set."""
        return {name: value for name, value in vars(self).items() if value}

    def batches(self, catalog: Catalog) -> list[BatchRow]:
        """Batches that answer.

        Raises
        ------
        Refusal
            A value cannot be read.
        """
        if self.quality not in ("", "0", "1", "2"):
            raise Refusal(400, f"quality = '{self.quality}': write 0 (good), 1 (usable with care) or 2 (bad)")
        found = catalog.batches(
            campaign_name=self.campaign or None,
            archive_name=self.archive or None,
            lineage_key=self.settings or None,
            quality_level=int(self.quality) if self.quality else None,
            start=_moment("from", self.since),
            stop=_moment("to", self.until),
        )
        low, high = _centimetres("least r0", self.r0_min), _centimetres("largest r0", self.r0_max)
        if low is None and high is None:
            return found
        return [
            row
            for row in found
            if row.r0 is not None and (low is None or row.r0 >= low) and (high is None or row.r0 <= high)
        ]


def _moment(name: str, text: str) -> int | None:
    if not text:
        return None
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        raise Refusal(400, f"{name} = '{text}': write a time in UTC, for example 2012-09-14T12:15") from None
    when = when.replace(tzinfo=UTC) if when.tzinfo is None else when.astimezone(UTC)
    return int((when - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds()) * 1_000_000_000


def _centimetres(name: str, text: str) -> float | None:
    if not text:
        return None
    try:
        return float(text) / 100
    except ValueError:
        raise Refusal(400, f"{name} = '{text}': write a number of centimetres, for example 4.5") from None


class Pages:
    """Everything that answers a request.

    Parameters
    ----------
    catalog : Catalog
        Opened read-only.
    name : str
        What the pages call it.
    """

    def __init__(self, catalog: Catalog, name: str) -> None:
        self.catalog = catalog
        self.name = name
        self._products: Kept[Dataset] = Kept(_OPEN)
        self._drawn: Kept[dict[str, str]] = Kept(_SHOWN, PEN)
        self._offers: Kept[Offer] = Kept(_SHOWN)
        self._templates = Environment(
            loader=FunctionLoader(_text), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
            lstrip_blocks=True,
            # Names come from headers of somebody's archives.
            finalize=lambda value: value if isinstance(value, Markup) else clean(value),
        )  # fmt: skip
        self._templates.filters |= {
            "clock": clock, "query": lambda query: urlencode(query), "svg": Markup, "level": lambda n: LEVELS[n],
        }  # fmt: skip
        self._templates.filters["units"] = raised_units
        self._templates.filters["second"] = lambda time: clock(time // 10**9 * 10**9)

    def app(self) -> Starlette:
        """The application, without its guard."""
        product = "/product/{product:int}"
        routes = {
            "/": self.overview,
            "/runs": self.runs,
            "/compare": self.compare,
            "/campaign/{campaign:str}": self.campaign,
            product: self.product,
            product + "/batch/{batch:int}": self.batch,
            product + "/figure/{panel:str}.{form:str}": self.figure,
            product + "/download/{form:str}": self.download,
            "/static/{name:str}": self.static,
        }
        return Starlette(routes=[Route(path, self._answer(made), methods=["GET"]) for path, made in routes.items()])

    def _answer(self, make: Callable[[Request], Response]) -> Callable[[Request], Any]:
        @wraps(make)
        async def endpoint(request: Request) -> Response:
            # Drawing takes a second; others should not wait for it.
            try:
                return await run_in_threadpool(make, request)
            except Refusal as refusal:
                return self._page("refusal.html", refusal.status, title="Nothing here", sentence=str(refusal))
            except (CatalogError, ProductError, DatabaseError) as error:
                return self._page("refusal.html", 500, title="This cannot be read", sentence=str(error))

        return endpoint

    def _page(self, template: str, status: int = 200, **content: Any) -> Response:
        text = self._templates.get_template(template).render(catalog=self.name, **content)
        return HTMLResponse(text, status)

    def _row(self, number: int) -> ProductRow:
        for row in self.catalog.products():
            if row.id == number:
                return row
        raise Refusal(404, f"the catalog has no product {number}")

    def _dataset(self, row: ProductRow) -> Dataset:
        return self._products.get((row.id, row.sha256), lambda: self.catalog.open(row))

    def _panel(self, key: str, rows: Sequence[ProductRow], batch: int = 0) -> dict[str, str]:
        name = (key, batch, tuple((row.id, row.sha256) for row in rows))
        products = [self._dataset(row) for row in rows]
        return self._drawn.get(name, lambda: panel_markup(key, products, batch))

    def _offer(self, kind: Sequence[BatchPanel | TimePanel], rows: Sequence[ProductRow], batch: int = 0) -> Offer:
        name = (kind is BATCH_PANELS, batch, tuple((row.id, row.sha256) for row in rows))
        return self._offers.get(name, lambda: Offer.of(kind, [self._dataset(row) for row in rows], batch))

    # --- pages ---------------------------------------------------------------------------------------------

    def overview(self, request: Request) -> Response:
        """Campaigns, products and batches, narrowed by filters."""
        products = self.catalog.products()
        filters = Filters.of(request.query_params)
        found = filters.batches(self.catalog)
        places = {(row.campaign, row.archive, row.lineage_key): row.id for row in products}
        page = _whole(request.query_params.get("page", "1"), "page", least=1)
        shown = found[(page - 1) * ROWS : page * ROWS]
        archives = sorted({row.archive for row in products})
        ranks = [
            {name: n for n, name in enumerate(names)}
            for names in (archives, sorted({row.lineage_key for row in shown}))
        ]
        return self._page(
            "overview.html",
            title="Catalog",
            campaigns=_campaigns(products),
            products=[
                row
                for row in products
                if (not filters.campaign or row.campaign == filters.campaign)
                and (not filters.archive or row.archive == filters.archive)
                and row.lineage_key.startswith(filters.settings)
            ][:ROWS],
            total=len(products),
            filters=filters,
            archives=archives,
            found=len(found),
            page=page,
            pages=max(1, -(-len(found) // ROWS)),
            batches=[
                {
                    "row": row,
                    "place": places.get((row.campaign, row.archive, row.lineage_key)),
                    "ranks": (ranks[0].get(row.archive, len(archives)), ranks[1][row.lineage_key]),
                    "flags": flag_names(row.quality_flag),
                    "r0": number(100 * _known(row.r0)),
                    "direct": number(_known(row.scintillation_index)),
                    "profile": number(_known(row.scintillation_index_profile)),
                    "chi2": number(_known(row.chi2)),
                    "sort": [repr(_known(value)) if value is not None else "" for value in
                             (row.r0, row.scintillation_index, row.scintillation_index_profile, row.chi2)],
                }
                for row in shown
            ],
        )  # fmt: skip

    def campaign(self, request: Request) -> Response:
        """Panels over time of the newest product of each archive of a campaign."""
        name = request.path_params["campaign"]
        rows = self.catalog.products(campaign_name=name)
        if not rows:
            raise Refusal(404, f"the catalog has no campaign '{name}'")
        newest = {row.archive_identity: row for row in sorted(rows, key=lambda row: (row.published, row.id))}
        chosen = sorted(newest.values(), key=lambda row: row.start)
        offer = self._offer(TIME_PANELS, chosen)
        key = _panel_key(request, offer, TIME_PANELS)
        return self._page(
            "campaign.html",
            title=name,
            name=name,
            rows=chosen,
            others=len(rows) - len(chosen),
            offer=offer,
            panel=self._panel(key, chosen),
        )

    def product(self, request: Request) -> Response:
        """One product: what it is, its panels over time, its batches, what it can be compared with."""
        row = self._row(request.path_params["product"])
        dataset = self._dataset(row)
        offer = self._offer(TIME_PANELS, [row])
        key = _panel_key(request, offer, TIME_PANELS)
        limit, level, raised = bounds(dataset), levels(dataset), flags(dataset)
        return self._page(
            "product.html",
            title=row.name,
            row=row,
            period=interval(row.start, row.stop),
            offer=offer,
            panel=self._panel(key, [row]),
            formats=list(FORMATS),
            batches=[
                {"start": int(limit[n][0]), "level": int(level[n]), "flags": flag_names(int(raised[n]))}
                for n in range(row.batches)
            ],
            attributes=[
                (str(name), str(value))
                for name, value in dataset.attrs.items()
                if not mapping(value) and len(str(value)) < 200
            ],
            others=[
                other
                for other in self.catalog.products(archive_identity=row.archive_identity)
                if other.id != row.id
            ],
        )  # fmt: skip

    def batch(self, request: Request) -> Response:
        """One batch: any panel, and the profile in numbers."""
        row = self._row(request.path_params["product"])
        n = request.path_params["batch"]
        if n >= row.batches:
            raise Refusal(404, f"{row.name} has {row.batches} batches; there is no number {n}")
        dataset = self._dataset(row)
        offer = self._offer(BATCH_PANELS, [row], n)
        key = _panel_key(request, offer, BATCH_PANELS)
        start, stop = (int(time) for time in bounds(dataset)[n])
        return self._page(
            "batch.html",
            title=f"{row.name}, batch {n}",
            row=row,
            number=n,
            period=interval(start, stop),
            level=int(levels(dataset)[n]),
            flags=flag_names(int(flags(dataset)[n])),
            offer=offer,
            panel=self._panel(key, [row], n),
            formats=list(FORMATS),
            rows=profile_rows(dataset, n) if key == BATCH_PANELS[0].key else [],
        )

    def compare(self, request: Request) -> Response:
        """Two products beside each other."""
        query = request.query_params
        if "a" not in query or "b" not in query:
            raise Refusal(400, "say which products to compare: /compare?a=NUMBER&b=NUMBER; product pages have links")
        rows = [self._row(_whole(query[name], name)) for name in "ab"]
        a, b = (self._dataset(row) for row in rows)
        summary = summary_rows(a, b)
        chosen = _whole(query.get("pair", "0"), "pair")
        if summary and chosen >= len(summary):
            raise Refusal(404, f"there are {len(summary)} pairs of batches; there is no number {chosen}")
        drawn, slices = None, []
        if summary:
            i, j = summary[chosen]["batches"]
            slices = slice_rows(a, b, i, j)
            key = ("compare", i, j, *((row.id, row.sha256) for row in rows))
            drawn = self._drawn.get(key, lambda: {"svg": two_profiles_markup((a, b), (i, j))})
        return self._page(
            "compare.html",
            title="Two lineages",
            rows=rows,
            candidates=self.catalog.products(archive_identity=rows[0].archive_identity),
            differences=differences(a, b),
            summary=summary,
            chosen=chosen,
            slices=slices,
            drawn=drawn,
        )

    def runs(self, request: Request) -> Response:
        """Runs, and what failed in them."""
        failed: dict[str, list[tuple[str, str, str]]] = {}
        for failure in self.catalog.failures():
            when = "" if failure.start is None else clock(failure.start)
            failed.setdefault(failure.run, []).append((failure.archive, when, failure.reason))
        return self._page("runs.html", title="Runs", runs=self.catalog.runs()[::-1][:ROWS], failed=failed)

    # --- files ---------------------------------------------------------------------------------------------

    def figure(self, request: Request) -> Response:
        """A panel as SVG, PNG or PDF."""
        row = self._row(request.path_params["product"])
        key = _one_of(request.path_params["panel"], PANELS)
        form = _one_of(request.path_params["form"], FORMATS)
        n = _whole(request.query_params.get("batch", "0"), "batch")
        if n >= row.batches:
            raise Refusal(404, f"{row.name} has {row.batches} batches; there is no number {n}")
        dataset = self._dataset(row)
        if reason := nothing_to_draw(PANELS[key], [dataset], n):
            raise Refusal(404, f"'{PANELS[key].title}' has nothing to draw here: {reason}")
        content = figure_bytes(key, [dataset], n, form)
        which = f".{n}" if PANELS[key] in BATCH_PANELS else ""
        return _attachment(content, FORMATS[form], f"{row.archive}.{row.lineage_key[:16]}{which}.{key}.{form}")

    def download(self, request: Request) -> Response:
        """A product as its own file, as tables, as NetCDF, or as a report."""
        row = self._row(request.path_params["product"])
        name = f"{row.archive}.{row.lineage_key[:16]}"
        form = _one_of(request.path_params["form"], ("zarr", "csv", "netcdf", "html"))
        if form == "zarr":
            if not row.path.is_file():
                raise Refusal(404, f"{row.path}: the file is gone; 'coslidar catalog verify' lists what is missing")
            return FileResponse(row.path, filename=row.path.name, media_type="application/zip")
        dataset = self._dataset(row)
        if form == "html":
            return _attachment(self._report(dataset).encode(), "text/html; charset=utf-8", f"{name}.html")
        with tempfile.TemporaryDirectory() as folder:
            if form == "netcdf":
                try:
                    written = export.export_netcdf([dataset], Path(folder) / f"{name}.nc")
                except ImportError as error:
                    raise Refusal(501, str(error)) from error
                return _attachment(written.read_bytes(), "application/x-netcdf", written.name)
            out = io.BytesIO()
            with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as bundle:
                for path in export.export_csv([dataset], Path(folder) / f"{name}.csv"):
                    bundle.write(path, path.name)
            return _attachment(out.getvalue(), "application/zip", f"{name}.csv.zip")

    def _report(self, dataset: Dataset) -> str:
        return self._drawn.get(("report", dataset.attrs["lineage_key"]), lambda: {"html": render(dataset)})["html"]

    def static(self, request: Request) -> Response:
        """Style sheets and the report's script."""
        found = _static().get(request.path_params["name"])
        if found is None:
            raise Refusal(404, "there is no such file")
        return Response(found[0], media_type=found[1])


@lru_cache(1)
def _static() -> dict[str, tuple[str, str]]:
    report = files("coslidar.catalog.report")
    return {
        "report.css": (report.joinpath("report.css").read_text("utf-8"), "text/css"),
        "report.js": (report.joinpath("report.js").read_text("utf-8"), "text/javascript"),
        "browser.css": (_text("browser.css"), "text/css"),
    }


def _text(name: str) -> str:
    return files(__package__).joinpath(name).read_text("utf-8")


def _campaigns(products: Sequence[ProductRow]) -> list[dict[str, Any]]:
    names = dict.fromkeys(row.campaign for row in products)
    found = []
    for name in names:
        mine = [row for row in products if row.campaign == name]
        found.append({
            "name": name,
            "archives": len({row.archive_identity for row in mine}),
            "products": len(mine),
            "batches": sum(row.batches for row in mine),
            "period": interval(min(row.start for row in mine), max(row.stop for row in mine)),
        })  # fmt: skip
    return found


def _known(value: float | None) -> float:
    return float("nan") if value is None else value


def _whole(text: str, name: str, least: int = 0) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) >= least):
        raise Refusal(400, f"{name} = '{text[:40]}': write a whole number of {least} or more")
    return int(text)


def _one_of(text: str, known: Sequence[str] | Mapping[str, Any]) -> str:
    if text not in known:
        raise Refusal(404, f"there is no '{text[:40]}' here; there are {', '.join(known)}")
    return text


def _panel_key(request: Request, offer: Offer, kind: Sequence[BatchPanel | TimePanel]) -> str:
    """The panel asked for, be it empty; else the first one that is not."""
    first = (offer.panels or kind)[0].key
    return _one_of(request.query_params.get("panel", first), [panel.key for panel in kind])


def _attachment(content: bytes, media_type: str, name: str) -> Response:
    # Names of campaigns and archives hold letters, digits and . _ - only.
    return Response(content, media_type=media_type, headers={"content-disposition": f'attachment; filename="{name}"'})


__all__ = ["Filters", "Pages", "Refusal"]
