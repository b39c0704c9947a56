"""Commands to begin with: init, inspect, simulate."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_CAMPAIGN = """\
# A coslidar campaign. Quantities are text with their unit: "3 min", "7 cm". Lines that begin with # show defaults.

{campaign}archives = {archives}
output = "results"                  # folder of the catalog and its products
# preset = "sauvage-2021"           # settings of the published campaign, under all that this file says
# keep = ["measurements"]           # slopes and fluxes too, 1 kB a frame: other correlations then read no frame

[batch]
duration = "{duration}"             # averaging window of one profile
# minimum = 0.5                     # part of it that the end of an archive must fill to be a batch of its own

[extraction]
# method = "subpixel_window"        # or "moving_maximum"
# window_x = "17 pixel"             # as large as box and sources allow, where absent
# window_y = "10 pixel"
# passes = 3

[correlation]
# covariance = "lagged"             # frames correlated in time; or "independent"
# sources = "both"                  # or "first", "second"
# vibration = "absorbed"            # by the inversion's constant; or "subtracted"
# flux_trend = "0.1 Hz"             # divide out slower changes of the light; off where absent

[response]
# slices = 12
# sampling = "mean"                 # over each slice; or "midpoint"
# slope_response = "centroid"       # or "printed"
# aperture = "square"               # or "circular"
# tilt = "gradient"                 # or "zernike": best-fitting plane
# band = "3.4 um:4.2 um"            # or {{file = "filter.csv", unit = "um"}}; one wavelength where absent
# scintillation = "first_order"     # or "extended_rytov", for moderate strength
# extent = "2 km"                   # end of the slices; needed for sources at infinity

[inversion]
# estimator = "map"                 # most probable profile; or "posterior_mean"
# subset = "all"                    # or "slopes", "scintillation", "auto", "cross"
# noise_bias = "joint"              # detection noise as an unknown; or "none"
# flux_noise = "measured"           # that of the fluxes from dark pixels and photons; or "joint"
# slope_offset = "joint"            # or "none"

# Plugins: 'coslidar plugins ls' lists them, 'coslidar plugins describe NAME' shows their parameters.
[source]
name = "gaussian"                   # FWHM from the archives where absent: fwhm_x = "8.9 cm", fwhm_y = "6.3 cm"

[spectrum]
name = "kolmogorov"                 # or "von_karman" with outer_scale = "30 m", ...

[regulariser]
name = "white"

[selector]
name = "gcv"                        # or "fixed" with mu = "1e27 m^(4/3)", ...

[run]
# scheduler = "tcp://10.0.0.1:8786" # a Dask cluster, or its scheduler file; this machine where absent
# threads = 2

# What the archives' headers lack or have wrong can be put right here, with the same keys:
# [path]
# length = "2670 m"

# Other instruments, weather and terrain make comparisons and heat fluxes of the profiles (docs/fluxes.md):
# [[scintillometers]]
# name = "A"
# wavelength = "0.88 um"
# diameters = ["5 cm", "14.5 cm"]     # at the pupil's end and at the sources' end
# series = {{file = "las.csv"}}         # Scintec .mnd, NetCDF, or CSV with units
# [meteorology]
# file = "weather.csv"
# [terrain]
# file = "transect.csv"
# pupil_height = "20 m"
# sources_height = "25 m"
"""


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(file_okay=False, path_type=Path))
@click.option("--scenario", help="Also simulate this scenario into DIR/raw: a shipped name, or a file (.toml).")
@click.option("--force", is_flag=True, help="Replace a campaign file that is there.")
def init(folder: Path, scenario: str | None, force: bool) -> None:
    """Write DIR/campaign.toml to begin with; every setting stands in it with its default.

    With --scenario it also makes recordings whose truth is known: 'coslidar init demo --scenario demo'.
    """
    from ..settings import InputError

    target = folder / "campaign.toml"
    if target.exists() and not force and scenario is None:
        raise InputError([f"{target} is there already; edit it, or replace it with --force"])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "raw").mkdir(exist_ok=True)
    campaign, duration = "", "3 min"
    if scenario is not None:
        made = _simulate(scenario, folder / "raw", force)
        campaign = f'campaign = "{made["campaign"]}"\n'
        duration = made["batch"] or duration
    if not target.exists() or force:
        target.write_text(
            _CAMPAIGN.format(campaign=campaign, archives='["raw/*.zarr.zip", "raw/*.zarr"]', duration=duration)
            if scenario is None
            else _CAMPAIGN.format(campaign=campaign, archives='["raw/*.zarr.zip"]', duration=duration),
            encoding="utf-8",
        )
    click.echo(f"{target} is ready. Next: coslidar run {target}")
    if scenario is None:
        click.echo(f"Put recordings (raw archives, format 1) into {folder / 'raw'}, or name them in {target}.")


def _simulate(scenario: str, folder: Path, force: bool) -> dict[str, Any]:
    """Make the recordings of a scenario that are not there yet; say how long a batch of them should be."""
    from ...pipeline.units import text
    from ..simulate import load_scenario, simulate

    loaded = load_scenario(scenario)
    with simulation_progress() as progress:
        simulate(loaded, folder, overwrite=force, keep=not force, progress=progress)
    shortest = min(archive.duration for archive in loaded.archives)
    return {"campaign": loaded.header.campaign, "batch": text(shortest, "s") if shortest < 180 else None}


@contextmanager
def simulation_progress() -> Iterator[Callable[[str, int, int], None]]:
    """Bars on a terminal, one line per archive elsewhere."""
    if not sys.stderr.isatty():

        def line(name: str, done: int, total: int) -> None:
            if done == total:
                click.echo(f"coslidar: {name}: {total} frames simulated", err=True)

        yield line
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def bar(name: str, done: int, total: int) -> None:
            if name not in tasks:
                tasks[name] = bars.add_task(f"simulating {name}", total=total)
            bars.update(tasks[name], completed=done)

        yield bar


@click.command()
@click.argument("scenario")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path),
              help="Archive (X.zarr or X.zarr.zip), or a folder for the archives of a scenario.")  # fmt: skip
@click.option("--duration", help="Length of each recording instead of the scenario's: '20 s'.")
@click.option("--seed", type=int, help="Seed instead of the scenario's.")
@click.option("--codec", type=click.Choice(["lz4", "zstd"]), help="Fast, or small; instead of the scenario's.")
@click.option("--force", is_flag=True, help="Replace archives that are there.")
def simulate(scenario: str, output: Path, duration: str | None, seed: int | None, codec: Any, force: bool) -> None:
    """Make recordings whose truth is known, by first-order theory in spherical waves.

    SCENARIO is the name of a shipped scenario ('coslidar simulate list -o .' names them) or a file. The truth of
    X.zarr.zip is written beside it as X.truth.json.
    """
    from ...pipeline.units import QuantityError, parse
    from ..settings import InputError
    from ..simulate import shipped
    from ..simulate import simulate as make

    if scenario == "list":
        for name, line in shipped().items():
            click.echo(f"{name:<20} {line}")
        return
    seconds = None
    if duration is not None:
        try:
            seconds = parse(duration, "s", key="--duration")
        except QuantityError as error:
            raise InputError([f"--duration = {duration!r}: {error}"]) from error
    try:
        with simulation_progress() as progress:
            written = make(
                scenario, output, duration=seconds, seed=seed, codec=codec, overwrite=force, progress=progress
            )
    except FileExistsError as error:
        raise InputError([f"{error}; replace it with --force"]) from error
    for path in written:
        click.echo(path)


@click.command()
@click.argument("archive")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option("--find-grid", is_flag=True, help="Find lenslets and spots, also on an image (FITS, HDF5, TIFF, ...).")
@click.option(
    "--header", type=click.Path(path_type=Path), help="With --find-grid: file whose [ingest] tells how to read."
)
@click.option(
    "-o", "--overlay", type=click.Path(path_type=Path), help="With --find-grid: picture of it (png, svg, pdf)."
)
def inspect(archive: str, as_json: bool, find_grid: bool, header: Path | None, overlay: Path | None) -> None:
    """Show what the raw archive ARCHIVE (folder, .zip or URL) holds.

    An archive that is not sound is refused with every fault it has. With --find-grid it prints the part of a header
    that describes the lenslets and spots on the mean frame of an archive, or of images that are none yet.
    """
    import json

    if find_grid:
        from .ingest import find_grid as find

        find(archive, header, overlay, as_json)
        return
    if header is not None or overlay is not None:
        raise click.UsageError("--header and --overlay go with --find-grid")
    from ...catalog.archive import describe, notes, open_archive

    opened = open_archive(archive)
    if as_json:
        click.echo(json.dumps({**describe(opened), "notes": notes(opened)}, indent=1, ensure_ascii=False))
        return
    for key, value in describe(opened).items():
        click.echo(f"{key:<18} {value}")
    for note in notes(opened):
        click.secho(f"note: {note}", fg="yellow")
