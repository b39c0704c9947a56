"""Cost of the extraction, as ratios taken in one run.

Frames of 160 x 160 px of 40 spots (20 lenslets, two sources) are drawn with photon and read noise. Printed are the CPU
time per frame of the extraction kernel, of `np.sum` over the same frames, and of AOtools (centre_of_gravity), photutils
(centroid_com) and scipy.ndimage (center_of_mass) doing the same work: three passes over the same windows of
calibrated pixels, with whole-pixel borders. AOtools and photutils come with the extra `bench`; of what is not
installed the output says so. Frames are taken in chunks of 256, as they come from an archive: 13 MB that were just
written by a decoder.

    python benchmarks/bench_extraction.py [--frames 256] [--repeats 15]
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from coslidar.pipeline.extraction import Calibration, SpotLayout, extract
from coslidar.pipeline.parameters import ExtractionParameters, Header
from coslidar.pipeline.spot_layout import layout, reference_image

MASK = [[0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [1, 1, 0, 1, 1], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0]]
SPOTS = [[9.95, 15.5], [21.05, 15.5]]
#: Who else measures centres of mass.
PEERS = ("scipy.ndimage", "AOtools", "photutils")


@dataclass(frozen=True)
class Result:
    """CPU seconds per frame; fastest of the repeats."""

    kernel: float
    sum: float
    others: dict[str, float]

    @property
    def to_sum(self) -> float:
        """Cost of the kernel over that of reading every pixel once."""
        return self.kernel / self.sum


def header(**instrument: str) -> Header:
    """Two spots in each of 20 lenslets; more keys of the instrument as given."""
    return Header.model_validate(
        {
            "format": "shwfs-frames",
            "format_version": 1,
            "campaign": "bench",
            "archive": "bench",
            "instrument": {
                "wavelength": "3.8 um",
                "frame_rate": "142 Hz",
                "pixel_scale": "27 urad",
                "subaperture_size": "7 cm",
                "subaperture_mask": MASK,
                "lenslet_origin": [0, 0],
                "lenslet_pitch": [32, 32],
                **instrument,
            },
            "path": {"length": "2670 m"},
            "sources": [
                {"name": "a", "position": ["0 m", "-0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": SPOTS[0]},
                {"name": "b", "position": ["0 m", "0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": SPOTS[1]},
            ],
        }
    )


def recording(n_frames: int) -> tuple[Header, NDArray[np.uint16], Calibration]:
    """Header, noisy frames, and calibration."""
    told = header(saturation="16383 count")
    rng = np.random.default_rng(1)
    rows, cols = np.indices((32, 32))
    frames = np.full((n_frames, 160, 160), 600.0)
    for r, c in np.argwhere(np.array(MASK)) * 32:
        for row, col in SPOTS:
            y, x = rng.normal([[row], [col]], 0.5, (2, n_frames))[..., None, None]
            light = 1000 * np.exp(0.3 * rng.standard_normal((n_frames, 1, 1)))
            frames[:, r : r + 32, c : c + 32] += light * np.exp(-((rows - y) ** 2 + (cols - x) ** 2) / 2.4)
    frames += rng.standard_normal(frames.shape) * np.sqrt(30 + frames / 12)
    bad = rng.random((160, 160)) < 17 / 160**2
    flat = 1 + 0.01 * rng.standard_normal((160, 160))
    calibration = Calibration(np.full((160, 160), 600.0), flat, bad, told.instrument.saturation)
    return told, frames.round().astype(np.uint16), calibration


def whole_windows(
    frames: NDArray[np.uint16],
    calibration: Calibration,
    found: SpotLayout,
    passes: int,
    measure: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """The same work with a general routine: `passes` windows per spot, each around the centre of mass of the last.

    `measure` gets all windows of a frame, (n, height, width), and returns their centres of mass, (n, 2) along y and x.
    """
    half_y, half_x = (int(side) // 2 for side in found.window)
    rows, cols = found.pitch
    n_sources, n_boxes = found.flux.shape
    positions = np.empty((len(frames), 2, n_sources, n_boxes))
    for t, raw in enumerate(frames):
        frame = np.where(calibration.bad_pixel, 0.0, (raw - calibration.dark) / calibration.flat)
        at = np.empty((n_sources, n_boxes, 2))
        for a, (r, c) in enumerate(found.boxes):
            for s in range(n_sources):
                top, bottom, left, right = found.search[s, a]
                part = frame[r + top : r + bottom + 1, c + left : c + right + 1]
                at[s, a] = np.add(np.unravel_index(np.argmax(part), part.shape), (top, left))
        for _ in range(passes):
            low_y = np.clip(np.round(at[..., 0]).astype(int) - half_y, 0, rows - 2 * half_y - 1)
            low_x = np.clip(np.round(at[..., 1]).astype(int) - half_x, 0, cols - 2 * half_x - 1)
            y = (found.boxes[:, 0] + low_y).reshape(-1, 1, 1) + np.arange(2 * half_y + 1)[:, None]
            x = (found.boxes[:, 1] + low_x).reshape(-1, 1, 1) + np.arange(2 * half_x + 1)
            at = measure(frame[y, x]).reshape(at.shape) + np.stack([low_y, low_x], axis=-1)
        positions[t] = np.moveaxis(at, -1, 0)[::-1]
    return positions


def general_routines() -> dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]]:
    """Centres of mass by what is installed."""
    routines = {"scipy.ndimage": lambda windows: np.array([ndimage.center_of_mass(window) for window in windows])}
    if importlib.util.find_spec("aotools"):
        from aotools.image_processing.centroiders import centre_of_gravity

        # It returns x before y, and works in place.
        routines["AOtools"] = lambda windows: np.asarray(centre_of_gravity(windows.copy()))[::-1].T
    if importlib.util.find_spec("photutils"):
        from photutils.centroids import centroid_com

        routines["photutils"] = lambda windows: np.array([centroid_com(window)[::-1] for window in windows])
    return routines


def fastest(repeats: int, *tasks: Callable[[], object]) -> list[float]:
    """Least CPU time of each task, s; in turns, so that a busy machine is unfair to none."""
    best = [np.inf] * len(tasks)
    for _ in range(repeats):
        for number, task in enumerate(tasks):
            start = time.process_time()
            task()
            best[number] = min(best[number], time.process_time() - start)
    return best


def measure(n_frames: int, repeats: int) -> Result:
    """Time all three on the same frames, and see that they agree."""
    told, frames, calibration = recording(n_frames)
    parameters = ExtractionParameters()
    found = layout(told, reference_image(frames), calibration, parameters)
    slopes, _, _ = extract(frames, found, calibration, parameters)  # compiles
    few = frames[: max(1, min(len(frames), 8))]
    own = slopes[: len(few)] / found.pixel_scale + np.moveaxis(found.spots, -1, 0)[::-1]
    tasks = {
        name: partial(whole_windows, few, calibration, found, parameters.passes, routine)
        for name, routine in general_routines().items()
    }
    for name, task in tasks.items():
        # Whole-pixel borders and unfilled bad pixels on their side: half a pixel at worst.
        if not float(np.median(np.abs(own - task()))) < 0.1:
            raise RuntimeError(f"{name} does not measure the same spots")
    kernel, total = fastest(repeats, lambda: extract(frames, found, calibration, parameters), frames.sum)
    slow = fastest(2, *tasks.values())
    others = dict(zip(tasks, (cost / len(few) for cost in slow), strict=True))
    return Result(kernel / len(frames), total / len(frames), others)


def main(argv: list[str] | None = None) -> Result:
    """Print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args(argv)
    result = measure(arguments.frames, arguments.repeats)
    print(f"extraction kernel       {result.kernel * 1e6:9.2f} us of CPU per frame")
    print(f"np.sum                  {result.sum * 1e6:9.2f} us")
    for name in PEERS:
        cost = result.others.get(name)
        if cost is None:
            print(f"{name:22s}  skipped: not installed; pip install -c constraints.txt -e '.[bench]'")
        else:
            print(f"{name:22s}  {cost * 1e6:9.2f} us, {cost / result.kernel:.0f} times the kernel")
    print(f"kernel / np.sum         {result.to_sum:.3f}")
    return result


if __name__ == "__main__":
    main()
