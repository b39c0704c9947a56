"""Centres of gravity in a window that follows the spot: the compiled loop over the pixels of all frames."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from .spots import FLAGS, WING_STEP

if TYPE_CHECKING:
    from collections.abc import Callable

#: Largest move of the window in the last of two or more passes, px. A pass leaves about a tenth of an error.
CONVERGENCE = 0.3


@lru_cache(maxsize=64)
def window_kernel(lanes: int, tall: int, wide: int) -> Callable[..., None]:
    """Compiled measurement for one size of search and window.

    Parameters
    ----------
    lanes : int
        Width of the search, rounded up to a multiple of 8.
    tall : int
        Whole part of the window's height: it touches tall + 2 rows, and covers all but the first and the last two.
    wide : int
        Columns that a window can touch, rounded up to a multiple of 8.

    Notes
    -----
    These widths are constants of the compiled code: only then are the inner loops unrolled and turned into vector
    instructions. Index arithmetic is unsigned because a signed index is first tested for counting from the end.
    A row of lenslets is calibrated at once: detector rows are then read from end to end, which memory likes best.
    """
    # No nnan and no ninf: a pixel that is not a number must reach the tests below.
    relaxed = {"reassoc", "contract", "nsz", "arcp"}
    single, long, index = np.float32, np.int64, np.uint64
    half, one, none = np.float32(0.5), np.float32(1.0), np.float32(0.0)
    edge = np.float32(1e-3)
    per_step = np.float32(1.0 / WING_STEP)
    no_light, window_left, strayed = FLAGS["no_light"], FLAGS["window_left"], FLAGS["strayed"]
    not_converged, saturated = FLAGS["not_converged"], FLAGS["saturated"]

    @njit(nogil=True, cache=True, fastmath=relaxed, error_model="numpy")
    def measure(
        frames: Any,
        n_frames: Any,
        frame_size: Any,
        frame_columns: Any,
        first_pixel: Any,
        width: Any,
        columns: Any,
        length: Any,
        first_box: Any,
        column_of: Any,
        rows: Any,
        scale: Any,
        offset: Any,
        bad_start: Any,
        bad_index: Any,
        bad_neighbour: Any,
        bad_weight: Any,
        spots: Any,
        search: Any,
        window: Any,
        passes: Any,
        boost: Any,
        wings: Any,
        wing_start: Any,
        floor: Any,
        divide: Any,
        excluded: Any,
        suspect: Any,
        saturation: Any,
        pixel_scale: Any,
        slopes: Any,
        flux: Any,
        flag: Any,
    ) -> None:
        n_sources = spots.shape[0]
        half_y = half * window[0]
        half_x = half * window[1]
        # A window's last rows and columns may lie beyond the box: there they have no weight.
        band = np.zeros((rows + 2) * length + wide + lanes, dtype=np.float32)
        peak = np.zeros(lanes, dtype=np.float32)
        at_y = np.zeros(n_sources, dtype=np.float32)
        at_x = np.zeros(n_sources, dtype=np.float32)
        last_y = np.zeros(n_sources, dtype=np.float32)
        last_x = np.zeros(n_sources, dtype=np.float32)
        light_of = np.zeros(n_sources, dtype=np.float32)
        brightest = np.zeros(n_sources, dtype=np.float32)
        leak = np.zeros(3, dtype=np.float32)
        states = np.zeros(n_sources, dtype=np.uint8)
        for frame in range(n_frames):
            for n in range(first_pixel.size):
                start_of_band = index(frame) * index(frame_size) + index(first_pixel[n])
                i = start_of_band
                j = index(n) * index(rows * length)
                o = index(0)
                for _ in range(rows):
                    for k in range(index(width[n])):
                        band[o + k] = single(frames[i + k]) * scale[j + k] - offset[j + k]
                    i += index(frame_columns)
                    j += index(length)
                    o += index(length)
                for a in range(first_box[n], first_box[n + 1]):
                    corner = index(column_of[a])
                    for b in range(bad_start[a], bad_start[a + 1]):
                        band[bad_index[b]] = none
                    for b in range(bad_start[a], bad_start[a + 1]):
                        value = none
                        for m in range(bad_neighbour.shape[1]):
                            value += bad_weight[b, m] * band[bad_neighbour[b, m]]
                        band[bad_index[b]] = value
                    for s in range(n_sources):
                        # Brightest pixel: largest of each column, then the column, then its row.
                        top = search[s, a, 0]
                        bottom = search[s, a, 1]
                        left = search[s, a, 2]
                        right = search[s, a, 3]
                        o = corner + index(top * length + left)
                        for k in range(index(lanes)):
                            peak[k] = band[o + k]
                        for _ in range(top, bottom):
                            o += index(length)
                            for k in range(index(lanes)):
                                value = band[o + k]
                                known = peak[k]
                                peak[k] = value if value > known else known
                        best = peak[0]
                        column = long(0)
                        for k in range(1, right - left + 1):
                            larger = peak[k] > best
                            best = peak[k] if larger else best
                            column = long(k) if larger else column
                        row = long(top)
                        o = corner + index(top * length + left + column)
                        for r in range(top, bottom + 1):
                            row = long(r) if band[o] == best else row
                            o += index(length)
                        at_y[s] = single(row)
                        at_x[s] = single(left + column)
                        light_of[s] = none
                        brightest[s] = best
                        states[s] = excluded[s, a]
                    # Both sources in each pass, so that the processor can overlap the two.
                    for _ in range(passes):
                        for s in range(n_sources):
                            y = at_y[s]
                            x = at_x[s]
                            # Borders of the window, counted from the outer border of the box's first pixel.
                            up = y - half_y + half
                            down = y + half_y + half
                            start = x - half_x + half
                            stop = x + half_x + half
                            if not (up >= none and down <= rows and start >= none and stop <= columns):
                                states[s] |= window_left
                                continue
                            row = long(up)
                            column = min(long(start), long(max(columns - wide, 0)))
                            down -= single(row)
                            start -= single(column)
                            stop -= single(column)
                            first = one - (up - single(row))
                            last = min(down - single(tall), one)
                            after = max(down - single(tall + 1), none)
                            o = corner + index(row * length + column)
                            end = o + index(tall * length)
                            light = none
                            moment_x = none
                            moment_y = none
                            for k in range(index(wide)):
                                total = first * band[o + k]
                                moment = none
                                for r in range(index(1), index(tall)):
                                    value = band[o + r * index(length) + k]
                                    total += value
                                    moment += single(np.int32(r)) * value
                                value = last * band[end + k]
                                total += value
                                moment += single(tall) * value
                                value = after * band[end + index(length) + k]
                                total += value
                                moment += single(tall + 1) * value
                                at = single(np.int32(k))
                                part = max(min(at + one, stop) - max(at, start), none)
                                total *= part
                                light += total
                                moment_x += at * total
                                moment_y += part * moment
                            last_y[s] = y
                            last_x[s] = x
                            light_of[s] = light
                            at_y[s] = y + (moment_y / light + single(row) - y) * boost[s, 0]
                            at_x[s] = x + (moment_x / light + single(column) - x) * boost[s, 1]
                    for s in range(n_sources):
                        if states[s] & window_left == 0:
                            move_y = at_y[s] - spots[s, a, 0]
                            move_x = at_x[s] - spots[s, a, 1]
                            if not light_of[s] > floor[s, a]:
                                states[s] |= no_light
                            elif not move_y * divide[s, a, 0] + move_x * divide[s, a, 1] < one:
                                states[s] |= strayed
                            elif passes > 1 and max(abs(at_y[s] - last_y[s]), abs(at_x[s] - last_x[s])) > CONVERGENCE:
                                states[s] |= not_converged
                    both = wings.shape[0] == 2 and states[0] == 0 and states[n_sources - 1] == 0
                    for s in range(n_sources):
                        state = states[s]
                        light = light_of[s]
                        y = at_y[s]
                        x = at_x[s]
                        if both:
                            # What the other source's mean spot has in this window, where it is seen from here.
                            other = n_sources - 1 - s
                            away_y = (at_y[other] - last_y[s] - wing_start[s, 0]) * per_step
                            away_x = (at_x[other] - last_x[s] - wing_start[s, 1]) * per_step
                            away_y = max(min(away_y, single(wings.shape[1]) - one - edge), none)
                            away_x = max(min(away_x, single(wings.shape[2]) - one - edge), none)
                            i_y = long(away_y)
                            i_x = long(away_x)
                            part_y = away_y - single(i_y)
                            part_x = away_x - single(i_x)
                            for m in range(3):
                                upper = wings[s, i_y, i_x, m] * (one - part_x) + wings[s, i_y, i_x + 1, m] * part_x
                                lower = (
                                    wings[s, i_y + 1, i_x, m] * (one - part_x) + wings[s, i_y + 1, i_x + 1, m] * part_x
                                )
                                leak[m] = (upper * (one - part_y) + lower * part_y) * light_of[other]
                            own = light - leak[0]
                            y = ((y - last_y[s]) * light - leak[1] * boost[s, 0]) / own + last_y[s]
                            x = ((x - last_x[s]) * light - leak[2] * boost[s, 1]) / own + last_x[s]
                            light = own
                        move_y = y - spots[s, a, 0]
                        move_x = x - spots[s, a, 1]
                        good = state == 0
                        slopes[frame, 0, s, a] = move_x * pixel_scale if good else np.nan
                        slopes[frame, 1, s, a] = move_y * pixel_scale if good else np.nan
                        flux[frame, s, a] = light if good else np.nan
                        if brightest[s] >= suspect[a]:
                            # Only now is it worth looking at every pixel of the window.
                            low_y = max(long(last_y[s] - half_y + half), long(0))
                            low_x = max(long(last_x[s] - half_x + half), long(0))
                            for r in range(low_y, min(low_y + long(tall + 2), long(rows))):
                                for k in range(low_x, min(low_x + long(wide), long(columns))):
                                    inside = abs(single(r) - last_y[s]) < half_y and abs(single(k) - last_x[s]) < half_x
                                    used = scale[index((n * rows + r) * length + k) + corner] != none
                                    raw = frames[start_of_band + corner + index(r * frame_columns + k)]
                                    if inside and used and raw >= saturation:
                                        state |= saturated
                        flag[frame, s, a] = state

    compiled: Callable[..., None] = measure
    return compiled
