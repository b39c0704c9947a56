"""Command that writes products and measurements in the formats of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .options import LINEAGE, OUT, SINCE, UNTIL

if TYPE_CHECKING:
    from ..chosen import Chosen

#: Format -> ending of its files.
_ENDINGS = {"csv": "csv", "parquet": "parquet", "netcdf": "nc", "aot": "fits"}


def _attributes(ctx: click.Context, parameter: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    found = {}
    for value in values:
        name, equals, text = value.partition("=")
        if not equals or not name.strip():
            raise click.BadParameter(f"'{value}': write NAME=TEXT, as creator_name='J. Doe'", ctx, parameter)
        found[name.strip()] = text.strip()
    return found


@click.command()
@click.argument("inputs", metavar="CAMPAIGN.toml | PRODUCT | FOLDER", nargs=-1, required=True)
@click.option(
    "--format",
    "form",
    type=click.Choice(list(_ENDINGS)),
    help="What to write.  [default: by the ending of the file; csv into a folder]",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    help="File to write all to, or an existing folder: a file a day then, named by site, quantity and day.",
)
@SINCE
@UNTIL
@LINEAGE
@click.option("--cf-strict", is_flag=True, help="NetCDF: leave out units that UDUNITS cannot read.")
@click.option("--attribute", "attributes", multiple=True, metavar="NAME=TEXT", callback=_attributes,
              help="NetCDF: a global attribute of ACDD, as creator_name, license.")  # fmt: skip
@OUT
def export(
    inputs: tuple[str, ...],
    form: str | None,
    output: Path,
    since: str | None,
    until: str | None,
    lineage: str | None,
    cf_strict: bool,
    attributes: dict[str, str],
    out: Path,
) -> None:
    """Write products as CSV (units in a .json beside it), NetCDF4 after CF and ACDD, or Parquet.

    --format aot writes the slopes and fluxes of a campaign's recordings as AOT telemetry, a FITS file for each: those
    that a run kept (keep = ["measurements"]), and else measured now from the frames.
    """
    from ...catalog.export import ExportError
    from ..chosen import choose
    from ..settings import InputError

    if not output.is_dir() and not output.suffix:
        raise InputError([f"{output}: there is no such folder; make it first, or name a file with an ending"])
    if form is None:
        endings = {f".{ending}": name for name, ending in _ENDINGS.items()}
        if not output.is_dir() and output.suffix not in endings:
            raise InputError([f"{output}: no export ends so; write one of {', '.join(endings)}, or say --format"])
        form = "csv" if output.is_dir() else endings[output.suffix]
    if form != "netcdf" and (cf_strict or attributes):
        raise InputError([f"--cf-strict and --attribute are for --format netcdf; {form} has neither"])
    try:
        if form == "aot":
            written = _telemetry(inputs, output, (since, until, lineage))
        else:
            written = _products(choose(inputs, out, since=since, until=until, lineage=lineage), form, output, cf_strict,
                                attributes)  # fmt: skip
    except ExportError as error:
        raise InputError([str(error)]) from error
    for path in written:
        click.echo(path)


def _products(chosen: Chosen, form: str, output: Path, strict: bool, attributes: dict[str, str]) -> list[Path]:
    import numpy as np

    from ...catalog import export as formats

    def write(datasets: Any, path: Path) -> list[Path]:
        if form == "csv":
            return formats.export_csv(datasets, path)
        if form == "parquet":
            return formats.export_parquet(datasets, path)
        created = None if chosen.made is None else np.datetime64(chosen.made, "ns")
        return [formats.export_netcdf(datasets, path, strict=strict, created=created, attributes=attributes)]

    if not output.is_dir():
        return write(chosen.datasets, output)
    attrs = chosen.datasets[0].attrs
    site = str(attrs.get("site_name", attrs["campaign"]))
    return [
        file
        for day, parts in formats.by_day(chosen.datasets).items()
        for file in write(parts, output / formats.file_name(site, "cn2", day, _ENDINGS[form]))
    ]


def _telemetry(inputs: tuple[str, ...], output: Path, unused: tuple[str | None, ...]) -> list[Path]:
    from ..settings import InputError
    from ..telemetry import export_recordings

    if len(inputs) != 1 or not inputs[0].endswith(".toml"):
        raise InputError(["--format aot needs one campaign file: slopes and fluxes belong to recordings, not products"])
    if any(unused):
        raise InputError(["--from, --to and --lineage choose products; --format aot writes whole recordings"])
    return export_recordings(Path(inputs[0]), output)
