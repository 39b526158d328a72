"""What the paper's tables say: (mean, standard deviation) of capture rate, capture step and collision rate."""

MAIN = {
    "wall": {
        "Angelani": ((0.008, 0.003), (798.0, 0.8), (0.010, 0.000)),
        "Janosov": ((0.009, 0.002), (797.0, 0.8), (0.010, 0.000)),
        "APF": ((0.010, 0.005), (797.0, 1.4), (0.010, 0.000)),
        "DACOOP": ((0.205, 0.007), (744.0, 9.1), (0.040, 0.008)),
        "MAPPO": ((0.817, 0.095), (569.1, 46.9), (0.010, 0.076)),
        "OPEN": ((0.987, 0.019), (480.4, 52.4), (0.000, 0.000)),
    },
    "narrow_gap": {
        "Angelani": ((0.213, 0.012), (755.0, 4.5), (0.094, 0.001)),
        "Janosov": ((0.219, 0.012), (757.7, 4.2), (0.077, 0.001)),
        "APF": ((0.253, 0.012), (743.0, 2.2), (0.085, 0.000)),
        "DACOOP": ((0.447, 0.017), (553.0, 2.2), (0.039, 0.002)),
        "MAPPO": ((0.917, 0.034), (484.0, 41.2), (0.039, 0.032)),
        "OPEN": ((1.000, 0.000), (526.0, 32.9), (0.017, 0.024)),
    },
    "random": {
        "Angelani": ((0.277, 0.002), (639.0, 1.6), (0.015, 0.001)),
        "Janosov": ((0.145, 0.019), (716.0, 12.0), (0.018, 0.002)),
        "APF": ((0.314, 0.018), (620.0, 14.8), (0.022, 0.002)),
        "DACOOP": ((0.563, 0.016), (488.7, 8.7), (0.020, 0.000)),
        "MAPPO": ((0.783, 0.272), (493.8, 183.6), (0.168, 0.160)),
        "OPEN": ((1.000, 0.000), (329.9, 60.6), (0.011, 0.008)),
    },
    "passage": {
        "Angelani": ((0.733, 0.010), (552.7, 5.0), (0.000, 0.000)),
        "Janosov": ((0.009, 0.003), (799.3, 0.5), (0.001, 0.000)),
        "APF": ((0.229, 0.027), (750.3, 7.4), (0.001, 0.000)),
        "DACOOP": ((0.818, 0.027), (533.7, 8.8), (0.001, 0.000)),
        "MAPPO": ((0.617, 0.275), (541.0, 144.9), (0.013, 0.008)),
        "OPEN": ((1.000, 0.000), (329.6, 76.9), (0.006, 0.008)),
    },
}
"""The main table, by layout and method."""
PARTS = {
    "random": {
        "MAPPO + predictor": ((1.000, 0.000), (301.0, 28.7), (0.012, 0.009)),
        "MAPPO + generator": ((0.967, 0.025), (477.1, 44.8), (0.107, 0.110)),
    },
    "passage": {
        "MAPPO + predictor": ((0.886, 0.120), (427.6, 123.0), (0.013, 0.010)),
        "MAPPO + generator": ((0.727, 0.193), (602.2, 41.1), (0.216, 0.292)),
    },
}
"""The table of layouts unlike the training's: the methods that the main table lacks."""
PREDICTION = {"wall": 0.054, "narrow_gap": 0.084, "random": 0.109, "passage": 0.081}
"""m, mean error of OPEN's predicted next position."""


def means(layout: str, method: str) -> tuple[float, int, float] | None:
    """Capture rate, capture step and collision rate; None of what the paper doesn't have."""
    found = (MAIN.get(layout, {}) | PARTS.get(layout, {})).get(method)
    if found is None:
        return None
    (rate, _), (step, _), (collisions, _) = found
    return rate, round(step), collisions
