"""Command that tells what profiles mean for an optical link."""

from __future__ import annotations

from pathlib import Path

import click

from .options import OUT, SINCE, UNTIL


@click.command()
@click.argument("inputs", metavar="CAMPAIGN.toml | PRODUCT | FOLDER", nargs=-1, required=True)
@click.option("--wavelength", metavar="LENGTH", required=True, help="Wavelength of the link, '1.55 um'.")
@click.option(
    "--direction",
    type=click.Choice(["toward", "away"]),
    default="toward",
    show_default=True,
    help="Light goes toward the pupil, as that of the sources, or away from it: the receiver is where it ends.",
)
@click.option(
    "--wave",
    type=click.Choice(["spherical", "plane"]),
    default="spherical",
    show_default=True,
    help="From a point of the transmitter, or as if from infinity.",
)
@click.option("--wind", metavar="SPEED", help="Wind across the path, '3 m/s'; without it there is no coherence time.")
@click.option(
    "--format",
    "form",
    type=click.Choice(["table", "csv", "json"]),
    default="table",
    show_default=True,
    help="A table to read, or what other programs read (SI units).",
)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="File to write.")
@SINCE
@UNTIL
@OUT
def link(
    inputs: tuple[str, ...],
    wavelength: str,
    direction: str,
    wave: str,
    wind: str | None,
    form: str,
    output: Path | None,
    since: str | None,
    until: str | None,
    out: Path,
) -> None:
    """Tell what profiles mean for an optical link along the same path.

    For each batch: Fried parameter r0 and isoplanatic angle at the receiver, coherence time if a wind is given, and the
    Rytov variance of a point receiver. Values are those of the retrieved profile, intervals those of its posterior
    (68 %), which counts what the data hardly see: it may lie beside the value where a parameter hangs on the far end of
    the path. 'strong' marks batches whose Rytov variance is 0.3 or more: first-order theory no longer holds there to a
    few per cent.

    Direction matters: turbulence beside the receiver costs r0, turbulence beside the transmitter does not. Cn2 is taken
    as that of the profiler's light; in dry air it differs by a few per cent at most between the visible and 4 um.

    \b
    coslidar link campaign.toml --wavelength '1.55 um' --wind '3 m/s'
    coslidar link demo/r0.78128ac8 --wavelength '1.55 um' --direction away --format csv -o downlink.csv
    """  # noqa: D301
    from ...pipeline.units import QuantityError, parse, safe
    from ..chosen import choose
    from ..links import Link, as_csv, as_json, as_table, rows_of
    from ..settings import InputError

    faults: list[str] = []

    def quantity(option: str, given: str, unit: str, example: str) -> float:
        try:
            value = parse(given, unit, key=option)
        except QuantityError as error:
            faults.append(f"{option} {safe(given)}: {error}")
            return 0.0
        if not value > 0:
            faults.append(f"{option} {safe(given)}: must be greater than 0, as in {option} '{example}'")
        return value

    length = quantity("--wavelength", wavelength, "m", "1.55 um")
    speed = None if wind is None else quantity("--wind", wind, "m/s", "3 m/s")
    if faults:
        raise InputError(faults)
    asked = Link(
        length,
        "toward_pupil" if direction == "toward" else "toward_sources",
        "plane" if wave == "plane" else "spherical",
        speed,
    )
    rows = rows_of(choose(inputs, out, since=since, until=until).datasets, asked)
    written = {"table": lambda: as_table(rows, asked) + "\n", "csv": lambda: as_csv(rows),
               "json": lambda: as_json(rows, asked)}[form]()  # fmt: skip
    if output is None:
        click.echo(written, nl=False)
        return
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(written, encoding="utf-8")
    except OSError as error:
        raise InputError([f"{safe(str(output))}: the file cannot be written: {error.strerror}"]) from error
    click.echo(output)
