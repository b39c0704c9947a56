"""The catalog: a folder of products and the database that lists them.

A row is written after its file, in one transaction, so a row always has its file; a process that dies in between
leaves a file without a row, which the next publisher of the same product replaces and :meth:`Catalog.collect` removes.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Any

import numpy as np
import sqlalchemy as sa

from ..pipeline.lineage import Key
from ..pipeline.markup import table
from ..pipeline.units import safe
from . import provenance as records
from .database import Database, location, plain_json, plain_text
from .entries import batch_rows, plugin_rows, timezone_of
from .products import ProductError, check_digest, check_name, open_product, product_bytes, sync_folder, write_temporary
from .query import QueryError, understand
from .releases import Releases, check_unreleased
from .rows import (
    BATCHES,
    PRODUCTS,
    SUFFIX,
    BatchRow,
    CatalogError,
    FailureRow,
    Fault,
    ProductRow,
    Publication,
    Release,
    RunRow,
    file_of,
    key_begins,
    product_row,
)
from .runs import RunLog
from .scratch import Scratch
from .tables import archive, batch, campaign, lineage, plugin, product, schema_version
from .upkeep import Upkeep

if TYPE_CHECKING:
    from sqlalchemy.engine import Connection
    from xarray import Dataset


class Catalog(RunLog, Releases, Upkeep):
    """A folder of products and the database that lists them.

    Any number of threads and processes may use one catalog. An instance belongs to the process that made it; send
    it elsewhere by pickle, not by fork.

    Parameters
    ----------
    root : path
        Folder of the catalog.
    database : str, optional
        SQLAlchemy URL; the SQLite file ``catalog.sqlite`` in `root` where it is absent.
    create : bool
        Make folder and tables where there are none.
    read_only : bool
        Let the database refuse every change; makes nothing.

    Raises
    ------
    CatalogError
        There is no catalog and none is to be made, or `root` cannot be a folder.
    coslidar.catalog.database.DatabaseError
        The database cannot be used.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        database: str | None = None,
        *,
        create: bool = True,
        read_only: bool = False,
    ) -> None:
        self.root = Path(root).absolute()
        create = create and not read_only
        if not create and not self.root.is_dir():
            raise CatalogError(f"{safe(str(self.root))}: there is no catalog; 'coslidar run' makes one")
        try:
            (self.root / "products").mkdir(parents=True, exist_ok=True) if create else None
        except OSError as error:
            raise CatalogError(f"{safe(str(self.root))}: the folder cannot be made: {error.strerror}") from error
        url = location(self.root) if database is None else database
        self._database = database
        self._read_only = read_only
        self.database = Database(url, create=create, read_only=read_only)
        self.scratch = Scratch(self.root / "scratch")

    def __getstate__(self) -> tuple[Path, str | None, bool]:
        return self.root, self._database, self._read_only

    def __setstate__(self, state: tuple[Path, str | None, bool]) -> None:
        self.__init__(*state[:2], read_only=state[2])  # type: ignore[misc]

    def __enter__(self) -> Catalog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self.database.close()

    # --- publishing ------------------------------------------------------------------------------------

    def publish(
        self,
        dataset: Dataset,
        run_id: str | None = None,
        *,
        url: str = "",
        header: Mapping[str, Any] | None = None,
        replace: bool = False,
    ) -> Publication:
        """Make a product part of the catalog.

        The file is written under another name, on the disk before it gets its own, and named before its rows are
        committed. Publishers of the same product, in any number of processes, leave one file and one row.

        Parameters
        ----------
        dataset : xarray.Dataset
            From :func:`coslidar.catalog.products.assemble`.
        run_id : str, optional
            From :meth:`start_run`.
        url : str
            Where the archive was.
        header : mapping, optional
            Header of the archive, JSON-able.
        replace : bool
            Put the product in the place of one that is there and differs, file and rows, as after a batch of it that
            had failed was computed again.

        Returns
        -------
        Publication
            The row, and False where the product was there already; its file is left alone then.

        Raises
        ------
        coslidar.catalog.products.ProductError
            The dataset is no product.
        OSError, sqlalchemy.exc.SQLAlchemyError
            Disk or database refuse. There is no row then.
        """
        data = product_bytes(dataset)
        names = {what: check_name(dataset.attrs[what], what) for what in ("campaign", "archive")}
        identity, key = str(dataset.attrs["archive_identity"]), str(dataset.attrs["lineage_key"])
        digest = hashlib.sha256(data).hexdigest()

        def stays(there: ProductRow) -> bool:
            return there.path.is_file() and not (replace and there.sha256 != digest)

        there = self._find_one(identity, key)
        if there is not None and stays(there):
            return Publication(there, False)

        relative = f"products/{names['campaign']}/{names['archive']}.{key[:16]}{SUFFIX}"
        target = file_of(self.root, relative)
        fresh = not target.parent.is_dir()
        target.parent.mkdir(parents=True, exist_ok=True)
        if fresh:
            sync_folder(target.parent.parent)
        bounds = dataset["time_bounds"].values.astype(np.int64)
        values: dict[str, Any] = {
            "run_id": run_id,
            "path": relative,
            "sha256": digest,
            "size": len(data),
            "published": time_ns(),
            "start": int(bounds[:, 0].min()),
            "stop": int(bounds[:, 1].max()),
            "batches": len(bounds),
        }
        temporary = write_temporary(data, target.parent)
        former: ProductRow | None = None
        try:
            with self.database.write() as connection:
                # Keeps the collector of orphans out until this is committed; on SQLite the whole database does.
                connection.execute(sa.select(schema_version.c.version).with_for_update(read=True))
                archive_id = self._archive_id(connection, names["campaign"], names["archive"], identity, url, header)
                document = json.loads(dataset.attrs["lineage"])
                row = {"key": key, "stage": plain_text(document["nodes"][key]["stage"], 100), "document": document}
                unknown = self.database.insert_new(connection, lineage, row, lineage.c.key) is not None
                if unknown and (plugins := plugin_rows(document)):
                    connection.execute(sa.insert(plugin), plugins)
                mine = (product.c.archive_id == archive_id) & (product.c.lineage_key == key)
                new = {"archive_id": archive_id, "lineage_key": key, **values}
                number = self.database.insert_new(connection, product, new, product.c.id)
                if number is None:
                    number = connection.scalar(sa.select(product.c.id).where(mine).with_for_update())
                    if number is None:
                        # Same name, same 16 digits, other key: once in 10^9 catalogs, and then not silently.
                        raise CatalogError(f"{relative}: the file name belongs to another product")
                    former = self._row(connection, number)
                    if stays(former):
                        # Somebody else was faster.
                        return Publication(former, False)
                    # Made again: the row outlived its file, which somebody deleted, or a failed batch was tried again.
                    if former.sha256 == digest:
                        target = former.path
                    else:
                        check_unreleased(connection, number, former.name)
                        # Under a name of its own, so that whoever dies here leaves no row with the other's hash.
                        values["path"] = f"{relative.removesuffix(SUFFIX)}-{digest[:8]}{SUFFIX}"
                        target = file_of(self.root, values["path"])
                        connection.execute(sa.update(product).where(mine).values(**values))
                        connection.execute(sa.delete(batch).where(batch.c.product_id == number))
                if former is None or former.sha256 != digest:
                    connection.execute(sa.insert(batch), batch_rows(dataset, number))
                os.replace(temporary, target)
                sync_folder(target.parent)
                found = self._row(connection, number)
        finally:
            temporary.unlink(missing_ok=True)
        if former is not None and former.path != found.path:
            former.path.unlink(missing_ok=True)
        return Publication(found, True)

    def _archive_id(
        self,
        connection: Connection,
        campaign_name: str,
        name: str,
        identity: str,
        url: str,
        header: Mapping[str, Any] | None,
    ) -> int:
        self.database.insert_new(connection, campaign, {"name": campaign_name}, campaign.c.id)
        here = sa.select(campaign.c.id, campaign.c.timezone).where(campaign.c.name == campaign_name)
        campaign_id, zone = connection.execute(here).one()
        given = timezone_of(header)
        if given is not None and given != zone:
            connection.execute(sa.update(campaign).where(campaign.c.id == campaign_id).values(timezone=given))
        values = {
            "campaign_id": campaign_id,
            "name": name,
            "identity": identity,
            "url": plain_text(url),
            "header": plain_json(header or {}),
        }
        self.database.insert_new(connection, archive, values, archive.c.id)
        known = sa.select(archive.c.id, archive.c.campaign_id, archive.c.name).where(archive.c.identity == identity)
        row = connection.execute(known).one()
        if (row.campaign_id, row.name) != (campaign_id, name):
            raise CatalogError(
                f"{campaign_name}/{name}: the catalog knows the same recording under another name, {row.name}"
            )
        if url:
            # The archive may have moved since; the newest place is the one to look at.
            connection.execute(sa.update(archive).where(archive.c.id == row.id).values(url=plain_text(url)))
        return int(row.id)

    # --- asking ----------------------------------------------------------------------------------------

    def has(self, archive_identity: str, lineage_key: Key | str) -> bool:
        """Whether a product is there, row and file.

        Parameters
        ----------
        archive_identity : str
            sha256 of the archive.
        lineage_key : Key or str
            Key of the product.
        """
        row = self._find_one(archive_identity, str(lineage_key))
        return row is not None and row.path.is_file()

    def products(
        self,
        *,
        campaign_name: str | None = None,
        archive_name: str | None = None,
        archive_identity: str | None = None,
        lineage_key: str | None = None,
        run_id: str | None = None,
    ) -> list[ProductRow]:
        """Products in the order of their time.

        Parameters
        ----------
        campaign_name, archive_name, archive_identity, run_id : str, optional
            Only those.
        lineage_key : str, optional
            Only those whose key begins so.

        Returns
        -------
        list of ProductRow
        """
        wanted = [
            column == value
            for column, value in (
                (campaign.c.name, campaign_name),
                (archive.c.name, archive_name),
                (archive.c.identity, archive_identity),
                (product.c.run_id, run_id),
            )
            if value is not None
        ]
        if lineage_key is not None:
            wanted.append(key_begins(lineage_key))
        return self._products(*wanted)

    def _products(self, *wanted: sa.ColumnElement[bool]) -> list[ProductRow]:
        query = PRODUCTS.where(*wanted).order_by(product.c.start, archive.c.name, product.c.published)
        with self.database.read() as connection:
            return [product_row(self.root, row) for row in connection.execute(query)]

    def find(self, text: str) -> ProductRow:
        """The one product that a person means.

        Parameters
        ----------
        text : str
            First digits of a lineage key, an archive's name, ``campaign/archive``, or either with ``.<digits of the
            key>`` as in the file name.

        Returns
        -------
        ProductRow
            Of several products of one archive the accepted one, else the one published last.

        Raises
        ------
        CatalogError
            There is none, or several archives answer.
        """
        name = text.removesuffix(SUFFIX).removeprefix("products/")
        place, slash, rest = name.rpartition("/")
        stem, dot, digits = rest.rpartition(".")
        # A file that took the place of another has eight more digits.
        digits = digits.partition("-")[0]
        ways = [archive.c.name == rest]
        if dot and stem and digits:
            ways.append(sa.and_(archive.c.name == stem, key_begins(digits)))
        if not slash and len(name) >= 4:
            ways.append(key_begins(name))
        found = self._products(sa.or_(*ways), *([campaign.c.name == place] if slash else []))
        if not found:
            raise CatalogError(f"there is no product '{safe(text)}' in {safe(str(self.root))}")
        if len({(row.campaign, row.archive_identity) for row in found}) > 1:
            several = ", ".join(row.name for row in found[:5])
            raise CatalogError(
                f"'{safe(text)}' stands for {len(found)} products, among them {several}; write more of it"
            )
        return max(found, key=standing)

    def batches(
        self,
        *,
        campaign_name: str | None = None,
        archive_name: str | None = None,
        lineage_key: str | None = None,
        start: int | None = None,
        stop: int | None = None,
        quality_level: int | None = None,
    ) -> list[BatchRow]:
        """Batches in the order of their time.

        Parameters
        ----------
        campaign_name, archive_name : str, optional
            Only those.
        lineage_key : str, optional
            Only those whose key begins so.
        start, stop : int, optional
            Only batches that begin at `start` or later and before `stop`, ns since 1970 UTC.
        quality_level : int, optional
            Only batches of this level or better.

        Returns
        -------
        list of BatchRow
        """
        wanted = []
        if campaign_name is not None:
            wanted.append(campaign.c.name == campaign_name)
        if archive_name is not None:
            wanted.append(archive.c.name == archive_name)
        if start is not None:
            wanted.append(batch.c.start >= start)
        if stop is not None:
            wanted.append(batch.c.start < stop)
        if quality_level is not None:
            wanted.append(batch.c.quality_level <= quality_level)
        if lineage_key is not None:
            wanted.append(key_begins(lineage_key))
        query = BATCHES.where(*wanted).order_by(batch.c.start, batch.c.product_id)
        with self.database.read() as connection:
            return [BatchRow(**row) for row in connection.execute(query).mappings()]

    def query(self, text: str, *, limit: int | None = None) -> list[BatchRow]:
        """Batches that a query asks for, in the order of their time.

        Parameters
        ----------
        text : str
            Conditions; see :mod:`coslidar.catalog.query`.
        limit : int, optional
            So many at most.

        Returns
        -------
        list of BatchRow

        Raises
        ------
        coslidar.catalog.query.QueryError
            The query cannot be understood, or names a release that does not exist.
        """
        asked = understand(text)
        known = {release.name for release in self.releases()} if any(t.field == "alias" for t in asked.terms) else set()
        unknown = [
            f"query, character {term.position}: alias={safe(name.strip())}: there is no release of this name"
            for term in asked.terms
            if term.field == "alias"
            for name in term.value.split(",")
            if name.strip() not in known
        ]
        if unknown:
            raise QueryError(unknown)
        with self.database.read() as connection:
            return [BatchRow(**row) for row in connection.execute(asked.batches(limit)).mappings()]

    def recording(self, row: ProductRow) -> tuple[str, dict[str, Any]]:
        """Where the archive of a product was last seen, and the header that it was processed with."""
        query = sa.select(archive.c.url, archive.c.header).where(archive.c.identity == row.archive_identity)
        with self.database.read() as connection:
            found = connection.execute(query).one()
        return str(found.url), dict(found.header)

    def open(self, row: ProductRow) -> Dataset:
        """Read a product; see :func:`coslidar.catalog.products.open_product`."""
        return open_product(row.path)

    def profiles(
        self,
        *,
        campaign_name: str | None = None,
        archive_name: str | None = None,
        lineage_key: str | None = None,
        quality_level: int = 1,
    ) -> Dataset:
        """Profiles of many archives as one dataset, in the order of time.

        Parameters
        ----------
        campaign_name, archive_name : str, optional
            Only those.
        lineage_key : str, optional
            Only products whose key begins so; the newest product of each archive where it is absent.
        quality_level : int
            Only batches of this level or better: 0 good, 1 usable with care, 2 bad.

        Returns
        -------
        xarray.Dataset
            As :func:`coslidar.catalog.export.join` makes it.

        Raises
        ------
        CatalogError
            There is none.
        coslidar.catalog.export.ExportError
            They do not fit together.
        """
        from .export import join

        rows = self.products(campaign_name=campaign_name, archive_name=archive_name, lineage_key=lineage_key)
        newest = {row.archive_identity: row for row in sorted(rows, key=lambda row: (row.published, row.id))}
        opened = [self.open(row) for row in newest.values()]
        good = [dataset.isel(time=dataset["quality_level"].values <= quality_level) for dataset in opened]
        found = [dataset for dataset in good if dataset.sizes["time"]]
        if not found:
            raise CatalogError(f"{safe(str(self.root))}: no batch answers; quality_level=2 takes the bad ones too")
        return join(found)

    def _repr_html_(self) -> str:
        """What a notebook shows: campaigns, and how much there is of each."""
        rows = self.products()
        lines = []
        for name in dict.fromkeys(row.campaign for row in rows):
            mine = [row for row in rows if row.campaign == name]
            span = [np.datetime64(time, "ns").astype("datetime64[s]") for time in (mine[0].start, mine[-1].stop)]
            archives = len({row.archive_identity for row in mine})
            lines.append((name, archives, len(mine), sum(row.batches for row in mine), *span))
        heading = ("campaign", "archives", "products", "batches", "from (UTC)", "to (UTC)")
        return table(f"Catalog {self.root}", heading, lines)

    def provenance(self, row: ProductRow) -> dict[str, Any]:
        """PROV-JSON of a product together with the run that published it."""
        written = json.loads(self.open(row).attrs["provenance"])
        made = self.made_by(row)
        return dict(written) if made is None else records.with_run(written, vars(made), row.lineage_key)

    def made_by(self, row: ProductRow) -> RunRow | None:
        """Run that published a product; None where none is known."""
        return next((found for found in self.runs() if found.id == row.run), None) if row.run else None

    def lineage(self, row: ProductRow) -> dict[str, Any]:
        """Lineage document of a product, as its file has it, which may be damaged or gone."""
        query = sa.select(lineage.c.document).where(lineage.c.key == row.lineage_key)
        with self.database.read() as connection:
            return dict(connection.execute(query).scalar_one())

    def _find_one(self, identity: str, key: str) -> ProductRow | None:
        check_digest(identity, "archive_identity")
        check_digest(key, "lineage_key")
        query = PRODUCTS.where(archive.c.identity == identity, product.c.lineage_key == key)
        with self.database.read() as connection:
            row = connection.execute(query).one_or_none()
        return None if row is None else product_row(self.root, row)

    def _row(self, connection: Connection, number: int) -> ProductRow:
        return product_row(self.root, connection.execute(PRODUCTS.where(product.c.id == number)).one())


def standing(row: ProductRow) -> tuple[bool, int, int]:
    """What decides which of the products of an archive counts: the accepted one, else the one published last."""
    return (row.accepted is not None, row.published, row.id)


def open_catalog(
    root: str | os.PathLike[str], database: str | None = None, *, create: bool = False, read_only: bool = False
) -> Catalog:
    """Open a catalog.

    Parameters
    ----------
    root : path
        Its folder.
    database : str, optional
        SQLAlchemy URL of its database; the SQLite file in `root` where it is absent.
    create : bool
        Make it where there is none.
    read_only : bool
        Let the database refuse every change.

    Returns
    -------
    Catalog

    Raises
    ------
    CatalogError, coslidar.catalog.database.DatabaseError
        There is no catalog, or it cannot be used.
    """
    return Catalog(root, database, create=create, read_only=read_only)


__all__ = [
    "BatchRow",
    "Catalog",
    "CatalogError",
    "FailureRow",
    "Fault",
    "ProductError",
    "ProductRow",
    "Publication",
    "Release",
    "RunRow",
    "open_catalog",
    "standing",
]
