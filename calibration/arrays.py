"""Array types used in signatures all over the package, and a helper for frozen classes that hold arrays."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def set_frozen(owner: object, **values: Any) -> None:
    """Set fields of a frozen dataclass during its creation. Arrays are not copied and become read-only."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        object.__setattr__(owner, name, value)
