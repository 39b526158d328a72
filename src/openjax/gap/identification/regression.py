"""Least squares of long records, and the windows and polynomials of an
autoregression.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view


class Regression:
    """Least squares on columns (N, P), by normal equations of scaled columns."""

    def __init__(self, columns: np.ndarray):
        gram = columns.T @ columns
        self.columns = columns
        # a column of zeros counts nothing, instead of being divided by
        self.scale = np.sqrt(np.diag(gram)) + 1e-30
        self.gram = gram / np.outer(self.scale, self.scale)
        # columns that say the same share their coefficient instead of failing
        self.gram[np.diag_indices(len(gram))] += 1e-10

    def solve(self, target: np.ndarray) -> np.ndarray:
        """Coefficients (P, ...) of targets (N, ...)."""
        products = (self.columns.T @ target).T / self.scale
        return (np.linalg.solve(self.gram, products.T).T / self.scale).T


def solve(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Least squares coefficients (P, ...) of columns (N, P) for targets (N, ...)."""
    return Regression(columns).solve(target)


def lag_columns(x: np.ndarray, order: int) -> np.ndarray:
    """x(k), then differences x(k) - x(k - 1) and before, (T - order, order): rows k =
    order - 1 up to T - 2, which foretell the next.
    """
    windows = sliding_window_view(x, order)[:-1, ::-1]
    # from row to row hardly anything changes: values would be nearly the same columns,
    # differences aren't
    return np.concatenate([windows[:, :1], windows[:, :-1] - windows[:, 1:]], 1)


def polynomial(coefficients: np.ndarray) -> np.ndarray:
    """1 - a_1 q^-1 - ... of coefficients on the last value and on differences before
    it.
    """
    out = np.zeros(len(coefficients) + 1)
    out[0] = 1.0
    out[1] -= coefficients[0]
    out[1:-1] -= coefficients[1:]
    out[2:] += coefficients[1:]
    return out
