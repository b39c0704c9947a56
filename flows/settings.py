"""A campaign file and the command line, read into one typed setting with every fault reported at once."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field, replace
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import ValidationError

from ..pipeline.parameters import Configuration, Header, Name, Parameters, overlay
from ..pipeline.surroundings import SurroundingsParameters
from ..pipeline.units import faults as sentences
from ..pipeline.units import safe, text
from ..plugins.registry import KEYS, PluginError, create, get
from .run_parameters import RunParameters

M = TypeVar("M", bound=Parameters)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ..plugins.contract import (
        HyperparameterSelectorBase,
        Plugin,
        RegulariserBase,
        SourceModelBase,
        TurbulenceSpectrumBase,
    )

#: Plugins that are used where a campaign names none.
DEFAULT_PLUGINS = {
    "source": {"name": "gaussian"},
    "spectrum": {"name": "kolmogorov"},
    "regulariser": {"name": "white"},
    "selector": {"name": "gcv"},
}
#: Settings that `preset = "NAME"` in a campaign file stands for; what the file says beside it wins.
PRESETS: dict[str, dict[str, Any]] = {
    # Sauvage et al. 2021, arXiv:2111.08003. The paper takes the response at a distance z_i for each slice without
    # saying which, and subtracts the variance of the vibration, found in the slopes' temporal spectrum, from all
    # entries of the slope maps; the constant that is estimated here takes its place.
    "sauvage-2021": {
        "batch": {"duration": "3 min"},
        "extraction": {"method": "moving_maximum"},
        "correlation": {"covariance": "independent", "vibration": "subtracted"},
        "response": {"slices": 12, "sampling": "midpoint", "slope_response": "printed"},
        "inversion": {
            "estimator": "map",
            "subset": "all",
            "noise_bias": "joint",
            "flux_noise": "joint",
            "slope_offset": "none",
        },
        "source": {"name": "gaussian"},
        "spectrum": {"name": "kolmogorov"},
        "regulariser": {"name": "white"},
        "selector": {"name": "gcv", "log_mu_min": 25.0, "log_mu_max": 33.0, "log_mu_step": 0.5},
    }
}
#: What `keep` of a campaign file may name.
KEPT = ("measurements",)
#: Tables of a campaign file that replace or complete keys of the archives' headers.
HEADER_TABLES = ("site", "instrument", "path", "sources", "scintillometers")
_URL = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]+://")


class InputError(ValueError):
    """Input that cannot be used; `faults` has one sentence each, and the program exits with 2."""

    def __init__(self, faults: list[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = faults

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.faults,))


class Unavailable(RuntimeError):
    """Something that a run needs does not answer: a scheduler, a server. The program says so and exits with 1."""


@dataclass(frozen=True)
class Settings:
    """What to compute, and where.

    Parameters
    ----------
    origin : str
        File or command line that the settings come from, for messages.
    campaign : str or None
        Name that every archive must carry; None accepts any.
    archives : tuple of str
        Paths and URLs of raw archives.
    output : pathlib.Path
        Folder of the catalog and its products.
    configuration : Configuration
        Parameters of the stages.
    plugins : dict
        Name and parameters (as text) of the plugin for each of source, spectrum, regulariser, selector.
    header : dict
        Tables that replace or complete the archives' headers.
    run : RunParameters
        Where to compute.
    keep : tuple of str
        Intermediate results that are kept beside the correlations: ``measurements``. No key depends on it.
    surroundings : SurroundingsParameters
        Weather and terrain.
    folder : pathlib.Path
        Where relative paths of series and terrain begin.
    """

    origin: str
    campaign: str | None
    archives: tuple[str, ...]
    output: Path
    configuration: Configuration = field(default_factory=Configuration)
    plugins: dict[str, dict[str, Any]] = field(default_factory=lambda: dict(DEFAULT_PLUGINS))
    header: dict[str, Any] = field(default_factory=dict)
    run: RunParameters = field(default_factory=RunParameters)
    keep: tuple[str, ...] = ()
    surroundings: SurroundingsParameters = field(default_factory=SurroundingsParameters)
    folder: Path = Path()

    @property
    def keeps_measurements(self) -> bool:
        """Whether slopes and fluxes of every batch are kept, so that other correlations of them read no frame."""
        return "measurements" in self.keep

    def effective_header(self, attributes: Mapping[str, Any], origin: str) -> Header:
        """Header of an archive with this campaign's tables on top.

        Raises
        ------
        InputError
            The result is no valid header.
        """
        try:
            return Header.model_validate(overlay(attributes, self.header))
        except ValidationError as error:
            raise InputError(sentences(error, origin)) from error

    def source_models(self, header: Header, origin: str) -> tuple[SourceModelBase, ...]:
        """Source model of each source of a header.

        Parameters that the campaign leaves out are taken from the header: `fwhm` gives `fwhm_x` and `fwhm_y`.
        """
        chosen = dict(self.plugins["source"])
        name = str(chosen.pop("name"))
        known = get(KEYS["source"], name).model_fields
        unit = "rad" if header.geometry().infinite else "m"
        models = []
        for number, source in enumerate(header.sources):
            given = {
                key: text(value, unit)
                for key, value in zip(("fwhm_x", "fwhm_y"), source.fwhm, strict=True)
                if key in known and key not in chosen
            }
            try:
                models.append(create(KEYS["source"], name, {**given, **chosen}))
            except PluginError as error:
                if error.validation is None:
                    raise InputError([f"{self.origin}: source.name = {name!r}: {error}"]) from error
                raise InputError(
                    [
                        f"{fault} (source model '{name}', fwhm of sources[{number}] from the header)"
                        for fault in sentences(error.validation, origin, "source")
                    ]
                ) from error
        return tuple(models)  # type: ignore[arg-type]

    def spectrum(self) -> TurbulenceSpectrumBase:
        """Turbulence spectrum."""
        return self._plugin("spectrum")  # type: ignore[return-value]

    def regulariser(self) -> RegulariserBase:
        """Regulariser."""
        return self._plugin("regulariser")  # type: ignore[return-value]

    def selector(self) -> HyperparameterSelectorBase:
        """Hyperparameter selector."""
        return self._plugin("selector")  # type: ignore[return-value]

    def _plugin(self, key: str) -> Plugin:
        parameters = dict(self.plugins[key])
        return create(KEYS[key], str(parameters.pop("name")), parameters)


def plugin_text(value: str) -> dict[str, Any]:
    """Read ``"name:parameter=value,parameter=value"``.

    Raises
    ------
    InputError
        A parameter has no value.
    """
    name, _, rest = value.partition(":")
    parameters: dict[str, Any] = {"name": name.strip()}
    for item in filter(None, (part.strip() for part in rest.split(",")) if rest else ()):
        key, equals, given = item.partition("=")
        if not equals:
            raise InputError([f"'{safe(value)}': '{safe(item)}' has no value; write NAME:parameter=value,…"])
        parameters[key.strip()] = _scalar(given.strip())
    return parameters


def _scalar(value: str) -> Any:
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return value


def _set(table: dict[str, Any], assignment: str) -> None:
    key, equals, value = assignment.partition("=")
    parts = [part.strip() for part in key.split(".")]
    if not equals or not all(parts):
        raise InputError([f"--set {safe(assignment)}: write --set table.key=value, for example batch.duration='1 min'"])
    place = table
    for part in parts[:-1]:
        below = place.setdefault(part, {})
        if isinstance(below, str) and part in KEYS:
            below = place[part] = plugin_text(below)
        if not isinstance(below, dict):
            raise InputError([f"--set {safe(assignment)}: '{part}' is no table"])
        place = below
    place[parts[-1]] = _scalar(value.strip())


def _expand(patterns: Iterable[str], folder: Path, origin: str, faults: list[str]) -> tuple[str, ...]:
    found: dict[str, None] = {}
    given = list(patterns)
    for pattern in given:
        if _URL.match(pattern):
            found[pattern] = None
        elif any(character in pattern for character in "*?["):
            found.update(dict.fromkeys(sorted(glob(str(folder / pattern)))))
        else:
            found[str(folder / pattern)] = None
    if given and not found:
        faults.append(f"{origin}: archives = {given!r}: no file or folder matches; looked in {safe(str(folder))}")
    return tuple(found)


def read_campaign(path: Path) -> dict[str, Any]:
    """Read a campaign file without judging its content.

    Raises
    ------
    InputError
        The file is missing, or is no TOML.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            [f"{safe(str(path))}: cannot be read ({error.strerror}); 'coslidar init DIR' writes a campaign file"]
        ) from error
    try:
        return tomllib.loads(content.decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError([f"{safe(str(path))}: this is no TOML file: {error}"]) from error


def load(
    campaign_file: Path | None = None,
    *,
    archives: Iterable[str] = (),
    output: Path | None = None,
    assignments: Iterable[str] = (),
    scheduler: str | None = None,
) -> Settings:
    """Bring campaign file and command line together.

    Parameters
    ----------
    campaign_file : pathlib.Path, optional
        Campaign file; without one every setting has its default.
    archives : iterable of str
        Archives given on the command line; they replace those of the file.
    output : pathlib.Path, optional
        Folder of the catalog; ``results`` beside the campaign file where it is absent.
    assignments : iterable of str
        ``table.key=value`` on top of the file.
    scheduler : str, optional
        Replaces `run.scheduler`.

    Returns
    -------
    Settings

    Raises
    ------
    InputError
        With every fault of the file.
    """
    origin = safe(str(campaign_file)) if campaign_file is not None else "command line"
    folder = campaign_file.parent if campaign_file is not None else Path()
    table = _beside(read_campaign(campaign_file), folder) if campaign_file is not None else {}
    faults: list[str] = []
    for assignment in assignments:
        try:
            _set(table, assignment)
        except InputError as error:
            faults += error.faults

    table = _with_preset(table, origin, faults)
    name = table.pop("campaign", None)
    if name is not None:
        try:
            sentences_of(_Named, {"campaign": name}, origin)
        except InputError as error:
            faults += error.faults
    patterns = table.pop("archives", [])
    if isinstance(patterns, str):
        patterns = [patterns]
    if not isinstance(patterns, list) or not all(isinstance(item, str) for item in patterns):
        faults.append(f"{origin}: archives must be a list of paths, patterns or URLs, for example ['raw/*.zarr.zip']")
        patterns = []
    keep = table.pop("keep", [])
    if not isinstance(keep, list) or not all(item in KEPT for item in keep):
        faults.append(f"{origin}: keep = {keep!r}: it must be a list of what can be kept: {', '.join(KEPT)}")
        keep = []
    out = table.pop("output", "results")
    if not isinstance(out, str):
        faults.append(f"{origin}: output = {out!r}: it must be the path of a folder")
        out = "results"

    header = {key: table.pop(key) for key in HEADER_TABLES if key in table}
    if header:
        faults += [fault for fault in _header_faults(header, origin) if fault not in faults]
    around = {key: table.pop(key) for key in SurroundingsParameters.model_fields if key in table}
    try:
        surroundings = SurroundingsParameters.model_validate(around)
    except ValidationError as error:
        faults += sentences(error, origin)
        surroundings = SurroundingsParameters()
    plugins = {key: dict(value) for key, value in DEFAULT_PLUGINS.items()}
    for key in KEYS:
        if key in table:
            faults += _plugin(plugins, key, table.pop(key), origin)
    try:
        run = RunParameters.model_validate(table.pop("run", {}))
    except ValidationError as error:
        faults += sentences(error, origin, "run")
        run = RunParameters()
    if run.tls is not None:
        run = run.model_copy(update={"tls": run.tls.below(folder)})
        faults += run.tls.faults(origin) if run.tls is not None else []
    if scheduler is not None:
        run = run.model_copy(update={"scheduler": scheduler, "jobs": None})
    if run.scheduler is not None and run.jobs is not None:
        faults.append(f"{origin}: run.scheduler and run.jobs: a run has one cluster; leave one of them out")
    try:
        configuration = Configuration.model_validate(table)
    except ValidationError as error:
        faults += sentences(error, origin)
        configuration = Configuration()
    chosen = tuple(archives)
    if chosen:
        expanded = _expand(chosen, Path(), "command line", faults)
    else:
        expanded = _expand(patterns, folder, origin, faults)
    if faults:
        raise InputError(faults)
    return Settings(
        origin=origin,
        campaign=name,
        archives=expanded,
        output=output if output is not None else folder / out,
        configuration=configuration,
        plugins=plugins,
        header=header,
        run=run,
        keep=tuple(keep),
        surroundings=surroundings,
        folder=folder,
    )


def _beside(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The same settings, with the files that they name looked for beside the campaign file."""
    table = dict(table)
    places: list[tuple[dict[str, Any], str]] = [(table, "source")]
    if isinstance(table.get("response"), dict):
        table["response"] = dict(table["response"])
        places.append((table["response"], "band"))
    for place, key in places:
        given = place.get(key)
        if isinstance(given, str) and "file" in given and "=" in given:
            try:
                given = plugin_text(given if key == "source" else f":{given}")
            except InputError:
                continue  # whoever reads the text says what is wrong with it
            if key == "band":
                del given["name"]
        if isinstance(given, dict) and isinstance(given.get("file"), str):
            place[key] = {**given, "file": str(folder / given["file"])}
    return table


def _with_preset(table: dict[str, Any], origin: str, faults: list[str]) -> dict[str, Any]:
    """The settings of a campaign file over those of the preset that it names."""
    table = dict(table)
    name = table.pop("preset", None)
    if name is None:
        return table
    if not isinstance(name, str) or name not in PRESETS:
        faults.append(f"{origin}: preset = {name!r}: there is no such preset; known: {', '.join(PRESETS)}")
        return table
    below = {**PRESETS[name]}
    for key in KEYS.keys() & below.keys() & table.keys():
        given = table[key]
        if isinstance(given, str) and given.partition("=")[0].partition(":")[0].strip() == below[key]["name"]:
            table[key] = given = plugin_text(given)
        if not isinstance(given, dict) or given.get("name", below[key]["name"]) != below[key]["name"]:
            # Parameters of one plugin mean nothing to another.
            del below[key]
    return overlay(below, table)


def sentences_of(model: type[M], values: dict[str, Any], origin: str) -> M:
    """Validate a model; its faults become an :class:`InputError`."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise InputError(sentences(error, origin)) from error


def with_plugin(settings: Settings, key: str, value: str | dict[str, Any]) -> Settings:
    """The same settings with the plugin of `key` given as ``"name:parameter=value,…"`` or as a table.

    Raises
    ------
    InputError
        No such plugin, or parameters it refuses.
    """
    plugins = {name: dict(chosen) for name, chosen in settings.plugins.items()}
    if faults := _plugin(plugins, key, value, f"--{key}"):
        raise InputError(faults)
    return replace(settings, plugins=plugins)


class _Named(Parameters):
    campaign: Name


def _header_faults(header: dict[str, Any], origin: str) -> list[str]:
    """Faults of what is there; what is missing, the archives have."""
    try:
        Header.model_validate(header)
    except ValidationError as error:
        return [
            sentence
            for sentence, fault in zip(sentences(error, origin), error.errors(include_url=False), strict=True)
            # Scintillometers are a list: what the campaign says of one is all there is.
            if fault["type"] != "missing" or fault["loc"][0] == "scintillometers"
        ]
    return []


def _plugin(plugins: dict[str, dict[str, Any]], key: str, given: Any, origin: str) -> list[str]:
    """Put the plugin that a file or an option names in place of the default, and judge its parameters."""
    if isinstance(given, str):
        try:
            given = plugin_text(given)
        except InputError as error:
            return [f"{origin}: {key}: {fault}" for fault in error.faults]
    if not isinstance(given, dict):
        return [f"{origin}: {key} = {given!r}: write a name, or a table with 'name' and its parameters"]
    parameters = {**given}
    name = parameters.pop("name", plugins[key]["name"])
    if not isinstance(name, str) or ":" in name or "/" in name:
        return [f"{origin}: {key}.name = {name!r}: it must be the name of an installed plugin"]
    plugins[key] = {"name": name, **parameters}
    try:
        create(KEYS[key], name, parameters)
    except PluginError as error:
        if error.validation is None:
            return [f"{origin}: {key}.name = {name!r}: {fault}" for fault in error.faults]
        judged = zip(sentences(error.validation, origin, key), error.validation.errors(include_url=False), strict=True)
        return [
            sentence
            for sentence, fault in judged
            # The archive's header gives the extent of its sources.
            if not (key == "source" and fault["type"] == "missing" and fault["loc"] in (("fwhm_x",), ("fwhm_y",)))
        ]
    return []
