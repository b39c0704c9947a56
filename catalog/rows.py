"""What the catalog tells of products, batches, runs and failures; and the queries that fetch them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import sqlalchemy as sa

from ..pipeline.units import safe
from .products import check_name
from .tables import archive, batch, campaign, product

SUFFIX = ".zarr.zip"
# Archive, 16 digits of the key, and 8 of the file's hash where it took the place of another.
_FILE = re.compile(r"(?P<archive>.+)\.[0-9a-f]{16}(-[0-9a-f]{8})?")


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
    accepted : int or None
        When it was made the accepted product of its archive; None where it is not.
    timezone : str or None
        Time zone of the campaign, by its IANA name.
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
    accepted: int | None
    timezone: str | None

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
    timezone: str | None


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


@dataclass(frozen=True)
class Release:
    """A name for a set of products."""

    name: str
    created: int
    note: str
    products: int


class Publication(NamedTuple):
    """Outcome of :meth:`Catalog.publish`: the row, and whether it is new."""

    row: ProductRow
    new: bool


class Fault(NamedTuple):
    """A product whose file is not what its row says."""

    row: ProductRow
    reason: str


#: Columns of a :class:`ProductRow`.
PRODUCTS: sa.Select[Any] = sa.select(
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
    product.c.accepted,
    campaign.c.timezone,
).select_from(product.join(archive).join(campaign))

#: Columns of a :class:`BatchRow`.
BATCHES: sa.Select[Any] = sa.select(
    campaign.c.name.label("campaign"),
    archive.c.name.label("archive"),
    product.c.lineage_key,
    *(column for column in batch.c if column.name != "product_id"),
    campaign.c.timezone,
).select_from(batch.join(product).join(archive).join(campaign))


def file_of(root: Path, relative: str) -> Path:
    """File of a product from the path in its row, which is judged before it is used.

    Raises
    ------
    CatalogError, coslidar.catalog.products.ProductError
        The path is none that a catalog gives; it may have been forged.
    """
    parts = PurePosixPath(relative).parts
    name = _FILE.fullmatch(parts[-1].removesuffix(SUFFIX)) if parts else None
    if len(parts) != 3 or parts[0] != "products" or name is None:
        raise CatalogError(f"{safe(relative)}: this is no path inside a catalog")
    check_name(parts[1], "campaign")
    check_name(name["archive"], "archive")
    return root.joinpath(*parts)


def product_row(root: Path, row: Any) -> ProductRow:
    """One row of :data:`PRODUCTS`."""
    values = dict(row._mapping)
    return ProductRow(**{**values, "path": file_of(root, values["path"])})


def key_begins(digits: str) -> sa.ColumnElement[bool]:
    """Condition that the lineage key of a product begins with `digits`; one that an index answers."""
    if not re.fullmatch(r"[0-9a-f]{0,64}", digits):
        return sa.false()
    return sa.and_(product.c.lineage_key >= digits, product.c.lineage_key < digits + "g")
