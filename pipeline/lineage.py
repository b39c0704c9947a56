"""Keys that say what a result was made of.

A key is the hash of everything that decides a result: the stage, its version, its tracked parameters, the plugins
it used and the keys of what it was made from. Equal keys mean equal results, so a result that is already there
under its key is not computed again. Paths, hosts, times, threads and chunk sizes decide nothing and stay outside.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import subprocess
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

#: Version of the way keys are made; raising it makes every stored result a stranger.
SCHEME = 1


class LineageError(ValueError):
    """Something that cannot enter a key, or a lineage document that contradicts itself."""


def canonical(value: object) -> str:
    """Write a value as JSON in the one way that equal values share.

    Floats have 15 significant digits, so that 3.8 um and 0.0038 mm are one wavelength; ``-0.0`` is ``0`` and a whole
    float below 1e15 is written as the integer it equals. Infinity is the text ``"inf"``. Mappings are sorted by
    key; tuples, lists and arrays are lists; numpy scalars are numbers; dataclasses and pydantic models are mappings.

    Parameters
    ----------
    value : object
        None, bool, int, float, str, or mappings, sequences, arrays, dataclasses and pydantic models of them.

    Returns
    -------
    str
        ASCII, without blanks. ``canonical(json.loads(text)) == text``.

    Raises
    ------
    LineageError
        NaN, a float beyond 1.79e308, a key of a mapping that is no text, or any other type.
    """
    return _write(value, "value")


def _write(value: object, where: str) -> str:
    if value is None:
        return "null"
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return _number(float(value), where)
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biufU":
            raise LineageError(f"{where}: an array of {value.dtype} cannot enter a key")
        return _write(value.tolist(), where)
    if isinstance(value, Mapping):
        strangers = [key for key in value if not isinstance(key, str)]
        if strangers:
            raise LineageError(f"{where}: the key {strangers[0]!r} of a mapping is no text")
        pairs = (f"{json.dumps(key)}:{_write(value[key], f'{where}.{key}')}" for key in sorted(value))
        return "{" + ",".join(pairs) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ",".join(_write(item, f"{where}[{i}]") for i, item in enumerate(value)) + "]"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _write({field.name: getattr(value, field.name) for field in dataclasses.fields(value)}, where)
    dump = getattr(value, "model_dump", None)
    if callable(dump) and not isinstance(value, type):
        return _write(dump(mode="python"), where)
    raise LineageError(f"{where}: a {type(value).__name__} cannot enter a key")


def _number(value: float, where: str) -> str:
    if math.isnan(value):
        raise LineageError(f"{where}: NaN cannot enter a key; it equals nothing, not even itself")
    if math.isinf(value):
        return '"inf"' if value > 0 else '"-inf"'
    text = f"{value:.15g}"
    if math.isinf(float(text)):
        raise LineageError(f"{where}: {value!r} is too large for a key")
    # Of a whole number the 15 digits are all there is, and "-0" is not among them.
    return str(int(float(text))) if float(text).is_integer() and abs(value) < 1e15 else text


@dataclasses.dataclass(frozen=True)
class Key:
    """The identity of a result, and what it was made of.

    Parameters
    ----------
    digest : str
        sha256, 64 hexadecimal digits.
    stage : str
        Name of the stage.
    version : str
        Version of the stage, with the mark of a modified checkout where there is one.
    tracked, plugins : str
        Parameters and plugin identities as canonical JSON.
    upstream : tuple of Key or str
        What the result was made from: keys, or plain identities of things from outside, as of an archive.
    """

    digest: str
    stage: str
    version: str
    tracked: str
    plugins: str
    upstream: tuple[Key | str, ...]

    def __str__(self) -> str:
        return self.digest


def _digest(stage: str, version: str, tracked: str, plugins: str, upstream: Sequence[str]) -> str:
    parts = (str(SCHEME), json.dumps(stage), json.dumps(version), tracked, plugins, _write(list(upstream), "upstream"))
    return hashlib.sha256(f"[{','.join(parts)}]".encode("ascii")).hexdigest()


def make_key(
    stage: str,
    version: int,
    tracked: object,
    plugins: object = None,
    upstream: Sequence[Key | str] = (),
    *,
    mark: str = "",
) -> Key:
    """Make the key of a result.

    Parameters
    ----------
    stage : str
        Name of the stage.
    version : int
        Its version: raised whenever the same input gives other numbers.
    tracked : object
        The parameters that decide the result; see :func:`canonical`.
    plugins : object
        Identities of the plugins that the stage calls: name, version and parameters of each.
    upstream : sequence of Key or str
        What the stage works on, in the order of its arguments.
    mark : str
        Mark of a modified checkout, from :func:`checkout`: results of changed code never pass for released ones.

    Returns
    -------
    Key

    Raises
    ------
    LineageError
        A parameter cannot enter a key.
    """
    written = _write(tracked, f"{stage} parameters")
    identities = _write({} if plugins is None else plugins, f"{stage} plugins")
    marked = f"{int(version)}{mark}"
    digest = _digest(stage, marked, written, identities, [str(item) for item in upstream])
    return Key(digest, stage, marked, written, identities, tuple(upstream))


def document(root: Key) -> dict[str, Any]:
    """Write down a key and everything behind it.

    Parameters
    ----------
    root : Key
        Key of a result.

    Returns
    -------
    dict
        JSON-able: ``scheme``, ``key``, and ``nodes``: digest -> stage, version, tracked, plugins, upstream. Identities
        from outside appear under ``upstream`` only.
    """
    nodes: dict[str, Any] = {}

    def visit(node: Key) -> None:
        if node.digest in nodes:
            return
        nodes[node.digest] = {
            "stage": node.stage,
            "version": node.version,
            "tracked": json.loads(node.tracked),
            "plugins": json.loads(node.plugins),
            "upstream": [str(item) for item in node.upstream],
        }
        for item in node.upstream:
            if isinstance(item, Key):
                visit(item)

    visit(root)
    return {"scheme": SCHEME, "key": root.digest, "nodes": {digest: nodes[digest] for digest in sorted(nodes)}}


def check(written: Mapping[str, Any]) -> None:
    """Compute every key of a lineage document again.

    Parameters
    ----------
    written : mapping
        A document of :func:`document`, perhaps read from a file.

    Raises
    ------
    LineageError
        The document is of another scheme, lacks its root, or a key does not follow from what stands under it.
    """
    if written.get("scheme") != SCHEME:
        raise LineageError(f"the lineage is of scheme {written.get('scheme')!r}; this version knows {SCHEME}")
    try:
        if written["key"] not in written["nodes"]:
            raise LineageError(f"the lineage of {written['key']} does not say what it was made of")
        for digest, node in written["nodes"].items():
            tracked, plugins = canonical(node["tracked"]), canonical(node["plugins"])
            if digest != _digest(node["stage"], node["version"], tracked, plugins, node["upstream"]):
                raise LineageError(f"the key {digest} of stage {node['stage']} does not follow from its lineage")
    except (KeyError, TypeError, AttributeError) as error:
        raise LineageError(f"the lineage is not complete: {error}") from error


@dataclasses.dataclass(frozen=True)
class Checkout:
    """State of the working copy that the code runs from.

    Parameters
    ----------
    commit : str
        Commit, 40 hexadecimal digits; empty where the code is not in a working copy.
    mark : str
        Empty for unchanged code, else ``"+dirty."`` and 12 digits that stand for the changes.
    """

    commit: str = ""
    mark: str = ""

    def __str__(self) -> str:
        return f"{self.commit}{self.mark}"


@lru_cache(maxsize=8)
def checkout(folder: Path | None = None) -> Checkout:
    """Find out which commit runs, and whether the code was changed since.

    The code of a process is what it was when it was imported, so the first answer is kept.

    Parameters
    ----------
    folder : Path, optional
        Root of the working copy; the one this module lies in where it is absent.

    Returns
    -------
    Checkout
        Empty where there is no git, no working copy, or the code lies in one without belonging to it, as an
        installed package in somebody's repository does.
    """
    root = Path(__file__).resolve().parents[1] if folder is None else folder
    code = [name for name in ("pipeline", "plugins", "catalog", "flows") if (root / name).is_dir()]

    def git(*arguments: str) -> bytes:
        command = ["git", "-c", "core.fsmonitor=false", "-c", "core.quotePath=true", "-C", str(root), *arguments]
        # Environment untouched, no lock taken: the state is looked at, never changed.
        return subprocess.run(
            [*command, "--", *code], check=True, capture_output=True, timeout=20, stdin=subprocess.DEVNULL
        ).stdout

    try:
        if not code or not git("ls-files", "--error-unmatch"):
            return Checkout()
        commit = (
            subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], check=True, capture_output=True, timeout=20)
            .stdout.decode()
            .strip()
        )
        changes = hashlib.sha256(git("diff", "HEAD", "--no-ext-diff", "--binary"))
        changed = git("diff", "HEAD", "--no-ext-diff", "--name-only") != b""
        for name in sorted(git("ls-files", "--others", "--exclude-standard", "-z").split(b"\0")):
            if name.endswith(b".py"):
                changed = True
                changes.update(name + b"\0" + (root / name.decode("utf-8", "surrogateescape")).read_bytes())
    except (OSError, subprocess.SubprocessError):
        return Checkout()
    return Checkout(commit, f"+dirty.{changes.hexdigest()[:12]}" if changed else "")
