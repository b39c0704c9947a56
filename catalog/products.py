"""Products: one archive under one lineage, as one immutable file.

A product is a zarr v3 group in a zip whose members are sorted, undated and not compressed, so that the same input
gives the same bytes on every machine, with every version of every library: its sha256 is its identity and the
regression test of whatever made it. It opens with xarray, or with any zarr reader. Times, host and command of a run
differ each time and stand in the catalog, not in the file; see :mod:`coslidar.catalog.provenance`.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import secrets
import socket
import struct
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from pydantic import TypeAdapter, ValidationError

from ..pipeline import lineage as lineages
from ..pipeline.parameters import Name
from ..pipeline.products import (
    COORDINATES,
    FIXED_COORDINATES,
    INTENSITY_KINDS,
    QUALITY_FLAGS,
    SCHEMA,
    SLOPE_KINDS,
    BatchResult,
    Variable,
)
from ..pipeline.units import safe, text
from . import provenance as records

if TYPE_CHECKING:
    from numpy.typing import NDArray

#: Version of the schema of products.
SCHEMA_VERSION = 1
CONVENTIONS = "CF-1.11"
#: How times are written.
TIME_UNITS = "nanoseconds since 1970-01-01T00:00:00"
_TIME_DTYPE = np.dtype("datetime64[ns]")

#: Coordinates that are names: dimension -> what they name. Those without a list are named by the archive.
_LABELS: dict[str, tuple[str, tuple[str, ...] | None]] = {
    "slope_kind": ("axis and pairing of a slope map", SLOPE_KINDS),
    "intensity_kind": ("pairing of a scintillation map", INTENSITY_KINDS),
    "axis": ("axis of a slope", ("x", "y")),
    "axis_kind": ("signal: slope along x, slope along y, intensity", ("x", "y", "i")),
    "source": ("name of the source", None),
    "scintillometer": ("name of a scintillometer on the same path", None),
}
#: Results that hold for the wavelength of the instrument only.
_AT_WAVELENGTH = (
    "r0_profile",
    "r0_direct",
    "zernike_variance",
    "zernike_variance_kolmogorov",
    "scintillation_index_direct",
    "scintillation_index_profile",
    "scintillation_index_point",
)
_LEVELS = "good usable bad"
_RESERVED = (
    "Conventions",
    "product_schema",
    "campaign",
    "archive",
    "archive_identity",
    "lineage_key",
    "lineage",
    "provenance",
    "wavelength",
)


class ProductError(ValueError):
    """A product that does not keep its promises, or a file that is none."""


def check_name(name: object, what: str) -> str:
    """Refuse a name that could not stand in a path.

    Parameters
    ----------
    name : object
        Name of a campaign or an archive.
    what : str
        Which of them, for the message.

    Returns
    -------
    str
        The name.

    Raises
    ------
    ProductError
        It is not 1 to 100 letters, digits, ``.``, ``_`` and ``-`` beginning with a letter or digit.
    """
    try:
        return str(TypeAdapter(Name).validate_python(name, strict=True))
    except ValidationError:
        raise ProductError(
            f"{what} = {safe(repr(name)[:120])}: use 1 to 100 letters, digits, '.', '_' and '-', beginning with a "
            "letter or digit"
        ) from None


def check_digest(digest: object, what: str) -> str:
    """Refuse what is not 64 lower-case hexadecimal digits."""
    if not isinstance(digest, str) or not re.fullmatch(r"[0-9a-f]{64}", digest):
        raise ProductError(f"{what} = {safe(repr(digest)[:120])}: it must be 64 hexadecimal digits")
    return digest


# --- building a dataset ------------------------------------------------------------------------------------


def assemble(
    results: Sequence[BatchResult],
    static: Mapping[str, Any],
    *,
    campaign: str,
    archive: str,
    archive_identity: str,
    lineage: lineages.Key | Mapping[str, Any],
    wavelength: float,
    sources: Sequence[str],
    scintillometers: Sequence[str] = (),
    attributes: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """Put the batches of an archive together.

    Parameters
    ----------
    results : sequence of BatchResult
        At least one, in any order. Floats of a batch that failed, or did not deliver a variable, are NaN, integers 0.
        Where no batch succeeded, every variable whose size is known is there nevertheless.
    static : mapping of str to array
        Coordinates ``z``, ``dy``, ``dx``, and variables without time: ``z_bounds``, ``pair_count``. ``log_mu_grid``
        stands here or among the values of each batch; if those differ, their union is the coordinate.
    campaign, archive : str
        Names from the archive's header.
    archive_identity : str
        sha256 of the archive.
    lineage : Key or mapping
        Key of the product, or its lineage document.
    wavelength : float
        Wavelength of the instrument, m.
    sources, scintillometers : sequence of str
        Names of the sources, and of the scintillometers on the path if there are any.
    attributes : mapping, optional
        Further global attributes: text, numbers, or lists of them.
    provenance : mapping, optional
        PROV document; of the lineage and the installed software where it is absent.

    Returns
    -------
    xarray.Dataset
        Checked against the schema.

    Raises
    ------
    ProductError
        Something delivered is not what the schema promises, batches overlap or are missing, or a name is refused.
    """
    if not results:
        raise ProductError("a product needs at least one batch")
    ordered = sorted(results, key=lambda result: result.start)
    for result, following in zip(ordered, [*ordered[1:], None], strict=True):
        if result.stop <= result.start or (following is not None and following.start < result.stop):
            raise ProductError(f"the batch that starts at {result.start} ns ends or overlaps where it must not")
    document = dict(lineages.document(lineage) if isinstance(lineage, lineages.Key) else lineage)
    identity = check_digest(archive_identity, "archive_identity")

    fixed = {**FIXED_COORDINATES, **{name: np.asarray(value) for name, value in static.items()}}
    grids = [fixed["log_mu_grid"]] if "log_mu_grid" in fixed else []
    grids += [np.asarray(r.values["log_mu_grid"]).reshape(-1) for r in ordered if "log_mu_grid" in r.values]
    if grids:
        fixed["log_mu_grid"] = np.unique(np.concatenate(grids))
    if "z" in fixed:
        fixed["z_true"] = fixed["z"]

    named = {"source": sources} | ({"scintillometer": scintillometers} if scintillometers else {})
    sizes = {
        "time": len(ordered),
        "bound": 2,
        **{name: len(labels) for name, labels in named.items()},
        **{name: len(labels) for name, (_, labels) in _LABELS.items() if labels is not None},
        **{name: value.size for name, value in fixed.items() if name in COORDINATES},
    }
    coordinates = {name: (name, value) for name, value in fixed.items() if name in COORDINATES}
    variables: dict[str, tuple[tuple[str, ...], NDArray[np.generic]]] = {
        name: (_promise(name).dims, value) for name, value in fixed.items() if name not in COORDINATES
    }
    for name in _delivered(ordered, sizes):
        variables[name] = (_promise(name).dims, _stack(name, ordered, sizes, fixed.get("log_mu_grid")))
    bounds = np.array([(result.start, result.stop) for result in ordered], dtype=np.int64)
    variables["time_bounds"] = (("time", "bound"), bounds.view(_TIME_DTYPE))
    variables["quality_flag"] = (("time",), np.array([r.quality_flag for r in ordered], dtype=np.int32))
    variables["quality_level"] = (("time",), np.array([r.quality_level for r in ordered], dtype=np.int8))

    dataset = xr.Dataset(variables, coordinates)
    dataset = dataset.assign_coords(time=("time", bounds[:, 0].view(_TIME_DTYPE)))
    for dim, (_, labels) in _LABELS.items():
        if dim in dataset.dims:
            names = named[dim] if labels is None else labels
            dataset = dataset.assign_coords({dim: (dim, np.array([str(name) for name in names]))})
    _describe(dataset, wavelength)

    extra = dict(attributes or {})
    taken = sorted(set(extra) & set(_RESERVED))
    if taken:
        raise ProductError(f"the attribute {taken[0]} is written by the product itself")
    written = (
        provenance
        if provenance is not None
        else records.of_product(document, campaign=campaign, archive=archive, archive_identity=identity)
    )
    dataset.attrs = {
        "Conventions": CONVENTIONS,
        "title": f"Cn2 profiles of {campaign}/{archive}",
        **extra,
        "product_schema": SCHEMA_VERSION,
        "campaign": campaign,
        "archive": archive,
        "archive_identity": identity,
        "wavelength": text(wavelength, "m"),
        "lineage_key": document["key"],
        "lineage": _json(document),
        "provenance": _json(written),
    }
    check(dataset)
    return dataset


def _promise(name: str) -> Variable:
    promised = COORDINATES.get(name) or SCHEMA.get(name)
    if promised is None:
        raise ProductError(f"{safe(name)}: a product has no such variable; promised are {', '.join(sorted(SCHEMA))}")
    return promised


def _delivered(results: Sequence[BatchResult], sizes: Mapping[str, int]) -> list[str]:
    """Variables with a time dimension that the product holds besides those of each batch itself."""
    own = {"time_bounds", "quality_flag", "quality_level"}
    names = {name for result in results for name in result.values if name not in COORDINATES}
    if not names:
        names = {
            name
            for name, promised in SCHEMA.items()
            if name not in own and "time" in promised.dims and all(dim in sizes for dim in promised.dims)
        }
    for name in sorted(names & own):
        raise ProductError(f"{name}: the product takes it from the batch itself; no stage delivers it")
    return sorted(names - own)


def _stack(
    name: str, results: Sequence[BatchResult], sizes: Mapping[str, int], grid: NDArray[np.generic] | None
) -> NDArray[np.generic]:
    promised = _promise(name)
    if promised.dims[:1] != ("time",):
        raise ProductError(f"{name}: promised once for a product; delivered by a batch")
    dtype = np.dtype(promised.dtype)
    blank = np.nan if dtype.kind == "f" else 0
    unknown = [dim for dim in promised.dims if dim not in sizes]
    if unknown:
        raise ProductError(f"{name}: delivered without its coordinate {unknown[0]}")
    shape = tuple(sizes[dim] for dim in promised.dims)
    whole = np.full(shape, blank, dtype)
    for number, result in enumerate(results):
        if name not in result.values:
            continue
        value = np.asarray(result.values[name])
        own_grid = result.values.get("log_mu_grid")
        if "log_mu_grid" in promised.dims and own_grid is not None and grid is not None:
            own = np.asarray(own_grid).reshape(-1)
            if value.shape != own.shape:
                raise ProductError(f"{name}: promised shape {own.shape}, delivered {value.shape}")
            spread = np.full(grid.shape, blank, dtype)
            spread[np.searchsorted(grid, own)] = value
            value = spread if value.dtype == dtype else value
        if value.dtype == np.bool_ and dtype == np.uint8:
            value = value.astype(np.uint8)
        if value.dtype != dtype:
            raise ProductError(f"{name}: promised dtype {dtype}, delivered {value.dtype}")
        if value.shape != shape[1:]:
            raise ProductError(
                f"{name}: promised dims ({', '.join(promised.dims[1:])}) of shape {shape[1:]}, delivered {value.shape}"
            )
        whole[number] = value
    return whole


def _describe(dataset: xr.Dataset, wavelength: float) -> None:
    """Give every variable its attributes."""
    for name, variable in dataset.variables.items():
        if name in _LABELS:
            variable.attrs = {"long_name": _LABELS[str(name)][0]}
            continue
        promised = _promise(str(name))
        variable.attrs = {"long_name": promised.long_name}
        # xarray keeps the units of times to itself; the file has them.
        if variable.dtype != _TIME_DTYPE:
            variable.attrs["units"] = promised.unit
        if name in _AT_WAVELENGTH:
            variable.attrs["wavelength"] = text(wavelength, "m")
    attributes: dict[str, dict[str, Any]] = {
        "time": {"standard_name": "time", "axis": "T", "bounds": "time_bounds"},
        "z": {"bounds": "z_bounds"} if "z_bounds" in dataset else {},
        "quality_flag": {
            "flag_masks": [bit for bit, _, _ in QUALITY_FLAGS.values()],
            "flag_meanings": " ".join(QUALITY_FLAGS),
            "comment": "; ".join(f"{flag}: {meaning}" for flag, (_, _, meaning) in QUALITY_FLAGS.items()),
        },
        "quality_level": {"flag_values": [0, 1, 2], "flag_meanings": _LEVELS},
        "cn2_at_bound": {"flag_values": [0, 1], "flag_meanings": "free at_bound"},
    }
    for name, more in attributes.items():
        if name in dataset.variables:
            dataset[name].attrs.update(more)


def _json(value: object) -> str:
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError) as error:
        raise ProductError(f"an attribute cannot be written: {error}") from error


def check(dataset: xr.Dataset) -> None:
    """Compare a dataset with the schema.

    Parameters
    ----------
    dataset : xarray.Dataset
        What is to become a product.

    Raises
    ------
    ProductError
        Every fault at once: ``<variable>: promised <unit, dims or dtype>, delivered <...>``.
    """
    faults: list[str] = []
    for key, variable in dataset.variables.items():
        name = str(key)
        if name in _LABELS:
            if variable.dims != (name,) or variable.dtype.kind not in "UT":
                faults.append(
                    f"{name}: promised names along ({name}), delivered {variable.dtype} along {variable.dims}"
                )
            continue
        promised = COORDINATES.get(name) or SCHEMA.get(name)
        if promised is None:
            faults.append(f"{safe(name)}: a product has no such variable")
            continue
        if (name in COORDINATES) != (key in dataset.coords):
            faults.append(f"{name}: promised as {'coordinate' if name in COORDINATES else 'data variable'}")
        time = promised.unit == "ns"
        dtype = _TIME_DTYPE if time else np.dtype(promised.dtype)
        if variable.dims != promised.dims:
            faults.append(f"{name}: promised dims {promised.dims}, delivered {variable.dims}")
        if variable.dtype != dtype:
            faults.append(f"{name}: promised dtype {dtype}, delivered {variable.dtype}")
        if not time and variable.attrs.get("units") != promised.unit:
            found = variable.attrs.get("units")
            delivered = "none" if found is None else f"'{safe(str(found))}'"
            faults.append(f"{name}: promised unit '{promised.unit}', delivered {delivered}")
        if time and np.isnat(variable.values).any():
            faults.append(f"{name}: promised times, delivered NaT")
    for name in ("time", "time_bounds", "quality_flag", "quality_level"):
        if name not in dataset.variables:
            faults.append(f"{name}: promised, not delivered")
    for name in _RESERVED:
        if name not in dataset.attrs:
            faults.append(f"attribute {name}: promised, not delivered")
    for what in ("campaign", "archive"):
        if what in dataset.attrs:
            try:
                check_name(dataset.attrs[what], what)
            except ProductError as error:
                faults.append(str(error))
    for what in ("archive_identity", "lineage_key"):
        if what in dataset.attrs:
            try:
                check_digest(dataset.attrs[what], what)
            except ProductError as error:
                faults.append(str(error))
    if faults:
        raise ProductError("\n".join(faults))


# --- file --------------------------------------------------------------------------------------------------


def product_bytes(dataset: xr.Dataset) -> bytes:
    """The file of a product.

    Parameters
    ----------
    dataset : xarray.Dataset
        See :func:`assemble`.

    Returns
    -------
    bytes
        The same for equal datasets: members sorted, dated 1980-01-01, uncompressed; JSON sorted by key.

    Raises
    ------
    ProductError
        The dataset differs from the schema, or an attribute cannot be written as JSON.
    """
    check(dataset)
    arrays = {}
    for key, variable in dataset.variables.items():
        attributes, values = dict(variable.attrs), np.asarray(variable.values)
        if values.dtype == _TIME_DTYPE:
            values = values.view(np.int64)
            attributes |= {"units": TIME_UNITS, "calendar": "standard"}
        arrays[str(key)] = (values, tuple(str(name) for name in variable.dims), attributes)
    return group_bytes(arrays, dict(dataset.attrs))


def group_bytes(
    arrays: Mapping[str, tuple[NDArray[Any], tuple[str, ...], Mapping[str, Any]]], attributes: Mapping[str, Any]
) -> bytes:
    """A zarr v3 group in a zip: the same bytes for the same content.

    Parameters
    ----------
    arrays : mapping
        Name -> values, dimensions, attributes.
    attributes : mapping
        Of the group.

    Returns
    -------
    bytes
        Members sorted, dated 1980-01-01, uncompressed; JSON sorted by key.

    Raises
    ------
    ProductError
        An attribute cannot be written as JSON.
    """
    members = {"zarr.json": _document({"zarr_format": 3, "node_type": "group", "attributes": dict(attributes)})}
    for name, (values, dimensions, described) in arrays.items():
        specification, chunk = _array(values)
        members[f"{name}/zarr.json"] = _document(
            {**specification, "attributes": dict(described), "dimension_names": list(dimensions)}
        )
        if values.size:
            members["/".join([name, "c", *("0" * values.ndim)])] = chunk
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(members):
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.create_system, entry.external_attr = 3, 0o644 << 16
            archive.writestr(entry, members[name])
    return packed.getvalue()


def fingerprint(dataset: xr.Dataset) -> str:
    """Hash of a product without its provenance: the same as long as lineage and numbers are.

    The file itself also changes with the commit and the versions of the software that made it, since they stand in
    its provenance.

    Parameters
    ----------
    dataset : xarray.Dataset
        See :func:`assemble`.

    Returns
    -------
    str
        sha256, 64 hexadecimal digits.
    """
    return hashlib.sha256(product_bytes(dataset.assign_attrs(provenance=""))).hexdigest()


def _document(content: Mapping[str, Any]) -> bytes:
    return _json(content).encode("ascii")


def _array(values: NDArray[Any]) -> tuple[dict[str, Any], bytes]:
    """Metadata of a zarr v3 array in one chunk, and the chunk."""
    codec: dict[str, Any]
    fill: Any
    if values.dtype.kind in "UT":
        encoded = [str(item).encode("utf-8", "replace") for item in values.ravel()]
        chunk = struct.pack("<I", len(encoded)) + b"".join(struct.pack("<I", len(e)) + e for e in encoded)
        data_type, fill, codec = "string", "", {"name": "vlen-utf8", "configuration": {}}
    else:
        little = np.array(values, dtype=values.dtype.newbyteorder("<"), order="C")
        if little.dtype.kind == "f":
            # The sign of a NaN tells how it came about, which is nobody's business.
            little[np.isnan(little)] = np.nan
        chunk, data_type = little.tobytes(), str(values.dtype)
        fill = "NaN" if values.dtype.kind == "f" else 0
        codec = {"name": "bytes"}
        if values.dtype.itemsize > 1:
            codec["configuration"] = {"endian": "little"}
    shape = list(values.shape)
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": data_type,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [max(1, n) for n in shape]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": fill,
        "codecs": [codec],
        "storage_transformers": [],
    }, chunk


def write_product(dataset: xr.Dataset, path: str | os.PathLike[str]) -> str:
    """Write a product as one file, whole or not at all.

    Parameters
    ----------
    dataset : xarray.Dataset
        See :func:`assemble`.
    path : path
        The file, usually ``*.zarr.zip``; replaced where it is there. Its folder must exist.

    Returns
    -------
    str
        sha256 of the file.

    Raises
    ------
    ProductError
        See :func:`product_bytes`. Nothing is written then.
    OSError
        The file cannot be written.
    """
    data, target = product_bytes(dataset), Path(path)
    temporary = write_temporary(data, target.parent)
    try:
        os.replace(temporary, target)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(target.parent)
    return hashlib.sha256(data).hexdigest()


def temporary_name() -> str:
    """Name for a file that is being written; says which process on which host writes it."""
    host = re.sub(r"[^A-Za-z0-9]", "-", socket.gethostname())[:60]
    return f".{secrets.token_hex(8)}.{host}.{os.getpid()}.part"


def write_temporary(data: bytes, folder: Path) -> Path:
    """Write bytes to a new file of a folder and wait until they are on the disk."""
    temporary = folder / temporary_name()
    try:
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    return temporary


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk, where the system can do that."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        return
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def open_product(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a product.

    Parameters
    ----------
    path : path
        A ``*.zarr.zip`` file of a catalog.

    Returns
    -------
    xarray.Dataset
        In memory; `time` is UTC in ``datetime64[ns]``.

    Raises
    ------
    ProductError
        There is no such file, it is damaged, or it is no product of this schema.
    """
    from zarr.storage import ZipStore

    name = safe(os.fspath(path))
    target = Path(path)
    if not target.is_file():
        raise ProductError(f"{name}: there is no such file")
    try:
        with zipfile.ZipFile(target) as archive:
            head = json.loads(archive.read("zarr.json"))["attributes"]
            if "product_schema" not in head:
                raise ProductError(f"{name}: this is a zarr group, but no product")
            damaged = archive.testzip()
        if damaged is not None:
            raise ProductError(f"{name}: {safe(damaged)} is damaged")
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, OSError) as error:
        if isinstance(error, ProductError):
            raise
        raise ProductError(f"{name}: this is no product, or a damaged one: {error}") from error
    if head["product_schema"] != SCHEMA_VERSION:
        raise ProductError(
            f"{name}: the product has schema {head['product_schema']!r}; this version reads {SCHEMA_VERSION}"
        )
    store = ZipStore(target, mode="r")
    try:
        with xr.open_zarr(store, consolidated=False, chunks=None) as lazy:
            dataset: xr.Dataset = lazy.load()
    except Exception as error:
        raise ProductError(f"{name}: the product cannot be read: {error}") from error
    finally:
        store.close()
    for label in _LABELS:
        if label in dataset.coords:
            attributes = dataset[label].attrs
            names = np.array([str(name) for name in dataset[label].values])
            dataset = dataset.assign_coords({label: (label, names, attributes)})
    for variable in dataset.variables.values():
        # What the file says about storage is no business of whoever writes it elsewhere.
        variable.encoding = {}
    return dataset
