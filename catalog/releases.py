"""Which product of an archive counts, and names for sets of products."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING

import sqlalchemy as sa

from ..pipeline.units import safe
from .database import Database, plain_text
from .products import check_name
from .rows import PRODUCTS, CatalogError, ProductRow, Release, product_row
from .tables import alias, alias_product, archive, product

if TYPE_CHECKING:
    from sqlalchemy.engine import Connection


class Releases:
    """Accepted products and releases of a catalog."""

    root: Path
    database: Database

    def promote(self, row: ProductRow, *, accepted: bool = True) -> None:
        """Make a product the accepted one of its archive, in the place of the one that was.

        Parameters
        ----------
        row : ProductRow
            From this catalog.
        accepted : bool
            False takes the distinction away; the product published last counts then.
        """
        with self.database.write() as connection:
            mine = sa.select(product.c.archive_id).where(product.c.id == row.id)
            number = connection.scalar(mine)
            if number is None:
                raise CatalogError(f"{row.name}: the catalog has no such product any more")
            # Of two who promote at once the second waits here.
            connection.execute(sa.select(archive.c.id).where(archive.c.id == number).with_for_update())
            connection.execute(sa.update(product).where(product.c.archive_id == number).values(accepted=None))
            if accepted:
                connection.execute(sa.update(product).where(product.c.id == row.id).values(accepted=time_ns()))

    def release(self, name: str, rows: Iterable[ProductRow], note: str = "") -> Release:
        """Give a set of products a name.

        Parameters
        ----------
        name : str
            For example ``paper-v1``; letters, digits, ``.``, ``_`` and ``-``.
        rows : iterable of ProductRow
            The products. None can go, or change its bytes, as long as the release has this name for it.
        note : str
            What it is for.

        Returns
        -------
        Release

        Raises
        ------
        CatalogError
            The name is taken, there is no product, or two products are of one archive.
        coslidar.catalog.products.ProductError
            The name cannot be one.
        """
        check_name(name, "release")
        chosen = {row.id: row for row in rows}
        if not chosen:
            raise CatalogError(f"{name}: a release needs at least one product")
        archives: dict[str, ProductRow] = {}
        for row in chosen.values():
            other = archives.setdefault(row.archive_identity, row)
            if other is not row:
                raise CatalogError(
                    f"{name}: {other.name} and {row.name} are of one archive; a release names one of them"
                )
        values = {"name": name, "created": time_ns(), "note": plain_text(note)}
        with self.database.write() as connection:
            if self.database.insert_new(connection, alias, values, alias.c.name) is None:
                raise CatalogError(f"{name}: there is a release of this name; names of releases do not change")
            connection.execute(sa.insert(alias_product), [{"alias": name, "product_id": number} for number in chosen])
        return Release(name, int(str(values["created"])), str(values["note"]), len(chosen))

    def withdraw(self, name: str) -> None:
        """Forget a release; its products stay.

        Raises
        ------
        CatalogError
            There is none of this name.
        """
        with self.database.write() as connection:
            gone = connection.execute(sa.delete(alias).where(alias.c.name == name).returning(alias.c.name)).scalar()
        if gone is None:
            raise CatalogError(f"there is no release '{safe(name)}'")

    def releases(self) -> list[Release]:
        """All releases, the first one first."""
        counted = sa.func.count(alias_product.c.product_id)
        query = (
            sa.select(alias.c.name, alias.c.created, alias.c.note, counted)
            .select_from(alias.outerjoin(alias_product))
            .group_by(alias.c.name, alias.c.created, alias.c.note)
            .order_by(alias.c.created, alias.c.name)
        )
        with self.database.read() as connection:
            return [Release(*row) for row in connection.execute(query)]

    def released(self, name: str) -> list[ProductRow]:
        """Products of a release in the order of their time; none where there is no such release."""
        query = (
            PRODUCTS.join(alias_product, alias_product.c.product_id == product.c.id)
            .where(alias_product.c.alias == name)
            .order_by(product.c.start, archive.c.name)
        )
        with self.database.read() as connection:
            return [product_row(self.root, row) for row in connection.execute(query)]


def check_unreleased(connection: Connection, product_id: int, name: str) -> None:
    """Refuse to change a product that a release names."""
    query = sa.select(alias_product.c.alias).where(alias_product.c.product_id == product_id).order_by("alias")
    if (found := connection.scalars(query).first()) is not None:
        raise CatalogError(
            f"{name}: the release '{found}' names this product, and what was made now has other bytes; "
            f"'coslidar catalog alias {found} --withdraw' lets it go"
        )
