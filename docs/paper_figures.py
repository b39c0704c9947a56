"""Pictures of docs/figures.md: counterparts of the paper's figures from the demo recordings.

``python docs/paper_figures.py demo`` makes the demo in the folder ``demo`` where it is missing, processes it with the
scintillometers of the paper's Table 1 and a drawn terrain, and writes ``docs/figures/paper-*.png``.
"""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
FIGURES = HERE / "figures"
#: File -> (kind, panel). The profile, the criterion and the sensitivity are those of the last batch, weak turbulence,
#: as in the paper; the others of the first.
PANELS = {
    "paper-02-terrain": ("time", "height"),
    "paper-04-05-response": ("time", "response"),
    "paper-06-checks": ("first", "checks"),
    "paper-07-correlations": ("first", "correlations"),
    "paper-08-criterion": ("last", "criterion"),
    "paper-09-other-mu": ("last", "other_mu"),
    "paper-10-11-strength": ("time", "strength"),
    "paper-12-weights": ("time", "weights"),
    "paper-13-averages": ("time", "averages"),
    "paper-14-profile": ("first", "profile"),
    "paper-15-map": ("time", "map"),
}
#: What the campaign file of the demo is completed with. The terrain is drawn, not surveyed.
MORE = """
[path]
heights = [
  ["0 m", "8 m"], ["400 m", "18 m"], ["1100 m", "34 m"], ["1600 m", "38 m"], ["2200 m", "24 m"], ["2670 m", "9 m"],
]

[[scintillometers]]
name = "A"
wavelength = "0.88 um"
diameters = ["5 cm", "14.5 cm"]

[[scintillometers]]
name = "B"
wavelength = "0.88 um"
diameters = ["14.5 cm", "14.5 cm"]

[[scintillometers]]
name = "C"
wavelength = "0.94 um"
diameters = ["14.5 cm", "5 cm"]
"""


def run(*arguments: str) -> None:
    """Call the command line as a user would."""
    subprocess.run([sys.executable, "-c", "from coslidar.flows.cli import main; main()", *arguments], check=True)


def save(png: bytes, path: Path) -> None:
    """Write a picture with few colours: a quarter of the bytes, and nothing that an eye misses."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as picture:
        picture.convert("RGB").quantize(96, dither=Image.Dither.NONE).save(path, optimize=True)


def draw(folder: Path) -> list[Path]:
    """Make the demo where it is missing, process it, and draw every figure.

    Parameters
    ----------
    folder : Path
        Of the demo.

    Returns
    -------
    list of Path
        The pictures.
    """
    from coslidar.catalog import open_product
    from coslidar.catalog.report import BATCH_PANELS, TIME_PANELS, figure

    if not (folder / "campaign.toml").exists():
        run("init", str(folder), "--scenario", "demo")
    paper = folder / "paper.toml"
    paper.write_text((folder / "campaign.toml").read_text("utf-8").replace('"results"', '"paper"') + MORE, "utf-8")
    run("run", "--no-prefect", str(paper))
    newest: dict[str, Path] = {}
    for path in sorted((folder / "paper").rglob("*.zarr.zip"), key=lambda path: path.stat().st_mtime):
        if path.parent.parent.name == "products":
            newest[path.name.split(".")[0]] = path
    products = [open_product(path) for _, path in sorted(newest.items())]
    panels = {panel.key: panel for panel in (*BATCH_PANELS, *TIME_PANELS)}
    FIGURES.mkdir(exist_ok=True)
    written = []
    for name, (which, key) in PANELS.items():
        chosen = {"time": products, "first": products[:1], "last": products[-1:]}[which]
        buffer = io.BytesIO()
        figure(panels[key], chosen).savefig(buffer, format="png", dpi=80, facecolor="white")
        save(buffer.getvalue(), FIGURES / f"{name}.png")
        written.append(FIGURES / f"{name}.png")
    appendix = folder / "appendix.png"
    run("experiment", "gcv", "--profile", "strong", "--draws", "10", "--frames", "independent", "--no-noise",
        "-o", str(appendix))  # fmt: skip
    save(appendix.read_bytes(), FIGURES / "paper-16-19-appendix.png")
    return [*written, FIGURES / "paper-16-19-appendix.png"]


if __name__ == "__main__":
    for path in draw(Path(sys.argv[1] if len(sys.argv) > 1 else "demo")):
        print(path)
