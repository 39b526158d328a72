"""JAX's release 0.10.2 sums wrongly on a CPU
(https://github.com/jax-ml/jax/issues/39103); with openjax it doesn't, and what can't be
mended is told.
"""

import os
import subprocess
import sys

import pytest

from openjax.xla_flags import FAULTY, FLAG, _jaxlib_version

# 40,001 rows: above 32,768, wrong from there on in float32
SUMS = """
import jax, jax.numpy as jnp
number = jnp.arange(40001.0)
rows = jnp.stack([number, 0 * number, 0 * number], axis=1)
turned = jax.jit(jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2)))(rows)
print(int(jnp.sum(abs(turned - number**2) > 1e-6 * number**2)))
"""


def run(script: str, flags: str | None) -> subprocess.CompletedProcess:
    """Run in a process that has the suite's flags, some other ones or none."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    environment |= {} if flags is None else {"XLA_FLAGS": flags}
    command = [sys.executable, "-c", script]
    return subprocess.run(command, capture_output=True, text=True, env=environment)


@pytest.mark.parametrize("first", ["import openjax", "import jax; import openjax"])
@pytest.mark.parametrize("flags", [None, os.environ["XLA_FLAGS"].split(f" {FLAG}")[0]])
def test_sums_are_right(first, flags):
    done = run(first + SUMS, flags)
    assert (done.stdout, done.stderr) == ("0\n", "")


@pytest.mark.skipif(_jaxlib_version() not in FAULTY, reason="this JAX sums rightly")
def test_one_line_warns_where_jax_has_started():
    done = run("import jax; jax.devices(); import openjax", None)
    assert "import openjax first, or set XLA_FLAGS=--xla_cpu" in done.stderr
    assert "<string>:1: RuntimeWarning" in done.stderr


def test_a_choice_of_the_users_own_is_kept():
    script = "import os, openjax; print(os.environ['XLA_FLAGS'])"
    assert run(script, f"{FLAG}=").stdout == f"{FLAG}=\n"


def test_releases_without_the_fault_get_no_flag():
    script = "import importlib.metadata as m; m.version = lambda name: '0.12.0'; import os, openjax"
    assert run(f"{script}; print(os.environ.get('XLA_FLAGS'))", None).stdout == "None\n"
