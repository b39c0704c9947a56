"""A regulariser for coslidar, in a distribution of its own."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from coslidar.pipeline.geometry import SliceGrid
from coslidar.pipeline.units import Length
from coslidar.plugins.contract import RegulariserBase


class PowerOfDistance(RegulariserBase):
    """Independent slices, Cn2 expected to follow a power of the distance from the pupil."""

    name: ClassVar[str] = "power_of_distance"
    version: ClassVar[int] = 1
    examples: ClassVar = ({"exponent": -0.5}, {"exponent": 2, "floor": "0.5 km"})

    exponent: float = Field(1.0, ge=-4, le=4)
    """Exponent of the power."""
    floor: Length = Field("100 m", gt=0)
    """Distance below which the expected strength levels off."""

    def precision(self, grid: SliceGrid) -> NDArray[np.float64]:
        """Inverse square of the expected strength, which has a root mean square of 1 over the slices."""
        strength = np.hypot(grid.centres, self.floor) ** self.exponent
        return np.diag(np.mean(strength**2) / strength**2)
