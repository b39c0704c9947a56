"""Recordings simulated from a scenario file, with their truth beside them."""

from __future__ import annotations

import json
import os
import tomllib
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..pipeline.scenario import Realised, ScenarioError, read
from ..pipeline.units import safe, text
from .settings import InputError, Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from ..pipeline.scenario import Recording, Scenario

    Codec = Literal["lz4", "zstd"]

#: Frames that are drawn at once and stored in one chunk.
CHUNK_FRAMES = 256
#: Ending of an archive in one file.
SUFFIX = ".zarr.zip"


def shipped() -> dict[str, str]:
    """Scenarios that come with the program.

    Returns
    -------
    dict of str to str
        Description by name.
    """
    found = {}
    for entry in files("coslidar.flows.scenarios").iterdir():
        if entry.name.endswith(".toml"):
            found[entry.name.removesuffix(".toml")] = tomllib.loads(entry.read_text("utf-8"))["description"]
    return dict(sorted(found.items()))


def load_scenario(scenario: str | Path) -> Scenario:
    """Read a scenario file, or one of those that come with the program.

    Parameters
    ----------
    scenario : str or pathlib.Path
        Path of a TOML file, or the name of a shipped scenario.

    Returns
    -------
    Scenario
        Checked and frozen.

    Raises
    ------
    InputError
        With every fault of the file.
    """
    origin = safe(str(scenario))
    path = Path(scenario)
    try:
        # A folder of that name is no scenario: `init demo --scenario demo` makes one.
        if path.suffix == ".toml" or path.is_file():
            content = path.read_bytes()
        elif (name := str(scenario)) in shipped():
            content = (files("coslidar.flows.scenarios") / f"{name}.toml").read_bytes()
        else:
            raise InputError([f"{origin}: no such scenario; give a TOML file, or one of: {', '.join(shipped())}"])
        table = tomllib.loads(content.decode("utf-8"))
    except OSError as error:
        raise InputError([f"{origin}: cannot be read ({error.strerror})"]) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError([f"{origin}: this is no TOML file: {error}"]) from error
    try:
        result = read(table, origin)
    except ScenarioError as error:
        raise InputError(error.faults) from error
    # Plugins are known here and not in the science: build them once, so that their faults are found now.
    _settings(result, origin).spectrum()
    _settings(result, origin).source_models(result.header, origin)
    return result


def recordings(scenario: Scenario, origin: str = "scenario") -> list[Recording]:
    """Recordings of a scenario, with its plugins in place; frames are drawn when asked for.

    Parameters
    ----------
    scenario : Scenario
        What to simulate.
    origin : str
        For messages.

    Returns
    -------
    list of Recording
        One per archive.
    """
    return [_recording(scenario, number, origin) for number in range(len(scenario.archives))]


def simulate(
    scenario: str | Path | Scenario,
    output: Path,
    *,
    duration: float | None = None,
    seed: int | None = None,
    threads: int | None = None,
    codec: Codec | None = None,
    overwrite: bool = False,
    keep: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[Path]:
    """Write every archive of a scenario, and the truth of each beside it.

    Parameters
    ----------
    scenario : str, pathlib.Path or Scenario
        Scenario file, name of a shipped scenario, or one already read.
    output : pathlib.Path
        The archive, if its name ends in ``.zarr`` or ``.zip``; else a folder that gets ``<archive>.zarr.zip``
        for each.
    duration : float, optional
        Seconds of each recording, instead of those of the scenario.
    seed : int, optional
        Instead of that of the scenario.
    threads : int, optional
        Threads that draw frames; one per core where absent. The frames do not depend on it.
    codec : {"lz4", "zstd"}, optional
        Compression of the archives, quick or small, instead of that of the scenario.
    overwrite : bool
        Replace archives that are there already.
    keep : bool
        Leave archives that are there already with their truth as they are.
    progress : callable, optional
        Called with (name of the archive, frames written, frames in all).

    Returns
    -------
    list of pathlib.Path
        The archives. The truth of ``X.zarr.zip`` is ``X.truth.json``.

    Raises
    ------
    InputError
        The scenario has faults, or several archives are to go into one.
    FileExistsError
        An archive is there already, and neither `overwrite` nor `keep` is set.
    """
    origin = safe(str(scenario)) if isinstance(scenario, (str, Path)) else "scenario"
    plan = load_scenario(scenario) if isinstance(scenario, (str, Path)) else scenario
    if duration is not None:
        archives = tuple(a.model_copy(update={"duration": duration}) for a in plan.archives)
        plan = plan.model_copy(update={"archives": archives})
    if seed is not None:
        plan = plan.model_copy(update={"seed": seed})
    if single := output.suffix in (".zarr", ".zip"):
        if len(plan.archives) > 1:
            raise InputError(
                [f"{origin} has {len(plan.archives)} archives: give a folder to write them to, not '{output}'"]
            )
        output.parent.mkdir(parents=True, exist_ok=True)
    else:
        output.mkdir(parents=True, exist_ok=True)
    written = []
    for number, archive in enumerate(plan.archives):
        path = output if single else output / f"{archive.archive}{SUFFIX}"
        written.append(path)
        if keep and path.exists() and truth_path(path).exists():
            continue
        # Without its truth an archive is what an interrupted command left behind.
        write_recording(
            _recording(plan, number, origin),
            path,
            threads=threads,
            codec=codec,
            overwrite=overwrite or keep,
            progress=progress,
        )
    return written


def write_recording(
    recording: Recording,
    path: Path,
    *,
    threads: int | None = None,
    codec: Codec | None = None,
    overwrite: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> None:
    """Write one recording and its truth.

    Parameters
    ----------
    recording : Recording
        Frames to draw.
    path : pathlib.Path
        The archive.
    threads, codec, overwrite, progress
        As for :func:`simulate`.
    """
    from ..catalog.archive_writer import write_archive

    realised = Realised()
    name = str(recording.attributes["archive"])

    def frames() -> Iterator[NDArray[np.uint16]]:
        done = 0
        for slopes, flux, drawn in _drawn(recording, threads or len(os.sched_getaffinity(0))):
            realised.add(slopes, flux)
            yield drawn
            done += len(drawn)
            if progress is not None:
                progress(name, done, recording.n_frames)

    calibration: dict[str, Any] = {}
    if recording.scenario.detector.calibrated:
        detector = recording.detector
        calibration = {"dark": detector.dark, "flat": detector.flat, "bad_pixel": detector.bad_pixel > 0}
    write_archive(
        path,
        recording.attributes,
        recording.time,
        frames(),
        chunk_frames=CHUNK_FRAMES,
        codec=codec or recording.scenario.codec,
        overwrite=overwrite,
        **calibration,
    )
    truth_path(path).write_text(json.dumps(recording.truth(realised), indent=1) + "\n", "utf-8")


def truth_path(archive: Path) -> Path:
    """File with the truth of a simulated archive."""
    return archive.parent / (archive.name.removesuffix(".zip").removesuffix(".zarr") + ".truth.json")


def simulate_recording(
    path: Path,
    frames: int,
    *,
    scenario: str = "lannemezan-strong",
    threads: int | None = None,
    codec: Codec | None = None,
    overwrite: bool = False,
) -> Path:
    """Write one recording with a given number of frames, as benchmarks need it.

    Parameters
    ----------
    path : pathlib.Path
        The archive.
    frames : int
        Number of frames.
    scenario : str
        Scenario whose first archive is made, with no frame dropped.
    threads, codec, overwrite
        As for :func:`simulate`.

    Returns
    -------
    pathlib.Path
        `path`.
    """
    plan = load_scenario(scenario)
    duration = text(frames / plan.header.instrument.frame_rate, "s")
    first = plan.archives[0].model_validate({**plan.archives[0].model_dump(mode="json"), "duration": duration})
    calm = plan.disturbances.model_copy(update={"dropped": 0.0})
    plan = plan.model_copy(update={"archives": (first,), "disturbances": calm})
    recording = _recording(plan, 0, scenario)
    exact = replace(recording, time=recording.time[:frames], index=recording.index[:frames])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_recording(exact, path, threads=threads, codec=codec, overwrite=overwrite)
    return path


def _recording(scenario: Scenario, number: int, origin: str) -> Recording:
    settings = _settings(scenario, origin)
    return scenario.recording(number, settings.spectrum(), settings.source_models(scenario.header, origin))


def _settings(scenario: Scenario, origin: str) -> Settings:
    plugins = {"source": dict(scenario.source), "spectrum": dict(scenario.spectrum)}
    return Settings(origin=origin, campaign=None, archives=(), output=Path(), plugins=plugins)


def _drawn(recording: Recording, threads: int) -> Iterator[tuple[Any, Any, NDArray[np.uint16]]]:
    """Signals and frames chunk by chunk, drawn by several threads a little ahead of the writer."""

    def draw(start: int) -> tuple[Any, Any, NDArray[np.uint16]]:
        stop = min(start + CHUNK_FRAMES, recording.n_frames)
        slopes, flux = recording.signals(start, stop)
        return slopes, flux, recording.detector.render(slopes, flux, recording.index[start:stop])

    with ThreadPoolExecutor(threads) as pool:
        ahead: deque[Any] = deque()
        for start in range(0, recording.n_frames, CHUNK_FRAMES):
            ahead.append(pool.submit(draw, start))
            if len(ahead) > threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
