"""openjax beside what a user would pick instead: crazyflow (drones) and JaxMARL (multi-agent learning).

Install both with `pip install "openjax[compare]"`; one run times all of them on one machine:
`python -m experiments.compare`.
"""

import os

# crazyflow hands JAX arrays to SciPy's rotations, which SciPy allows only if told so before its first import.
os.environ.setdefault("SCIPY_ARRAY_API", "1")
