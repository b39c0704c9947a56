"""Products whose files are damaged or gone, computed again."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from ..catalog.archive import ArchiveError
from ..pipeline.units import safe
from ..plugins.registry import PluginError
from .plan import plan_archive
from .reproduce import campaign_file, differences
from .run import run as process
from .settings import InputError, load

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ..catalog.store import Catalog, ProductRow


@dataclass(frozen=True)
class Repair:
    """What became of a damaged product.

    Parameters
    ----------
    row : ProductRow
        The product.
    sound : bool
        Whether its file is what its row says now.
    same : bool
        Whether it has the bytes that were lost.
    reasons : tuple of str
        Why it is not sound, or not the same.
    """

    row: ProductRow
    sound: bool
    same: bool = False
    reasons: tuple[str, ...] = ()


def repair(catalog: Catalog, row: ProductRow, folder: Path | None = None) -> Repair:
    """Compute a product again from its lineage and its archive, and put it in its place.

    A damaged file is kept aside until the new one is there, and put back where there will be none.

    Parameters
    ----------
    catalog : Catalog
        Where the product is.
    row : ProductRow
        A product that :meth:`Catalog.verify` found fault with.
    folder : Path, optional
        Where relative paths of archives begin; the folder of the run that made the product where it is absent.

    Returns
    -------
    Repair
    """
    url, header = catalog.recording(row)
    document, made = catalog.lineage(row), catalog.made_by(row)
    begin = folder if folder is not None else Path((made.configuration.get("folder") if made else None) or ".")
    place = url if "://" in url else str(begin / url)
    why = tuple(differences({node["stage"]: node for node in document["nodes"].values()}))
    try:
        settings = _settings(catalog, row, document, place, header, made.commit if made else "")
        planned = plan_archive(place, settings)
    except (ArchiveError, InputError, PluginError) as error:
        return Repair(row, False, reasons=(*error.faults, *why))
    if planned.archive.identity != row.archive_identity:
        return Repair(row, False, reasons=(f"{safe(place)}: this is another recording than the product was made of",))
    if str(planned.profile_key) != row.lineage_key:
        changed = why or ("this code gives the product another key",)
        return Repair(row, False, reasons=(*changed, "'coslidar run' makes a product of its own of this recording"))

    aside = row.path.with_name(f".{row.path.name}.damaged")
    if row.path.is_file():
        row.path.rename(aside)
    try:
        outcome = process(settings, prefect=False)[0]
    finally:
        found = catalog.products(archive_identity=row.archive_identity, lineage_key=row.lineage_key)[0]
        there = found.path.is_file()
        if aside.is_file():
            aside.unlink() if there else aside.rename(row.path)
    if not there:
        return Repair(row, False, reasons=outcome.faults or (f"the recording was {outcome.status}",))
    same = found.sha256 == row.sha256
    return Repair(found, True, same, () if same else ("numbers or provenance differ from those that were lost", *why))


def _settings(
    catalog: Catalog, row: ProductRow, document: Mapping[str, Any], url: str, header: Mapping[str, Any], commit: str
) -> Any:
    """Settings that make the product, from what the database says of it: the file can no longer be asked."""
    attributes = {
        "campaign": row.campaign,
        "archive": row.archive,
        "archive_identity": row.archive_identity,
        "lineage_key": row.lineage_key,
        "lineage": json.dumps(document),
        "provenance": json.dumps({"agent": {"coslidar:software": {"prov:label": "", "coslidar:commit": commit}}}),
    }
    lost: Any = SimpleNamespace(attrs=attributes)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "repair.toml"
        file.write_text(campaign_file(lost, url, header, str(catalog.root)), encoding="utf-8")
        return load(file, output=catalog.root)
