"""The report page: complete, true to the product, self-contained, the same twice, and safe with hostile text."""

from __future__ import annotations

import base64
import hashlib
import html.parser
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from chromium import QUIET
from report_fixture import LENGTH, START, product

from coslidar.catalog import report
from coslidar.catalog.report import words

VOID = {"meta", "br", "img", "link", "input", "hr"}


class Page(html.parser.HTMLParser):
    """Elements of a page with their attributes and text, as a browser's parser sees the source."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text: dict[str, list[str]] = {}
        self.open: list[str] = []
        self.rows: list[list[tuple[str, str]]] = []
        self.table = ""
        self.feed(source)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attributes}
        self.elements.append((tag, found))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.table = found.get("id", "")
        if self.table == "batches" and tag == "tr" and "tbody" in self.open:
            self.rows.append([])
        if self.table == "batches" and tag == "td":
            self.rows[-1].append((found["data-v"], ""))

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attributes}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open[-1:] == [tag], f"</{tag}> closes something else"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        inside = self.open[-1] if self.open else ""
        self.text.setdefault(inside, []).append(data)
        if inside == "td" and self.table == "batches":
            value, text = self.rows[-1][-1]
            self.rows[-1][-1] = (value, text + data)

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture(scope="module")
def many() -> xr.Dataset:
    return product(4, failed=(2,))


@pytest.fixture(scope="module")
def source(many: xr.Dataset) -> str:
    return report.render(many, most_batches=2)


@pytest.fixture(scope="module")
def page(source: str) -> Page:
    return Page(source)


def ink(figure: Any) -> np.ndarray:
    """Picture of a figure, (row, column, RGB) in 0..255 on white."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_facecolor("white")
    figure.set_dpi(60)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # Nothing is cut off at the edge of the figure; letters are set to whole pixels, here as large as 1/60 inch.
    drawn, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
    assert min(drawn.x0, drawn.y0, width - drawn.x1, height - drawn.y1) > -2 / 60, drawn
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(int)


# --- what is on the page -----------------------------------------------------------------------------------


def test_every_panel_is_there_once_per_batch_or_once(page: Page) -> None:
    panels = [attributes["data-panel"] for attributes in page.all("figure")]
    assert sorted(panels) == sorted(
        [panel.key for panel in report.BATCH_PANELS] * 2 + [panel.key for panel in report.TIME_PANELS]
    )
    assert {panel.key for panel in report.BATCH_PANELS} >= {
        "profile", "correlations", "criterion", "kernels", "other_mu", "checks", "vibration"}  # fmt: skip
    assert {panel.key for panel in report.TIME_PANELS} >= {
        "map", "strength", "fit", "selection", "averages", "response", "quality"}  # fmt: skip
    assert page.open == []


def test_every_figure_has_a_text_alternative_and_a_question_as_title(page: Page, source: str) -> None:
    figures = page.all("svg")
    assert len(figures) == 2 * len(report.BATCH_PANELS) + len(report.TIME_PANELS)
    identifiers = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    for attributes in figures:
        assert attributes["role"] == "img"
        assert attributes["aria-label"].endswith("?")
        assert attributes["aria-describedby"] in identifiers
    assert all(len(text) > 20 for text in page.text["desc"])
    for reference in re.findall(r'(?:url\(|href=")#([^)"]+)', source):
        assert reference in identifiers


@pytest.mark.parametrize("panel", report.BATCH_PANELS + report.TIME_PANELS, ids=lambda panel: panel.key)
def test_a_figure_shows_the_data(panel: Any, many: xr.Dataset) -> None:
    """The picture changes with the data: a figure with axes and no data inside would not."""
    other = product(4, failed=(1,), seed=5)
    for name in ("mu", "criterion", "averaging_kernel", "r0_profile", "slope_spectrum", "response_slope",
                 "response_intensity"):  # fmt: skip
        other[name] = other[name] * (1 + 0.3 * other[name] / other[name].max())
    other["response_intensity"] = other["response_intensity"] * np.linspace(1, 0.5, 12)
    other["scintillometer_weight"] = other["scintillometer_weight"] * np.linspace(1, 0.5, 12)
    first, second = ink(report.figure(panel, many, 0)), ink(report.figure(panel, other, 0))
    assert first.shape == second.shape
    assert (first != 255).any(axis=-1).mean() > 0.01
    assert (first != second).any(axis=-1).mean() > 0.002


def test_numbers_of_the_table_are_those_of_the_product(page: Page, many: xr.Dataset) -> None:
    assert len(page.rows) == 4
    thickness = np.diff(many["z_bounds"].values, axis=1)[:, 0]
    expected = {
        1: [180.0] * 4,
        4: many["cn2"].values @ thickness / LENGTH,
        5: 100 * many["r0_profile"].values,
        6: many["scintillation_index_direct"].values.mean(axis=1),
        7: many["scintillation_index_profile"].values,
        8: many["scintillation_index_point"].values,
        9: np.log10(many["mu"].values),
        10: many["chi2_reduced"].values,
        11: many["degrees_of_freedom"].values,
        12: 100 * many["valid_fraction"].values.mean(axis=1),
    }
    superscript = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-")
    for i, row in enumerate(page.rows):
        assert len(row) == 13
        assert row[0] == (str(START + i * 180 * 10**9), f"2012-09-14 12:{15 + 3 * i}:00")
        for column, values in expected.items():
            if np.isnan(values[i]):
                assert row[column] == ("", "–")
                continue
            # What is sorted by has all digits, what is shown four.
            assert float(row[column][0]) == pytest.approx(values[i], rel=1e-12)
            shown = float(row[column][1].replace("×10", "e").translate(superscript))
            assert shown == pytest.approx(values[i], rel=5.1e-4)
    assert page.rows[0][3][1] == "usable with care: strong scintillation"
    assert page.rows[2][3][1] == "bad: failed"


def test_headline_names_what_was_measured(source: str) -> None:
    text = re.sub(r"<[^>]+>", "", source)
    for expected in (
        "lannemezan-2012",
        "2012-09-14T1415",
        "2012-09-14 12:15:00 to 12:27:00",
        "2012-09-14 14:15:00 to 14:27:00",
        "Europe/Paris, UTC+02:00",
        "3.8 µm",
        "12 slices, 0 to 2670 m",
        "1 bad",
        "the batch could not be processed",
        "10.1364/AO.438170",
        "0f3c" * 16,
        "coslidar 0.1.0 (commit 57b8f58)",
        "noise_bias = joint",
    ):
        assert expected in text, expected


def test_batches_with_figures_are_those_with_a_profile(page: Page) -> None:
    labels = [attributes["aria-label"] for attributes in page.all("article")]
    assert labels == ["Batch 2012-09-14 12:15:00 to 12:18:00 UTC", "Batch 2012-09-14 12:24:00 to 12:27:00 UTC"]
    assert len(page.all("option")) == 2


@pytest.mark.parametrize(
    ("usable", "most", "expected"),
    [
        ([True] * 3, 12, [0, 1, 2]),
        ([True] * 9, 3, [0, 4, 8]),
        ([False, True, False, True, True], 2, [1, 4]),
        ([True] * 5, 1, [0]),
        ([False], 3, []),
    ],
)
def test_batches_are_picked_evenly(usable: list[bool], most: int, expected: list[int]) -> None:
    from coslidar.catalog.report.page import pick

    assert pick(usable, most) == expected


@pytest.fixture
def few_panels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two figures of a batch and two over time, for tests that are about the page around them."""
    monkeypatch.setattr(report.page, "BATCH_PANELS", report.BATCH_PANELS[:2])
    monkeypatch.setattr(report.page, "TIME_PANELS", report.TIME_PANELS[:2])


# --- cases -------------------------------------------------------------------------------------------------


def test_a_single_batch_has_no_map_and_no_picker() -> None:
    single = product(1, seconds=19.7, decoded=False)
    page = Page(report.render(single))
    expected = {panel.key for panel in report.BATCH_PANELS + report.TIME_PANELS} - {"map"}
    assert sorted(attributes["data-panel"] for attributes in page.all("figure")) == sorted(expected)
    assert page.all("select") == []
    assert page.rows[0][1][1] == "19.70"


@pytest.mark.usefixtures("few_panels")
def test_one_source_has_no_maps_between_sources() -> None:
    page = Page(report.render(product(1, sources=1)))
    assert "There are no maps between sources: one source was observed." in " ".join(page.text["p"])
    assert "direct, bottom" in page.text["text"]
    assert "direct, top" not in page.text["text"]


def test_nothing_but_failed_batches_is_said_and_not_drawn() -> None:
    page = Page(report.render(product(2, failed=(0, 1))))
    # What does not depend on a batch is drawn nevertheless.
    assert [attributes["aria-label"] for attributes in page.all("svg")] == [
        "Where along the path does each scintillometer look?",
        "What do the data answer to, and from where?",
        "Which batches need care?",
    ]
    assert "No batch has a profile" in " ".join(page.text["p"])
    assert [cell[1] for cell in page.rows[0][4:]] == ["–"] * 9


@pytest.mark.usefixtures("few_panels")
def test_several_products_are_put_in_order_even_with_other_slices() -> None:
    late = product(2, start=START + 3600 * 10**9, slices=9, attributes={"archive": "later"})
    early = product(2)
    page = Page(report.render([late, early], most_batches=1))
    starts = [int(row[0][0]) for row in page.rows]
    assert starts == sorted(starts)
    assert len(starts) == 4
    text = " ".join(page.text["dd"])
    assert "2012-09-14T1415, later" in text
    assert "9 slices" in text
    assert "12 slices" in text


@pytest.mark.usefixtures("few_panels")
def test_a_product_without_optional_variables_still_has_a_page() -> None:
    poor = product(3)[["time_bounds", "cn2", "quality_flag"]].drop_attrs()
    page = Page(report.render(poor, most_batches=1))
    assert "unnamed campaign" in " ".join(page.text["dd"])
    assert len(page.rows) == 3


def test_without_a_batch_there_is_no_page(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("old")
    with pytest.raises(ValueError, match="there is no batch to report on"):
        report.write_report([], tmp_path / "report.html")
    with pytest.raises(ValueError, match="there is no batch to report on"):
        report.write_report(product(3).isel(time=slice(0)), tmp_path / "report.html")
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


def test_the_profile_is_drawn_where_it_is() -> None:
    from matplotlib.figure import Figure

    dataset = product(1)
    with report.figure_style():
        ax = report.draw_profile(Figure().add_subplot(), dataset, 0)
    steps = next(patch for patch in ax.patches if patch.get_label() == "retrieved").get_data()
    cn2 = dataset["cn2"].values[0]
    bound = dataset["cn2_at_bound"].values[0] > 0
    assert bound.sum() == 2
    np.testing.assert_array_equal(steps.values, np.where(bound, np.nan, cn2))
    np.testing.assert_allclose(steps.edges, np.linspace(0, LENGTH, 13))
    arrows = next(line for line in ax.lines if line.get_label() == "upper limit")
    np.testing.assert_allclose(arrows.get_xdata(), dataset["z"].values[bound])
    lengths = {container.get_label(): container for container in ax.containers}
    for label, name in (("MAP bar", "cn2_standard_error"), ("maximum-likelihood bar", "cn2_standard_error_ml")):
        segments = np.array(lengths[label][2][0].get_segments())
        # Bars end under the axis where they reach below zero, so that their upper ends are what can be compared.
        np.testing.assert_allclose(segments[:, 1, 1], (cn2 + dataset[name].values[0])[~bound])
    thick = next(item for item in ax.collections if item.get_label() == "68 % and 95 % interval")
    ends = np.array(thick.get_segments())
    np.testing.assert_allclose(ends[:, 0, 0], dataset["z"].values[~bound])
    np.testing.assert_allclose(ends[:, 1, 1], dataset["cn2_interval_68"].values[0, ~bound, 1])
    # h^(-4/3), as close as weighted least squares bring it: the residual is orthogonal to the shape.
    line = next(line for line in ax.lines if str(line.get_label()).startswith("$h"))
    shape = dataset["height_above_ground"].values ** (-4 / 3)
    drawn = np.asarray(line.get_ydata())
    np.testing.assert_allclose(drawn / shape, drawn[0] / shape[0])
    weighted = (cn2 - drawn) * shape / dataset["cn2_standard_error"].values[0] ** 2
    assert abs(weighted.sum()) < 1e-9 * np.abs(weighted).sum()


def test_many_labels_of_the_colours_leave_room_for_their_name() -> None:
    """Less than a decade has a label at every other step, and each of them is long."""
    dataset = product(1)
    dataset["cn2"][0], dataset["cn2_at_bound"][0] = np.linspace(6e-15, 5e-14, 12), 0
    ink(report.figure(next(panel for panel in report.TIME_PANELS if panel.key == "map"), dataset))


@pytest.mark.parametrize("cn2", [np.zeros(12), np.full(12, 3e-15), np.full(12, np.nan), np.full(12, 1e-300)])
def test_odd_profiles_are_drawn(cn2: np.ndarray) -> None:
    dataset = product(1)
    dataset["cn2"][0] = cn2
    dataset["cn2_at_bound"][0] = cn2 == 0
    dataset["cn2_standard_error_ml"][0] = np.inf
    assert (ink(report.figure(report.BATCH_PANELS[0], dataset)) != 255).any()


@pytest.mark.parametrize("name", [name for name in report.__all__ if name.startswith("draw_")])
def test_what_draws_takes_axes_and_a_product_and_returns_the_axes(name: str) -> None:
    """As somebody with a notebook would call it; what a product lacks is said in the axes."""
    from matplotlib.figure import Figure

    draw = getattr(report, name)
    for dataset in (product(3), product(1)[["time_bounds", "z_bounds", "cn2"]]):
        ax = Figure().add_subplot()
        assert draw(ax, dataset) is ax
        if "response_slope" in dataset:
            assert ax.lines or ax.images or ax.collections or ax.patches or ax.texts


def test_maps_of_every_kind_are_drawn_with_their_unit() -> None:
    from matplotlib.figure import Figure

    dataset = product(2)
    for kind in ("xx_auto", "yy_cross", "ii_auto"):
        for which in ("measured", "model", "residual"):
            ax = report.draw_correlation_map(Figure().add_subplot(), dataset, 1, kind=kind, which=which)
            shown = np.ma.filled(ax.images[0].get_array(), np.nan)
            side, number = {"xx_auto": ("slope", 0), "yy_cross": ("slope", 3), "ii_auto": ("intensity", 0)}[kind]
            measured, model, error = (
                dataset[f"{side}_correlation{part}"].values[1, number] for part in ("", "_model", "_error")
            )
            expected = {"measured": measured, "model": model, "residual": (measured - model) / error}
            factor = 1e12 if side == "slope" and which != "residual" else 1
            np.testing.assert_allclose(shown, factor * expected[which], rtol=1e-12)
    with pytest.raises(ValueError, match="there are xx_auto"):
        report.draw_correlation_map(Figure().add_subplot(), dataset, kind="zz")
    with pytest.raises(ValueError, match="there are measured"):
        report.draw_correlation_map(Figure().add_subplot(), dataset, which="error")
    with pytest.raises(ValueError, match="there are ii_auto, xx_auto"):
        report.draw_response(Figure().add_subplot(), dataset, "yy_cross")


def test_dy_points_upward_in_the_maps() -> None:
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from coslidar.catalog.report import batch_panels

    dataset = product(1)
    values = np.zeros((9, 9))
    values[8, 4] = 1.0
    with report.figure_style():
        figure = Figure(figsize=(3, 3))
        ax = figure.add_axes((0, 0, 1, 1))
        batch_panels._draw_map(ax, dataset, values, norm=Normalize(0, 1), ticks=False)
    bright = np.argwhere((ink(figure)[..., 0] > 200) & (ink(figure)[..., 2] < 100))
    rows, columns = bright.mean(axis=0) / 180
    assert rows < 0.15
    assert columns == pytest.approx(0.5, abs=0.05)


def test_maps_are_compared_where_there_are_pairs() -> None:
    from coslidar.catalog.report.reading import maps

    dataset = product(1)
    dataset["slope_correlation_model"][:] = 1.0
    item = maps(dataset, 0)[1]
    assert item.kind == "yy_auto"
    empty = dataset["pair_count"].values == 0
    assert empty.sum() == 12
    for values in (item.measured, item.model, item.residual):
        np.testing.assert_array_equal(np.isnan(values), empty)
    expected = (dataset["slope_correlation"] - 1.0) / dataset["slope_correlation_error"]
    np.testing.assert_allclose(item.residual, expected.values[0, 1])
    assert item.rms == pytest.approx(np.sqrt(np.nanmean(expected.values[0, 1] ** 2)))


def test_gaps_of_the_map_are_blank_and_bounded_values_hatched() -> None:
    from matplotlib.figure import Figure

    dataset = product(6, gap_after=3)
    with report.figure_style():
        figure = Figure(figsize=(8, 3))
        ax = figure.add_axes((0, 0, 1, 1))
        report.draw_time_distance(ax, dataset)
        for child in [*ax.child_axes, *(other for other in figure.axes if other is not ax)]:
            child.remove()
        ax.set_axis_off()
        ax.set_position((0, 0, 1, 1))
    picture = ink(figure)
    height, width = picture.shape[:2]
    low, high = ax.get_xlim()

    def cell(day: float, z: float) -> np.ndarray:
        column, row = int((day - low) / (high - low) * width), int((1 - z / LENGTH) * height)
        return picture[row - 4 : row + 5, column - 4 : column + 5].reshape(-1, 3)

    limits = (dataset["time_bounds"].values.astype("datetime64[ns]").astype(np.int64)) / 86_400e9
    gap = (limits[2, 1] + limits[3, 0]) / 2
    assert (cell(gap, 500) == 255).all()
    first = limits[0].mean()
    assert (cell(first, 500).std(axis=0) < 3).all()
    assert (cell(first, 500).mean(axis=0) < 250).any()
    hatched = cell(first, 1223.75)
    assert (hatched == 255).all(axis=1).any()
    assert (hatched < 200).all(axis=1).any()


# --- safe, self-contained, reproducible --------------------------------------------------------------------


def test_nothing_of_the_page_comes_from_elsewhere(page: Page, source: str) -> None:
    for tag, attributes in page.elements:
        assert "style" not in attributes, f"<{tag} style>: the policy forbids it"
        assert not any(name.startswith("on") for name in attributes)
        for name in ("href", "src", "data", "action", "srcset", "xlink:href"):
            assert re.match(r"#|data:image/png;base64,", attributes.get(name, "#")), attributes
    assert not {"link", "iframe", "object", "embed", "base", "form"} & {tag for tag, _ in page.elements}
    assert set(re.findall(r"https?://[^\s\"'<]+", source)) <= {"http://www.w3.org/2000/svg"}
    assert "@import" not in source
    assert set(re.findall(r"url\((.)", source)) <= {"#"}


def test_the_policy_allows_the_page_itself_and_nothing_else(page: Page) -> None:
    policy = next(a["content"] for a in page.all("meta") if a.get("http-equiv") == "Content-Security-Policy")
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["img-src"] == "data:"
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        assert len(page.all(tag)) == 1
        digest = hashlib.sha256("".join(page.text[tag]).encode()).digest()
        assert rules[rule] == f"'sha256-{base64.b64encode(digest).decode()}'"


HOSTILE = (
    "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>{{ 7 * 7 }}\x00\x1b[31m\u202egnp\ud800$\\frac{$&amp;"
)


@pytest.mark.usefixtures("few_panels")
def test_hostile_text_is_shown_and_does_nothing() -> None:
    dataset = product(
        1,
        attributes={
            "campaign": HOSTILE,
            "archive": HOSTILE,
            "timezone": "../../etc/passwd",
            "wavelength": HOSTILE,
            "lineage_key": HOSTILE,
            "lineage": '{"nodes": {"<b>": {"stage": "</script><script>alert(2)</script>", "tracked": ["<i>"]}, "": 3}}',
            "provenance": '{"agent": {"a": {"prov:label": "coslidar <u>", "coslidar:commit": ["<s>"]}, "b": []}}',
            "note": "]]><style>*{display:none}</style>" * 20,
            HOSTILE: HOSTILE,
        },
    ).assign_coords(source=["$\\frac{$", "<b>\x07" + "very long" * 50])
    source = report.render(dataset, title=HOSTILE)
    source.encode("utf-8")
    page = Page(source)
    assert len(page.all("script")) == len(page.all("style")) == 1
    assert not {"img", "b2", "i", "u", "s"} & {tag for tag, _ in page.elements}
    assert not any(name.startswith("on") for _, attributes in page.elements for name in attributes)
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", source)
    assert "<script>alert(1)</script>" in "".join(page.text["h1"])
    assert "{{ 7 * 7 }}" in "".join(page.text["h1"])
    assert "Local time" not in "".join(page.text["dt"])


@pytest.mark.slow
def test_the_same_products_give_the_same_bytes(tmp_path: Path) -> None:
    """Also in another process with another hash seed, time zone, locale and matplotlib settings."""
    report.write_report(product(2), tmp_path / "first.html", most_batches=1)
    import matplotlib

    with matplotlib.rc_context({"font.size": 30, "axes.grid": True, "svg.fonttype": "path", "text.usetex": False}):
        before = dict(matplotlib.rcParams)
        report.write_report(product(2), tmp_path / "second.html", most_batches=1)
        assert dict(matplotlib.rcParams) == before
    code = (
        "from report_fixture import product; from coslidar.catalog import report; import sys;"
        "report.write_report(product(2), sys.argv[1], most_batches=1)"
    )
    environment = {
        **os.environ,
        "PYTHONHASHSEED": "7",
        "TZ": "Asia/Kathmandu",
        "PYTHONPATH": str(Path(__file__).parents[1]),
        "MPLBACKEND": "svg",
    }
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "third.html")], check=True, env=environment)
    contents = {path.read_bytes() for path in tmp_path.glob("*.html")}
    assert len(contents) == 1
    assert not [path for path in tmp_path.iterdir() if path.suffix != ".html"]


def test_importing_the_report_is_cheap() -> None:
    code = (
        "import coslidar.catalog.report, sys; print([name for name in ('matplotlib', 'jinja2') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "[]\n"


def test_geometry_is_told_with_units(source: str) -> None:
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", source))
    for expected in (
        "z_max692.0 m (triangulation ends here",
        "Resolution near the pupil214.8 m",
        "Pupil along y35.0 cm",
        "Fresnel scale on the pupil2.10 to 48.3 cm",
        "Resolution of the profiles500 m (length of path that a slice stands for: median; 500 to 500",
    ):
        assert expected in text, expected


def test_slices_without_resolution_are_said() -> None:
    from coslidar.catalog.report.batch_panels import describe_kernels
    from coslidar.catalog.report.page import geometry

    dataset = product(2)
    border = dataset["z_bounds"].values[:, 0]
    assert "Not resolved" not in describe_kernels(dataset, 0)
    dataset["resolution_length"][0, [3, 10, 11]] = np.nan
    said = describe_kernels(dataset, 0)
    assert f"Not resolved, more the prior's than the data's: {border[3]:.1f} to {border[4]:.1f} m, " in said
    assert said.endswith(f" m, {border[10]:.0f} to 2670 m.")
    remark = {row["name"]: row["remark"] for row in geometry([dataset])}["Resolution of the profiles"]
    assert remark.endswith("500 to 500; 12 % of the slices are not resolved"), remark


def test_spectrum_and_checks_are_said() -> None:
    from coslidar.catalog.report.check_panels import describe_checks, describe_spectrum

    dataset = product(1)
    assert "A vibration line at 50.00 Hz holds 1.00×10⁻¹² rad² of the slopes along x" in describe_spectrum(dataset, 0)
    assert "bottom: r₀ from the Zernike variances 13.3 cm" in describe_checks(dataset, 0)
    dataset["vibration_frequency"][:] = np.nan
    assert describe_spectrum(dataset, 0) == "No vibration line stands out of the spectrum."


def test_checks_are_drawn_where_they_are() -> None:
    from matplotlib.figure import Figure

    from coslidar.catalog.report import check_panels

    dataset = product(1)
    with report.figure_style():
        ax = check_panels.draw_zernike(Figure().add_subplot(), dataset)
        measured = next(line for line in ax.lines if line.get_label() == "measured, top")
        np.testing.assert_allclose(measured.get_ydata(), dataset["zernike_variance"].values[0, 1])
        ax = check_panels.draw_log_amplitude(Figure().add_subplot(), dataset)
        steps = next(patch for patch in ax.patches if patch.get_label() == "measured, bottom").get_data()
    # A density: its integral is 1, and its width that of the Gaussian.
    width = np.diff(steps.edges)
    assert (steps.values * width).sum() == pytest.approx(1, rel=1e-9)
    middle = (steps.edges[1:] + steps.edges[:-1]) / 2
    # Bins of 0.01 add 0.01^2 / 12 to the variance.
    expected = dataset["log_amplitude_deviation"].values[0, 0] ** 2 + 0.01**2 / 12
    assert (steps.values * width * middle**2).sum() == pytest.approx(expected, rel=2e-3)


def test_differences_of_direct_and_retrieved_are_relative() -> None:
    from matplotlib.figure import Figure

    from coslidar.catalog.report.time_panels import draw_relative

    dataset = product(3)
    with report.figure_style():
        ax = draw_relative(Figure().add_subplot(), dataset)
    line = next(line for line in ax.lines if "sigma" in str(line.get_label()))
    direct = dataset["scintillation_index_direct"].values.mean(axis=1)
    expected = 100 * (dataset["scintillation_index_profile"].values - direct) / direct
    np.testing.assert_allclose(line.get_ydata(), expected)


def test_profiles_at_other_mu_share_a_scale() -> None:
    dataset = product(1)
    panel = next(panel for panel in report.BATCH_PANELS if panel.key == "other_mu")
    axes = report.figure(panel, dataset).axes
    assert len({ax.get_ylim() for ax in axes}) == 1
    drawn = [next(patch for patch in ax.patches if patch.get_label() == "retrieved").get_data().values for ax in axes]
    shown = np.isfinite(drawn[2])
    np.testing.assert_allclose(drawn[2][shown], 0.6 * dataset["cn2"].values[0][shown])


@pytest.mark.slow
def test_a_long_campaign_has_an_index_and_a_page_a_day(tmp_path: Path) -> None:
    """Ten batches of six hours from 12:15 UTC, 14:15 in Paris: two, four and four a day of the site."""
    dataset = product(10, seconds=6 * 3600, failed=(4,), attributes={"campaign": HOSTILE})
    files = report.write_report(dataset, tmp_path / "a b.html", most_batches=1)
    days = ["2012-09-14", "2012-09-15", "2012-09-16"]
    assert [file.name for file in files] == ["a b.html", *(f"a b-{day}.html" for day in days)]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(file.name for file in files)
    index = Page(files[0].read_text("utf-8"))
    links = [attributes["href"] for attributes in index.all("a")]
    assert [link for link in links if not link.startswith("#")] == [f"a%20b-{day}.html" for day in days]
    assert index.all("article") == []
    assert "map" in [attributes["data-panel"] for attributes in index.all("figure")]
    assert index.open == []
    counts = []
    for file in files[1:]:
        page = Page(file.read_text("utf-8"))
        counts.append(len(page.rows))
        assert "a%20b.html" in [attributes["href"] for attributes in page.all("a")]
        assert len(page.all("article")) == 1
    assert counts == [2, 4, 4]


@pytest.mark.slow
def test_the_report_on_paper_is_reproducible(tmp_path: Path) -> None:
    dataset = product(2, attributes={"campaign": HOSTILE, "note": HOSTILE})
    (first,) = report.write_pdf(dataset, tmp_path / "a.pdf", most_batches=1)
    (second,) = report.write_pdf(dataset, tmp_path / "b.pdf", most_batches=1)
    content = first.read_bytes()
    assert content == second.read_bytes()
    assert content.startswith(b"%PDF")
    # A page of numbers, then the panels.
    assert len(re.findall(rb"/Type /Page\b", content)) == 1 + len(report.TIME_PANELS) + len(report.BATCH_PANELS)
    assert not re.search(rb"/JavaScript|/URI|/Launch", content)


@pytest.mark.slow
def test_pictures_have_names_and_words(tmp_path: Path) -> None:
    from PIL import Image

    files = report.write_png(product(1), tmp_path / "r.png", dpi=40)
    names = {file.name for file in files}
    assert {"r-profile.png", "r-strength.png", "r-checks.png"} <= names
    assert names == {path.name for path in tmp_path.iterdir()}
    with Image.open(tmp_path / "r-profile.png") as picture:
        assert picture.text["Title"] == "How does Cn² vary along the line of sight?"  # type: ignore[attr-defined]
        assert "12 slices" in picture.text["Description"]  # type: ignore[attr-defined]
        assert np.asarray(picture.convert("L")).std() > 5


def test_nothing_is_told_by_colour_alone() -> None:
    """Lines that share axes differ in marker or dashes, not only in colour."""
    dataset = product(6)
    for panel in report.BATCH_PANELS + report.TIME_PANELS:
        for ax in report.figure(panel, dataset).axes:
            named = [line for line in ax.lines if not str(line.get_label()).startswith("_")]
            looks = [(line.get_marker(), str(line._dash_pattern), line.get_linestyle() != "None") for line in named]
            assert len(set(looks)) == len(looks), (panel.key, [line.get_label() for line in named])


def contrast(first: str, second: str) -> float:
    """Contrast ratio of two colours (WCAG 2.2, relative luminance)."""

    def luminance(colour: str) -> float:
        channels = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    high, low = sorted((luminance(first), luminance(second)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_colours_have_the_contrast_that_reading_needs() -> None:
    """4.5 for text, 3 for lines of figures (WCAG 2.2, 1.4.3 and 1.4.11), in the light and in the dark theme."""
    sheet = (Path(report.__file__).parent / "report.css").read_text("utf-8")
    themes = [
        dict(re.findall(r"--(\w+): (#[0-9a-f]{6});", block)) for block in re.findall(r":root \{(.*?)\}", sheet, re.S)
    ]
    assert len(themes) == 2
    for theme in themes:
        for text in ("ink", "muted", "link"):
            assert contrast(theme[text], theme["card"]) >= 4.5, text
            assert contrast(theme[text], theme["back"]) >= 4.5, text
        for line in ("blue", "red", "green", "purple"):
            assert contrast(theme[line], theme["card"]) >= 3, line


@pytest.mark.slow
def test_five_hundred_batches_fit_on_a_page(tmp_path: Path) -> None:
    """Less than 2 MB; measured 1.7 MB, in 14 s of CPU on two busy cores."""
    dataset = product(500, gap_after=250, failed=(7, 8))
    (path,) = report.write_report(dataset, tmp_path / "report.html")
    assert path.stat().st_size < 2e6
    page = Page(path.read_text("utf-8"))
    assert len(page.rows) == 500
    assert len(page.all("article")) == 6


@pytest.mark.slow
def test_the_page_needs_no_sideways_scrolling_at_400_percent(tmp_path: Path) -> None:
    """1280 pixels are 320 at 400 % (WCAG 2.2, 1.4.10); tables and figures scroll in boxes of their own."""
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("no chromium: the page is not opened in a browser")
    long = "x" * 200
    source = report.render(product(2, attributes={"campaign": long, "archive": long, "note": long}), most_batches=1)
    # The page's own policy would not let anybody measure it.
    source = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", source)
    probe = "const d = document.documentElement; parent.document.title = d.clientWidth + ' ' + d.scrollWidth;"
    (tmp_path / "page.html").write_text(source.replace("</body>", f"<script>{probe}</script></body>"), "utf-8")
    frame = '<iframe src="page.html" style="width: 320px; height: 800px"></iframe>'
    (tmp_path / "frame.html").write_text(f"<!DOCTYPE html><title>none</title>{frame}", "utf-8")
    done = subprocess.run(
        [browser, *QUIET, "--disable-web-security", "--dump-dom",
         "--allow-file-access-from-files", "--virtual-time-budget=5000", f"--user-data-dir={tmp_path / 'profile'}",
         (tmp_path / "frame.html").as_uri()],
        check=True, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    shown, needed = (int(n) for n in re.findall(r"<title>(\d+) (\d+)</title>", done.stdout)[0])
    assert 0 < shown <= 320
    assert needed <= shown


# --- words -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "digits", "expected"),
    [
        (0.0, 3, "0"),
        (float("nan"), 3, "–"),
        (float("inf"), 3, "∞"),
        (2.0449e-13, 3, "2.04×10⁻¹³"),
        (-0.01234, 2, "−0.012"),
        (9.996, 3, "10.0"),
        (12345.0, 4, "12345"),
        (1.5e7, 2, "1.5×10⁷"),
    ],
)
def test_numbers_as_words(value: float, digits: int, expected: str) -> None:
    assert words.number(value, digits) == expected


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (2.0449e-13, 3.1e-14, "(2.04 ± 0.31)×10⁻¹³"),
        (0.108, 0.0123, "0.108 ± 0.012"),
        (1.0, float("nan"), "1.00"),
        (0.0, 2.5e-15, "(0.0 ± 2.5)×10⁻¹⁵"),
        (1.0, 0.00996, "1.0000 ± 0.0100"),
    ],
)
def test_measured_numbers_as_words(value: float, error: float, expected: str) -> None:
    assert words.measured(value, error) == expected


def test_times_as_words() -> None:
    paris = words.site_zone({"site": '{"timezone": "Europe/Paris"}'})
    assert paris is not None
    assert words.clock(START, paris) == "2012-09-14 14:15:00"
    assert words.offset(START, paris) == "UTC+02:00"
    assert words.interval(START, START + 12 * 3600 * 10**9) == ("2012-09-14 12:15:00", "2012-09-15 00:15:00")
    assert words.clock(2**63 - 1) == "2262-04-11 23:47:16.8"
    for nonsense in ("", "Nowhere/Land", "/etc/passwd", "Europe", "\x00", 3):
        assert words.site_zone({"timezone": nonsense}) is None
