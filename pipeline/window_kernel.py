"""Centres of gravity in a window that follows the spot: the compiled loop over the pixels of all frames."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from .kernel_parts import bring_near, calibrate
from .spots import FLAGS, WING_STEP

if TYPE_CHECKING:
    from collections.abc import Callable

#: Largest move of the window in the last of two or more passes, px. A pass leaves about a tenth of an error.
CONVERGENCE = 0.3
#: Bytes of frames that are measured box by box, together: a part of the second level cache of a core.
GROUP = 2**19
#: No nnan and no ninf: a pixel that is not a number must reach the tests of what was measured.
_RELAXED = {"reassoc", "contract", "nsz", "arcp"}


@njit(nogil=True, fastmath=_RELAXED, error_model="numpy")
def repair(
    box: Any,
    frames: Any,
    corner: Any,
    frame_columns: Any,
    cols: Any,
    scale: Any,
    offset: Any,
    of_box: Any,
    bad: Any,
    neighbours: Any,
    weights: Any,
    begin: Any,
    end: Any,
) -> None:
    """Predict the bad pixels of a box, of which a part may not be calibrated."""
    for b in range(begin, end):
        value = np.float32(0.0)
        for m in range(neighbours.shape[1]):
            if weights[b, m] != np.float32(0.0):
                pixel = neighbours[b, m]
                raw = np.float32(frames[corner + np.uint64(pixel // cols * frame_columns + pixel % cols)])
                value += weights[b, m] * (raw * scale[np.uint64(of_box + pixel)] - offset[np.uint64(of_box + pixel)])
        box[bad[b]] = value


@lru_cache(maxsize=64)
def window_kernel(cols: int, across: int, lanes: int, tall: int, wide: int) -> Callable[..., None]:
    """Compiled measurement for one size of box, search and window.

    Parameters
    ----------
    cols, across : int
        Width of a box, and of its part that the windows are usually in.
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
    Some frames at a time are measured box by box: calibration and box then stay in the first level cache, and while a
    box is measured that of the next frame is on its way. Of a box only the part is calibrated that the windows are
    usually in; the whole of it where they turn out to be elsewhere.
    From one pass to the next a window moves by a fraction of a pixel. The sums over its inner rows, column by column,
    are taken again only where it has come upon other rows.
    """
    single, index = np.float32, np.uint64
    long: Any = np.int64
    half, one, none, nothing = np.float32(0.5), np.float32(1.0), np.float32(0.0), np.float32(-np.inf)
    edge = np.float32(1e-3)
    per_step = np.float32(1.0 / WING_STEP)
    no_light, window_left, strayed = FLAGS["no_light"], FLAGS["window_left"], FLAGS["strayed"]
    not_converged, saturated = FLAGS["not_converged"], FLAGS["saturated"]

    @njit(nogil=True, cache=True, fastmath=_RELAXED, error_model="numpy")
    def measure(
        frames: Any,
        n_frames: Any,
        frame_size: Any,
        frame_columns: Any,
        first_pixel: Any,
        rows: Any,
        usual: Any,
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
        spare = (wide - long(window[1]) - 2) // 2
        half_y = half * window[0]
        half_x = half * window[1]
        # A window's last rows and columns may lie beyond the box: there they have no weight.
        box = np.zeros((rows + 2) * cols + wide + lanes, dtype=np.float32)
        peak = np.zeros(lanes, dtype=np.float32)
        inner_light = np.zeros((n_sources, wide), dtype=np.float32)
        inner_moment = np.zeros((n_sources, wide), dtype=np.float32)
        inner_row = np.zeros(n_sources, dtype=np.int64)
        inner_column = np.zeros(n_sources, dtype=np.int64)
        at_y = np.zeros(n_sources, dtype=np.float32)
        at_x = np.zeros(n_sources, dtype=np.float32)
        last_y = np.zeros(n_sources, dtype=np.float32)
        last_x = np.zeros(n_sources, dtype=np.float32)
        light_of = np.zeros(n_sources, dtype=np.float32)
        brightest = np.zeros(n_sources, dtype=np.float32)
        leak = np.zeros(3, dtype=np.float32)
        states = np.zeros(n_sources, dtype=np.uint8)
        together = max(GROUP // (frame_size * frames.itemsize), 1)
        for begin in range(0, n_frames, together):
            for a in range(first_pixel.size):
                low = usual[a, 0]
                high = usual[a, 1]
                left = usual[a, 2]
                predictors = (scale, offset, a * rows * cols, bad_index, bad_neighbour, bad_weight)
                for frame in range(begin, min(begin + together, n_frames)):
                    corner = index(frame) * index(frame_size) + index(first_pixel[a])
                    ahead = corner + index(frame_size + low * frame_columns + left)
                    for _ in range(low, high):
                        bring_near(frames, ahead)
                        bring_near(frames, ahead + index(across - 1))
                        ahead += index(frame_columns)
                    i = corner + index(low * frame_columns + left)
                    o = index(low * cols + left)
                    j = index(a * rows * cols) + o
                    for _ in range(low, high):
                        calibrate(frames, i, scale, offset, j, box, o, across)
                        i += index(frame_columns)
                        j += index(cols)
                        o += index(cols)
                    repair(*(box, frames, corner, frame_columns, cols), *predictors, bad_start[a], bad_start[a + 1])
                    whole = False
                    for s in range(n_sources):
                        # Brightest pixel: largest of each column, then the column, then its row.
                        top = search[s, a, 0]
                        bottom = search[s, a, 1]
                        leftmost = search[s, a, 2]
                        reach = np.int32(search[s, a, 3] - leftmost)
                        o = index(top * cols + leftmost)
                        for k in range(index(lanes)):
                            peak[k] = box[o + k]
                        for _ in range(top, bottom):
                            o += index(cols)
                            for k in range(index(lanes)):
                                value = box[o + k]
                                known = peak[k]
                                peak[k] = value if value > known else known
                        for k in range(index(lanes)):
                            peak[k] = peak[k] if np.int32(k) <= reach else nothing
                        # In pairs: the processor compares several at a time.
                        best = nothing
                        for k in range(index(0), index(lanes), index(8)):
                            a_0 = peak[k] if peak[k] > peak[k + 4] else peak[k + 4]
                            a_1 = peak[k + 1] if peak[k + 1] > peak[k + 5] else peak[k + 5]
                            a_2 = peak[k + 2] if peak[k + 2] > peak[k + 6] else peak[k + 6]
                            a_3 = peak[k + 3] if peak[k + 3] > peak[k + 7] else peak[k + 7]
                            a_0 = a_0 if a_0 > a_2 else a_2
                            a_1 = a_1 if a_1 > a_3 else a_3
                            a_0 = a_0 if a_0 > a_1 else a_1
                            best = a_0 if a_0 > best else best
                        column = long(0)
                        for k in range(lanes - 1, -1, -1):
                            column = long(k) if peak[index(k)] == best else column
                        row = long(top)
                        o = index(top * cols + leftmost + column)
                        for r in range(top, bottom + 1):
                            row = long(r) if box[o] == best else row
                            o += index(cols)
                        at_y[s] = single(row)
                        at_x[s] = single(leftmost + column)
                        light_of[s] = none
                        brightest[s] = best
                        states[s] = excluded[s, a]
                        inner_row[s] = -1
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
                            if not (up >= none and down <= rows and start >= none and stop <= cols):
                                states[s] |= window_left
                                continue
                            row = long(up)
                            column = inner_column[s]
                            if row != inner_row[s] or start < column or stop > column + wide:
                                column = min(max(long(start) - spare, left), max(left + across - wide, left))
                                outside = start < column or stop > column + wide
                                if not whole and (outside or row < low or row + tall + 2 > high):
                                    # Elsewhere than usual.
                                    whole = True
                                    for r in range(rows):
                                        i = corner + index(r * frame_columns)
                                        o = index(r * cols)
                                        j = index((a * rows + r) * cols)
                                        calibrate(frames, i, scale, offset, j, box, o, cols)
                                    repair(
                                        *(box, frames, corner, frame_columns, cols),
                                        *predictors,
                                        bad_start[a],
                                        bad_start[a + 1],
                                    )
                                if outside:
                                    column = min(max(long(start) - spare, 0), max(cols - wide, 0))
                                inner_row[s] = row
                                inner_column[s] = column
                                o = index(row * cols + column)
                                for k in range(index(wide)):
                                    total = none
                                    moment = none
                                    for r in range(index(1), index(tall)):
                                        value = box[o + r * index(cols) + k]
                                        total += value
                                        moment += single(np.int32(r)) * value
                                    inner_light[index(s), k] = total
                                    inner_moment[index(s), k] = moment
                            down -= single(row)
                            start -= single(column)
                            stop -= single(column)
                            first = one - (up - single(row))
                            last = min(down - single(tall), one)
                            after = max(down - single(tall + 1), none)
                            o = index(row * cols + column)
                            end = o + index(tall * cols)
                            light = none
                            moment_x = none
                            moment_y = none
                            for k in range(index(wide)):
                                total = first * box[o + k] + inner_light[index(s), k]
                                value = last * box[end + k]
                                total += value
                                moment = inner_moment[index(s), k] + single(tall) * value
                                value = after * box[end + index(cols) + k]
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
                                for k in range(low_x, min(low_x + long(wide), long(cols))):
                                    inside = abs(single(r) - last_y[s]) < half_y and abs(single(k) - last_x[s]) < half_x
                                    used = scale[index((a * rows + r) * cols + k)] != none
                                    raw = frames[corner + index(r * frame_columns + k)]
                                    if inside and used and raw >= saturation:
                                        state |= saturated
                        flag[frame, s, a] = state

    compiled: Callable[..., None] = measure
    return compiled
