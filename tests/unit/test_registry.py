from __future__ import annotations

import pickle
import sys
import types
from importlib.metadata import EntryPoint, entry_points

import numpy as np
import pytest

from coslidar.plugins import registry
from coslidar.plugins.contract import RegulariserBase, SourceModelBase

GROUP = "coslidar.regularisers"


@pytest.fixture
def points(monkeypatch: pytest.MonkeyPatch) -> list[EntryPoint]:
    """Entry points of hand-made plugins, nothing installed."""
    module = types.ModuleType("handmade")

    class Good(RegulariserBase):
        """Good."""

        name = "good"

        def precision(self, grid: object) -> np.ndarray:
            return np.eye(3)

    class Misnamed(Good):
        """Misnamed."""

        name = "other"

    module.Good, module.Misnamed, module.text = Good, Misnamed, "no class"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "handmade", module)
    return [
        EntryPoint("good", "handmade:Good", GROUP),
        EntryPoint("misnamed", "handmade:Misnamed", GROUP),
        EntryPoint("text", "handmade:text", GROUP),
        EntryPoint("absent", "handmade:Absent", GROUP),
        EntryPoint("broken", "no_such_module:X", GROUP),
    ]


def install(monkeypatch: pytest.MonkeyPatch, points: list[EntryPoint]) -> None:
    monkeypatch.setattr(registry, "entry_points", lambda group: points if group == GROUP else entry_points(group=group))


def test_one_broken_plugin_hides_no_other(monkeypatch: pytest.MonkeyPatch, points: list[EntryPoint]) -> None:
    install(monkeypatch, points)
    loaded, failed = registry.available("regulariser")
    assert list(loaded) == ["good"]
    assert set(failed) == {"misnamed", "text", "absent", "broken"}
    assert failed["broken"].startswith("ModuleNotFoundError: No module named 'no_such_module'")
    assert "RegulariserBase" in failed["text"]
    assert "must agree" in failed["misnamed"]


def test_unknown_name_lists_what_is_there_and_what_failed(
    monkeypatch: pytest.MonkeyPatch, points: list[EntryPoint]
) -> None:
    install(monkeypatch, points)
    with pytest.raises(registry.PluginError) as error:
        registry.get("regulariser", "tv")
    assert str(error.value).startswith("no regulariser 'tv'; installed: good; failed to load: ")
    assert "broken (ModuleNotFoundError" in str(error.value)


def test_two_of_one_name_are_an_error(monkeypatch: pytest.MonkeyPatch, points: list[EntryPoint]) -> None:
    install(monkeypatch, [*points, EntryPoint("good", "elsewhere:Good", GROUP)])
    with pytest.raises(registry.PluginError, match=r"two plugins are called regulariser 'good'.*elsewhere:Good"):
        registry.get("regulariser", "good")


def test_listing_imports_nothing(monkeypatch: pytest.MonkeyPatch, points: list[EntryPoint]) -> None:
    install(monkeypatch, points)
    monkeypatch.setattr(EntryPoint, "load", lambda self: pytest.fail("a plugin was imported"))
    assert sorted(registry.entries("regulariser")) == ["absent", "broken", "good", "misnamed", "text"]


@pytest.mark.parametrize("kind", list(registry.KINDS))
def test_every_built_in_plugin_loads(kind: str) -> None:
    loaded, failed = registry.available(kind)
    assert not failed
    assert loaded
    for cls in loaded.values():
        assert cls.__doc__
        assert all(info.description for info in cls.model_fields.values()), f"{cls.name} has an undocumented parameter"


def test_refused_parameters_name_themselves() -> None:
    with pytest.raises(registry.PluginError) as error:
        registry.create("source model", "gaussian", {"fwhm_x": "1 s", "fwhm_y": 3})
    assert error.value.validation is not None
    assert error.value.validation.error_count() == 2


def test_a_plugin_is_frozen_and_pickles() -> None:
    model = registry.create("source model", "gaussian", {"fwhm_x": "8.9 cm", "fwhm_y": "63 mm"})
    assert pickle.loads(pickle.dumps(model)) == model
    assert model == registry.create("source model", "gaussian", {"fwhm_x": "89 mm", "fwhm_y": "6.3 cm"})
    with pytest.raises(Exception, match="frozen"):
        model.fwhm_x = 1.0  # type: ignore[attr-defined]


class Lopsided(SourceModelBase):
    """A triangle in x: analytic transfer and moment known."""

    name = "lopsided"

    def transfer(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Two points of unequal weight, at x = 0.1 m and x = -0.3 m, blurred along both axes by 2 cm."""
        blur = np.exp(-2 * np.pi**2 * 0.02**2 * (fx**2 + fy**2))
        return blur * (0.75 * np.exp(-2j * np.pi * 0.1 * fx) + 0.25 * np.exp(2j * np.pi * 0.3 * fx))


def test_default_moment_against_the_closed_form() -> None:
    """s P of a blurred point at s0: (s0 - 2 pi i sigma^2 f) times its transfer function."""
    fx, fy = np.meshgrid(np.linspace(-15, 15, 31), np.linspace(-15, 15, 31))
    blur = np.exp(-2 * np.pi**2 * 0.02**2 * (fx**2 + fy**2))
    points = [(0.75, 0.1), (0.25, -0.3)]
    x = sum(w * blur * np.exp(-2j * np.pi * s * fx) * (s - 2j * np.pi * 0.02**2 * fx) for w, s in points)
    y = sum(w * blur * np.exp(-2j * np.pi * s * fx) * (-2j * np.pi * 0.02**2 * fy) for w, s in points)
    found_x, found_y = Lopsided().moment(fx, fy)
    assert np.abs(found_x - x).max() < 1e-9
    assert np.abs(found_y - y).max() < 1e-9
