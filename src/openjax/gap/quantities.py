"""What an estimator measures: numbers beside what is assumed of the vehicle, with one
covariance.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Estimate:
    """By how much the quantities `names` (n,) differ from the assumed ones."""

    names: tuple[str, ...]
    value: Float[np.ndarray, " quantities"]
    covariance: Float[np.ndarray, "quantities quantities"]

    def doubted(self, directions: Float[np.ndarray, "quantities doubts"], sizes) -> "Estimate":
        """The estimate where each direction (n, k) may be off by its size (k,) as well."""
        columns = np.asarray(directions) * np.asarray(sizes)
        return replace(self, covariance=self.covariance + columns @ columns.T)
