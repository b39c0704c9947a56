"""Provenance in the terms of W3C PROV, as PROV-JSON (https://www.w3.org/submissions/prov-json/).

Two documents. The one inside a product holds what is the same whenever the product is made again: what was made from
what, by which stages with which parameters, with which versions of which software, from which commit. Because product
files are reproducible byte for byte, times, host, user and command line stand in the catalog's table of runs; the
document that the catalog gives for a product joins the two.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from ..pipeline.lineage import checkout

#: Packages whose version can change a number.
NUMERICAL = ("coslidar", "numpy", "scipy", "numba", "llvmlite", "pint", "numcodecs", "zarr")
_PREFIXES = {"coslidar": "urn:coslidar:", "package": "urn:pypi:"}


@lru_cache(maxsize=8)
def software(more: tuple[str, ...] = ()) -> dict[str, str]:
    """Versions of Python and of the packages that can change a number.

    Parameters
    ----------
    more : tuple of str
        Further distributions, as those of plugins.

    Returns
    -------
    dict of str to str
        Distribution -> version; what is not installed is left out.
    """
    found = {"python": platform.python_version()}
    for name in (*NUMERICAL, *more):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def of_product(
    document: Mapping[str, Any],
    *,
    campaign: str,
    archive: str,
    archive_identity: str,
    packages: Iterable[str] = (),
) -> dict[str, Any]:
    """Reproducible part of the provenance of a product.

    Parameters
    ----------
    document : mapping
        Lineage document; see :func:`coslidar.pipeline.lineage.document`.
    campaign, archive : str
        Names from the archive's header.
    archive_identity : str
        sha256 of the archive.
    packages : iterable of str
        Distributions of the plugins that were used.

    Returns
    -------
    dict
        PROV-JSON: an entity for the archive and for every key of the lineage, an activity for every stage, an agent
        for the software with its commit and the versions of what it builds on.
    """
    state = checkout()
    versions = software(tuple(sorted(set(packages))))
    source = f"coslidar:archive.{archive_identity}"
    agent = "coslidar:software"
    written: dict[str, Any] = {
        "prefix": dict(_PREFIXES),
        "entity": {source: {"prov:label": f"{campaign}/{archive}", "prov:type": "raw archive"}},
        "activity": {},
        "agent": {
            agent: {
                "prov:type": {"$": "prov:SoftwareAgent", "type": "prov:QUALIFIED_NAME"},
                "prov:label": f"coslidar {versions.get('coslidar', '')}{state.mark}".strip(),
                "coslidar:commit": str(state),
                **{f"package:{name}": number for name, number in sorted(versions.items())},
            }
        },
        "used": {},
        "wasGeneratedBy": {},
        "wasAssociatedWith": {},
        "wasDerivedFrom": {},
    }
    for digest, node in sorted(document["nodes"].items()):
        entity, activity = f"coslidar:result.{digest}", f"coslidar:stage.{digest}"
        kind = "product" if digest == document["key"] else "intermediate result"
        written["entity"][entity] = {"prov:label": node["stage"], "prov:type": kind}
        written["activity"][activity] = {"prov:label": node["stage"], "coslidar:version": node["version"]}
        written["wasGeneratedBy"][f"_:g.{digest}"] = {"prov:entity": entity, "prov:activity": activity}
        written["wasAssociatedWith"][f"_:a.{digest}"] = {"prov:activity": activity, "prov:agent": agent}
        tracked = node["tracked"] if isinstance(node["tracked"], dict) else {}
        reads = archive_identity in node["upstream"] or tracked.get("archive") == archive_identity
        inputs = [source] if reads else []
        inputs += [f"coslidar:result.{item}" for item in node["upstream"] if item in document["nodes"]]
        for number, item in enumerate(inputs):
            written["used"][f"_:u.{digest}.{number}"] = {"prov:activity": activity, "prov:entity": item}
            written["wasDerivedFrom"][f"_:d.{digest}.{number}"] = {
                "prov:generatedEntity": entity,
                "prov:usedEntity": item,
            }
    return written


def with_run(written: Mapping[str, Any], run: Mapping[str, Any], product: str) -> dict[str, Any]:
    """Join the run that made a product to the provenance inside it.

    Parameters
    ----------
    written : mapping
        Document of :func:`of_product`.
    run : mapping
        ``id``, ``started`` and ``finished`` (ns since 1970 UTC or None), ``host``, ``command``, ``state``.
    product : str
        Lineage key of the product.

    Returns
    -------
    dict
        PROV-JSON.
    """
    joined = {
        section: dict(content) if isinstance(content, Mapping) else content for section, content in written.items()
    }
    activity, host = f"coslidar:run.{run['id']}", "coslidar:host"
    times = {"prov:startTime": run["started"], "prov:endTime": run["finished"]}
    joined.setdefault("activity", {})[activity] = {
        "prov:label": "run",
        "coslidar:command": run["command"],
        "coslidar:state": run["state"],
        **{name: iso(value) for name, value in times.items() if value is not None},
    }
    joined.setdefault("agent", {})[host] = {"prov:label": run["host"], "prov:type": "computer"}
    joined.setdefault("wasAssociatedWith", {})["_:a.run"] = {"prov:activity": activity, "prov:agent": host}
    # The run published what the stage computed: the product is the stage's result, and the run informed by it.
    joined.setdefault("wasInformedBy", {})["_:i.run"] = {
        "prov:informed": activity,
        "prov:informant": f"coslidar:stage.{product}",
    }
    return joined


def iso(nanoseconds: int) -> str:
    """UTC time as ISO 8601 with microseconds."""
    seconds, rest = divmod(nanoseconds, 10**9)
    moment = datetime.fromtimestamp(seconds, UTC).replace(microsecond=rest // 1000)
    return moment.isoformat(timespec="microseconds").replace("+00:00", "Z")


def surroundings() -> dict[str, str]:
    """What a run happens in and no product depends on: host, system, interpreter."""
    return {"host": platform.node(), "system": platform.platform(), "interpreter": sys.executable}
