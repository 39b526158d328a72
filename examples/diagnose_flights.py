"""What makes flights differ from the simulator? Make flights of a vehicle with drag, and ask.

python examples/diagnose_flights.py
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from openjax.gap import diagnose_case, load_case

folder = Path(tempfile.mkdtemp()) / "drag"
sample = [sys.executable, "-m", "openjax", "sample_flights", str(folder), "--effect", "rotor_drag"]
subprocess.run(sample, check=True)

case = load_case(folder)  # flight logs (CSV, micro-SD, ROS 2 bags) and a vehicle.toml
report = diagnose_case(case)
print("\n".join(report.in_words()))
