"""The command that holds the whole chain against recordings whose truth is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from ..recovery import Recovery


@click.command()
@click.argument("scenario")
@click.option("--records", type=click.IntRange(2, 10000), default=50, show_default=True, help="How many recordings.")
@click.option("--duration", default="20 s", show_default=True, help="Length of each.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Of the random numbers: the same seed, the same draws.",
)
@click.option("--set", "assignments", multiple=True, metavar="KEY=VALUE",
              help="One setting of the chain, as for a run; may be repeated: --set selector=evidence.")  # fmt: skip
@click.option("--no-frames", is_flag=True, help="Take the simulator's own slopes and fluxes instead of frames.")
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="Figure to write (.png, .svg).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
def recovery(
    scenario: str,
    records: int,
    duration: str,
    seed: int,
    assignments: tuple[str, ...],
    no_frames: bool,
    output: Path | None,
    as_json: bool,
) -> None:
    """Simulate many short recordings, profile each, and tell how well the truth is found.

    SCENARIO is the name of a shipped scenario ('coslidar simulate list -o .' names them) or a file. Frames are drawn,
    measured and forgotten; only the figure is written. The chain is told the slices, spectrum and source model of
    the scenario; everything else has its defaults.
    """
    from ...pipeline.units import QuantityError, parse
    from ..recovery import recover
    from ..settings import InputError
    from ..simulate import load_scenario

    faults = []
    try:
        seconds = parse(duration, "s", key="--duration")
    except QuantityError as error:
        faults.append(f"--duration = {duration!r}: {error}")
    if output is not None and output.suffix.lower() not in (".png", ".svg", ".pdf"):
        faults.append(f"{output}: the name of a figure must end in .png, .svg or .pdf")
    if faults:
        raise InputError(faults)
    loaded = load_scenario(scenario)

    def told(done: int, total: int) -> None:
        if done == total or done % 10 == 0:
            click.echo(f"coslidar: {done} of {total} recordings", err=True)

    found = recover(
        loaded,
        records=records,
        seed=seed,
        duration=seconds,
        assignments=assignments,
        frames=not no_frames,
        progress=told,
    )
    if output is not None:
        from ...catalog.report.recovery import draw_recovery

        output.parent.mkdir(parents=True, exist_ok=True)
        draw_recovery(found, f"{scenario}: {len(found.cn2)} recordings of {duration}", output)
    click.echo(json.dumps(_numbers(found), indent=1) if as_json else _table(found))
    for reason in sorted(set(found.failed)):
        click.echo(f"coslidar: {found.failed.count(reason)} without a profile: {reason}", err=True)
    if output is not None:
        click.echo(f"coslidar: figure: {output}", err=True)


def _numbers(found: Recovery) -> dict[str, Any]:
    slices = {
        "z": found.grid.centres,
        "truth": found.truth.mean(axis=0),
        "cn2": found.cn2.mean(axis=0),
        "cn2_deviation": found.cn2.std(axis=0),
        "cn2_posterior_mean": found.posterior_mean.mean(axis=0),
        "interval_68": found.mean_interval_68,
        "interval_95": found.mean_interval_95,
        "held_68": found.held_68,
        "held_95": found.held_95,
        "held_by_bars": found.held_by_bars,
    }
    return {
        "records": len(found.cn2),
        "failed": len(found.failed),
        "chi2_reduced": float(found.chi2.mean()),
        **{name: values.tolist() for name, values in slices.items()},
        "mean_within_95": found.mean_within_95.tolist(),
        "integrals": {
            name: {
                "truth": float(one.truth.mean()),
                "found": float(one.found.mean()),
                "deviation": float(one.found.std()),
                "held_68": one.held,
            }
            for name, one in found.integrals.items()
        },
    }


def _table(found: Recovery) -> str:
    """Markdown: one row per slice, and one for each number that follows from the profile."""
    rows = [
        "| z, m | truth | mean profile | posterior mean | mean 68 % interval | mean 95 % interval | 68 % holds | 95 % "
        "holds | MAP bar holds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    columns = zip(
        found.grid.centres,
        found.truth.mean(axis=0),
        found.cn2.mean(axis=0),
        found.posterior_mean.mean(axis=0),
        found.mean_interval_68,
        found.mean_interval_95,
        found.held_68,
        found.held_95,
        found.held_by_bars,
        strict=True,
    )
    for z, truth, cn2, mean, narrow, wide, at_68, at_95, bars in columns:
        rows.append(
            f"| {z:.0f} | {truth:.2e} | {cn2:.2e} | {mean:.2e} | {narrow[0]:.1e} to {narrow[1]:.1e} "
            f"| {wide[0]:.1e} to {wide[1]:.1e} | {at_68:.2f} | {at_95:.2f} | {bars:.2f} |"
        )
    rows.append(
        f"| all | | | | | | {found.held_68.mean():.2f} | {found.held_95.mean():.2f} | {found.held_by_bars.mean():.2f} |"
    )
    rows.append(f"\nMean profile within the stated 95 %: {found.mean_within_95.sum()} of {found.grid.k} slices.")
    rows.append(f"Chi2 per datum {found.chi2.mean():.2f} +- {found.chi2.std():.2f}.\n")
    rows += ["| | truth | mean of the recordings | scatter | 68 % holds |", "|---|---|---|---|---|"]
    for name, one in found.integrals.items():
        rows.append(
            f"| {name} | {one.truth.mean():.3g} | {one.found.mean():.3g} | {one.found.std():.2g} | {one.held:.2f} |"
        )
    return "\n".join(rows)
