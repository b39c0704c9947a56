"""Move the fragments of this folder into CHANGES.md: `python changes/collect.py VERSION [DATE]`."""

from __future__ import annotations

import datetime
import sys
from pathlib import Path

KINDS = {"added": "Added", "changed": "Changed", "fixed": "Fixed", "removed": "Removed"}
HERE = Path(__file__).resolve().parent


def fragments(folder: Path) -> list[tuple[str, Path]]:
    """Kind and file of each fragment, in the order of kinds and names.

    Raises
    ------
    ValueError
        Files whose name names no kind, all at once.
    """
    found = [(path.name.split(".")[-2], path) for path in sorted(folder.glob("*.*.md"))]
    unknown = [path.name for kind, path in found if kind not in KINDS]
    unknown += [path.name for path in folder.glob("*.md") if path.name.count(".") < 2]
    if unknown:
        raise ValueError(f"{', '.join(sorted(unknown))}: write <subject>.<kind>.md, kind one of {', '.join(KINDS)}")
    return sorted(found, key=lambda item: (list(KINDS).index(item[0]), item[1].name))


def section(folder: Path, version: str, date: str) -> str:
    """The section of a release."""
    parts = [f"## {version} ({date})\n"]
    last = None
    for kind, path in fragments(folder):
        if kind != last:
            parts.append(f"\n### {KINDS[kind]}\n\n")
            last = kind
        text = path.read_text("utf-8").strip().replace("\n", "\n  ")
        parts.append(f"- {text}\n")
    return "".join(parts)


def collect(changes: Path, folder: Path, version: str, date: str) -> None:
    """Put a section for `version` on top of the releases in `changes`, and remove the fragments."""
    head, mark, rest = changes.read_text("utf-8").partition("<!-- releases -->\n")
    if not mark:
        raise ValueError(f"{changes}: the line '<!-- releases -->' is missing")
    used = [path for _, path in fragments(folder)]
    changes.write_text(f"{head}{mark}\n{section(folder, version, date)}{rest}", "utf-8")
    for path in used:
        path.unlink()


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    today = sys.argv[2] if len(sys.argv) == 3 else datetime.datetime.now(datetime.UTC).date().isoformat()
    collect(HERE.parent / "CHANGES.md", HERE, sys.argv[1], today)
