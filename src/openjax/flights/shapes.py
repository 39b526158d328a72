"""Shapes in types: NumPy's arrays of the rows of one vehicle's log or of one track."""

import numpy as np
from jaxtyping import Bool, Float

Times = Float[np.ndarray, "rows"]
"""A number of each row: its time (s), a voltage."""
Vectors = Float[np.ndarray, "rows 3"]
Quaternions = Float[np.ndarray, "rows 4"]
"""Attitudes, scalar first, from body to world."""
Motors = Float[np.ndarray, "rows 4"]
"""A number of each motor, in the order of `Flight`."""
Columns = Float[np.ndarray, "rows columns"]
Chosen = Bool[np.ndarray, "rows"]
"""The rows of which something is true."""
