"""The catalog: a folder of products and the database that lists them.

A row is written after its file, in one transaction, so a row always has its file; a process that dies in between
leaves a file without a row, which the next publisher of the same product replaces and :meth:`Catalog.collect` removes.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import socket
import sys
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from time import time, time_ns
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import sqlalchemy as sa

from ..pipeline.lineage import Key, checkout
from ..pipeline.units import safe
from . import provenance as records
from .database import Database, location, number, plain_text
from .heartbeats import alive
from .products import ProductError, check_digest, check_name, open_product, product_bytes, sync_folder, write_temporary
from .scratch import Scratch
from .tables import archive, batch, campaign, failure, lineage, plugin, product, run, schema_version

if TYPE_CHECKING:
    from sqlalchemy.engine import Connection
    from xarray import Dataset

_SUFFIX = ".zarr.zip"
State = Literal["finished", "failed", "cancelled"]


class CatalogError(ValueError):
    """Something asked of a catalog that it does not have."""


@dataclass(frozen=True)
class ProductRow:
    """A product as the catalog lists it; times in ns since 1970 UTC.

    Parameters
    ----------
    id : int
        Number in this catalog.
    campaign, archive, archive_identity, lineage_key : str
        What it is: names, sha256 of the archive, key.
    path : Path
        Its file.
    sha256 : str
        Hash of the file.
    size : int
        Bytes.
    published, start, stop : int
        When it was published; start of its first and end of its last batch.
    batches : int
        How many.
    run : str or None
        Run that published it.
    """

    id: int
    campaign: str
    archive: str
    archive_identity: str
    lineage_key: str
    path: Path
    sha256: str
    size: int
    published: int
    start: int
    stop: int
    batches: int
    run: str | None

    @property
    def name(self) -> str:
        """Campaign, archive and the first digits of the key, for people."""
        return f"{self.campaign}/{self.archive}.{self.lineage_key[:16]}"


@dataclass(frozen=True)
class BatchRow:
    """A batch as the catalog lists it; times in ns since 1970 UTC, None where a number is unknown."""

    campaign: str
    archive: str
    lineage_key: str
    number: int
    start: int
    stop: int
    quality_flag: int
    quality_level: int
    n_frames: int | None
    r0: float | None
    scintillation_index: float | None
    scintillation_index_profile: float | None
    scintillation_index_point: float | None
    mu: float | None
    chi2: float | None


@dataclass(frozen=True)
class RunRow:
    """A run as the catalog lists it; times in ns since 1970 UTC."""

    id: str
    started: int
    finished: int | None
    state: str
    host: str
    pid: int
    command: str
    commit: str
    software: dict[str, str]
    configuration: dict[str, Any]
    heartbeat: int | None
    progress: dict[str, Any] | None


@dataclass(frozen=True)
class FailureRow:
    """An archive, or a batch of one, that a run could not process."""

    run: str
    archive: str
    start: int | None
    stop: int | None
    reason: str
    recorded: int


class Publication(NamedTuple):
    """Outcome of :meth:`Catalog.publish`: the row, and whether it is new."""

    row: ProductRow
    new: bool


class Fault(NamedTuple):
    """A product whose file is not what its row says."""

    row: ProductRow
    reason: str


class Catalog:
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
        relative = f"products/{names['campaign']}/{names['archive']}.{key[:16]}{_SUFFIX}"
        target = self._file(relative)
        there = self._find_one(identity, key)
        if there is not None and there.path.is_file() and not (replace and there.sha256 != _sha256(data)):
            return Publication(there, False)

        fresh = not target.parent.is_dir()
        target.parent.mkdir(parents=True, exist_ok=True)
        if fresh:
            sync_folder(target.parent.parent)
        bounds = dataset["time_bounds"].values.astype(np.int64)
        file = {"sha256": _sha256(data), "size": len(data), "published": time_ns()}
        temporary = write_temporary(data, target.parent)
        try:
            with self.database.write() as connection:
                # Keeps the collector of orphans out until this is committed; on SQLite the whole database does.
                connection.execute(sa.select(schema_version.c.version).with_for_update(read=True))
                archive_id = self._archive_id(connection, names["campaign"], names["archive"], identity, url, header)
                document = json.loads(dataset.attrs["lineage"])
                row = {"key": key, "stage": plain_text(document["nodes"][key]["stage"], 100), "document": document}
                unknown = self.database.insert_new(connection, lineage, row, lineage.c.key) is not None
                if unknown and (plugins := _plugin_rows(document)):
                    connection.execute(sa.insert(plugin), plugins)
                new = self.database.insert_new(
                    connection,
                    product,
                    {
                        "archive_id": archive_id,
                        "lineage_key": key,
                        "run_id": run_id,
                        "path": relative,
                        "start": int(bounds[:, 0].min()),
                        "stop": int(bounds[:, 1].max()),
                        "batches": len(bounds),
                        **file,
                    },
                    product.c.id,
                )
                if new is not None:
                    connection.execute(sa.insert(batch), _batch_rows(dataset, new))
                else:
                    self._same_product(connection, archive_id, key, relative)
                    if target.is_file() and not replace:
                        # Somebody else was faster.
                        temporary.unlink()
                        return Publication(self._row(connection, archive_id, key), False)
                    # Made again: the row outlived its file, which somebody deleted, or a failed batch was tried again.
                    mine = (product.c.archive_id == archive_id) & (product.c.lineage_key == key)
                    number_of_it = connection.scalar(sa.select(product.c.id).where(mine))
                    connection.execute(sa.update(product).where(mine).values(run_id=run_id, **file))
                    connection.execute(sa.delete(batch).where(batch.c.product_id == number_of_it))
                    connection.execute(sa.insert(batch), _batch_rows(dataset, number_of_it))
                os.replace(temporary, target)
                sync_folder(target.parent)
                found = self._row(connection, archive_id, key)
        finally:
            temporary.unlink(missing_ok=True)
        return Publication(found, True)

    def _same_product(self, connection: Connection, archive_id: int, key: str, relative: str) -> None:
        mine = (product.c.archive_id == archive_id) & (product.c.lineage_key == key)
        if connection.scalar(sa.select(product.c.id).where(mine)) is None:
            # Same name, same 16 digits, other key: once in 10^9 catalogs, and then not silently.
            raise CatalogError(f"{relative}: the file name belongs to another product")

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
        given = _timezone(header)
        if given is not None and given != zone:
            connection.execute(sa.update(campaign).where(campaign.c.id == campaign_id).values(timezone=given))
        values = {
            "campaign_id": campaign_id,
            "name": name,
            "identity": identity,
            "url": plain_text(url),
            "header": dict(header or {}),
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
            wanted.append(product.c.lineage_key.startswith(lineage_key, autoescape=True))
        query = _PRODUCTS.where(*wanted).order_by(product.c.start, archive.c.name, product.c.published)
        with self.database.read() as connection:
            return [self._product(row) for row in connection.execute(query)]

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
            Of several products of one archive the one published last.

        Raises
        ------
        CatalogError
            There is none, or several archives answer.
        """
        name = text.removesuffix(_SUFFIX).removeprefix("products/")
        found = [
            row
            for row in self.products()
            if name in (row.archive, f"{row.campaign}/{row.archive}")
            or (row.name.startswith(name) and len(name) > len(f"{row.campaign}/{row.archive}."))
            or (f"{row.archive}.{row.lineage_key}".startswith(name) and len(name) > len(f"{row.archive}."))
            or (len(name) >= 4 and row.lineage_key.startswith(name))
        ]
        if not found:
            raise CatalogError(f"there is no product '{safe(text)}' in {safe(str(self.root))}")
        if len({(row.campaign, row.archive_identity) for row in found}) > 1:
            several = ", ".join(row.name for row in found[:5])
            raise CatalogError(
                f"'{safe(text)}' stands for {len(found)} products, among them {several}; write more of it"
            )
        return max(found, key=lambda row: (row.published, row.id))

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
            wanted.append(product.c.lineage_key.startswith(lineage_key, autoescape=True))
        columns = [column for column in batch.c if column.name != "product_id"]
        query = (
            sa.select(
                campaign.c.name.label("campaign"), archive.c.name.label("archive"), product.c.lineage_key, *columns
            )
            .select_from(batch.join(product).join(archive).join(campaign))
            .where(*wanted)
            .order_by(batch.c.start, batch.c.product_id)
        )
        with self.database.read() as connection:
            return [BatchRow(**row) for row in connection.execute(query).mappings()]

    def open(self, row: ProductRow) -> Dataset:
        """Read a product; see :func:`coslidar.catalog.products.open_product`."""
        return open_product(row.path)

    def provenance(self, row: ProductRow) -> dict[str, Any]:
        """PROV-JSON of a product together with the run that published it."""
        written = json.loads(self.open(row).attrs["provenance"])
        runs = [] if row.run is None else [found for found in self.runs() if found.id == row.run]
        return records.with_run(written, vars(runs[0]), row.lineage_key) if runs else dict(written)

    # --- runs ------------------------------------------------------------------------------------------

    def start_run(self, configuration: Mapping[str, Any] | None = None, command: str | None = None) -> str:
        """Note that a run begins.

        Runs of this host that still pass for running although their process is gone are noted as interrupted.

        Parameters
        ----------
        configuration : mapping, optional
            What was asked for, JSON-able.
        command : str, optional
            Command line; the one of this process where it is absent.

        Returns
        -------
        str
            Identity of the run.
        """
        identity, host, now = uuid.uuid4().hex, socket.gethostname(), time_ns()
        with self.database.write() as connection:
            running = sa.select(run.c.id, run.c.process).where(run.c.state == "running", run.c.host == host)
            gone = [row.id for row in connection.execute(running) if not alive(row.process)]
            if gone:
                connection.execute(sa.update(run).where(run.c.id.in_(gone)).values(state="interrupted"))
            connection.execute(
                sa.insert(run).values(
                    id=identity,
                    started=now,
                    heartbeat=now,
                    state="running",
                    host=host,
                    process=os.getpid(),
                    command=plain_text(command if command is not None else " ".join(sys.argv)),
                    commit=str(checkout()),
                    software=records.software(),
                    configuration=dict(configuration or {}),
                )
            )
        return identity

    def beat(self, run_id: str, progress: Mapping[str, Any] | None = None) -> None:
        """Note that a run is alive; see :attr:`RunRow.heartbeat`.

        Parameters
        ----------
        run_id : str
            From :meth:`start_run`.
        progress : mapping, optional
            How far it is, JSON-able; see :mod:`coslidar.catalog.heartbeats`.
        """
        values: dict[str, Any] = {"heartbeat": time_ns()}
        if progress is not None:
            values["progress"] = dict(progress)
        with self.database.write() as connection:
            connection.execute(sa.update(run).where(run.c.id == run_id).values(**values))

    def finish_run(self, run_id: str, state: State = "finished") -> None:
        """Note that a run ended."""
        with self.database.write() as connection:
            connection.execute(sa.update(run).where(run.c.id == run_id).values(state=state, finished=time_ns()))

    def record_failure(
        self, run_id: str, archive_url: str, reason: str, *, start: int | None = None, stop: int | None = None
    ) -> None:
        """Note an archive, or one of its batches, that could not be processed.

        Parameters
        ----------
        run_id : str
            From :meth:`start_run`.
        archive_url : str
            Which archive.
        reason : str
            Why.
        start, stop : int, optional
            Time of the batch, ns since 1970 UTC.
        """
        values = {
            "run_id": run_id,
            "archive": plain_text(archive_url),
            "start": start,
            "stop": stop,
            "reason": plain_text(reason),
            "recorded": time_ns(),
        }
        with self.database.write() as connection:
            connection.execute(sa.insert(failure).values(**values))

    def runs(self) -> list[RunRow]:
        """All runs, the first one first."""
        with self.database.read() as connection:
            rows = connection.execute(sa.select(*_RUN).order_by(run.c.started)).mappings()
            return [RunRow(**row) for row in rows]

    def failures(self, run_id: str | None = None) -> list[FailureRow]:
        """Failures of one run, or of all, the first one first."""
        query = sa.select(failure).order_by(failure.c.id)
        if run_id is not None:
            query = query.where(failure.c.run_id == run_id)
        with self.database.read() as connection:
            return [
                FailureRow(row.run_id, row.archive, row.start, row.stop, row.reason, row.recorded)
                for row in connection.execute(query)
            ]

    # --- keeping in order ------------------------------------------------------------------------------

    def verify(self, *, fast: bool = False) -> list[Fault]:
        """Compare every file with its row.

        Parameters
        ----------
        fast : bool
            Compare sizes only, not hashes.

        Returns
        -------
        list of Fault
            Empty where all is well.
        """
        faults = []
        for row in self.products():
            try:
                size = row.path.stat().st_size
                if size != row.size:
                    faults.append(Fault(row, f"the file has {size} bytes instead of {row.size}"))
                elif not fast:
                    with open(row.path, "rb") as file:
                        found = hashlib.file_digest(file, "sha256").hexdigest()
                    if found != row.sha256:
                        faults.append(Fault(row, "the file has changed since it was published"))
            except FileNotFoundError:
                faults.append(Fault(row, "the file is missing"))
            except OSError as error:
                faults.append(Fault(row, f"the file cannot be read: {error.strerror}"))
        return faults

    def orphans(self, *, older_than: float = 3600.0) -> list[Path]:
        """Files that belong to no row and to no living publisher; see :meth:`collect`."""
        with self.database.write() as connection:
            return self._orphans(connection, older_than)

    def collect(self, *, older_than: float = 3600.0) -> list[Path]:
        """Remove files that belong to no row and to no living publisher.

        Parameters
        ----------
        older_than : float
            Age in s from which a half-written file counts as left behind; one minute at most where its process is
            known to be gone.

        Returns
        -------
        list of Path
            What was removed.
        """
        with self.database.write() as connection:
            found = self._orphans(connection, older_than)
            for path in found:
                path.unlink(missing_ok=True)
        return found

    def _orphans(self, connection: Connection, older_than: float) -> list[Path]:
        # No publisher is between naming its file and committing its row while this is held.
        connection.execute(sa.select(schema_version.c.version).with_for_update())
        listed = set(connection.scalars(sa.select(product.c.path)))
        found = []
        for path in sorted((self.root / "products").glob("*/*")):
            if path.is_symlink() or not path.is_file():
                continue
            relative = path.relative_to(self.root).as_posix()
            whole = path.name.endswith(_SUFFIX) and not path.name.startswith(".") and relative not in listed
            if whole or _left_behind(path, older_than):
                found.append(path)
        return found

    # --- rows ------------------------------------------------------------------------------------------

    def _file(self, relative: str) -> Path:
        parts = PurePosixPath(relative).parts
        if len(parts) != 3 or parts[0] != "products":
            raise CatalogError(f"{safe(relative)}: this is no path inside a catalog")
        check_name(parts[1], "campaign")
        check_name(parts[2].removesuffix(_SUFFIX)[:-17], "archive")
        return self.root.joinpath(*parts)

    def _product(self, row: Any) -> ProductRow:
        values = dict(row._mapping)
        return ProductRow(**{**values, "path": self._file(values["path"])})

    def _find_one(self, identity: str, key: str) -> ProductRow | None:
        check_digest(identity, "archive_identity")
        check_digest(key, "lineage_key")
        query = _PRODUCTS.where(archive.c.identity == identity, product.c.lineage_key == key)
        with self.database.read() as connection:
            row = connection.execute(query).one_or_none()
        return None if row is None else self._product(row)

    def _row(self, connection: Connection, archive_id: int, key: str) -> ProductRow:
        query = _PRODUCTS.where(product.c.archive_id == archive_id, product.c.lineage_key == key)
        return self._product(connection.execute(query).one())


_RUN = [run.c.process.label("pid") if column.name == "process" else column for column in run.c]

_PRODUCTS = sa.select(
    product.c.id,
    campaign.c.name.label("campaign"),
    archive.c.name.label("archive"),
    archive.c.identity.label("archive_identity"),
    product.c.lineage_key,
    product.c.path,
    product.c.sha256,
    product.c.size,
    product.c.published,
    product.c.start,
    product.c.stop,
    product.c.batches,
    product.c.run_id.label("run"),
).select_from(product.join(archive).join(campaign))


def _timezone(header: Mapping[str, Any] | None) -> str | None:
    site = (header or {}).get("site")
    zone = site.get("timezone") if isinstance(site, Mapping) else None
    return zone if isinstance(zone, str) and len(zone) <= 64 else None


def _plugin_rows(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [
        {
            "lineage_key": document["key"],
            "role": plain_text(role, 20),
            "number": number,
            "name": plain_text(identity["name"], 100),
            "version": identity["version"],
            "parameters": identity.get("parameters", {}),
        }
        for node in document["nodes"].values()
        for role, given in node["plugins"].items()
        for number, identity in enumerate(given if isinstance(given, list) else [given])
    ]


def _batch_rows(dataset: Dataset, product_id: int) -> list[dict[str, Any]]:
    count = dataset.sizes["time"]

    def column(name: str) -> list[float | None]:
        if name not in dataset:
            return [None] * count
        values = np.asarray(dataset[name].values, dtype=np.float64).reshape(count, -1)
        # Of several sources the mean of those that could be measured.
        return [number(np.mean(row[np.isfinite(row)])) if np.isfinite(row).any() else None for row in values]

    bounds = dataset["time_bounds"].values.astype(np.int64)
    flags, levels = dataset["quality_flag"].values, dataset["quality_level"].values
    frames = [int(n) for n in dataset["n_frames"].values] if "n_frames" in dataset else [None] * count
    columns = {
        "r0": column("r0_profile"),
        "scintillation_index": column("scintillation_index_direct"),
        "scintillation_index_profile": column("scintillation_index_profile"),
        "scintillation_index_point": column("scintillation_index_point"),
        "mu": column("mu"),
        "chi2": column("chi2_reduced"),
    }
    return [
        {
            "product_id": product_id,
            "number": i,
            "start": int(bounds[i, 0]),
            "stop": int(bounds[i, 1]),
            "quality_flag": int(flags[i]),
            "quality_level": int(levels[i]),
            "n_frames": frames[i],
            **{name: values[i] for name, values in columns.items()},
        }
        for i in range(count)
    ]


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _left_behind(path: Path, older_than: float) -> bool:
    """Whether a half-written file has lost its writer."""
    match = re.fullmatch(r"\.[0-9a-f]{16}\.([A-Za-z0-9-]*)\.(\d{1,10})\.part", path.name)
    if match is None:
        return False
    here = re.sub(r"[^A-Za-z0-9]", "-", socket.gethostname())[:60]
    # Containers may share a name and not their processes, so even a process that is gone gets a minute.
    gone = match[1] == here and not alive(int(match[2]))
    try:
        return time() - path.stat().st_mtime >= (min(older_than, 60.0) if gone else older_than)
    except FileNotFoundError:
        return False


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
    "RunRow",
    "open_catalog",
]
