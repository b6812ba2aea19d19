"""Vector operations for compiled kernels: sixteen lanes of 8, 16 or 32 bits, written as LLVM instructions.

Input: vectors, or addresses of arrays. Output: vectors, or numbers in memory. Vectors exist only in compiled code. This
module defines short names for the arrays that kernels take.
"""

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int16 = NDArray[np.int16]
Int32 = NDArray[np.int32]
Uint8 = NDArray[np.uint8]
Bools = NDArray[np.bool_]
