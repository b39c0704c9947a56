"""Commands for what has been computed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .options import OUT

if TYPE_CHECKING:
    from ...catalog.store import Catalog, ProductRow


def existing(folder: Path, *, read_only: bool = False) -> Catalog:
    """The catalog in a folder; never makes one."""
    from ...catalog.database import DatabaseError, is_catalog
    from ...catalog.store import Catalog, CatalogError
    from ...pipeline.units import safe
    from ..settings import InputError

    if not is_catalog(folder):
        if (campaign := folder / "campaign.toml").is_file():
            raise InputError([f"{safe(str(folder))}: there is no catalog, but a campaign; name {safe(str(campaign))}"])
        raise InputError([f"{safe(str(folder))}: there is no catalog; 'coslidar run' makes one, --out names another"])
    try:
        return Catalog(folder, create=False, read_only=read_only)
    except (CatalogError, DatabaseError) as error:
        raise InputError([str(error)]) from error


def find(catalog: Catalog, text: str) -> ProductRow:
    """The product that a person means."""
    from ...catalog.store import CatalogError
    from ..settings import InputError

    try:
        return catalog.find(text)
    except CatalogError as error:
        raise InputError([str(error)]) from error


@click.group()
def catalog() -> None:
    """List, find, compare, cite and keep products.

    \b
    coslidar catalog ls                                   what there is
    coslidar catalog query 'quality=good r0>10 cm'        batches by what came out of them
    coslidar catalog diff demo/r0.78128ac8 demo/r0.dd832e33
    coslidar catalog promote demo/r0.78128ac8             the product that counts for its recording
    coslidar catalog alias paper-v1 --query 'current=yes campaign=demo'
    coslidar catalog backup /media/disk/results           and 'verify' of it from time to time
    """  # noqa: D301


@catalog.command("ls")
@OUT
@click.option("--campaign", help="Only this campaign.")
@click.option("--batches", is_flag=True, help="One line per batch instead of one per product.")
def catalog_ls(out: Path, campaign: str | None, batches: bool) -> None:
    """List products, or their batches, with their local times; * marks accepted products.

    'coslidar catalog query' chooses batches by their numbers.
    """
    from ...catalog import listing
    from ...catalog.query_times import local_text, utc_text
    from ..progress import counted

    with existing(out) as opened:
        if batches:
            click.echo(listing.table(opened.batches(campaign_name=campaign)), nl=False)
            return
        rows = opened.products(campaign_name=campaign)
    click.echo(f"{'product':<44}   {'start (UTC)':<20}  {'local time':<25} {'batches':>7}  file")
    for row in rows:
        mark = "*" if row.accepted is not None else " "
        click.echo(
            f"{row.name:<44} {mark} {utc_text(row.start):<20}  {local_text(row.start, row.timezone) or '-':<25} "
            f"{row.batches:>7}  {row.path}"
        )
    click.echo(f"{counted(len(rows), 'product')} in {out}")


@catalog.command("runs")
@OUT
@click.option("--failures", is_flag=True, help="Also every archive and batch that failed in each, and why.")
def catalog_runs(out: Path, failures: bool) -> None:
    """List runs: when each began, how it ended, what failed in it."""
    from ...catalog.query_times import utc_text
    from ...pipeline.units import safe

    with existing(out) as opened:
        runs, failed = opened.runs(), opened.failures()
    click.echo(f"{'start (UTC)':<20} {'state':<12} {'failures':>8}  command")
    for made in runs:
        mine = [failure for failure in failed if failure.run == made.id]
        click.echo(f"{utc_text(made.started):<20} {made.state:<12} {len(mine):>8}  {safe(made.command)}")
        for failure in mine if failures else ():
            what = failure.archive if failure.start is None else f"{failure.archive} at {utc_text(failure.start)}"
            click.echo(f"    {safe(what)}: {safe(failure.reason.removeprefix(failure.archive + ': '))}")


@catalog.command("show")
@click.argument("product")
@OUT
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def catalog_show(product: str, out: Path, as_json: bool) -> None:
    """Show a product (its name, the beginning of its key, or its file): profiles, settings, lineage."""
    import json

    from ...catalog.query_times import utc_text
    from ...pipeline.units import safe

    with existing(out) as opened:
        row = find(opened, product)
        dataset = opened.open(row)
        if as_json:
            content = {
                "name": row.name,
                "path": str(row.path),
                "sha256": row.sha256,
                "attributes": {
                    key: json.loads(value) if key in ("lineage", "provenance") else value
                    for key, value in dataset.attrs.items()
                },
                "cn2": dataset["cn2"].values.tolist(),
                "cn2_standard_error": dataset["cn2_standard_error"].values.tolist(),
                "z": dataset["z"].values.tolist(),
            }
            click.echo(json.dumps(content, indent=1, default=str))
            return
        click.secho(row.name, bold=True)
        click.echo(f"file      {row.path}\nsha256    {row.sha256}\npublished {utc_text(row.published)}")
        for key, value in dataset.attrs.items():
            if key not in ("lineage", "provenance"):
                click.echo(f"{key:<18} {safe(str(value))}")
        click.echo(f"\n{'z (m)':>9} {'Cn2':>10} {'MAP bar':>10}   m^(-2/3), of the first of {row.batches} batches")
        first = dataset.isel(time=0)
        for z, value, bar in zip(
            first["z"].values, first["cn2"].values, first["cn2_standard_error"].values, strict=True
        ):
            click.echo(f"{z:9.1f} {value:10.2e} {bar:10.1e}")
