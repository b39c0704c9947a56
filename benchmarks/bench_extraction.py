"""Cost of the extraction, as ratios taken in one run.

Frames of 160 x 160 px of 40 spots (20 lenslets, two sources) are drawn with photon and read noise. Printed are the CPU
time per frame of the extraction kernel, of `np.sum` over the same frames, and of
`scipy.ndimage.center_of_mass` doing the same work (three passes over the same windows of calibrated pixels,
whole-pixel borders), and the ratios of the first to the other two. The frames are taken in chunks of 256,
as they come from an archive: 13 MB that were just written by a decoder.

    python benchmarks/bench_extraction.py [--frames 256] [--repeats 15]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from coslidar.pipeline.extraction import Calibration, SpotLayout, extract
from coslidar.pipeline.parameters import ExtractionParameters, Header
from coslidar.pipeline.spot_layout import layout, reference_image

MASK = [[0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [1, 1, 0, 1, 1], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0]]
SPOTS = [[9.95, 15.5], [21.05, 15.5]]


@dataclass(frozen=True)
class Result:
    """CPU seconds per frame; fastest of the repeats."""

    kernel: float
    sum: float
    center_of_mass: float

    @property
    def to_sum(self) -> float:
        """Cost of the kernel over that of reading every pixel once."""
        return self.kernel / self.sum

    @property
    def to_center_of_mass(self) -> float:
        """Cost of the kernel over that of the general routine."""
        return self.kernel / self.center_of_mass


def recording(n_frames: int) -> tuple[Header, NDArray[np.uint16], Calibration]:
    """Header, noisy frames, and calibration."""
    header = Header.model_validate(
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
                "saturation": "16383 count",
                "subaperture_mask": MASK,
                "lenslet_origin": [0, 0],
                "lenslet_pitch": [32, 32],
            },
            "path": {"length": "2670 m"},
            "sources": [
                {"name": "a", "position": ["0 m", "-0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": SPOTS[0]},
                {"name": "b", "position": ["0 m", "0.4 m"], "fwhm": ["8.9 cm", "6.3 cm"], "spot": SPOTS[1]},
            ],
        }
    )
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
    calibration = Calibration(np.full((160, 160), 600.0), flat, bad, header.instrument.saturation)
    return header, frames.round().astype(np.uint16), calibration


def center_of_mass(
    frames: NDArray[np.uint16], calibration: Calibration, found: SpotLayout, passes: int
) -> NDArray[np.float64]:
    """The same work with scipy: three windows per spot, each around the centre of mass of the last."""
    half_y, half_x = (int(side) // 2 for side in found.window)
    rows, cols = found.pitch
    positions = np.empty((len(frames), 2, *found.flux.shape))
    for t, raw in enumerate(frames):
        frame = np.where(calibration.bad_pixel, 0.0, (raw - calibration.dark) / calibration.flat)
        for a, (r, c) in enumerate(found.boxes):
            box = frame[r : r + rows, c : c + cols]
            for s in range(len(found.spots)):
                top, bottom, left, right = found.search[s, a]
                row, col = ndimage.maximum_position(box[top : bottom + 1, left : right + 1])
                y, x = float(row + top), float(col + left)
                for _ in range(passes):
                    low_y, low_x = max(round(y) - half_y, 0), max(round(x) - half_x, 0)
                    part = box[low_y : round(y) + half_y + 1, low_x : round(x) + half_x + 1]
                    y, x = np.add(ndimage.center_of_mass(part), (low_y, low_x))
                positions[t, :, s, a] = x, y
    return positions


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
    header, frames, calibration = recording(n_frames)
    parameters = ExtractionParameters()
    found = layout(header, reference_image(frames), calibration, parameters)
    slopes, _, _ = extract(frames, found, calibration, parameters)  # compiles
    few = frames[: max(1, min(len(frames), 8))]
    reference = center_of_mass(few, calibration, found, parameters.passes)
    own = slopes[: len(few)] / found.pixel_scale + np.moveaxis(found.spots, -1, 0)[::-1]
    # Whole-pixel borders and unfilled bad pixels on their side: half a pixel at worst.
    if not float(np.median(np.abs(own - reference))) < 0.1:
        raise RuntimeError("the two implementations do not measure the same spots")
    kernel, total = fastest(repeats, lambda: extract(frames, found, calibration, parameters), frames.sum)
    (slow,) = fastest(2, lambda: center_of_mass(few, calibration, found, parameters.passes))
    return Result(kernel / len(frames), total / len(frames), slow / len(few))


def test_ratios() -> None:
    """A small run: same spots, and no order of magnitude lost. The figure itself is for a quiet machine."""
    result = measure(64, 5)
    assert result.to_sum < 3.0
    assert result.to_center_of_mass < 0.02


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=15)
    arguments = parser.parse_args()
    result = measure(arguments.frames, arguments.repeats)
    print(f"extraction kernel       {result.kernel * 1e6:9.2f} us of CPU per frame")
    print(f"np.sum                  {result.sum * 1e6:9.2f} us")
    print(f"ndimage.center_of_mass  {result.center_of_mass * 1e6:9.2f} us")
    print(f"kernel / center_of_mass {result.to_center_of_mass:.5f}")
    print(f"kernel / np.sum         {result.to_sum:.3f}")


if __name__ == "__main__":
    main()
