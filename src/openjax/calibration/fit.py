"""The fit behind a calibration: Gauss-Newton on windows of flight, and errors that don't count rows."""

from __future__ import annotations

import numpy as np

from openjax.calibration.model import LAG_PRIOR, STEP, build, parameter_names, prior_of
from openjax.errors import UserError
from openjax.flights.flight import Case
from openjax.flights.track import Track

_ITERATIONS = 8


class CalibrationFit:
    """The fit's working state: beta and log time constant, weights, covariance."""

    def __init__(self, case: Case, tracks: list[Track], vehicles):
        self.flights = list(dict.fromkeys(t.flight for t in tracks))
        self.per_flight = case.vehicle_file.motor_command == "pwm"
        self.names = parameter_names(self.flights, self.per_flight)
        self.mean, self.spread = prior_of(self.names)
        self.floor_z = float(case.vehicle_file.log.get("floor_z", 0.0))
        self.tracks, self.vehicles = tracks, vehicles
        self.log_nominal = float(np.log(vehicles[0].motor_time_constant))
        if not len(self.equations_at(self.log_nominal).y):
            raise UserError(
                f"{case.name}: no half second of flight is clear of the ground; nothing to calibrate on"
            )

    def equations_at(self, log_lag: float):
        """The linear equations of the flights for motors with a time constant of exp(`log_lag`) s."""
        return build(self.tracks, self.vehicles, self.names, float(np.exp(log_lag)), self.floor_z)

    def run(self) -> None:
        """Fit constants and lag by turns, until neither moves."""
        beta, lag = self.mean.copy(), self.log_nominal
        sigma = None
        for _ in range(_ITERATIONS):
            equations, slope = self._linearised(lag, beta)
            sigma = self._noise(equations, equations.y - equations.X @ beta) if sigma is None else sigma
            beta, step = self._solve(equations, slope, sigma, lag, np.ones(len(equations.y), bool))
            moved = float(np.clip(lag + np.clip(step, -0.4, 0.4), np.log(2e-3), np.log(0.3)))
            sigma = self._noise(equations, equations.y - equations.X @ beta - slope * step)
            converged, lag = abs(moved - lag) < 1e-3, moved
            if converged:
                break
        self.equations, self.slope = self._linearised(lag, beta)
        self.beta, self.lag, self.sigma = beta, lag, sigma
        self.residual = self.equations.y - self.equations.X @ beta
        self.covariance = self._covariance()

    def _linearised(self, lag: float, beta: np.ndarray):
        later, earlier = self.equations_at(lag + STEP), self.equations_at(lag - STEP)
        return self.equations_at(lag), ((later.X - earlier.X) @ beta) / (2 * STEP)

    def _noise(self, equations, residual: np.ndarray) -> np.ndarray:
        """Per row: rms of the residual of its channel."""
        sigma = np.ones(len(residual))
        for channel in np.unique(equations.channel):
            rows = equations.channel == channel
            sigma[rows] = max(float(np.sqrt(np.mean(residual[rows] ** 2))), 1e-6)
        return sigma

    def _normal(self, equations, slope, sigma, lag: float, rows):
        """Weighted normal equations with the priors, for changes of (beta, log lag) about (prior
        mean, lag)."""
        G = np.column_stack([equations.X, slope])[rows] / sigma[rows, None]
        target = (equations.y - equations.X @ self.mean)[rows] / sigma[rows]
        precision = np.append(self.spread, LAG_PRIOR) ** -2.0
        right = G.T @ target
        right[-1] += precision[-1] * (self.log_nominal - lag)
        return G.T @ G + np.diag(precision), right, precision

    def _solve(self, equations, slope, sigma, lag: float, rows) -> tuple[np.ndarray, float]:
        hessian, right, _ = self._normal(equations, slope, sigma, lag, rows)
        solution = np.linalg.solve(hessian, right)
        return self.mean + solution[:-1], float(solution[-1])

    def _covariance(self) -> np.ndarray:
        """Of (beta, log lag), from blocks of time, widened where leaving flights out says more."""
        equations, sigma = self.equations, self.sigma
        every = np.ones(len(equations.y), bool)
        hessian, _, precision = self._normal(equations, self.slope, sigma, self.lag, every)
        scores = np.column_stack([equations.X, self.slope]) * (self.residual / sigma**2)[:, None]
        blocks = np.zeros((equations.block.max() + 1, scores.shape[1]))
        np.add.at(blocks, equations.block, scores)
        count = len(np.unique(equations.block))
        inverse = np.linalg.inv(hessian)
        meat = blocks.T @ blocks * count / max(count - 1, 1) + np.diag(precision)
        covariance = inverse @ meat @ inverse
        if len(self.flights) < 2:
            return covariance
        wider = np.sqrt(np.maximum(self._flight_variance() / np.diag(covariance), 1.0))
        return covariance * np.outer(wider, wider)

    def _flight_variance(self) -> np.ndarray:
        """Variance of (beta, log lag) over flights, by leaving each out. Flights tell different things, so
        each counts by its share of the information on a parameter: the delete-m_j jackknife (Busing, Meijer,
        van der Leeden 1999)."""
        equations, sigma = self.equations, self.sigma
        flights = np.unique(equations.flight)
        squares = (np.column_stack([equations.X, self.slope]) / sigma[:, None]) ** 2
        shares = np.stack([squares[equations.flight == f].sum(0) for f in flights])
        shares = np.clip(shares / np.maximum(shares.sum(0), 1e-12), 1e-6, 1 - 1e-6)
        left_out = []
        for flight in flights:
            beta, step = self._solve(equations, self.slope, sigma, self.lag, equations.flight != flight)
            left_out.append(np.append(beta, step))
        full = np.append(self.beta, 0.0)
        ratio = 1 / shares
        mean = len(flights) * full - ((1 - shares) * left_out).sum(0)
        pseudo = ratio * full - (ratio - 1) * left_out
        variance = np.mean((pseudo - mean) ** 2 / (ratio - 1), axis=0)
        own = np.array([":" in n for n in (*self.names, "lag")])  # a flight's own don't vary over flights
        return np.where(own, 0.0, variance)
