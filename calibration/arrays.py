"""Types of arrays that stand in signatures all over the package, and the fields of frozen classes that hold some."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def set_frozen(owner: object, **values: Any) -> None:
    """Set fields of a frozen dataclass while it is made; arrays are read-only from then on."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        object.__setattr__(owner, name, value)
