"""Bring recordings in: ingest, and what inspect does to find the lenslet grid."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from ...pipeline.lenslets import Boxes, LensletGrid


def _range(ctx: click.Context, parameter: click.Parameter, value: str | None) -> list[int] | None:
    if value is None:
        return None
    first, colon, end = value.partition(":")
    if not colon or not first.isdigit() or not end.isdigit():
        raise click.BadParameter("write FIRST:END, for example 0:160")
    return [int(first), int(end)]


@click.command()
@click.argument("sources", nargs=-1, required=True, metavar="SOURCE...")
@click.option("--header", required=True, type=click.Path(path_type=Path),
              help="TOML or JSON: attributes of the archive, and a table [ingest].")  # fmt: skip
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="OUT.zarr or OUT.zarr.zip.")
@click.option("--dry-run", is_flag=True, help="Read everything, tell what would be written and every fault.")
@click.option("--archive", help="Name of the archive instead of the header's.")
@click.option("--start", help="Time of the first frame instead of [ingest.time]: 2012-09-14T12:15:00Z.")
@click.option("--dataset", help="Dataset, array, variable or HDU with the frames.")
@click.option("--axes", help="Order of the axes as stored: time,row,col.")
@click.option("--rows", callback=_range, help="Region of interest, FIRST:END (END is not in it).")
@click.option("--columns", callback=_range, help="Region of interest, FIRST:END.")
@click.option("--dark", type=click.Path(path_type=Path), help="Dark frame, or a series of them.")
@click.option("--flat", type=click.Path(path_type=Path), help="Relative response of the pixels, mean 1.")
@click.option("--bad-pixel", type=click.Path(path_type=Path), help="Image that is not zero at bad pixels.")
@click.option("--given-order", is_flag=True, help="The files stand in the right order, whatever their names.")
@click.option("--codec", type=click.Choice(["lz4", "zstd"]), default="lz4", show_default=True, help="Quick, or small.")
@click.option("--chunk-frames", type=int, help="Frames in a chunk of the archive; 256, fewer where they are large.")
@click.option("--force", is_flag=True, help="Replace an archive that is there.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def ingest(
    sources: tuple[str, ...],
    header: Path,
    output: Path,
    dry_run: bool,
    archive: str | None,
    start: str | None,
    given_order: bool,
    codec: Any,
    chunk_frames: int | None,
    force: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Make a raw archive of FITS, HDF5, NumPy, TIFF, MATLAB or raw binary files.

    SOURCE is one file or several in the order of time; a pattern in quotes is put in natural order. All frames go
    into one archive, which is at its place when it is whole. After an interruption, run the same command again: it goes
    on with the chunks that are complete, kept in the hidden folder .OUT.zarr.partial beside the output; where files or
    options have changed since, it says so and begins anew.
    """
    from ...catalog.ingest import describe, find_sources, made_before, plan_ingest, survey
    from ...catalog.ingest import ingest as write
    from ..settings import InputError

    if output.suffix not in (".zarr", ".zip"):
        raise InputError([f"-o {output}: the name of an archive ends in .zarr or .zarr.zip"])
    changes: dict[str, Any] = {key: value for key, value in options.items() if value is not None}
    for key in ("dark", "flat", "bad_pixel"):
        if key in changes:  # relative to here, those of the header file to itself
            changes[key] = str(changes[key].absolute())
    if "axes" in changes:
        changes["axes"] = [name.strip() for name in changes["axes"].split(",")]
    if start is not None:
        changes["time"] = {"start": start}
    plan = plan_ingest(find_sources(sources, given_order=given_order), header, changes=changes, archive=archive)
    if dry_run:
        there = not force and made_before(plan, output) is not None
        with _progress() as progress:
            described = describe(plan, survey(plan, progress), output, chunk_frames)
        note = [f"{output} is there already, made of the same files; it would be left as it is"] if there else []
        _show({**described, "written": False}, note, as_json)
        return
    from ...catalog.archive import describe as describe_archive
    from ...catalog.archive import notes

    def tell(sentence: str) -> None:
        click.echo(f"coslidar: {sentence}", err=True)

    with _progress() as progress:
        made = write(plan, output, codec=codec, chunk=chunk_frames, overwrite=force, progress=progress, tell=tell)
    told = {key: value for key, value in describe_archive(made).items() if key not in ("attributes", "notes", "mask")}
    _show(told, notes(made), as_json)


def _show(described: dict[str, Any], notes: list[str], as_json: bool) -> None:
    import json

    if as_json:
        click.echo(json.dumps({**described, "notes": notes}, indent=1, ensure_ascii=False))
        return
    for key, value in described.items():
        click.echo(f"{key:<18} {value}")
    for note in notes:
        click.secho(f"note: {note}", fg="yellow")


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """A bar on a terminal, a line per phase elsewhere."""
    if not sys.stderr.isatty():

        def line(what: str, done: int, total: int) -> None:
            if done == total:
                click.echo(f"coslidar: {what}: {total} frames", err=True)

        yield line
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def bar(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total)
            bars.update(tasks[what], completed=done)

        yield bar


# --- inspect --find-grid -----------------------------------------------------------------------------------


def find_grid(source: str, header: Path | None, overlay: Path | None, as_json: bool) -> None:
    """Find the lenslet grid of an archive or image, print the part of a header that describes it, and draw it.

    Parameters
    ----------
    source : str
        Archive, or a file that `ingest` can read.
    header : Path, optional
        Header file whose table ``[ingest]`` says how to read it.
    overlay : Path, optional
        Picture to write.
    as_json : bool
        Print JSON instead of TOML.

    Raises
    ------
    InputError
        There is no grid, or format 1 cannot describe it.
    """
    import json

    from ...pipeline.lenslets import NoGrid, boxes
    from ...pipeline.lenslets import find_grid as find
    from ...pipeline.units import safe
    from ..settings import InputError

    image, bad, known = _image(source, header)
    grid, found, faults = None, None, []
    try:
        grid = find(image, bad_pixel=bad)
        found = boxes(grid, (image.shape[0], image.shape[1]))
        faults = [f"{safe(source)}: {fault}" for fault in found.faults]
    except NoGrid as error:
        faults = [f"{safe(source)}: {error}"]
    if grid is not None and found is not None:
        if not found.faults:
            click.echo(json.dumps(_snippet(found), indent=1) if as_json else _toml(grid, found, source))
        for line in _differences(found, known):
            click.secho(f"note: {line}", fg="yellow", err=True)
        for note in found.notes:
            click.secho(f"note: {note}", fg="yellow", err=True)
        if found.faults:
            click.echo(f"found: {_words(grid)}", err=True)
    if overlay is not None:
        from ...catalog.report.grid_figure import draw_grid

        title = f"{Path(source).name}: {'no grid' if grid is None else _words(grid)}"
        try:
            overlay.parent.mkdir(parents=True, exist_ok=True)
            draw_grid(image, grid, found, title, overlay)
            click.echo(f"drawn: {overlay}", err=True)
        except (OSError, ValueError) as error:
            faults.append(f"-o {overlay}: cannot be drawn ({error})")
    if faults:
        raise InputError(faults)


def _image(source: str, header: Path | None) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None, Any]:
    """Mean frame, bad pixels, and the header of an archive."""
    import numpy as np

    from ...catalog.archive import open_archive
    from ...catalog.ingest import IngestParameters, mean_frame, open_sources, read_header
    from ...catalog.ingest_files import FileFault, Reading, kind_of
    from ...pipeline.units import safe
    from ..settings import InputError

    path = Path(source)
    if path.is_dir() or (kind_of(path) is None and header is None):
        opened = open_archive(source)
        # From all over the recording: the spots wander with the turbulence, and their mean is what counts.
        total, count = np.zeros(opened.frame_shape), 0
        for i in sorted({round(k) for k in np.linspace(0, opened.n_chunks - 1, 8)}):
            chunk = opened.read_chunk(i)
            total += chunk.sum(axis=0, dtype=np.float64)
            count += len(chunk)
        image = total / count
        image = image if opened.dark is None else image - opened.dark
        if opened.flat is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                image = image / opened.flat
        return image, opened.bad_pixel, opened.header
    reading = Reading()
    if header is not None:
        _, table = read_header(header)
        good = {key: value for key, value in table.items() if key != "time"}
        from pydantic import ValidationError

        from ...pipeline.units import faults

        try:
            # An image needs no time.
            parameters = IngestParameters.model_validate({**good, "time": {"start": "2000-01-01T00:00:00Z"}})
        except ValidationError as error:
            raise InputError(faults(error, safe(str(header)), "ingest")) from error
        reading = parameters.reading()
    wrong: list[str] = []
    files = open_sources([path], reading, wrong)
    if wrong:
        raise InputError(wrong)
    try:
        image = mean_frame(files)
    except FileFault as error:
        raise InputError([safe(f"{path}: {error}")]) from error
    if header is not None:
        rows, columns = (slice(*piece) if piece else slice(None) for piece in (parameters.rows, parameters.columns))
        image = image[rows, columns]
    return image, None, None


def _snippet(found: Boxes) -> dict[str, Any]:
    return {
        "instrument": {
            "subaperture_mask": found.mask.astype(int).tolist(),
            "lenslet_origin": list(found.origin),
            "lenslet_pitch": list(found.pitch),
        },
        "sources": [{"spot": [round(float(x), 2) for x in spot]} for spot in found.spots],
    }


def _words(grid: LensletGrid) -> str:
    import math

    rows, cols = grid.mask.shape
    spots = "1 spot" if grid.n_sources == 1 else f"{grid.n_sources} spots"
    return (
        f"{grid.kind} grid, pitch {grid.pitch[0]:.2f} x {grid.pitch[1]:.2f} px, "
        f"{int(grid.mask.sum())} of {rows} x {cols} lenslets, {spots} of {grid.fwhm:.1f} px"
        + (f", turned {round(math.degrees(grid.rotation), 2) + 0.0:.2f} deg" if grid.kind == "rectangular" else "")
    )


def _toml(grid: LensletGrid, found: Boxes, source: str) -> str:
    from ...pipeline.units import safe

    snippet = _snippet(found)
    rows = ",\n".join(f"  {row}" for row in snippet["instrument"]["subaperture_mask"])
    lines = [
        f"# {safe(Path(source).name)}: {_words(grid)};",
        f"# spots {grid.residual:.2f} px (rms) about the grid, boxes within {found.misfit:.2f} px of it",
        "[instrument]",
        f"subaperture_mask = [\n{rows},\n]",
        f"lenslet_origin = {snippet['instrument']['lenslet_origin']}",
        f"lenslet_pitch = {snippet['instrument']['lenslet_pitch']}",
    ]
    for item in snippet["sources"]:
        lines += ["", "[[sources]]", f"spot = {item['spot']}"]
    return "\n".join(lines)


def _differences(found: Boxes, known: Any) -> list[str]:
    """What the header of the archive has otherwise."""
    if known is None:
        return []
    instrument, snippet = known.instrument, _snippet(found)["instrument"]
    said = []
    for key, value in snippet.items():
        have = getattr(instrument, key)
        have = [list(row) for row in have] if key == "subaperture_mask" else list(have)
        if have != value:
            said.append(f"the archive's header has instrument.{key} = {have}")
    if len(known.sources) != len(found.spots):
        said.append(f"the archive's header has {len(known.sources)} sources, {len(found.spots)} were found")
    else:
        for number, (source, spot) in enumerate(zip(known.sources, found.spots, strict=True)):
            if max(abs(a - b) for a, b in zip(source.spot, spot, strict=True)) > 1:
                said.append(f"the archive's header has sources[{number}].spot = {list(source.spot)}")
    return said or ["the archive's header agrees with what was found"]
