"""Shapes in types: NumPy's arrays of the diagnosis.

Channels are the nine of a row: angular velocity, velocity and specific force, three
axes each.
"""

import numpy as np
from jaxtyping import Float

Parameters = Float[np.ndarray, "parameters"]
"""Of all physics effects together (theta); at `library.ABSENT` nothing acts."""
Hypotheses = Float[np.ndarray, "hypotheses parameters"]
Rows = Float[np.ndarray, "rows channels"]
"""The channels of a track."""
Squares = Float[np.ndarray, "*sets channels"]
"""Squared errors of each channel."""
Nuisances = Float[np.ndarray, "nuisances"]
"""Sizes of small errors that are free in every hypothesis."""
