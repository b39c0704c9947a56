"""Commands that try the inversion on synthetic data: how mu is chosen, what bars and intervals are worth."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from .recovery import recovery

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from ...pipeline.experiment import Outcome, Setup
    from ..settings import Settings

_PROFILES = ("strong", "weak", "bright-last", "rough", "empty", "single")


@click.group()
def experiment() -> None:
    """Try priors, selectors and error bars on data whose truth is known.

    For gcv and compare the data are correlations of a known profile for the instrument of Sauvage et al. 2021 (20
    lenslets of 7 cm, two lamps at 2670 m, 3.8 um, 25,560 frames) with convergence noise drawn from its theoretical
    covariance. recovery simulates frames of any instrument, and tries the whole chain on them.
    """


experiment.add_command(recovery)


def _shared(draws: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Options of all experiments."""

    def add(function: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(
            (
                click.option("--draws", type=click.IntRange(2, 10000), default=draws, show_default=True,
                             help="How many times noise is drawn for each profile."),
                click.option("--seed", type=click.IntRange(0), default=0, show_default=True,
                             help="Of the random numbers: the same seed, the same draws."),
                click.option(
                    "--frames", type=click.Choice(["measured", "independent"]), default="measured", show_default=True,
                    help="Effectively independent frames: 1460, 910 and 4930 for x, y slopes and fluxes, as measured "
                    "in a simulation, or all 25,560, as the paper has it.",
                ),
                click.option(
                    "--sampling", type=click.Choice(["mean", "midpoint"]), default="midpoint", show_default=True,
                    help="Response averaged over a slice or at its middle, of data and inversion alike.",
                ),
                click.option("--no-noise", is_flag=True, help="No detection noise, and no unknowns beside the "
                             "profile (the paper's appendix)."),
                click.option("--json", "as_json", is_flag=True, help="Print JSON instead of text."),
            )
        ):  # fmt: skip
            function = option(function)
        return function

    return add


@experiment.command()
@click.option("--profile", "profiles", type=click.Choice(_PROFILES), multiple=True, default=("strong", "weak"),
              show_default=True, help="True profile; may be repeated.")  # fmt: skip
@click.option("--regulariser", default="white", show_default=True, help="NAME[:parameter=value,…]")
@click.option("--selector", default="gcv:log_mu_min=25", show_default=True, help="NAME[:parameter=value,…]")
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="Figure to write (.png, .svg).")
@_shared(draws=100)
def gcv(
    profiles: tuple[str, ...],
    regulariser: str,
    selector: str,
    output: Path | None,
    draws: int,
    seed: int,
    frames: str,
    sampling: Literal["mean", "midpoint"],
    no_noise: bool,
    as_json: bool,
) -> None:
    """Repeat the appendix of Sauvage et al. 2021: choice of mu, MAP bars against empirical ones, coverage."""
    from ...pipeline.experiment import reconstruct
    from ..settings import InputError, load, with_plugin

    if output is not None and output.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError([f"{output}: the name of a figure must end in .png, .svg or .pdf"])
    settings = with_plugin(with_plugin(load(), "regulariser", regulariser), "selector", selector)
    outcomes = {}
    for setup in _setups(settings, profiles, draws, seed, frames, sampling, no_noise):
        outcomes[setup.name] = reconstruct(
            setup, settings.regulariser().precision(setup.grid), settings.selector(), seed=seed
        )
        grid = setup.grid
    if output is not None:
        from ...catalog.report.experiment import draw_experiment

        output.parent.mkdir(parents=True, exist_ok=True)
        draw_experiment(outcomes, grid, settings.plugins["selector"]["name"], output)
    if as_json:
        head = {"regulariser": regulariser, "selector": selector, "draws": draws, "seed": seed, "frames": frames,
                "sampling": sampling, "detection_noise": not no_noise}  # fmt: skip
        full = {name: {**_numbers(outcome), **_curves(outcome)} for name, outcome in outcomes.items()}
        click.echo(json.dumps({**head, "z": grid.centres.tolist(), "profiles": full}, indent=1))
        return
    for name, outcome in outcomes.items():
        click.echo(_text(name, outcome, grid.centres))
    if output is not None:
        click.echo(f"figure: {output}")


@experiment.command()
@click.option("--profile", "profiles", type=click.Choice(_PROFILES), multiple=True, default=_PROFILES,
              help="True profile; may be repeated.  [default: all]")  # fmt: skip
@click.option(
    "--regulariser", "regularisers", multiple=True, help="May be repeated.  [default: all that are installed]"
)
@click.option("--selector", "selectors", multiple=True,
              help="May be repeated.  [default: all that are installed, but for fixed]")  # fmt: skip
@_shared(draws=40)
def compare(
    profiles: tuple[str, ...],
    regularisers: tuple[str, ...],
    selectors: tuple[str, ...],
    draws: int,
    seed: int,
    frames: str,
    sampling: Literal["mean", "midpoint"],
    no_noise: bool,
    as_json: bool,
) -> None:
    """Compare every prior with every selector on the same draws, as a Markdown table.

    Each cell: error of the MAP profile and of the posterior mean at the chosen mu, over the mean of the truth, and the
    shares of slices and draws that the 68 and 95 % intervals hold. JSON also has the errors of each draw, for paired
    comparisons: draws of one seed are the same in every row.
    """
    from ...pipeline.experiment import reconstruct
    from ...plugins.registry import available
    from ..settings import load, with_plugin

    base = load()
    priors = regularisers or tuple(available("regulariser")[0])
    criteria = selectors or tuple(name for name in available("hyperparameter selector")[0] if name != "fixed")
    chosen = [
        (prior, criterion, with_plugin(with_plugin(base, "regulariser", prior), "selector", criterion))
        for prior in priors
        for criterion in criteria
    ]
    setups = list(_setups(base, profiles, draws, seed, frames, sampling, no_noise))
    rows = []
    if not as_json:
        click.echo("| prior | selector | " + " | ".join(profiles) + " |")
        click.echo("|---|---|" + "---|" * len(profiles))
    for prior, criterion, settings in chosen:
        found = {}
        for setup in setups:
            outcome = reconstruct(setup, settings.regulariser().precision(setup.grid), settings.selector(), seed=seed)
            each = {"errors_map": outcome.error_map.tolist(), "errors_mean": outcome.error_mean.tolist()}
            found[setup.name] = {**_numbers(outcome), **each}
        rows.append({"regulariser": prior, "selector": criterion, "profiles": found})
        if not as_json:
            cells = (
                f"{one['error_map']:.2f}, {one['error_mean']:.2f}; "
                f"{one['coverage_hpd'][0]:.2f}, {one['coverage_hpd'][1]:.2f}"
                for one in found.values()
            )
            click.echo(f"| {prior} | {criterion} | " + " | ".join(cells) + " |")
    if as_json:
        click.echo(json.dumps(rows, indent=1))


def _setups(
    settings: Settings,
    profiles: Iterable[str],
    draws: int,
    seed: int,
    frames: str,
    sampling: Literal["mean", "midpoint"],
    no_noise: bool,
) -> Iterable[Setup]:
    """Draws of each profile."""
    import numpy as np

    from ...pipeline import experiment as synthetic
    from ...pipeline.geometry import SliceGrid
    from ...pipeline.response import response_matrix
    from ...plugins.registry import create

    geometry = synthetic.scindar()
    grid = SliceGrid.uniform(geometry.path_length, 12)
    spectrum = settings.spectrum()
    lamp: Any = create("source model", "gaussian", {"fwhm_x": "8.9 cm", "fwhm_y": "6.3 cm"})
    matrix = response_matrix(geometry, grid, spectrum, [lamp, lamp], sampling=sampling)
    noise = (0.0, 0.0, 0.0) if no_noise else synthetic.DETECTION_NOISE
    for name in profiles:
        truth = np.array(synthetic.TRUTHS[name])
        if no_noise and not truth.any():
            raise click.UsageError(f"--profile {name} has no turbulence, and with --no-noise nothing to draw")
        signals = synthetic.channel_covariance(geometry, grid, truth, spectrum, [lamp, lamp])
        covariance = synthetic.convergence_covariance(
            geometry, signals, effective_frames=synthetic.EFFECTIVE_FRAMES[frames], detection_noise=noise
        )
        yield synthetic.draw(
            name, truth, geometry, grid, matrix, covariance, draws=draws, seed=seed,
            detection_noise=noise, noise_bias=not no_noise, slope_offset=not no_noise,
        )  # fmt: skip


def _numbers(outcome: Outcome) -> dict[str, Any]:
    """Means over draws and slices."""
    return {
        "log_mu": float(outcome.log_mu.mean()),
        "log_mu_deviation": float(outcome.log_mu.std()),
        "squared_gap": outcome.squared_gap,
        "error_map": float(outcome.error_map.mean()),
        "error_mean": float(outcome.error_mean.mean()),
        "error_best": float(outcome.error_best.mean()),
        **{
            f"coverage_{kind}": [float(values.at_68.mean()), float(values.at_95.mean())]
            for kind, values in outcome.coverage.items()
        },
    }


def _curves(outcome: Outcome) -> dict[str, Any]:
    """What the figure shows."""
    return {
        "truth": outcome.truth.tolist(),
        "cn2_map": outcome.cn2_map.mean(axis=0).tolist(),
        "cn2_posterior_mean": outcome.cn2_mean.mean(axis=0).tolist(),
        "bar_map": outcome.bar_map.mean(axis=0).tolist(),
        "bar_ml": outcome.bar_ml.mean(axis=0).tolist(),
        "bar_empirical": outcome.bar_empirical.tolist(),
        "log_mu_grid": outcome.log_mu_grid.tolist(),
        "criterion": outcome.criterion.mean(axis=0).tolist(),
        "error_curve": outcome.error_curve.mean(axis=0).tolist(),
        "coverage": {
            kind: {"68": values.at_68.tolist(), "95": values.at_95.tolist()}
            for kind, values in outcome.coverage.items()
        },
    }


def _text(name: str, outcome: Outcome, z: Any) -> str:
    """A page of numbers."""
    one = _numbers(outcome)
    ten = outcome.log_mu[:10] - outcome.best_log_mu[:10]
    lines = [
        f"{name}: {len(outcome.log_mu)} draws",
        f"  log mu             {one['log_mu']:.2f} +- {one['log_mu_deviation']:.2f}",
        f"  squared gap        {one['squared_gap']:.2f} to the best log mu; {(ten**2).mean():.2f} over the first ten "
        "draws (0.76 in the paper)",
        f"  error              MAP {one['error_map']:.2f}, posterior mean {one['error_mean']:.2f}, "
        f"MAP at the best mu {one['error_best']:.2f}",
    ]
    for kind, label in (("map", "MAP bars"), ("ml", "ML bars"), ("hpd", "intervals")):
        at_68, at_95 = one[f"coverage_{kind}"]
        lines.append(f"  coverage           {label:<10} {at_68:.2f} at 68 %, {at_95:.2f} at 95 %")
    lines.append("  log mu      " + "".join(f"{value:9.1f}" for value in outcome.log_mu_grid[::4]))
    lines.append("  criterion   " + "".join(f"{value:9.4g}" for value in outcome.criterion.mean(axis=0)[::4]))
    lines.append("  error       " + "".join(f"{value:9.2f}" for value in outcome.error_curve.mean(axis=0)[::4]))
    lines.append("       z [m]     truth  mean MAP   MAP bar empirical    ML bar  covered: MAP    ML   interval (68 %)")
    columns = zip(
        z, outcome.truth, outcome.cn2_map.mean(axis=0), outcome.bar_map.mean(axis=0), outcome.bar_empirical,
        outcome.bar_ml.mean(axis=0), *(outcome.coverage[kind].at_68 for kind in ("map", "ml", "hpd")), strict=True,
    )  # fmt: skip
    for place, *values, by_map, by_ml, by_interval in columns:
        lines.append(
            f"  {place:10.1f}" + "".join(f"{value:10.1e}" for value in values)
            + f"{by_map:14.2f}{by_ml:6.2f}{by_interval:11.2f}"
        )  # fmt: skip
    return "\n".join(lines)
