"""Commands that expose the science: plugins, response, invert."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

if TYPE_CHECKING:
    from ...pipeline.geometry import SliceGrid
    from ...pipeline.parameters import Header
    from ..settings import Settings

_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_OUT = click.Path(dir_okay=False, path_type=Path)


@click.group()
def plugins() -> None:
    """List, describe and check installed plugins."""


@plugins.command("ls")
def plugins_ls() -> None:
    """List every plugin by kind, and those that failed to load with the reason."""
    from ...pipeline.units import safe
    from ...plugins.registry import KINDS, available, entries

    for kind in KINDS:
        click.secho(f"{kind}s" if not kind.endswith("spectrum") else "turbulence spectra", bold=True)
        loaded, failed = available(kind)
        registered = entries(kind)
        for name, cls in loaded.items():
            summary = (cls.__doc__ or "").strip().splitlines()[:1] or [""]
            click.echo(f"  {name:<20} version {cls.version}  {registered[name].distribution:<18} {summary[0]}")
        for name, reason in failed.items():
            click.secho(f"  {name:<20} failed to load: {safe(reason)}", fg="red")


@plugins.command("describe")
@click.argument("name")
def plugins_describe(name: str) -> None:
    """Show what the plugin NAME does, and its parameters with units and defaults."""
    from inspect import cleandoc

    from ...plugins.registry import KEYS, KINDS, PluginError, available, entries

    found = False
    keys = {kind: key for key, kind in KEYS.items()}
    for kind in KINDS:
        loaded, _ = available(kind)
        if name not in loaded:
            continue
        found = True
        cls = loaded[name]
        click.secho(f"{kind} '{name}', version {cls.version}, from {entries(kind)[name].distribution}", bold=True)
        click.echo(cleandoc(cls.__doc__ or "") + "\n")
        schema = cls.model_json_schema()
        for field, info in cls.model_fields.items():
            unit = schema["properties"].get(field, {}).get("unit")
            default = "required" if info.is_required() else f"default {info.default!r}"
            described = " ".join((info.description or "").split())
            click.echo(f"  {field}  ({f'unit {unit}, ' if unit else ''}{default})  {described}")
        if not cls.model_fields:
            click.echo("  no parameters")
        click.echo(f'\nIn a campaign file:  [{keys[kind]}]  name = "{name}"')
    if not found:
        raise PluginError([f"no plugin '{name}'; 'coslidar plugins ls' lists them"])


@plugins.command("check")
@click.argument("distribution", metavar="DIST")
def plugins_check(distribution: str) -> None:
    """Run the contract on every plugin of the installed distribution DIST, a line per check.

    Each is tried with its defaults and with the parameters of its class attribute `examples`. Exit codes: 1 where a
    check fails, 2 where there is no such distribution.
    """
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import distribution as installed

    from ...pipeline.units import safe
    from ...plugins.conformance import CheckResult, check_plugin
    from ...plugins.registry import KINDS, Entry, PluginError
    from ..settings import InputError

    try:
        found = installed(distribution)
    except (PackageNotFoundError, ValueError) as error:
        raise InputError(
            [f"no distribution '{safe(distribution)}' is installed; 'coslidar plugins ls' names them"]
        ) from error
    title = f"{found.name} {found.version}"
    groups = {group: kind for kind, (group, _) in KINDS.items()}
    points = [point for point in found.entry_points if point.group in groups]
    if not points:
        raise InputError([f"{title} registers no plugin: it has no entry point of {', '.join(groups)}"])

    colours = {"passed": None, "failed": "red", "exempt": "yellow"}
    counts = dict.fromkeys(colours, 0)
    for point in sorted(points, key=lambda point: (list(groups).index(point.group), point.name)):
        entry = Entry(groups[point.group], point.name, title, point)
        try:
            results = check_plugin(entry.load())
        except (PluginError, ValueError) as error:
            results = [CheckResult(point.name, "loads", "failed", str(error))]
        for result in results:
            counts[result.status] += 1
            line = f"{result.status:<7} {result.plugin:<24} {result.check:<20} {result.message}".rstrip()
            click.secho("".join(c if c.isprintable() else " " for c in line), fg=colours[result.status])
    click.echo(
        f"{title}: {len(points)} plugin{'s' * (len(points) != 1)}, {counts['passed']} checks passed, "
        f"{counts['failed']} failed, {counts['exempt']} exempt"
    )
    if counts["failed"]:
        raise click.exceptions.Exit(1)


def _header(archive: str | None, campaign: Path | None) -> tuple[Header, Settings, str]:
    from pydantic import ValidationError

    from ...catalog.archive import open_archive
    from ...pipeline.parameters import FORMAT, FORMAT_VERSION, Header
    from ..settings import InputError, load

    if (archive is None) == (campaign is None):
        raise click.UsageError("give either --archive or --campaign")
    if campaign is None:
        assert archive is not None
        return open_archive(archive).header, load(archives=[archive]), archive
    settings = load(campaign)
    alone = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "campaign": settings.campaign or "campaign",
        "archive": "none",
        **settings.header,
    }
    try:
        return Header.model_validate(alone), settings, str(campaign)
    except ValidationError:
        if not settings.archives:
            raise InputError(
                [
                    f"{campaign}: it names no archive, and its tables instrument, path and sources do not describe an "
                    'instrument by themselves; add archives = ["..."], or use --archive'
                ]
            ) from None
    first = settings.archives[0]
    return settings.effective_header(open_archive(first).attributes, first), settings, first


@click.command()
@click.option("--archive", help="Take the geometry from this raw archive (path or URL).")
@click.option("--campaign", type=_FILE, help="Take the geometry from this campaign file, or its first archive.")
@click.option("--slices", type=click.IntRange(1, 200), help="Number of equal slices.  [default: 12]")
@click.option("--sampling", type=click.Choice(["mean", "midpoint"]), help="Averaged over a slice or at its middle.")
@click.option(
    "--slope-response",
    type=click.Choice(["centroid", "printed"]),
    help="With the centroid term, or as printed.",
)
@click.option("--aperture", type=click.Choice(["square", "circular"]), help="Shape of a subaperture.")
@click.option("--tilt", type=click.Choice(["gradient", "zernike"]), help="Mean gradient, or best-fitting plane.")
@click.option(
    "--band", help="Band of the detector: '3.4 um:4.2 um', flat, or 'file=filter.csv,unit=um' with its weight."
)
@click.option("--extent", help="Where the slices end, needed for sources at infinity: '10 km'.")
@click.option("--spectrum", help="NAME[:parameter=value,…], for example 'von_karman:outer_scale=10 m'.")
@click.option("--source", help="NAME[:parameter=value,…], for example 'gaussian:fwhm_x=8.9 cm,fwhm_y=6.3 cm'.")
@click.option("--wavelength", help="Instead of the header's: '3.4 um'.")
@click.option("-o", "--output", type=_OUT, required=True, help="NumPy file to write (.npz).")
def response(
    archive: str | None,
    campaign: Path | None,
    slices: int | None,
    sampling: str | None,
    slope_response: str | None,
    aperture: str | None,
    tilt: str | None,
    band: str | None,
    extent: str | None,
    spectrum: str | None,
    source: str | None,
    wavelength: str | None,
    output: Path,
) -> None:
    """Compute the response matrix M of an instrument and write it to a NumPy file.

    Correlation data = M @ cn2, with the slice thickness inside M. The file holds M (6 (2p-1)(2q-1), k), z (k,), edges
    (k + 1,), separation (6 (2p-1)(2q-1), 2) as (dx, dy) in m, valid (rows that a pair of subapertures measures),
    kind (name of each row's map) and the settings as text. Rows: blocks xx_auto, yy_auto, xx_cross, yy_cross,
    ii_auto, ii_cross, each [dy, dx] from -(p-1)d to (p-1)d.
    """
    import numpy as np

    from ...pipeline.geometry import MAP_KINDS
    from ...pipeline.parameters import ResponseParameters
    from ...pipeline.response import response_matrix
    from ..settings import InputError, sentences_of, with_plugin

    header, settings, origin = _header(archive, campaign)
    given = {
        "slices": slices,
        "sampling": sampling,
        "slope_response": slope_response,
        "aperture": aperture,
        "tilt": tilt,
        "band": band,
        "extent": extent,
    }
    base = settings.configuration.response.model_dump(mode="json", exclude_none=True)
    parameters = sentences_of(
        ResponseParameters,
        {**base, **{key: value for key, value in given.items() if value is not None}},
        "options",
    )
    if spectrum:
        settings = with_plugin(settings, "spectrum", spectrum)
    if source:
        settings = with_plugin(settings, "source", source)
    if wavelength:
        header = _with_wavelength(header, wavelength)
    geometry = header.geometry()
    try:
        grid = parameters.grid(geometry)
        options = parameters.options(geometry)
    except ValueError as error:
        raise InputError([f"{origin}: {error}"]) from error
    matrix = response_matrix(
        geometry,
        grid,
        settings.spectrum(),
        settings.source_models(header, origin),
        **options,
    )
    rows = len(matrix) // len(MAP_KINDS)
    output.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        output,
        M=matrix,
        z=grid.centres,
        edges=np.asarray(grid.edges),
        separation=geometry.separation_vectors,
        valid=geometry.valid,
        kind=np.repeat(MAP_KINDS, rows),
        sampling=parameters.sampling,
        slope_response=parameters.slope_response,
        aperture=parameters.aperture,
        tilt=parameters.tilt,
        band=parameters.band.text() if parameters.band else "single wavelength",
        spectrum=str(settings.plugins["spectrum"]),
        source=str([model.identity() for model in settings.source_models(header, origin)]),
        wavelength=geometry.wavelength,
        path_length=geometry.path_length,
        convention="data = M @ cn2, cn2 in m^(-2/3); slope rows rad^2, intensity rows 1; d_ab = r_a - r_b with a on "
        "the first source and b on the second; x along columns, y along rows",
    )
    click.echo(f"{output}: M {matrix.shape[0]} x {matrix.shape[1]}, {int(geometry.valid.sum())} rows measured")


def _with_wavelength(header: Header, wavelength: str) -> Header:
    from ...pipeline.units import QuantityError, parse
    from ..settings import InputError

    try:
        value = parse(wavelength, "m", key="--wavelength")
        if value <= 0:
            raise QuantityError("it must be positive")
    except QuantityError as error:
        raise InputError([f"--wavelength = {wavelength!r}: {error}"]) from error
    return header.model_copy(update={"instrument": header.instrument.model_copy(update={"wavelength": value})})


def _log_mu(value: str | None) -> dict[str, Any]:
    if value is None:
        return {}
    try:
        low, high, step = (float(part) for part in value.split(":"))
    except ValueError as error:
        raise click.BadParameter(f"'{value}' is not LOW:HIGH:STEP, for example 23:33:0.25") from error
    return {"log_mu_min": low, "log_mu_max": high, "log_mu_step": step}


@click.command()
@click.argument("source", metavar="IN.npz", type=_FILE)
@click.option("--regulariser", default="white", show_default=True, help="NAME[:parameter=value,…]")
@click.option("--selector", default="gcv", show_default=True, help="NAME[:parameter=value,…]")
@click.option("--mu", help="Fix the hyperparameter, for example '1e27 m^(4/3)'; replaces --selector.")
@click.option("--log-mu", metavar="LOW:HIGH:STEP", help="Range of log10 mu that the selector searches.")
@click.option("--noise-bias", type=click.Choice(["joint", "none"]), default="joint", show_default=True,
              help="Estimate detection noise at zero separation with the profile.")  # fmt: skip
@click.option("--slope-offset", type=click.Choice(["joint", "none"]), default="joint", show_default=True,
              help="Estimate a constant of each axis' slope maps with the profile.")  # fmt: skip
@click.option("--estimator", type=click.Choice(["map", "posterior_mean"]), default="map", show_default=True,
              help="Most probable profile, or the mean of all that are possible.")  # fmt: skip
@click.option("--subset", type=click.Choice(["all", "slopes", "scintillation", "auto", "cross"]), default="all",
              show_default=True, help="Part of the data to use.")  # fmt: skip
@click.option("-o", "--output", type=_OUT, required=True, help="NumPy file to write (.npz).")
def invert(
    source: Path,
    regulariser: str,
    selector: str,
    mu: str | None,
    log_mu: str | None,
    noise_bias: str,
    slope_offset: str,
    estimator: Literal["map", "posterior_mean"],
    subset: str,
    output: Path,
) -> None:
    """Invert correlation data of your own.

    IN.npz holds C_mes (n,) or (draws, n), C_conv (n, n) and M (n, k), in six blocks of (2p-1)(2q-1) rows: xx_auto,
    yy_auto, xx_cross, yy_cross, ii_auto, ii_cross. Rows that no pair measures are NaN or zero; redundant rows of auto
    maps may stay, they are found and left out. An array z or edges gives the slices (equal ones without).

    OUT.npz holds cn2 and error (MAP bar), (k,) or (draws, k), hpd68 and hpd95, (k, 2) or (draws, k, 2), the shortest
    intervals that hold 68 and 95 % of the positive posterior, posterior_mean, mu, log_mu_grid, criterion,
    n_independent, and error_ml, averaging_kernel, degrees_of_freedom, resolution_length (m, or slices where none are
    given; NaN in slices that the data do not resolve), chi2_reduced, nuisance, nuisance_error, nuisance_names, rows.
    Without a posterior, where neither data nor prior bound the profile, intervals reach from 0 to infinity and
    posterior_mean is NaN.
    """
    import numpy as np

    from ...pipeline import inversion
    from ..settings import InputError, load, plugin_text, with_plugin

    try:
        with np.load(source, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (OSError, ValueError) as error:
        raise InputError([f"{source}: this is no NumPy .npz file of plain arrays: {error}"]) from error
    faults = [f"{source}: array {name} is missing" for name in ("C_mes", "C_conv", "M") if name not in arrays]
    if faults:
        raise InputError(faults)
    data, covariance, matrix = (np.asarray(arrays[name]) for name in ("C_mes", "C_conv", "M"))
    faults += [
        f"{source}: {name} has type {value.dtype}; it must be real numbers"
        for name, value in (("C_mes", data), ("C_conv", covariance), ("M", matrix))
        if value.dtype.kind not in "fiu"
    ]
    n = matrix.shape[0] if matrix.ndim == 2 else -1
    if matrix.ndim != 2:
        faults.append(f"{source}: M has shape {matrix.shape}; it must be (n, k)")
    elif data.ndim not in (1, 2) or data.shape[-1] != n:
        faults.append(f"{source}: C_mes has shape {data.shape}; it must be ({n},) or (draws, {n}), as M has {n} rows")
    if matrix.ndim == 2 and covariance.shape != (n, n):
        faults.append(f"{source}: C_conv has shape {covariance.shape}; it must be ({n}, {n}), as M has {n} rows")
    if faults:
        raise InputError(faults)
    grid = _grid(arrays, matrix.shape[1], source)

    chosen = plugin_text(f"fixed:mu={mu}") if mu else plugin_text(selector)
    text = chosen.pop("name")
    parameters = {**chosen, **({} if mu else _log_mu(log_mu))}
    settings = load()
    settings = with_plugin(settings, "regulariser", regulariser)
    settings = with_plugin(settings, "selector", {"name": text, **parameters})
    try:
        reduction = inversion.prepare(
            data,
            covariance,
            matrix,
            subset=subset,
            noise_bias=noise_bias == "joint",
            slope_offset=slope_offset == "joint",
        )
        precision = settings.regulariser().precision(grid)
        profiles = [
            inversion.estimate(
                reduction, draw, precision, settings.selector(), grid=grid, estimator=estimator, seed=number
            )
            for number, draw in enumerate(np.atleast_2d(data))
        ]
    except (ValueError, np.linalg.LinAlgError) as error:
        raise InputError([f"{source}: {error}"]) from error

    def stack(name: str) -> Any:
        values = np.stack([np.asarray(getattr(profile, name)) for profile in profiles])
        return values[0] if data.ndim == 1 else values

    output.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        output,
        cn2=stack("cn2"),
        error=stack("error_map"),
        error_ml=stack("error_ml"),
        hpd68=stack("interval_68"),
        hpd95=stack("interval_95"),
        posterior_mean=stack("posterior_mean"),
        resolution_length=stack("resolution_length"),
        mu=stack("mu"),
        log_mu_grid=np.asarray(profiles[0].log_mu_grid),
        criterion=stack("criterion"),
        n_independent=reduction.n_data,
        averaging_kernel=stack("averaging_kernel"),
        degrees_of_freedom=stack("degrees_of_freedom"),
        chi2_reduced=stack("chi2_reduced"),
        nuisance=stack("nuisance"),
        nuisance_error=stack("nuisance_error"),
        nuisance_names=np.asarray(reduction.names, dtype=str),
        rows=reduction.rows,
        z=grid.centres,
        estimator=estimator,
        subset=subset,
    )
    click.echo(f"{output}: {len(profiles)} profile(s) of {grid.k} slices from {reduction.n_data} independent data")


def _grid(arrays: dict[str, Any], k: int, source: Path) -> SliceGrid:
    import numpy as np

    from ...pipeline.geometry import SliceGrid
    from ..settings import InputError

    try:
        if "edges" in arrays and np.shape(arrays["edges"]) == (k + 1,):
            return SliceGrid(tuple(float(edge) for edge in arrays["edges"]))
        if "z" in arrays and np.shape(arrays["z"]) == (k,) and k > 1:
            z = np.asarray(arrays["z"], dtype=float)
            middle = (z[1:] + z[:-1]) / 2
            ends = (max(0.0, z[0] - (middle[0] - z[0])), z[-1] + (z[-1] - middle[-1]))
            return SliceGrid((float(ends[0]), *map(float, middle), float(ends[1])))
    except ValueError as error:
        raise InputError([f"{source}: the slices of z or edges cannot be used: {error}"]) from error
    return SliceGrid.uniform(float(k), k)
