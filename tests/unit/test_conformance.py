"""The contract of plugins: what is built in keeps it, and each of its checks catches a plugin that breaks it."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import pytest
from pydantic import BeforeValidator, Field, PrivateAttr, model_validator

from coslidar.pipeline import inversion
from coslidar.pipeline.units import Length
from coslidar.plugins import conformance, registry
from coslidar.plugins.conformance import CHECKS, check_plugin, checks_of, label, parametrize_with_checks
from coslidar.plugins.contract import (
    HyperparameterSelectorBase,
    RegulariserBase,
    SourceModelBase,
    TurbulenceSpectrumBase,
)
from coslidar.plugins.hyperparameter_selectors import (
    GCV,
    UPRE,
    Discrepancy,
    Evidence,
    Fixed,
    LCurve,
    PositiveEvidence,
    Previous,
)
from coslidar.plugins.regularisers import (
    Exponential,
    Gradient,
    Laplacian,
    WeightedLaplacian,
    White,
    WhiteGradient,
)
from coslidar.plugins.source_models import Disc, Gaussian, Image, Point, Rectangle
from coslidar.plugins.turbulence_spectra import Hill, Kolmogorov, PowerLaw, Tatarskii, VonKarman

BUILT_IN = [
    Gaussian(fwhm_x="8.9 cm", fwhm_y="6.3 cm"),
    Gaussian(fwhm_x="0.01 arcsec", fwhm_y="0.02 arcsec"),
    Point(),
    Disc(diameter="8 cm"),
    Rectangle(width_x="16 cm", width_y="12.5 cm"),
    Image(pixel_size="1 cm", intensity=((0, 1, 2, 0), (3, 4, 1, 1), (0, 5, 0, 0))),
    Kolmogorov(),
    VonKarman(outer_scale="10 m"),
    Tatarskii(inner_scale="5 mm"),
    Tatarskii(inner_scale="5 mm", outer_scale="0.4 m"),
    Hill(inner_scale="1 cm", outer_scale="2 m"),
    PowerLaw(exponent=3.1),
    PowerLaw(exponent=3.9, reference="1 mm"),
    White(),
    White(scale=tuple(range(1, 13))),
    Gradient(),
    Laplacian(),
    WeightedLaplacian(),
    WeightedLaplacian(reference_z=("100 m", "2 km"), reference_cn2=("1e-14 m^(-2/3)", "1e-13 m^(-2/3)")),
    WhiteGradient(ratio=3),
    Exponential(length="30 m"),
    Exponential(length="5 km"),
    GCV(),
    GCV(log_mu_min=25, log_mu_step=0.1),
    Fixed(mu="3e26 m^(4/3)"),
    Evidence(),
    PositiveEvidence(),
    UPRE(),
    Discrepancy(),
    LCurve(),
    Previous(),
    Previous(criterion="positive_evidence"),
]
ON_PURPOSE = {
    "fixed": {
        "mu_at_minimum": "mu is given; the curve is there for comparison",
        "recovers_mu": "mu is given",
    },
    "discrepancy": {
        "recovers_mu": "a misfit of 1 per datum leaves nothing for the modes that are fitted: a decade too smooth",
    },
}


@parametrize_with_checks(BUILT_IN, expected_failed_checks=lambda plugin: ON_PURPOSE.get(plugin.name, {}))
def test_built_in_plugins_keep_the_contract(plugin: Any, check: Any) -> None:
    check(plugin)


@pytest.mark.parametrize("kind", list(registry.KINDS))
def test_every_built_in_plugin_is_among_them(kind: str) -> None:
    shipped = {name for name, entry in registry.entries(kind).items() if entry.distribution.split()[0] == "coslidar"}
    assert shipped == {plugin.name for plugin in BUILT_IN if conformance.kind_of(plugin) == kind}


# --- plugins that break one promise each -----------------------------------------------------------------


class Prior(RegulariserBase):
    """A sound prior to break."""

    name: ClassVar[str] = "prior"

    def precision(self, grid: Any) -> Any:
        return np.eye(grid.k)


class Unfrozen(Prior, frozen=False):
    """Its strength can be changed after it has entered a key."""

    strength: float = 1.0
    """Strength."""

    __hash__ = object.__hash__


class Unhashable(Prior):
    """Frozen, but what it holds is not."""

    weights: list[float] = Field([1.0])
    """Weights."""


class Unpicklable(Prior):
    """Holds a function that cannot travel to a worker."""

    _function: Any = PrivateAttr(default_factory=lambda: lambda x: x)


class Undocumented(Prior):
    """Nobody knows what its parameter is."""

    strength: float = 1.0


class StripsUnits(Prior):
    """Reads the number and throws the unit away."""

    length: Annotated[float, BeforeValidator(lambda text: float(str(text).split()[0]))] = 300.0
    """Correlation length."""


class HeldAsText(Prior):
    """Reads its length when it is used."""

    length: str = "300 m"
    """Correlation length."""


class Anonymous(Prior):
    """Refuses a wrong dimension, but does not say which parameter it means."""

    length: Length = Field("300 m")  # type: ignore[assignment]
    """Correlation length."""

    @model_validator(mode="before")
    @classmethod
    def _hide(cls, data: Any) -> Any:
        if "m" not in str(data.get("length", "300 m")):
            raise ValueError("bad input")
        return data


class KeepsSpelling(Prior):
    """Remembers how its length was written."""

    length: Length = Field("300 m")  # type: ignore[assignment]
    """Correlation length."""
    written: str = ""
    """The length as it was written."""

    @model_validator(mode="before")
    @classmethod
    def _remember(cls, data: Any) -> Any:
        return {**data, "written": f"as {data.get('length', '300 m')}"}


class HoldsPath(Prior):
    """A file's path is where its values are, and not what they are."""

    file: Path = Path("weights.npy")
    """File with weights."""


class Random(Prior):
    """Adds jitter for good measure."""

    def precision(self, grid: Any) -> Any:
        return np.diag(1 + 1e-9 * np.random.default_rng().uniform(size=grid.k))


class Counting(Prior):
    """Depends on what was computed before."""

    _calls: list[int] = PrivateAttr(default_factory=lambda: [0])

    def precision(self, grid: Any) -> Any:
        self._calls[0] += 1
        return np.eye(grid.k) * (1 + 1e-12 * self._calls[0])


class TextVersion(Prior):
    """Versions of packages are texts, this one is not."""

    version: ClassVar[Any] = "1.2"


class Misnamed(Prior):
    """Its entry point is called otherwise."""

    name: ClassVar[str] = "called_otherwise"


class ByValue(Prior):
    """One row and column short: written for the steps between slices."""

    def precision(self, grid: Any) -> Any:
        return np.eye(grid.k - 1)


class OneSlice(Prior):
    """Divides by the spacing of slices, and one slice has none."""

    def precision(self, grid: Any) -> Any:
        spacing = np.diff(grid.centres)
        return np.eye(grid.k) * (spacing.sum() / np.float64(spacing.size))


class Triangular(Prior):
    """x^T R x is right, and R is not."""

    def precision(self, grid: Any) -> Any:
        return np.eye(grid.k) - np.diag(np.ones(grid.k - 1), 1)


class UnevenOnly(Prior):
    """Positive on equal slices only."""

    def precision(self, grid: Any) -> Any:
        return np.diag(2 * grid.thickness.mean() - grid.thickness)


class Nothing(Prior):
    """Penalises nothing."""

    def precision(self, grid: Any) -> Any:
        return np.zeros((grid.k, grid.k))


def bell(fx: Any, fy: Any) -> Any:
    """Transfer function of a Gaussian source of about 5 cm."""
    return np.exp(-0.01 * (fx**2 + fy**2))


class Source(SourceModelBase):
    """A sound source to break."""

    name: ClassVar[str] = "source"

    def transfer(self, fx: Any, fy: Any) -> Any:
        return bell(fx, fy)


class Flattened(Source):
    """Works on lists of frequencies only, and gives back no other."""

    def transfer(self, fx: Any, fy: Any) -> Any:
        return bell(fx, fy) if fx.ndim != 1 else bell(fx, fy)[:, None]

    def moment(self, fx: Any, fy: Any) -> Any:
        return (-0.01j / np.pi) * fx * bell(fx, fy), (-0.01j / np.pi) * fy * bell(fx, fy)


class Overflowing(Source):
    """A reciprocal hyperbolic cosine by way of two exponentials that overflow."""

    def transfer(self, fx: Any, fy: Any) -> Any:
        x = np.hypot(fx, fy) / 5
        return 2 * np.exp(x) / (np.exp(2 * x) + 1)


class Dim(Source):
    """Normalised to 0.99."""

    def transfer(self, fx: Any, fy: Any) -> Any:
        return 0.99 * bell(fx, fy)


class Swelling(Source):
    """Exceeds 1 near its half frequency, as no intensity does."""

    def transfer(self, fx: Any, fy: Any) -> Any:
        return (1 + 0.02 * (fx**2 + fy**2)) * bell(fx, fy)


class Unreal(Source):
    """A chirp: its intensity is complex."""

    def transfer(self, fx: Any, fy: Any) -> Any:
        return bell(fx, fy) * np.exp(0.01j * fx**2)


class ListOfMoments(Source):
    """Gives the moments as a list."""

    def moment(self, fx: Any, fy: Any) -> Any:
        return list(super().moment(fx, fy))


class WrongSign(Source):
    """Of the other convention of the Fourier transform."""

    def moment(self, fx: Any, fy: Any) -> Any:
        x, y = super().moment(fx, fy)
        return -x, y


class OffCentre(Source):
    """Puts its position, which the header gives, into its shape."""

    def transfer(self, fx: Any, fy: Any) -> Any:
        return bell(fx, fy) * np.exp(-2j * np.pi * 0.4 * fy)


def kolmogorov(f: Any) -> Any:
    """Kolmogorov's spectrum."""
    return 0.033 * (2 * np.pi) ** (-2 / 3) * f ** (-11 / 3)


class Spectrum(TurbulenceSpectrumBase):
    """A sound spectrum to break."""

    name: ClassVar[str] = "spectrum"

    def psd(self, f: Any) -> Any:
        return kolmogorov(f)


class InPlace(Spectrum):
    """Squares the frequencies where they are."""

    def psd(self, f: Any) -> Any:
        np.square(f, out=f)
        return 0.033 * (2 * np.pi) ** (-2 / 3) * f ** (-11 / 6)


class Raveled(Spectrum):
    """Gives one row whatever it was given."""

    def psd(self, f: Any) -> Any:
        return kolmogorov(f).ravel()


class UndefinedTail(Spectrum):
    """Interpolates a table that ends at 1e4 /m."""

    def psd(self, f: Any) -> Any:
        return np.where(f > 1e4, np.nan, kolmogorov(f))


class NegativeHead(Spectrum):
    """A fit that changes sign below 1 cm^-1... of a kilometre."""

    def psd(self, f: Any) -> Any:
        return np.where(f < 1e-2, -1.0, 1.0) * kolmogorov(f)


class NoiseFloor(Spectrum):
    """Measured, with the noise of the thermometer."""

    def psd(self, f: Any) -> Any:
        return kolmogorov(f) + 1e-9


class TooSteep(Spectrum):
    """f^(-4.2): slopes of infinite variance."""

    def psd(self, f: Any) -> Any:
        return kolmogorov(f) * f ** (11 / 3 - 4.2)


class RadiansPerMetre(Spectrum):
    """Phi_n(kappa) instead of S_n(f)."""

    def psd(self, f: Any) -> Any:
        return 0.033 * (2 * np.pi * f) ** (-11 / 3)


class Selector(HyperparameterSelectorBase):
    """A sound selector to break: the evidence."""

    name: ClassVar[str] = "selector"

    def select(self, problem: Any) -> Any:
        log_mu = inversion.log_mu_grid()
        return self.changed(inversion.select_minimum("evidence", log_mu, inversion.evidence(problem, log_mu)))

    def changed(self, found: inversion.Selection) -> Any:
        return found


def altered(found: inversion.Selection, **changes: Any) -> inversion.Selection:
    kept = {name: getattr(found, name) for name in ("criterion_name", "mu", "log_mu_grid", "criterion", "at_edge")}
    return inversion.Selection(**{**kept, **changes})


class Spoils(Selector):
    """Rescales the decomposition that every other criterion shares."""

    def select(self, problem: Any) -> Any:
        found = super().select(problem)
        problem.modes.gain[:] *= 1 + 1e-9
        return found


class Counted(Selector):
    """Counts the ends at which the minimum lies, instead of saying whether it does."""

    def changed(self, found: inversion.Selection) -> Any:
        return altered(found, at_edge=int(found.at_edge))


class ShortCurve(Selector):
    """Drops the last value, of which the grid keeps the place."""

    def changed(self, found: inversion.Selection) -> Any:
        return altered(found, criterion=found.criterion[:-1])


class Extrapolates(Selector):
    """Goes on beyond the end of the grid."""

    def changed(self, found: inversion.Selection) -> Any:
        if not found.at_edge:
            return found
        return altered(found, mu=found.mu * (1e3 if found.log_mu > 28 else 1e-3))


class BesidesTheMinimum(Selector):
    """Takes three steps toward smoother profiles, to be safe."""

    def changed(self, found: inversion.Selection) -> Any:
        place = min(int(np.argmin(found.criterion)) + 3, len(found.criterion) - 1)
        edge = place in (0, len(found.criterion) - 1)
        return altered(found, mu=10.0 ** found.log_mu_grid[place], at_edge=edge)


class NeverAtEdge(Selector):
    """Says that the minimum was bracketed when it was not."""

    def changed(self, found: inversion.Selection) -> Any:
        return altered(found, at_edge=False)


class Blind(Selector):
    """A curve that owes nothing to the data."""

    def changed(self, found: inversion.Selection) -> Any:
        return inversion.select_minimum("blind", found.log_mu_grid, (found.log_mu_grid - 31.0) ** 2)


BROKEN = {
    Unfrozen: "frozen",
    Unhashable: "frozen",
    Unpicklable: "pickles_equal",
    Undocumented: "documented",
    StripsUnits: "wrong_dimension",
    HeldAsText: "wrong_dimension",
    Anonymous: "wrong_dimension",
    KeepsSpelling: "unit_spelling",
    HoldsPath: "round_trip",
    Random: "deterministic",
    Counting: "deterministic",
    TextVersion: "version",
    Misnamed: "entry_point",
    ByValue: "precision_shape",
    OneSlice: "precision_finite",
    Triangular: "precision_symmetric",
    UnevenOnly: "precision_psd",
    Nothing: "precision_not_zero",
    Flattened: "transfer_shape",
    Overflowing: "transfer_finite",
    Dim: "transfer_at_zero",
    Swelling: "transfer_bounded",
    Unreal: "transfer_conjugate",
    ListOfMoments: "moment_shape",
    WrongSign: "moment_derivative",
    OffCentre: "moment_centred",
    InPlace: "inputs_untouched",
    Raveled: "psd_shape",
    UndefinedTail: "psd_finite",
    NegativeHead: "psd_positive",
    NoiseFloor: "psd_decays",
    TooSteep: "psd_integrable",
    RadiansPerMetre: "psd_normalised",
    Spoils: "inputs_untouched",
    Counted: "selection",
    ShortCurve: "curve_on_grid",
    Extrapolates: "mu_in_grid",
    BesidesTheMinimum: "mu_at_minimum",
    NeverAtEdge: "at_edge",
    Blind: "recovers_mu",
}
SOUND = (Prior, Source, Spectrum, Selector)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entry points as if the class under test were installed under its name."""

    def points(group: str) -> list[EntryPoint]:
        found = list(entry_points(group=group))
        for cls in (*SOUND, *BROKEN):
            if conformance.KINDS[conformance.kind_of(cls)][0] == group:
                name = "misnamed" if cls is Misnamed else cls.__name__.lower()
                found.append(EntryPoint(name, f"{cls.__module__}:{cls.__name__}", group))
        return found

    monkeypatch.setattr(conformance, "entry_points", points)
    for cls in (*SOUND, *BROKEN):
        if cls is not Misnamed:
            monkeypatch.setattr(cls, "name", cls.__name__.lower())


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("cls", SOUND)
def test_the_sound_ones_pass(cls: Any) -> None:
    assert [result.message for result in check_plugin(cls) if result.status != "passed"] == []


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(("cls", "name"), BROKEN.items(), ids=lambda value: getattr(value, "__name__", value))
def test_each_broken_plugin_is_caught_by_its_own_check_alone(cls: Any, name: str) -> None:
    results = check_plugin(cls)
    assert [
        (result.check, result.message) for result in results if result.status != "passed" and result.check != name
    ] == []
    (failed,) = [result for result in results if result.check == name]
    assert failed.status == "failed"
    sentence = (
        rf"{conformance.kind_of(cls)} '{cls.name}(\(.*\))?' fails the check '{name}': promised: .+; delivered: .+"
    )
    assert re.fullmatch(sentence, failed.message, re.DOTALL)


def test_every_check_of_the_contract_is_shown_to_fail() -> None:
    assert set(BROKEN.values()) == {check.name for checks in CHECKS.values() for check in checks}


@pytest.mark.usefixtures("registered")
def test_the_sentence_says_what_was_delivered() -> None:
    (failed,) = [result for result in check_plugin(UnevenOnly) if result.status == "failed"]
    assert failed.message == (
        "regulariser 'unevenonly' fails the check 'precision_psd': promised: precision is positive semi-definite to "
        "1e-10 of its largest eigenvalue, on every grid; delivered: an eigenvalue of -737 beside a largest of 713 on "
        "7 unequal slices to 2670 m"
    )


@pytest.mark.parametrize("mu", [np.nan, np.inf, -1.0, 27.0])
def test_mu_itself_must_be_usable(mu: float) -> None:
    class Returns(Selector):
        """Returns a mu of its own."""

        def changed(self, found: inversion.Selection) -> Any:
            return altered(found, mu=mu)

    messages = [result.message for result in check_plugin(Returns()) if result.check == "selection"]
    assert f"delivered: mu = {mu:.3g}" in messages[0].replace(".0", "")


def test_what_a_plugin_raises_is_what_it_delivered() -> None:
    class Raises(Prior):
        """Raises."""

        def precision(self, grid: Any) -> Any:
            raise KeyError("weights.npy")

    messages = [result.message for result in check_plugin(Raises()) if result.check == "precision_shape"]
    assert messages[0].endswith("delivered: KeyError: 'weights.npy'")


def test_a_refusal_must_name_the_plugin_and_spare_some_grid() -> None:
    class Twelve(Prior):
        """Knows twelve slices only."""

        complaint: ClassVar[str] = "prior: made for 12 slices"

        def precision(self, grid: Any) -> Any:
            if grid.k != 12:
                raise ValueError(self.complaint)
            return np.eye(12)

    def failed(plugin: Any) -> set[str]:
        return {r.check for r in check_plugin(plugin) if r.status == "failed"} - {"entry_point", "pickles_equal"}

    assert failed(Twelve()) == set()
    Twelve.complaint = "operands could not be broadcast together"
    assert "precision_shape" in failed(Twelve())


# --- classes, examples, exemptions -----------------------------------------------------------------------


class Lengthy(Prior):
    """Needs a length."""

    length: Length = Field(gt=0)
    """Correlation length."""


def test_a_class_without_defaults_needs_examples() -> None:
    (only,) = check_plugin(Lengthy)
    assert (only.check, only.status) == ("examples", "failed")
    assert "no example, though length has no default" in only.message


def test_examples_are_tried_beside_the_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Lengthy, "examples", ({"length": "500 m"}, {"length": "5 km"}))
    tried = [label(plugin) for plugin, check in checks_of(Lengthy) if check.name == "version"]
    assert tried == ["prior(length=500 m)", "prior(length=5000 m)"]
    monkeypatch.setattr(Lengthy, "examples", ({"length": "500 s"},))
    (only,) = check_plugin(Lengthy)
    assert "'s' is a duration, but regulariser.length must be a length" in only.message
    monkeypatch.setattr(White, "examples", ({"scale": [1.0] * 12},))
    tried = [label(plugin) for plugin, check in checks_of(White) if check.name == "version"]
    assert tried == ["white", "white(scale=[1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, ...)"]


def test_what_fails_on_purpose_is_exempt_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    reason = "prior of a plugin that is not installed"
    (found,) = [
        r for r in check_plugin(Prior(), expected_failed_checks={"entry_point": reason}) if r.status != "passed"
    ]
    assert (found.check, found.status, found.message) == ("entry_point", "exempt", reason)
    monkeypatch.setattr(Prior, "expected_failed_checks", {"entry_point": reason})
    assert [r.status for r in check_plugin(Prior()) if r.status != "passed"] == ["exempt"]


def test_an_exemption_from_no_check_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"names 'psd', which is no check; there are: .*precision_psd"):
        parametrize_with_checks([Prior()], expected_failed_checks={"psd": "misspelt"})


def test_tests_have_readable_names_and_marks() -> None:
    mark = parametrize_with_checks(
        [Exponential(length="500 m"), Gradient], expected_failed_checks={"precision_psd": "a reason"}
    ).mark
    names, cases = mark.args
    assert names == ("plugin", "check")
    ids = [case.id for case in cases]
    assert len(set(ids)) == len(ids) == 2 * len(CHECKS["regulariser"]) + 1
    assert "exponential(length=500 m)-precision_psd" in ids
    assert "gradient-examples" in ids
    marked = {case.id: [(m.name, m.kwargs) for m in case.marks] for case in cases if case.marks}
    assert marked["gradient-precision_psd"] == [("xfail", {"reason": "a reason"})]
    assert len(marked) == 2


def test_only_plugins_can_be_checked() -> None:
    with pytest.raises(TypeError, match=r"dict is no plugin; derive it from one of .*: SourceModelBase"):
        check_plugin(dict)  # type: ignore[arg-type]


def test_the_contract_needs_no_pytest() -> None:
    program = (
        "import sys; sys.modules['pytest'] = None\n"
        "from coslidar.plugins import conformance, regularisers\n"
        "print({r.status for r in conformance.check_plugin(regularisers.White)})"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "{'passed'}\n"


# --- the command line ------------------------------------------------------------------------------------


def distribution(folder: Path, name: str, module: str, points: dict[str, str]) -> None:
    """An installed distribution, as far as anyone can see: a module and its metadata on the path."""
    (folder / f"{name}.py").write_text(module)
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 1.0\n")
    lines = ["[coslidar.regularisers]", *(f"{key} = {value}" for key, value in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) if points else "")


MODULE = '''
from typing import ClassVar
import numpy as np
from coslidar.plugins.contract import RegulariserBase

class Ridge(RegulariserBase):
    """A ridge."""
    name = "a_ridge"
    examples: ClassVar = ({"ratio": 2},)
    expected_failed_checks: ClassVar = {"precision_not_zero": "for the sake of the test"}
    ratio: float = 1.0
    """Ratio."""
    def precision(self, grid):
        return 0 * np.eye(grid.k)

class Wrong(RegulariserBase):
    """Wrong."""
    name = "a_wrong"
    def precision(self, grid):
        return -np.eye(grid.k)
'''


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    from click.testing import CliRunner

    from coslidar.flows.commands.science import plugins

    monkeypatch.syspath_prepend(tmp_path)
    registry._load.cache_clear()
    yield lambda *arguments: CliRunner().invoke(plugins, ["check", *arguments], standalone_mode=False)
    sys.modules.pop("ridges", None)
    registry._load.cache_clear()


def test_command_prints_a_line_per_check(run: Any, tmp_path: Path) -> None:
    distribution(tmp_path, "ridges", MODULE, {"a_ridge": "ridges:Ridge"})
    done = run("Ridges")
    assert (done.exception, done.return_value) == (None, None)
    lines = done.output.splitlines()
    assert sum(line.startswith("passed ") for line in lines) == 2 * (len(CHECKS["regulariser"]) - 1) + 1
    assert [" ".join(line.split()) for line in lines if line.startswith("exempt ")] == [
        "exempt a_ridge precision_not_zero for the sake of the test",
        "exempt a_ridge(ratio=2.0) precision_not_zero for the sake of the test",
    ]
    assert lines[-1] == f"ridges 1.0: 1 plugin, {len(lines) - 3} checks passed, 0 failed, 2 exempt"


def test_command_fails_where_a_check_does(run: Any, tmp_path: Path) -> None:
    distribution(tmp_path, "ridges", MODULE, {"a_ridge": "ridges:Ridge", "a_wrong": "ridges:Wrong"})
    done = run("ridges")
    assert done.return_value == 1
    (failed,) = [line for line in done.output.splitlines() if line.startswith("failed ")]
    assert re.search(r"precision_psd +regulariser 'a_wrong' fails the check 'precision_psd': promised", failed)


def test_command_names_what_cannot_be_loaded(run: Any, tmp_path: Path) -> None:
    distribution(tmp_path, "ridges", MODULE, {"a_ridge": "ridges:Ridge", "gone": "ridges:Gone"})
    done = run("ridges")
    assert done.return_value == 1
    (failed,) = [line for line in done.output.splitlines() if line.startswith("failed ")]
    assert "regulariser 'gone' (ridges 1.0) failed to load: AttributeError" in failed


def test_command_refuses_what_is_not_there(run: Any, tmp_path: Path) -> None:
    distribution(tmp_path, "ridges", MODULE, {})
    for name, words in (("no-such-thing", "no distribution 'no-such-thing' is installed"), ("ridges", "no plugin")):
        done = run(name)
        # What carries `faults` leaves the program with exit code 2.
        assert words in done.exception.faults[0]
