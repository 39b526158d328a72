"""A generated C program, compiled here and called from Python: to compare it with what
it was made of.
"""

import ctypes
import math
import shutil
import subprocess
import tempfile
import timeit
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.export.c_program import CProgram
from openjax.interruption import unfinished

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC")


class Compiled:
    """A compiled program. Raises UserError if the compiler refuses it.

    Attributes:
      library: with all that its header declares.
      observation: the structure that its functions take.
    """

    def __init__(self, program: CProgram, name: str, compiler: str):
        with tempfile.TemporaryDirectory() as scratch, unfinished(Path(scratch)):
            folder = Path(scratch)
            (folder / f"{name}.h").write_text(program.header, encoding="utf-8")
            (folder / f"{name}.c").write_text(program.source, encoding="utf-8")
            library = folder / f"{name}.so"
            command = [compiler, *FLAGS, "-o", str(library), str(folder / f"{name}.c"), "-lm"]
            ran = subprocess.run(command, capture_output=True, text=True, check=False)
            if ran.returncode != 0:
                errors = [line for line in ran.stderr.splitlines() if "error" in line]
                complaint = errors[0] if errors else "no word"
                raise UserError(f"{compiler} refuses the exported program: {complaint}")
            self.library = ctypes.CDLL(str(library))
        self._function = getattr(self.library, name)
        self._function.restype = None
        self._inputs = tuple(program.inputs)
        fields = []
        for field, kind in program.inputs.items():
            number = ctypes.c_ubyte if kind.dtype == bool else ctypes.c_float
            fields.append((field, number * math.prod(kind.shape)))
        self.observation = type("Observation", (ctypes.Structure,), {"_fields_": fields})()
        self._arrays = {
            name: np.ctypeslib.as_array(getattr(self.observation, name)) for name in self._inputs
        }
        # nobody clears it on a vehicle either: what is read before it was written shows
        # as NaN
        self._workspace = np.full(program.workspace, np.nan, np.float32)
        self._output = np.zeros(program.shape, np.float32)
        self._pointers = [
            ctypes.byref(self.observation),
            ctypes.c_void_p(self._workspace.ctypes.data),
            ctypes.c_void_p(self._output.ctypes.data),
        ]

    def __call__(self, samples: dict) -> np.ndarray:
        """Outputs (number, ...) for {input: array (number, ...)}."""
        outputs = []
        for i in range(len(samples[self._inputs[0]])):
            for name in self._inputs:
                self._arrays[name][:] = samples[name][i].reshape(-1)
            self._function(*self._pointers)
            outputs.append(self._output.copy())
        return np.stack(outputs)

    def seconds(self, repeats: int = 500) -> float:
        """Seconds of one call; the best of five batches."""
        batches = timeit.repeat(lambda: self._function(*self._pointers), number=repeats, repeat=5)
        return min(batches) / repeats


def compile_c(program: CProgram, name: str) -> Compiled | None:
    """The program, compiled; None where there is no C compiler."""
    compiler = shutil.which("cc")
    return None if compiler is None else Compiled(program, name, compiler)
