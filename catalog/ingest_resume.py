"""Half an archive: what an ingest that was interrupted leaves, and how the next one goes on with it.

Beside ``evening.zarr.zip`` that is the hidden folder ``.evening.zarr.zip.partial`` with the archive as a folder and a
journal: lines of JSON, the first of them what the archive is made of, then one for each file of it that is complete,
with its size and checksum. A line is written after its file; what has no line, or another checksum, is made again.
"""

from __future__ import annotations

import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Beginning of the names of chunks of frames in an archive.
_CHUNKS = "frames/c/"


def partial_folder(output: Path) -> Path:
    """Where an archive grows: hidden, so that no pattern finds half of one."""
    return output.parent / f".{output.name}.partial"


@dataclass(frozen=True)
class Journal:
    """What an earlier ingest has left.

    Parameters
    ----------
    made_of : dict
        Sources and options, see :class:`Partial`.
    files : dict
        Name of a file within the archive -> (bytes, crc32).
    """

    made_of: dict[str, Any]
    files: dict[str, tuple[int, int]]


def read_journal(folder: Path) -> Journal | None:
    """The journal of a partial archive; None where there is none that can be read."""
    try:
        first, *lines = (folder / "journal").read_text("utf-8").splitlines()
        made_of = dict(json.loads(first))
    except (OSError, ValueError, TypeError):
        return None
    files = {}
    for line in lines:
        try:
            name, size, crc = json.loads(line)
        except (ValueError, TypeError):
            break  # the power may fail within a line; those before it hold
        files[name] = (size, crc)
    return Journal(made_of, files)


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """What is not as it was, in words.

    Parameters
    ----------
    before : mapping
        What the partial archive is made of.
    now : mapping
        What it is to be made of; keys that it lacks are not compared.

    Returns
    -------
    list of str
        Empty where the one can go on with the other.
    """
    changed = []
    files = {name: (size, modified) for name, size, modified in before.get("inputs", [])}
    inputs = {name: (size, modified) for name, size, modified in now["inputs"]}
    if list(files.items()) != list(inputs.items()):
        other = [name for name, known in inputs.items() if name in files and files[name] != known]
        fresh = [name for name in inputs if name not in files]
        gone = [name for name in files if name not in inputs]
        for names, what in ((other, "changed"), (fresh, "new"), (gone, "not named any more")):
            if names:
                changed.append(f"{names[0]}{f' and {len(names) - 1} more' if names[1:] else ''}: {what}")
        changed = changed or ["the files stand in another order"]
    elif before.get("fingerprint") != now["fingerprint"]:
        changed.append("header, table [ingest], calibration or times: changed")
    for key in now.keys() - {"inputs", "fingerprint"}:
        if before.get(key) != now[key]:
            changed.append(f"{key.replace('_', ' ')}: now {now[key]}, {before.get(key)} before")
    return sorted(changed)


class Partial:
    """An archive in the making.

    Parameters
    ----------
    folder : Path
        See :func:`partial_folder`.
    made_of : mapping
        Plain values that decide about every byte of the archive: ``inputs`` with path, size and time of each file,
        ``fingerprint`` of all else that was read, options, versions of the libraries that write.
    """

    def __init__(self, folder: Path, made_of: Mapping[str, Any]) -> None:
        self.folder, self.made_of = folder, dict(made_of)
        self.archive = folder / "archive.zarr"
        self._files: dict[str, tuple[int, int]] = {}

    @property
    def chunks(self) -> set[int]:
        """Numbers of the chunks of frames that are complete."""
        return {_chunk(name) for name in self._files if name.startswith(_CHUNKS)}

    def begin(self, create: Callable[[Path], None]) -> None:
        """Begin anew.

        Parameters
        ----------
        create : callable
            Makes everything but the chunks of frames, in the folder that it is given.
        """
        discard(self.folder)
        self.folder.mkdir()
        create(self.archive)
        self._files = {name: _mark(self.archive / name) for name in self._present()}
        self._write_journal()

    def go_on(self, journal: Journal) -> int | None:
        """Keep the files that are as the journal says, and remove all others.

        Returns
        -------
        int or None
            Number of chunks that were complete and are not any more; None where something else than chunks is
            missing or damaged, so that it must begin anew.
        """
        present = self._present()
        whole = {
            name: mark for name, mark in journal.files.items() if name in present and _mark(self.archive / name) == mark
        }
        if not whole or any(name not in whole and not name.startswith(_CHUNKS) for name in journal.files):
            return None
        for name in present - whole.keys():
            (self.archive / name).unlink()
        self._files = whole
        self._write_journal()
        return len(journal.files) - len(whole)

    def complete(self, chunk: int) -> None:
        """Enter a chunk of frames that has just been written."""
        name = f"{_CHUNKS}{chunk}/0/0"
        self._files[name] = _mark(self.archive / name)
        with (self.folder / "journal").open("a", encoding="utf-8") as file:
            file.write(self._line(name))

    def missing(self, n_chunks: int) -> list[tuple[int, int]]:
        """Runs of chunks that are still to be made: the first of each, and the one after its last."""
        there = self.chunks
        runs: list[tuple[int, int]] = []
        for number in range(n_chunks):
            if number in there:
                continue
            if runs and runs[-1][1] == number:
                runs[-1] = (runs[-1][0], number + 1)
            else:
                runs.append((number, number + 1))
        return runs

    def finished(self, packed: bool) -> Path:
        """The whole archive, on the disk: the folder, or a zip of it that has the same bytes whenever it is made."""
        names = sorted(self._files, key=lambda name: (_chunk(name), name.count("/"), name))
        if not packed:
            for name in names:
                _flush(self.archive / name)
            return self.archive
        path = self.folder / "archive.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as file:
            for name in names:
                member = zipfile.ZipInfo(name)  # of 1980, whenever that is
                member.external_attr = 0o644 << 16
                file.writestr(member, (self.archive / name).read_bytes())
        _flush(path)
        return path

    def _present(self) -> set[str]:
        return {path.relative_to(self.archive).as_posix() for path in self.archive.rglob("*") if path.is_file()}

    def _line(self, name: str) -> str:
        return json.dumps([name, *self._files[name]]) + "\n"

    def _write_journal(self) -> None:
        fresh = self.folder / "journal.new"
        lines = [json.dumps(self.made_of) + "\n", *(self._line(name) for name in self._files)]
        fresh.write_text("".join(lines), "utf-8")
        os.replace(fresh, self.folder / "journal")


def discard(folder: Path) -> None:
    """Remove a partial archive."""
    shutil.rmtree(folder, ignore_errors=True)


def _chunk(name: str) -> int:
    """Number of a chunk of frames; -1 for what stands before all of them."""
    return int(name.split("/")[2]) if name.startswith(_CHUNKS) else -1


def _mark(path: Path) -> tuple[int, int]:
    content = path.read_bytes()
    return len(content), zlib.crc32(content)


def _flush(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())
