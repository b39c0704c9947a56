"""What the detector band changes in the response matrix of the paper's instrument, per slice and kind of map.

Run: OMP_NUM_THREADS=1 python benchmarks/bench_band.py
Largest change of each map over its maximum, in 1e-4, against the single wavelength of 3.8 um.
"""

from __future__ import annotations

import numpy as np
from bench_response import GRID, LAMPS, SCINDAR

from coslidar.pipeline.band import Band
from coslidar.pipeline.geometry import MAP_KINDS
from coslidar.pipeline.response import response_matrix
from coslidar.plugins.turbulence_spectra import Kolmogorov

BANDS = {
    "3.4 to 4.2 um, flat": Band((3.4e-6, 4.2e-6), (1.0, 1.0)),
    "3.4 to 4.2 um, weight doubling toward 4.2 um": Band((3.4e-6, 4.2e-6), (1.0, 2.0)),
    "3.4 um alone": Band((3.4e-6,), (1.0,)),
}


def main() -> None:
    """Print a table for each band."""
    maps = {
        name: response_matrix(SCINDAR, GRID, Kolmogorov(), LAMPS, band=band).reshape(6, 81, 12)
        for name, band in {"alone": None, **BANDS}.items()
    }
    alone = maps.pop("alone")
    for name, found in maps.items():
        change = 1e4 * np.abs(found - alone).max(axis=1) / np.abs(alone).max(axis=1)
        print(name)
        print("  slice     " + " ".join(f"{number:6d}" for number in range(1, 13)))
        for kind, row in zip(MAP_KINDS, change, strict=True):
            print(f"  {kind:9s} " + " ".join(f"{value:6.2f}" for value in row))


if __name__ == "__main__":
    main()
