"""Compiled search of the pixel interval that a depth range leaves on a row."""

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def row_windows(
    u: NDArray[np.float32], v: NDArray[np.float32], plane: NDArray[np.float64], w_far: float, w_near: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """First and last pixel (rows, columns) int32 whose inverse depth p.(u, v, 1) lies in [w_far, w_near].

    Pixels without a ray (NaN) are outside. Inverse depth is monotone between the first and the last valid pixel of a
    row, so both ends are found by bisection.
    """
    rows, width = u.shape
    columns = plane.shape[0]
    x_lo = np.zeros((rows, columns), np.int32)
    x_hi = np.full((rows, columns), -1, np.int32)
    for y in range(rows):
        first = 0
        while first < width and np.isnan(u[y, first]):
            first += 1
        last = width - 1
        while last > first and np.isnan(u[y, last]):
            last -= 1
        if first >= last:
            continue
        for c in range(columns):
            px, py, pz = plane[c, 0], plane[c, 1], plane[c, 2]
            w_first = px * u[y, first] + py * v[y, first] + pz
            w_last = px * u[y, last] + py * v[y, last] + pz
            falling = w_first > w_last
            # Lowest x at which w has passed the first limit, in the sense of travel.
            enter, leave = (w_near, w_far) if falling else (w_far, w_near)
            lo, hi = first, last + 1
            while lo < hi:
                mid = (lo + hi) // 2
                w = px * u[y, mid] + py * v[y, mid] + pz
                inside = w <= enter if falling else w >= enter
                if inside:
                    hi = mid
                else:
                    lo = mid + 1
            x_lo[y, c] = lo
            lo, hi = first, last + 1
            while lo < hi:
                mid = (lo + hi) // 2
                w = px * u[y, mid] + py * v[y, mid] + pz
                beyond = w < leave if falling else w > leave
                if beyond:
                    hi = mid
                else:
                    lo = mid + 1
            x_hi[y, c] = lo - 1
    return x_lo, x_hi
