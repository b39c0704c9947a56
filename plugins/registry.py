"""Discovery of plugins through entry points.

Loading is lazy: listing names imports nothing. A plugin that cannot be loaded is named with its reason and
hides no other; two of one name are an error that names both distributions.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from ..pipeline.markup import table
from .contract import (
    HyperparameterSelectorBase,
    Plugin,
    RegulariserBase,
    SourceModelBase,
    TurbulenceSpectrumBase,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

#: Kind of plugin -> (entry point group, base class, key in a campaign file).
KINDS: dict[str, tuple[str, type[Plugin]]] = {
    "source model": ("coslidar.source_models", SourceModelBase),
    "turbulence spectrum": ("coslidar.turbulence_spectra", TurbulenceSpectrumBase),
    "regulariser": ("coslidar.regularisers", RegulariserBase),
    "hyperparameter selector": ("coslidar.hyperparameter_selectors", HyperparameterSelectorBase),
}

#: Key of a campaign file that chooses a plugin -> kind.
KEYS = {
    "source": "source model",
    "spectrum": "turbulence spectrum",
    "regulariser": "regulariser",
    "selector": "hyperparameter selector",
}


class PluginError(ValueError):
    """A plugin that is not there, cannot be loaded, or refuses its parameters.

    Parameters
    ----------
    faults : list of str
        One sentence per fault.
    """

    def __init__(self, faults: list[str], validation: ValidationError | None = None) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults
        self.validation = validation

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.faults,))


@dataclass(frozen=True)
class Entry:
    """One registered plugin, not yet loaded.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.
    name : str
        Name of the entry point.
    distribution : str
        Installed distribution and its version.
    point : importlib.metadata.EntryPoint
        What to load.
    """

    kind: str
    name: str
    distribution: str
    point: EntryPoint

    def load(self) -> type[Plugin]:
        """Import the class.

        Raises
        ------
        PluginError
            It cannot be imported, or is no plugin of its kind.
        """
        return _load(self)


@lru_cache(maxsize=256)
def _load(entry: Entry) -> type[Plugin]:
    try:
        found = entry.point.load()
    except Exception as error:  # a third party's import may fail in any way, and must not hide the others
        raise PluginError(
            [f"{entry.kind} '{entry.name}' ({entry.distribution}) failed to load: {type(error).__name__}: {error}"]
        ) from error
    base = KINDS[entry.kind][1]
    if not (isinstance(found, type) and issubclass(found, base)):
        raise PluginError(
            [
                f"{entry.kind} '{entry.name}' ({entry.distribution}) is no {base.__name__}: "
                f"'{entry.point.value}' must be a class derived from coslidar.plugins.contract.{base.__name__}"
            ]
        )
    if getattr(found, "name", None) != entry.name:
        raise PluginError(
            [
                f"{entry.kind} '{entry.name}' ({entry.distribution}) calls itself "
                f"'{getattr(found, 'name', None)}': the entry point and the class attribute `name` must agree"
            ]
        )
    return found


def _distribution(point: EntryPoint) -> str:
    dist = getattr(point, "dist", None)
    return f"{dist.name} {dist.version}" if dist is not None else "unknown distribution"


class Entries(dict[str, Entry]):
    """Registered plugins by name, as :func:`entries` finds them."""

    def _repr_html_(self) -> str:
        """What a notebook shows: every plugin, loaded or with the reason why not."""
        rows = []
        for name, entry in self.items():
            try:
                about = (entry.load().__doc__ or "").strip().partition("\n")[0]
            except PluginError as error:
                about = f"cannot be loaded: {error}"
            rows.append((entry.kind, name, entry.distribution, about))
        return table("Plugins", ("kind", "name", "from", "what"), rows)


def entries(kind: str, points: Iterable[EntryPoint] | None = None) -> Entries:
    """All registered plugins of one kind, by name, without loading any.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.
    points : iterable of EntryPoint, optional
        Entry points to use instead of the installed ones.

    Returns
    -------
    Entries
        A dictionary from name to :class:`Entry`, sorted by name.

    Raises
    ------
    PluginError
        Two distributions register the same name.
    """
    if points is None:
        return Entries(_installed(kind, entry_points, _state_of_path()))
    return _registered(kind, points)


def _state_of_path() -> tuple[tuple[str, int], ...]:
    """Places that distributions are found in, with the time of their last change."""
    state = []
    for place in sys.path:
        with suppress(OSError):
            changed = os.stat(place or ".").st_mtime_ns
            if _holds_distributions(place, changed):
                state.append((place, changed))
    return tuple(state)


@lru_cache(maxsize=256)
def _holds_distributions(place: str, changed: int) -> bool:
    # Dask puts a new folder on the path for every run.
    try:
        return any(name.endswith((".dist-info", ".egg-info")) for name in os.listdir(place or "."))
    except NotADirectoryError:
        return True  # a zip file


@lru_cache(maxsize=16)
def _installed(kind: str, find: Callable[..., Iterable[EntryPoint]], state: object) -> Entries:
    # Looking through all distributions takes tens of milliseconds, and a run asks half a dozen times.
    return _registered(kind, find(group=KINDS[kind][0]))


def _registered(kind: str, points: Iterable[EntryPoint]) -> Entries:
    found = Entries()
    faults = []
    for point in sorted(points, key=lambda p: (p.name, p.value)):
        entry = Entry(kind, point.name, _distribution(point), point)
        known = found.setdefault(point.name, entry)
        if known.point.value != point.value:
            faults.append(
                f"two plugins are called {kind} '{point.name}': {known.distribution} ({known.point.value}) and "
                f"{entry.distribution} ({point.value}); uninstall one of them"
            )
    if faults:
        raise PluginError(faults)
    return found


def available(kind: str) -> tuple[dict[str, type[Plugin]], dict[str, str]]:
    """Load every plugin of a kind.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.

    Returns
    -------
    loaded : dict of str to type
        Plugin classes by name.
    failed : dict of str to str
        Reason by name of those that cannot be loaded.
    """
    loaded: dict[str, type[Plugin]] = {}
    failed: dict[str, str] = {}
    for name, entry in entries(kind).items():
        try:
            loaded[name] = entry.load()
        except PluginError as error:
            cause = error.__cause__
            failed[name] = f"{type(cause).__name__}: {cause}" if cause is not None else str(error)
    return loaded, failed


def get(kind: str, name: str) -> type[Plugin]:
    """The plugin class of a kind and name.

    Raises
    ------
    PluginError
        There is none of that name, or it cannot be loaded; the message lists what is installed and what
        failed to load and why.
    """
    known = entries(kind)
    if name in known:
        return known[name].load()
    loaded, failed = available(kind)
    message = f"no {kind} '{name}'; installed: {', '.join(loaded) or 'none'}"
    if failed:
        message += "; failed to load: " + ", ".join(f"{key} ({reason})" for key, reason in failed.items())
    raise PluginError([message])


def create(kind: str, name: str, parameters: Mapping[str, Any]) -> Plugin:
    """Build a plugin from the text values of a campaign file.

    Parameters
    ----------
    kind, name : str
        Which plugin.
    parameters : mapping
        Its parameters as text with units.

    Returns
    -------
    Plugin
        Frozen instance.

    Raises
    ------
    PluginError
        No such plugin, or (with `validation` set) parameters it refuses.
    """
    cls = get(kind, name)
    try:
        return cls.model_validate(dict(parameters))
    except ValidationError as error:
        raise PluginError([str(error)], validation=error) from error
