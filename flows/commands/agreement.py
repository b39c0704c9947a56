"""Command that puts profiles beside scintillometers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from .options import OUT, SINCE, UNTIL

if TYPE_CHECKING:
    from ...pipeline.comparison import Comparison, Pair

_FILE = click.Path(dir_okay=False, path_type=Path)


@click.command()
@click.argument("inputs", metavar="CAMPAIGN.toml | PRODUCT | FOLDER", nargs=-1, required=True)
@click.option(
    "--campaign",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Campaign file with the scintillometers; the first one among the inputs where it is absent.",
)
@click.option("--average", metavar="DURATION", help="Windows of this length, '30 min'; the batches where it is absent.")
@click.option(
    "--coverage", type=click.FloatRange(0, 1), default=0.5, show_default=True, help="Part of a window with values."
)
@click.option("--whole", is_flag=True, help="All that the scintillometers measured, also where there are no batches.")
@click.option("--csv", "table", type=_FILE, help="Write the values of every window.")
@click.option("-o", "--output", type=_FILE, help="Figure to write (.svg, .png or .pdf).")
@SINCE
@UNTIL
@OUT
def compare(
    inputs: tuple[str, ...],
    campaign: Path | None,
    average: str | None,
    coverage: float,
    whole: bool,
    table: Path | None,
    output: Path | None,
    since: str | None,
    until: str | None,
    out: Path,
) -> None:
    """Compare profiles with scintillometers on the same path.

    Each profile is averaged along the path as the scintillometer weights it, with the error that its posterior gives,
    and put beside what the instrument measured in the same time: ratio, bias, regression, scatter, and the scatter that
    the errors of both explain. The last column says how far the instrument stands from the line of sight; with
    height_scaling = "free_convection" and its heights, profiles are carried to the height of its beam as h^(-4/3).

    \b
    coslidar compare campaign.toml --average '30 min' -o agreement.svg --csv agreement.csv
    """  # noqa: D301
    import numpy as np

    from ...pipeline.units import QuantityError, parse, safe
    from ..agreement import pairs_of, saturated, stations_of
    from ..chosen import choose
    from ..settings import InputError

    files = [Path(item) for item in inputs if item.endswith(".toml")]
    if campaign is None and not files:
        raise InputError(["no campaign file names scintillometers; add --campaign campaign.toml"])
    try:
        window = None if average is None else parse(average, "s", key="--average")
    except QuantityError as error:
        raise InputError([f"--average {safe(str(average))}: {error}"]) from error
    if window is not None and window < 1:
        raise InputError([f"--average {safe(str(average))}: windows of less than a second hold no values"])
    if whole and window is None:
        raise InputError(["--whole: say how long the windows are, --average '1 hour'"])
    if output is not None and output.suffix.lower() not in (".svg", ".png", ".pdf"):
        raise InputError([f"{safe(str(output))}: no figure ends so; write .svg, .png or .pdf"])
    stations = stations_of(campaign or files[0])
    datasets = choose(inputs, out, since=since, until=until).datasets
    pairs = pairs_of(datasets, stations, average=window, coverage=coverage, whole=whole)
    for warning in dict.fromkeys(w for station in stations if station.series for w in station.series.warnings):
        click.echo(f"coslidar: {safe(warning)}", err=True)
    click.echo(
        f"{'scintillometer':<16} {'windows':>7} {'ratio':>14} {'bias (m^(-2/3))':>20} {'slope':>14} {'corr.':>6} "
        f"{'scatter':>8} {'expected':>8} {'saturated':>9}  separation"
    )
    length = float(np.max(datasets[0]["z_bounds"].values))
    for station, pair in zip(stations, pairs, strict=True):
        click.echo(_line(pair, pair.comparison(), saturated(station, pair, length)))
    if table is not None:
        _write(pairs, table)
        click.echo(table)
    if output is not None:
        from ...catalog.report.flux_panels import agreement_figure

        output.parent.mkdir(parents=True, exist_ok=True)
        agreement_figure(pairs, datasets[0].attrs).savefig(output)
        click.echo(output)


def _line(pair: Pair, found: Comparison, beyond: int) -> str:
    def number(value: float, error: float, form: str) -> str:
        return "-" if value != value else f"{value:{form}} ± {error:{form}}" if error == error else f"{value:{form}}"

    return (
        f"{pair.name:<16.16} {found.count:>7} {number(found.ratio, found.ratio_error, '.3f'):>14} "
        f"{number(found.bias, found.bias_error, '.1e'):>20} {number(found.slope, found.slope_error, '.2f'):>14} "
        f"{number(found.correlation, float('nan'), '.3f'):>6} {number(found.scatter, float('nan'), '.3f'):>8} "
        f"{number(found.expected_scatter, float('nan'), '.3f'):>8} {beyond:>9}  {pair.separation.text()}"
    )


def _write(pairs: list[Pair], path: Path) -> None:
    import csv

    import numpy as np

    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        unit = "[m^(-2/3)]"
        writer.writerow(
            ["scintillometer", "time [UTC]", "end [UTC]", f"emulated {unit}", f"emulated error {unit}",
             f"measured {unit}", f"measured error {unit}"]
        )  # fmt: skip
        for pair in pairs:
            for number, (start, stop) in enumerate(pair.bounds):
                row = [float(column[number]) for column in (pair.ours, pair.ours_error, pair.theirs, pair.theirs_error)]
                if np.isfinite([row[0], row[2]]).any():
                    times = [f"{np.datetime64(int(t), 'ns').astype('datetime64[s]')}Z" for t in (start, stop)]
                    writer.writerow([pair.name, *times, *("" if value != value else f"{value:.6g}" for value in row)])
