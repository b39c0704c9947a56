"""What every stage and every built-in plugin gives on a fixed input, stored beside its version.

The version is what tells two results apart in a key: numbers that move under the same version make products of one key
differ, and a version that moves without the numbers has everybody compute everything again. So both move together, and

    .venv/bin/python tests/golden/cases.py            # stores what has a new version, or is new
    .venv/bin/python tests/golden/cases.py retrieve   # only the cases named

stores the new ones; it refuses numbers that moved under the version that is stored. Look at ``git diff tests/golden``
before you commit.

Inputs are arithmetic (no random generator, whose streams numpy may change) or stored values of the stage before, so
that a stage fails for its own reason only. Values are compared to `TOLERANCE` of the largest of their array. Other
processors add in other orders and fuse multiplications: rounding of 1e-16 that the worst-conditioned step here, a solve
of condition 1e6, makes 1e-10. A change of method moves at least some number by more than 1e-6. What is sampled follows
the same uniform numbers, but where rounding turns an acceptance the chain is another one: `SAMPLED` is three times the
scatter of such chains.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from coslidar.pipeline import batch, extraction, inversion
from coslidar.pipeline.geometry import Geometry, SliceGrid
from coslidar.pipeline.parameters import (
    CorrelationParameters,
    ExtractionParameters,
    Header,
    InversionParameters,
    ResponseParameters,
)
from coslidar.pipeline.products import Measurements
from coslidar.pipeline.response import response_matrix
from coslidar.plugins.contract import Plugin
from coslidar.plugins.registry import KEYS, entries, get

VALUES = Path(__file__).parent / "values"
COMMAND = ".venv/bin/python tests/golden/cases.py"
TOLERANCE = 1e-6
SAMPLED = 0.2
#: Results of the retrieval that follow from draws.
DRAWN = ("interval", "posterior_mean")
#: Arrays longer than this are stored as so many entries of even step, and their root mean square.
LONGEST = 240

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Case:
    """One stage or plugin.

    Parameters
    ----------
    name : str
        Name of the file with its values.
    version : int
        Its version now.
    constant : str
        Where that stands.
    compute : callable
        Gives its result on the fixed input.
    """

    name: str
    version: int
    constant: str
    compute: Callable[[], Arrays]

    @property
    def path(self) -> Path:
        return VALUES / f"{self.name}.json"

    def result(self) -> dict[str, list[float]]:
        """The result, as it is stored."""
        return {name: shortened(np.asarray(values)) for name, values in sorted(self.compute().items())}

    def stored(self) -> dict[str, Any] | None:
        return json.loads(self.path.read_text()) if self.path.is_file() else None


def shortened(values: np.ndarray) -> list[float]:
    """Numbers that stand for an array: itself, or a part of it and its root mean square."""
    flat = values.astype(float).ravel()
    if len(flat) > LONGEST:
        step = -(-len(flat) // LONGEST)
        flat = np.append(flat[::step], np.sqrt(np.nanmean(flat**2)))
    return [float(f"{value:.12g}") for value in flat]


def differences(case: Case, now: dict[str, list[float]], then: dict[str, list[float]]) -> list[str]:
    """What moved by more than rounding."""
    found = [f"{name} is new" for name in now.keys() - then.keys()] + [
        f"{name} is gone" for name in then.keys() - now.keys()
    ]
    for name in sorted(now.keys() & then.keys()):
        a, b = np.array(now[name], float), np.array(then[name], float)
        if a.shape != b.shape or not np.array_equal(np.isnan(a), np.isnan(b)):
            found.append(f"{name} has another shape, or other gaps")
            continue
        finite = np.isfinite(a) & np.isfinite(b)
        if not np.array_equal(a[~finite], b[~finite], equal_nan=True):
            found.append(f"{name} is infinite elsewhere")
        size = np.abs(b[finite]).max(initial=0.0)
        moved = np.abs(a - b)[finite].max(initial=0.0)
        limit = SAMPLED if any(word in name for word in DRAWN) else TOLERANCE
        if moved > limit * size:
            found.append(f"{name} moved by {moved / size if size else np.inf:.1e} of its largest value")
    return found


def verdict(case: Case) -> str | None:
    """What is wrong with a case; None where nothing is."""
    stored = case.stored()
    if stored is None:
        return f"{case.name} has no golden values; store them with: {COMMAND} {case.name}"
    moved = differences(case, case.result(), stored["values"])
    if stored["version"] == case.version:
        return f"bump {case.constant} or restore the result: {'; '.join(moved)}" if moved else None
    if moved:
        return (
            f"{case.constant} is {case.version}, the golden values are of {stored['version']}; "
            f"store the new ones with: {COMMAND} {case.name}"
        )
    return (
        f"restore {case.constant} to {stored['version']} or change the result: nothing here moved with it. If what "
        f"changed shows on other input only, store the new version with: {COMMAND} {case.name}"
    )


def store(case: Case) -> str:
    """Store what a case gives now.

    Raises
    ------
    SystemExit
        The numbers moved under the version that is stored.
    """
    stored, now = case.stored(), case.result()
    if stored is not None and stored["version"] == case.version:
        if moved := differences(case, now, stored["values"]):
            sys.exit(f"{case.name}: bump {case.constant} first: {'; '.join(moved)}")
        return f"{case.name}: unchanged"
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(values)}" for name, values in now.items())
    case.path.write_text(f'{{"version": {case.version}, "values": {{\n{lines}\n}}}}\n')
    return f"{case.name}: version {case.version} stored"


# --- inputs ------------------------------------------------------------------------------------------------

MASK = ((1, 1, 1), (1, 0, 1), (1, 1, 1))
GEOMETRY = Geometry(MASK, 0.07, 2670.0, 3.8e-6, ((0.0, -0.4), (0.0, 0.4)))
GRID = SliceGrid.uniform(2670.0, 4)
RATE, FRAMES = 100.0, 400
START = 1_347_624_900_000_000_000
HEADER = Header.model_validate(
    {
        "format": "shwfs-frames",
        "format_version": 1,
        "campaign": "golden",
        "archive": "golden",
        "instrument": {
            "wavelength": "3.8 um",
            "frame_rate": "100 Hz",
            "pixel_scale": "27 urad",
            "gain": "12 electron/count",
            "saturation": "16383 count",
            "subaperture_size": "7 cm",
            "subaperture_mask": [list(row) for row in MASK],
            "lenslet_origin": [0, 0],
            "lenslet_pitch": [20, 12],
        },
        "path": {"length": "2670 m"},
        "sources": [
            {"name": "bottom", "position": ["0 m", "-0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": [4.8, 5.5]},
            {"name": "top", "position": ["0 m", "0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": [14.2, 5.5]},
        ],
    }
)


def noise(*shape: int, seed: int = 1) -> np.ndarray:
    """Numbers of mean 0 and variance 1 that look random and are arithmetic: sums of four uniform ones.

    Park and Miller's generator, x -> 16807 x mod (2^31 - 1), Communications of the ACM 31 (1988) 1192.
    """
    count = 4 * int(np.prod(shape))
    drawn, x = np.empty(count), seed
    for i in range(count):
        x = 16807 * x % 2147483647
        drawn[i] = x / 2147483647
    return (drawn.reshape(*shape, 4) - 0.5).sum(axis=-1) * np.sqrt(3.0)


def motion() -> tuple[np.ndarray, np.ndarray]:
    """Displacements of the spots (T, 2, S, A), logarithms of their fluxes (T, S, A); correlated in time and space."""
    t = np.arange(FRAMES) / RATE
    position = GEOMETRY.subaperture_position
    displacement = np.zeros((FRAMES, 2, 2, len(position)))
    light = np.zeros((FRAMES, 2, len(position)))
    for number, (frequency, phase, wx, wy) in enumerate(noise(24, 4, seed=7)):
        for source in (0, 1):
            angle = (
                2 * np.pi * (1 + 9 * abs(frequency)) * t[:, None]
                + 9 * (wx * position[:, 0] + wy * position[:, 1])
                + phase + 0.4 * source * number
            )  # fmt: skip
            displacement[:, number % 2, source] += 0.12 * np.sin(angle)
            light[:, source] += 0.03 * np.cos(angle + 0.3)
    return displacement, light


def frames() -> np.ndarray:
    displacement, light = motion()
    pitch, count = (20, 12), 300
    made = 100 + 4 * noise(count, 60, 36, seed=3)
    y, x = np.arange(pitch[0])[:, None], np.arange(pitch[1])[None, :]
    for number, (i, j) in enumerate(GEOMETRY.subaperture_index):
        for source, spot in enumerate(HEADER.sources):
            row = spot.spot[0] + displacement[:count, 1, source, number][:, None, None]
            col = spot.spot[1] + displacement[:count, 0, source, number][:, None, None]
            peak = 1200 * np.exp(light[:count, source, number])[:, None, None]
            box = np.s_[:, pitch[0] * i : pitch[0] * (i + 1), pitch[1] * j : pitch[1] * (j + 1)]
            made[box] += peak * np.exp(-((y - row) ** 2 + (x - col) ** 2) / 2.4)
    return np.rint(made).astype(np.uint16)


def measurements() -> Measurements:
    displacement, light = motion()
    slopes = 27e-6 * (displacement + 0.02 * noise(*displacement.shape, seed=5))
    flux = 9000 * np.exp(light) * (1 + 0.004 * noise(*light.shape, seed=9))
    slopes[17, :, 0, 3], flux[17, 0, 3] = np.nan, np.nan
    each = light.shape[1:]
    return Measurements(
        START + np.arange(FRAMES) * 10_000_000,
        slopes,
        flux,
        np.zeros(light.shape, np.uint8),
        flux_noise=np.full(each, 36.0**2),
        slope_noise=np.full((2, *each), (0.02 * 27e-6) ** 2),
        centroid_gain=np.full((2, 2), 1.01),
    )


def stored_response() -> np.ndarray:
    stored = json.loads((VALUES / "response.json").read_text())["values"]
    columns = [np.concatenate([stored[f"slice_{i}_{kind}"] for kind in ("slope", "intensity")]) for i in range(GRID.k)]
    return np.stack(columns, axis=1)


def by_kind(name: str, values: np.ndarray) -> Arrays:
    """Maps of slopes (1e-11 rad^2) and of intensities (1e-2) apart: each has its own largest value."""
    flat = values.reshape(6, -1)
    return {f"{name}_slope": flat[:4].ravel(), f"{name}_intensity": flat[4:].ravel()}


def covariance(name: str, values: np.ndarray) -> Arrays:
    """A covariance as logarithms of its variances and as correlations, for the same reason."""
    deviation = np.sqrt(np.diagonal(values))
    return {f"{name}_log_deviation": np.log(deviation), f"{name}_correlation": values / np.outer(deviation, deviation)}


# --- stages ------------------------------------------------------------------------------------------------


def measure() -> Arrays:
    made = frames()
    time = START + np.arange(len(made)) * 10_000_000
    found = batch.measure([made], time, HEADER, extraction.Calibration(), ExtractionParameters())
    paper = batch.measure(
        [made],
        time,
        HEADER,
        extraction.Calibration(),
        ExtractionParameters(method="moving_maximum", window_x="5 pixel", window_y="5 pixel"),
    )
    arrays = {name: getattr(found, name) for name in vars(found) if name != "time"}
    return {**arrays, "slopes_moving_maximum": paper.slopes, "flux_moving_maximum": paper.flux}


def reduce() -> Arrays:
    found = batch.reduce(measurements(), GEOMETRY, RATE, 4.0, CorrelationParameters())
    independent = batch.reduce(measurements(), GEOMETRY, RATE, 4.0, CorrelationParameters(covariance="independent"))
    rest = {name: value for name, value in found.arrays.items() if name not in ("maps", "noise_covariance")}
    # Of 4 s, with a covariance so badly known that rounding shows: its size, in standard deviations.
    own = rest.pop("weighting_correction") / np.sqrt(np.diagonal(found.arrays["noise_covariance"]))
    return {
        **rest,
        "weighting_correction_size": np.asarray(np.sqrt(np.nanmean(own**2))),
        **by_kind("maps", found.arrays["maps"]),
        **covariance("noise", found.arrays["noise_covariance"]),
        **covariance("noise_independent", independent.arrays["noise_covariance"]),
        "quality_flag": np.asarray(found.quality_flag),
    }


def response() -> Arrays:
    source, spectrum = get(KEYS["source"], "gaussian"), get(KEYS["spectrum"], "kolmogorov")
    made = [source(fwhm_x="8.9 cm", fwhm_y="6.3 cm")] * 2
    options = ResponseParameters().options(GEOMETRY)
    matrix = response_matrix(GEOMETRY, GRID, spectrum(), made, **options)
    midpoint = response_matrix(GEOMETRY, GRID, spectrum(), made, **{**options, "sampling": "midpoint"})
    slices = [part for i in range(GRID.k) for part in by_kind(f"slice_{i}", matrix[:, i]).items()]
    middles = [part for i in range(GRID.k) for part in by_kind(f"midpoint_{i}", midpoint[:, i]).items()]
    return dict([*slices, *middles])


def retrieve() -> Arrays:
    matrix = stored_response()
    truth = np.array([4e-15, 0.0, 2.5e-14, 9e-15])
    maps = (matrix @ truth).reshape(6, *GEOMETRY.map_shape)
    size = np.repeat(np.nanmax(np.abs(maps.reshape(6, -1)), axis=1), maps[0].size)[GEOMETRY.independent]
    rows = np.full(maps.size, np.nan)
    rows[GEOMETRY.independent] = maps.ravel()[GEOMETRY.independent] + 0.04 * size * noise(len(size), seed=11)
    noisy = rows.reshape(maps.shape)
    for kind in (0, 1, 4):  # the other half of a symmetric map
        mirrored = noisy[kind][::-1, ::-1]
        noisy[kind] = np.where(np.isnan(noisy[kind]), mirrored, noisy[kind])
    reduced = batch.ReducedBatch(
        start=START,
        stop=START + 4_000_000_000,
        quality_flag=0,
        arrays={
            "maps": noisy,
            "noise_covariance": np.diag((0.04 * size) ** 2),
            "weighting_correction": np.zeros(len(size)),
            "n_effective": np.full(3, 200.0),
            "mean_flux": np.full(2, 9000.0),
            "scintillation_index": np.full(2, 0.02),
            "noise_variance_intensity_detector": np.full(2, 1e-5),
            "valid_fraction": np.ones(2),
            "n_frames": np.asarray(FRAMES),
        },
    )
    model = batch.Model(
        geometry=GEOMETRY,
        grid=GRID,
        matrix=matrix,
        sampling="mean",
        regulariser=_default("regulariser", "white"),
        selector=_default("selector", "gcv"),
        inversion=InversionParameters(),
    )
    found = batch.retrieve(reduced, model)
    return {**found.values, "quality_flag": np.asarray(found.quality_flag)}


# --- plugins -----------------------------------------------------------------------------------------------


def _default(key: str, name: str) -> Any:
    """A plugin with its defaults, or with its first example where it has parameters without one."""
    model = get(KEYS[key], name)
    needed = any(field.is_required() for field in model.model_fields.values())
    return model(**(model.examples[0] if model.examples and (needed or name == "image") else {}))


def source_model(plugin: Any) -> Arrays:
    fx, fy = (axis.ravel() for axis in np.meshgrid(np.linspace(-30, 30, 9), np.linspace(0, 25, 6)))
    transfer, moments = plugin.transfer(fx, fy), plugin.moment(fx, fy)
    named = {"transfer": transfer, "moment_x": moments[0], "moment_y": moments[1]}
    return {
        f"{name}_{part}": getattr(np.asarray(values, complex), part)
        for name, values in named.items()
        for part in ("real", "imag")
    }


def spectrum(plugin: Any) -> Arrays:
    return {"log_psd": np.log(plugin.psd(np.logspace(-2, 3, 31)))}


def regulariser(plugin: Any) -> Arrays:
    return {"precision": plugin.precision(SliceGrid.uniform(2670.0, _slices(plugin)))}


def _slices(plugin: Any) -> int:
    """As many slices as a reference profile has, where there is one."""
    return next((len(value) for value in plugin.model_dump().values() if isinstance(value, tuple) and value), 6)


def selector(plugin: Any) -> Arrays:
    z = np.linspace(0.05, 0.95, 6)
    rows = np.linspace(0, 1, 40)
    matrix = 3e14 * np.exp(-((rows[:, None] - z) ** 2) / 0.08)
    precision = np.eye(6)

    def problem(seed: int, neighbours: tuple[inversion.LinearProblem, ...] = ()) -> inversion.LinearProblem:
        data = matrix @ (1e-14 * np.array([1, 3, 2, 0.3, 1, 2])) + noise(40, seed=seed)
        return inversion.LinearProblem(matrix, data, precision, 40, neighbours=neighbours)

    chosen = plugin.select(problem(21, (problem(22), problem(23))))
    return {"log_mu": np.log10(chosen.mu), "criterion": chosen.criterion}


def cases() -> Iterator[Case]:
    """All stages, and the plugins that this distribution brings."""
    yield Case("measure", batch.MEASURE_VERSION, "the EXTRACTION version (VERSION in pipeline/extraction.py)", measure)
    yield Case("reduce", batch.REDUCE_VERSION, "the CORRELATION version (REDUCE_VERSION in pipeline/batch.py)", reduce)
    yield Case(
        "response", batch.RESPONSE_VERSION, "the RESPONSE version (RESPONSE_VERSION in pipeline/batch.py)", response
    )
    yield Case(
        "retrieve", batch.RETRIEVE_VERSION, "the PROFILE version (RETRIEVE_VERSION in pipeline/batch.py)", retrieve
    )
    computed = {"source": source_model, "spectrum": spectrum, "regulariser": regulariser, "selector": selector}
    for key, compute in computed.items():
        for name, entry in sorted(entries(KEYS[key]).items()):
            model: type[Plugin] = entry.load()
            if model.__module__.startswith("coslidar.plugins."):
                file = model.__module__.removeprefix("coslidar.").replace(".", "/")
                yield Case(
                    f"{key}-{name}",
                    model.version,
                    f"the version of {model.__name__} (in {file}.py)",
                    lambda key=key, name=name, compute=compute: compute(_default(key, name)),
                )


if __name__ == "__main__":
    known = {case.name: case for case in cases()}
    if strangers := set(sys.argv[1:]) - set(known):
        sys.exit(f"there is no case {', '.join(sorted(strangers))}; there are {', '.join(known)}")
    VALUES.mkdir(exist_ok=True)
    for chosen in sys.argv[1:] or known:
        print(store(known[chosen]))
