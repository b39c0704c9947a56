"""Commands that keep a catalog: check, repair, tidy, copy, upgrade it, and say which products count."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .options import OUT
from .results import catalog, existing, find

if TYPE_CHECKING:
    from ...catalog.rows import Fault
    from ...catalog.store import Catalog


@catalog.command("verify")
@OUT
@click.option("--fast", is_flag=True, help="Compare sizes, not hashes: finds what is gone or cut off.")
@click.option("--repair", is_flag=True, help="Compute damaged and missing products again, from their recordings.")
@click.option(
    "--recordings",
    type=click.Path(file_okay=False, exists=True, path_type=Path),
    help="Where relative paths of recordings begin now, for --repair.",
)
def catalog_verify(out: Path, fast: bool, repair: bool, recordings: Path | None) -> None:
    """Check that every product is what its row says.

    Exit code 1 says that a product is not sound. --repair makes it again under its key: with the same software it is
    the same file, byte for byte; where the code has changed since, it says so and changes nothing.

    \b
    coslidar catalog verify --fast                 in a moment, every day
    coslidar catalog verify                        reads every byte
    coslidar catalog verify --repair               and mends what can be mended
    """  # noqa: D301
    with existing(out) as opened:
        faults = opened.verify(fast=fast)
        total = len(opened.products())
        for fault in faults:
            click.echo(f"coslidar: {fault.row.path}: {fault.reason}", err=True)
        bad = _repaired(opened, faults, recordings) if repair else len(faults)
    click.echo(f"{total - bad} of {total} products are sound")
    if bad:
        raise click.exceptions.Exit(1)


def _repaired(opened: Catalog, faults: list[Fault], recordings: Path | None) -> int:
    """Number of products that could not be repaired."""
    from ...pipeline.units import safe
    from ..repair import repair

    bad = 0
    for fault in faults:
        done = repair(opened, fault.row, recordings)
        if done.sound:
            how = "the same bytes" if done.same else f"other bytes: {'; '.join(done.reasons)}"
            click.echo(f"{fault.row.name} is repaired ({safe(how)})")
        else:
            bad += 1
            for reason in done.reasons:
                click.echo(f"coslidar: {fault.row.name} cannot be repaired: {safe(reason)}", err=True)
    return bad


@catalog.command("gc")
@OUT
@click.option("--dry-run", is_flag=True, help="Only say what would be removed.")
@click.option(
    "--older-than", default="1 hour", show_default=True, metavar="DURATION",
    help="Age from which a half-written file of another machine counts as left behind.",
)  # fmt: skip
def catalog_gc(out: Path, dry_run: bool, older_than: str) -> None:
    """Remove files that no row knows, as a killed run leaves them.

    Runs may go on meanwhile: what a living one is writing stays.
    """
    from ...pipeline.units import QuantityError, parse
    from ..progress import counted
    from ..settings import InputError

    try:
        age = parse(older_than, "s", key="--older-than")
    except QuantityError as error:
        raise InputError([f"--older-than = '{older_than}': {error.reason}"]) from error
    with existing(out) as opened:
        found = opened.orphans(older_than=age) if dry_run else opened.collect(older_than=age)
    for path in found:
        click.echo(path)
    click.echo(f"{counted(len(found), 'file')} {'would be ' if dry_run else ''}removed")


@catalog.command("backup")
@click.argument("destination", type=click.Path(file_okay=False, path_type=Path))
@OUT
def catalog_backup(destination: Path, out: Path) -> None:
    """Copy the catalog, rows and files of one moment, while runs go on.

    The copy is a catalog itself: any command takes it as --out. Done again to the same place, only what is new is
    copied. A catalog on PostgreSQL becomes one on SQLite.

    \b
    coslidar catalog backup /media/disk/results
    coslidar catalog verify --out /media/disk/results
    """  # noqa: D301
    from ...catalog.backup import backup
    from ...catalog.store import CatalogError
    from ..progress import counted
    from ..settings import InputError, Unavailable

    with existing(out) as opened:
        try:
            done = backup(opened, destination)
        except CatalogError as error:
            raise InputError([str(error)]) from error
        except OSError as error:
            raise Unavailable(f"{destination}: the backup cannot be written: {error.strerror}") from error
    for fault in done.faults:
        click.echo(f"coslidar: {fault.row.path}: {fault.reason}", err=True)
    click.echo(
        f"{counted(done.copied, 'product')} copied to {destination}, {done.present} there already"
        + (f", {len(done.faults)} not copied" if done.faults else "")
    )
    if done.faults:
        raise click.exceptions.Exit(1)


@catalog.command("promote")
@click.argument("products", metavar="PRODUCT...", nargs=-1, required=True)
@OUT
@click.option("--undo", is_flag=True, help="Take the distinction away: the newest product counts again.")
def catalog_promote(products: tuple[str, ...], out: Path, undo: bool) -> None:
    """Make a product the accepted one of its recording.

    Of several products of one recording the accepted one counts, else the newest: for names without a key, for
    reports, and for 'current=yes' in a query.

    \b
    coslidar catalog promote demo/r0.78128ac8
    """  # noqa: D301
    with existing(out) as opened:
        rows = [find(opened, product) for product in products]
        for row in rows:
            opened.promote(row, accepted=not undo)
            click.echo(f"{row.name} is {'no longer' if undo else 'now'} the accepted product of {row.archive}")


@catalog.command("alias")
@click.argument("name", required=False)
@click.argument("products", metavar="[PRODUCT]...", nargs=-1)
@OUT
@click.option("--query", help="Products of the batches that this finds; see 'coslidar catalog query'.")
@click.option("--note", default="", help="What the release is for.")
@click.option("--withdraw", is_flag=True, help="Forget the release; its products stay.")
def catalog_alias(
    name: str | None, products: tuple[str, ...], out: Path, query: str | None, note: str, withdraw: bool
) -> None:
    """Name a set of products, as for a paper; without NAME list the names, with NAME alone its products.

    A release has one product of a recording at most. Its products keep their bytes for as long as it names them, and
    the name never gets others. Queries ask for alias=NAME, and 'coslidar report NAME' draws it.

    \b
    coslidar catalog alias paper-v1 --query 'current=yes campaign=lannemezan quality<=usable' --note 'Figs. 5 to 9'
    coslidar catalog alias paper-v1
    """  # noqa: D301
    from ...catalog.products import ProductError
    from ...catalog.query import QueryError
    from ...catalog.query_times import utc_text
    from ...catalog.store import CatalogError
    from ...pipeline.units import safe
    from ..progress import counted
    from ..settings import InputError

    with existing(out) as opened:
        try:
            if name is None:
                for made in opened.releases():
                    size = counted(made.products, "product")
                    click.echo(f"{made.name:<24} {utc_text(made.created)}  {size:>12}  {safe(made.note)}".rstrip())
            elif withdraw:
                opened.withdraw(name)
                click.echo(f"{name} is forgotten; its products stay")
            elif not products and query is None:
                rows = opened.released(name)
                if not rows:
                    raise CatalogError(f"there is no release '{safe(name)}'")
                for row in rows:
                    click.echo(f"{row.name:<44} {utc_text(row.start)}  {row.sha256}")
            else:
                rows = [find(opened, product) for product in products]
                if query is not None:
                    keys = {row.lineage_key for row in opened.query(query)}
                    rows += [row for row in opened.products() if row.lineage_key in keys]
                made = opened.release(name, rows, note)
                click.echo(f"{name} names {counted(made.products, 'product')}")
        except QueryError as error:
            raise InputError(error.faults) from error
        except (CatalogError, ProductError) as error:
            raise InputError([str(error)]) from error


@catalog.command("upgrade")
@OUT
def catalog_upgrade(out: Path) -> None:
    """Bring a catalog of an older coslidar up to date; nothing in it is lost.

    All steps are one transaction. An SQLite catalog is copied first, to a file beside it.
    """
    from ...catalog.database import Database, DatabaseError, OldTables, is_catalog, keep_copy, location
    from ...pipeline.units import safe
    from ..settings import InputError

    if not is_catalog(out):
        raise InputError([f"{safe(str(out))}: there is no catalog; --out names another"])
    try:
        url = location(out.absolute())
        try:
            Database(url, create=False).close()
        except OldTables:
            copy = keep_copy(url)
            Database(url, create=False, upgrade=True).close()
            click.echo(f"{out} is up to date" + ("" if copy is None else f"; as it was before: {copy}"))
        else:
            click.echo(f"{out} is up to date already")
    except DatabaseError as error:
        raise InputError([str(error)]) from error


@catalog.command("create")
@OUT
@click.option("--database", metavar="URL", help="postgresql://USER@HOST/NAME instead of a file in the folder.")
def catalog_create(out: Path, database: str | None) -> None:
    """Make an empty catalog, on PostgreSQL where many runs on many machines share it.

    Only a catalog on PostgreSQL needs this: 'coslidar run' makes any other. The URL is kept in the folder, which all
    machines must see; a password is not part of it, but stands in ~/.pgpass or PGPASSWORD on each of them.

    \b
    coslidar catalog create --out /data/results --database postgresql://me@server/coslidar
    """  # noqa: D301
    from ...catalog.database import DatabaseError, is_catalog, remember
    from ...catalog.store import Catalog, CatalogError
    from ..settings import InputError

    if is_catalog(out):
        raise InputError([f"{out}: there is a catalog already"])
    try:
        Catalog(out, database).close()
        if database is not None:
            remember(out.absolute(), database)
    except (CatalogError, DatabaseError) as error:
        raise InputError([str(error)]) from error
    click.echo(f"{out} is a catalog now. Next: coslidar run CAMPAIGN.toml --out {out}")
