"""Commands for what has been computed: catalog and report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ...catalog.store import Catalog, ProductRow

_OUT = click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("results"),
    show_default=True,
    help="Folder of the catalog.",
)


def existing(folder: Path, *, read_only: bool = False) -> Catalog:
    """The catalog in a folder; never makes one."""
    from ...catalog.database import DatabaseError, is_catalog
    from ...catalog.store import Catalog, CatalogError
    from ...pipeline.units import safe
    from ..settings import InputError

    if not is_catalog(folder):
        raise InputError([f"{safe(str(folder))}: there is no catalog; 'coslidar run' makes one, --out names another"])
    try:
        return Catalog(folder, create=False, read_only=read_only)
    except (CatalogError, DatabaseError) as error:
        raise InputError([str(error)]) from error


def _find(catalog: Catalog, text: str) -> ProductRow:
    from ...catalog.store import CatalogError
    from ..settings import InputError

    try:
        return catalog.find(text)
    except CatalogError as error:
        raise InputError([str(error)]) from error


def _time(nanoseconds: int) -> str:
    import numpy as np

    return f"{np.datetime64(nanoseconds, 'ns').astype('datetime64[s]')}Z"


@click.group()
def catalog() -> None:
    """List, show, export and check products."""


@catalog.command("ls")
@_OUT
@click.option("--campaign", help="Only this campaign.")
@click.option("--batches", is_flag=True, help="One line per batch instead of one per product.")
def catalog_ls(out: Path, campaign: str | None, batches: bool) -> None:
    """List products, or their batches."""
    from ..progress import counted

    with existing(out) as opened:
        if not batches:
            rows = opened.products(campaign_name=campaign)
            click.echo(f"{'product':<44} {'start (UTC)':<20} {'batches':>7}  file")
            for row in rows:
                click.echo(f"{row.name:<44} {_time(row.start):<20} {row.batches:>7}  {row.path}")
            click.echo(f"{counted(len(rows), 'product')} in {out}")
            return
        found = opened.batches(campaign_name=campaign)
        click.echo(
            f"{'start (UTC)':<20} {'archive':<24} {'frames':>7} {'r0 (m)':>8} {'scint.':>8} {'profile':>8} "
            f"{'log mu':>6} {'chi2':>6} quality"
        )
        words = ("good", "usable", "bad")

        def number(value: float | None, form: str) -> str:
            return "-" if value is None else format(value, form)

        from math import log10

        for batch in found:
            click.echo(
                f"{_time(batch.start):<20} {batch.archive:<24} {number(batch.n_frames, 'd'):>7} "
                f"{number(batch.r0, '.4f'):>8} {number(batch.scintillation_index, '.4f'):>8} "
                f"{number(batch.scintillation_index_profile, '.4f'):>8} "
                f"{number(log10(batch.mu) if batch.mu else None, '.2f'):>6} {number(batch.chi2, '.2f'):>6} "
                f"{words[batch.quality_level]}"
            )


@catalog.command("runs")
@_OUT
@click.option("--failures", is_flag=True, help="Also every archive and batch that failed in each, and why.")
def catalog_runs(out: Path, failures: bool) -> None:
    """List runs: when each began, how it ended, what failed in it."""
    with existing(out) as opened:
        click.echo(f"{'start (UTC)':<20} {'state':<12} {'failures':>8}  command")
        for made in opened.runs():
            failed = opened.failures(made.id)
            click.echo(f"{_time(made.started):<20} {made.state:<12} {len(failed):>8}  {made.command}")
            for failure in failed if failures else ():
                what = failure.archive if failure.start is None else f"{failure.archive} at {_time(failure.start)}"
                click.echo(f"    {what}: {failure.reason.removeprefix(failure.archive + ': ')}")


@catalog.command("show")
@click.argument("product")
@_OUT
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def catalog_show(product: str, out: Path, as_json: bool) -> None:
    """Show a product (its name, the beginning of its key, or its file): profiles, settings, lineage."""
    import json

    with existing(out) as opened:
        row = _find(opened, product)
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
        click.echo(f"file      {row.path}\nsha256    {row.sha256}\npublished {_time(row.published)}")
        for key, value in dataset.attrs.items():
            if key not in ("lineage", "provenance"):
                click.echo(f"{key:<18} {value}")
        click.echo(f"\n{'z (m)':>9} {'Cn2':>10} {'MAP bar':>10}   m^(-2/3), of the first of {row.batches} batches")
        first = dataset.isel(time=0)
        for z, value, bar in zip(
            first["z"].values, first["cn2"].values, first["cn2_standard_error"].values, strict=True
        ):
            click.echo(f"{z:9.1f} {value:10.2e} {bar:10.1e}")


@catalog.command("export")
@click.argument("product")
@_OUT
@click.option("--format", "form", type=click.Choice(["csv", "netcdf"]), default="csv", show_default=True)
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="File to write.")
def catalog_export(product: str, out: Path, form: str, output: Path) -> None:
    """Write a product as CSV (units in a .json beside it) or NetCDF4."""
    from ...catalog import export
    from ..settings import InputError

    with existing(out) as opened:
        dataset = opened.open(_find(opened, product))
    output.parent.mkdir(parents=True, exist_ok=True)
    try:
        if form == "csv":
            written = export.export_csv([dataset], output)
        else:
            written = [export.export_netcdf([dataset], output)]
    except ImportError as error:
        raise InputError([str(error)]) from error
    for path in written:
        click.echo(path)


@catalog.command("verify")
@_OUT
@click.option("--fast", is_flag=True, help="Compare sizes, not hashes.")
def catalog_verify(out: Path, fast: bool) -> None:
    """Check that every product is what its row says."""
    with existing(out) as opened:
        faults = opened.verify(fast=fast)
        total = len(opened.products())
    for fault in faults:
        click.echo(f"coslidar: {fault.row.path}: {fault.reason}", err=True)
    click.echo(f"{total - len(faults)} of {total} products are sound")
    if faults:
        raise click.exceptions.Exit(1)


@catalog.command("gc")
@_OUT
def catalog_gc(out: Path) -> None:
    """Remove files that no row knows, as a killed run leaves them."""
    with existing(out) as opened:
        removed = opened.collect()
    click.echo(f"{len(removed)} files removed")


@click.command()
@click.argument("inputs", metavar="CAMPAIGN.toml | PRODUCT | FOLDER", nargs=-1, required=True)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), required=True, help="Page (.html).")
@_OUT
def report(inputs: tuple[str, ...], output: Path, out: Path) -> None:
    """Draw one self-contained page: profiles with their bars, correlation maps, criterion curves and more.

    Give a campaign file (the newest product of each of its archives), product files, names or keys in the catalog
    of --out, or the folder of a catalog.
    """
    from ...catalog.products import open_product
    from ...catalog.report import write_report
    from ..settings import InputError

    datasets: list[Any] = []
    title = None
    for item in inputs:
        path = Path(item)
        if item.endswith(".toml"):
            chosen, title = _of_campaign(path)
            datasets += chosen
        elif path.is_dir():
            with existing(path) as opened:
                datasets += [opened.open(row) for row in _newest(opened.products())]
        elif path.is_file():
            datasets.append(open_product(path))
        else:
            with existing(out) as opened:
                datasets.append(opened.open(_find(opened, item)))
    if not datasets:
        raise InputError([f"{', '.join(inputs)}: there is no product yet; 'coslidar run' makes them"])
    output.parent.mkdir(parents=True, exist_ok=True)
    write_report(datasets, output, title=title)
    click.echo(f"{output}: {sum(dataset.sizes['time'] for dataset in datasets)} batches. Open it in a browser.")


def _newest(rows: list[ProductRow]) -> list[ProductRow]:
    """The newest product of each archive, in the order of their time."""
    newest: dict[str, ProductRow] = {}
    for row in sorted(rows, key=lambda row: row.published):
        newest[row.archive_identity] = row
    return sorted(newest.values(), key=lambda row: row.start)


def _of_campaign(path: Path) -> tuple[list[Any], str | None]:
    """Products of a campaign file: those of its settings where they are there, else the newest ones."""
    from ...catalog.archive import ArchiveError
    from ..plan import plan_archive
    from ..settings import InputError, load

    settings = load(path)
    found = []
    with existing(settings.output) as opened:
        rows = opened.products(campaign_name=settings.campaign)
        for url in settings.archives:
            try:
                planned = plan_archive(url, settings)
            except (ArchiveError, InputError):
                continue  # 'coslidar run' and 'inspect' say what is wrong with it
            mine = [row for row in rows if row.archive_identity == planned.archive.identity]
            exact = [row for row in mine if row.lineage_key == str(planned.profile_key)]
            found += [opened.open(row) for row in exact or _newest(mine)]
    return found, settings.campaign
