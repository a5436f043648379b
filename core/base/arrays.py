"""Names of the array types in annotations."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers: values, matrices, bounds."""
Integers = NDArray[np.int64]
"""Times in ns, counts, byte offsets."""
Index = NDArray[np.intp]
"""Positions in another array."""
Mask = NDArray[np.bool_]
"""True or false for each entry of another array."""
