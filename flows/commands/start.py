"""Commands to begin with: init, inspect, simulate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

_CAMPAIGN = """\
# A coslidar campaign. Quantities are text with their unit: "3 min", "7 cm". Lines that begin with # show defaults.

{campaign}archives = {archives}
output = "results"                  # folder of the catalog and its products

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

[response]
# slices = 12
# sampling = "mean"                 # over each slice; or "midpoint"
# slope_response = "centroid"       # or "printed"
# extent = "2 km"                   # end of the slices; needed for sources at infinity

[inversion]
# noise_bias = "joint"              # or "none"
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
    raise NotImplementedError


@click.command()
@click.argument("archive")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def inspect(archive: str, as_json: bool) -> None:
    """Show what the raw archive ARCHIVE (folder, .zip or URL) holds.

    An archive that is not sound is refused with every fault it has.
    """
    import json

    from ...catalog.archive import describe, notes, open_archive

    opened = open_archive(archive)
    if as_json:
        click.echo(json.dumps({**describe(opened), "notes": notes(opened)}, indent=1, ensure_ascii=False))
        return
    for key, value in describe(opened).items():
        click.echo(f"{key:<18} {value}")
    for note in notes(opened):
        click.secho(f"note: {note}", fg="yellow")
