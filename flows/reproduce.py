"""From a product back to the campaign file that makes it again."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from ..catalog.archive import ArchiveError, ChunkError, open_archive
from ..pipeline import batch as stages
from ..pipeline.parameters import (
    BatchParameters,
    CorrelationParameters,
    ExtractionParameters,
    InversionParameters,
    ResponseParameters,
)
from ..pipeline.units import safe
from ..plugins.registry import KEYS, PluginError, get
from .settings import HEADER_TABLES, InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from xarray import Dataset

#: Stage -> version that this code has.
VERSIONS = {
    "measurements": stages.MEASURE_VERSION,
    "correlation": stages.REDUCE_VERSION,
    "response": stages.RESPONSE_VERSION,
    "profile": stages.RETRIEVE_VERSION,
}


def campaign_file(dataset: Dataset, url: str, header: Mapping[str, Any], output: str = "reproduced") -> str:
    """Write the campaign file that makes a product again.

    Every parameter is written down as the lineage has it, defaults too: they may change with another version.

    Parameters
    ----------
    dataset : xarray.Dataset
        The product.
    url : str
        Where its archive is.
    header : mapping
        Header that the archive was processed with, as the catalog has it.
    output : str
        Folder for the new catalog.

    Returns
    -------
    str
        TOML. Comments at its top say what may keep the result from being the same.

    Raises
    ------
    InputError
        The lineage names what this coslidar does not know.
    """
    import tomli_w

    lineage, key = json.loads(dataset.attrs["lineage"]), str(dataset.attrs["lineage_key"])
    nodes = {node["stage"]: node for node in lineage["nodes"].values()}
    try:
        table = {
            "campaign": str(dataset.attrs["campaign"]),
            "archives": [url],
            "output": output,
            **_parameters(nodes),
            **_plugins(nodes),
            **_header(url, str(dataset.attrs["archive_identity"]), header),
        }
    except (KeyError, TypeError) as error:
        raise InputError([f"the lineage of {key[:16]} is not one that this coslidar can read: {error}"]) from error
    notes = [
        f"Makes the product {safe(str(dataset.attrs['archive']))}.{key[:16]} again: key {key}",
        f"Software: {_software(dataset)}",
        *(f"ATTENTION: {fault}" for fault in differences(nodes)),
    ]
    return "".join(f"# {note}\n" for note in notes) + "\n" + tomli_w.dumps(table)


def differences(nodes: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Why this code gives another product, whatever the campaign file says."""
    found = []
    for stage, node in nodes.items():
        version, _, mark = str(node["version"]).partition("+")
        if mark:
            found.append(f"stage {stage} was computed by a modified checkout ({safe(mark)})")
        if stage in VERSIONS and version != str(VERSIONS[stage]):
            found.append(f"stage {stage} was of version {safe(version)}, this coslidar has version {VERSIONS[stage]}")
        for kind, identities in node["plugins"].items():
            for identity in identities if isinstance(identities, list) else [identities]:
                found += _plugin_difference(kind, identity)
    return found


def _plugin_difference(kind: str, identity: Mapping[str, Any]) -> list[str]:
    name, version = str(identity["name"]), identity["version"]
    key = "source" if kind == "sources" else kind
    try:
        mine = get(KEYS[key], name).version
    except PluginError as error:
        return [f"{key} '{safe(name)}' cannot be had: {safe(str(error))}"]
    return [] if mine == version else [f"{key} '{name}' was of version {version}, version {mine} is installed"]


def _software(dataset: Dataset) -> str:
    """What made the product, from its provenance."""
    agent = json.loads(dataset.attrs["provenance"])["agent"]["coslidar:software"]
    packages = [f"{name[8:]} {value}" for name, value in agent.items() if name.startswith("package:")]
    return safe(f"{agent['prov:label']}, commit {agent['coslidar:commit'] or 'unknown'}; {', '.join(packages)}")


def _parameters(nodes: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Tables of the stages."""
    measured, response = nodes["measurements"]["tracked"], nodes["response"]["tracked"]
    of_response = {name: value for name, value in response.items() if name in ResponseParameters.model_fields}
    of_response |= {"slices": len(response["edges"]) - 1, "extent": response["edges"][-1]}
    profile = nodes["profile"]["tracked"]
    return {
        "batch": written(BatchParameters, measured["batch"]),
        "extraction": written(ExtractionParameters, measured["extraction"]),
        "correlation": written(CorrelationParameters, nodes["correlation"]["tracked"]),
        "response": written(ResponseParameters, of_response),
        "inversion": written(
            InversionParameters,
            {name: value for name, value in profile.items() if name in InversionParameters.model_fields},
        ),
    }


def _plugins(nodes: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Tables of the plugins."""
    response, profile = nodes["response"]["plugins"], nodes["profile"]["plugins"]
    sources = response["sources"]
    # Models of several sources differ in what each one's header says of it.
    shared = {
        name: value
        for name, value in sources[0]["parameters"].items()
        if all(other["parameters"].get(name) == value for other in sources)
    }
    chosen = {
        "source": {**sources[0], "parameters": shared},
        "spectrum": response["spectrum"],
        "regulariser": profile["regulariser"],
        "selector": profile["selector"],
    }
    return {key: _plugin(key, identity) for key, identity in chosen.items()}


def _plugin(key: str, identity: Mapping[str, Any]) -> dict[str, Any]:
    try:
        model = get(KEYS[key], str(identity["name"]))
    except PluginError as error:
        raise InputError(
            [f"{key}.name = '{safe(str(identity['name']))}': {fault}" for fault in error.faults]
        ) from error
    return {"name": str(identity["name"]), **written(model, identity["parameters"])}


def written(model: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters from a lineage (SI floats) as a campaign file has them (text with units); None is left out."""
    read: dict[str, Any] = {}
    for name, value in values.items():
        inner = _inner(model, name)
        if value is None:
            continue
        read[name] = written(inner, value) if inner is not None and isinstance(value, dict) else _numbers(value)
    nested = {name: value for name, value in read.items() if isinstance(value, dict)}
    plain = model.model_construct(**{name: value for name, value in read.items() if name not in nested})
    return {**plain.model_dump(mode="json", include=set(read) - set(nested)), **nested}


def _inner(model: type[BaseModel], name: str) -> type[BaseModel] | None:
    """Model of a field that is a table itself."""
    annotation = model.model_fields[name].annotation
    candidates = [annotation, *getattr(annotation, "__args__", ())]
    return next((one for one in candidates if isinstance(one, type) and issubclass(one, BaseModel)), None)


def _numbers(value: Any) -> Any:
    """JSON values as the models have them: tuples, and infinity, which a lineage writes as text."""
    if isinstance(value, list):
        return tuple(_numbers(item) for item in value)
    return float(value) if value in ("inf", "-inf") else value


def _header(url: str, identity: str, header: Mapping[str, Any]) -> dict[str, Any]:
    """Tables on top of the archive's header: none where the archive alone is what was processed."""
    try:
        if open_archive(url, allow_missing=True).identity == identity:
            return {}
    except (ArchiveError, ChunkError):
        pass  # it cannot be asked, or needs these tables to be one
    return {name: _without_none(header[name]) for name in HEADER_TABLES if name in header}


def _without_none(value: Any) -> Any:
    """TOML has no null."""
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return [_without_none(item) for item in value] if isinstance(value, list) else value
