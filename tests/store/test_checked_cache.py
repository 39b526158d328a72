"""The cache of compiled programs: damage, and folders that others can write to."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from openjax.store.checked_cache import ENTRY, CheckedCache
from openjax.store.compiled_programs import cache_programs

FLIPS = """
import os, sys
import jax, jax.numpy as jnp
import numpy as np
from openjax.store.checked_cache import ENTRY
from openjax.store.compiled_programs import cache_programs
from openjax.vehicle import hover_state, load_vehicle, make_drones_step

folder, seed, flips = cache_programs(), int(sys.argv[1]), int(sys.argv[2])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
vehicle = load_vehicle()
step = make_drones_step("rigid", substeps=2)
start = hover_state(vehicle, jnp.array([[0.0, 0.0, 0.5], [0.3, 0.0, 0.6], [-0.3, 0.1, 0.7]]))
pillars = jnp.array([[0.2, 0.2]]), jnp.array([True])

def fly(drones):
    command = jnp.tile(jnp.array([0.7, 1.0, -1.0, 0.5]), (3, 1))
    return jax.lax.scan(lambda d, _: (step(vehicle, d, command, *pillars), d.position), drones, None, length=20)

rng = np.random.default_rng(seed)
for flip in range(flips + 1):
    if flip:
        (file,) = folder.glob(f"jit_fly*{ENTRY}")
        content = bytearray(file.read_bytes())
        bit = int(rng.integers(8 * len(content)))
        content[bit // 8] ^= 1 << bit % 8
        file.write_bytes(content)
    jax.clear_caches()
    print(np.asarray(jax.jit(fly)(start)[1]).tobytes().hex(), flush=True)
"""


@pytest.mark.slow
def test_flipped_bits_end_no_process_and_change_no_number(tmp_path):
    """Each start after a flip says that the entry is damaged and compiles anew.
    OPENJAX_FLIPS: how often, else four times.
    """
    flips = int(os.environ.get("OPENJAX_FLIPS", "4"))
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", FLIPS, "0", str(flips)]
    ran = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert ran.returncode == 0, ran.stderr[-2000:]
    numbers = ran.stdout.split()
    assert len(numbers) == flips + 1 and set(numbers) == {numbers[0]}
    assert ran.stderr.count("is damaged") == flips


def test_half_an_entry_is_none(tmp_path):
    cache = CheckedCache(tmp_path)
    cache.put("key", b"program")
    file = tmp_path / f"key{ENTRY}"
    for size in (0, 10, 35):
        file.write_bytes(file.read_bytes()[:size])
        assert cache.get("key") is None
        cache.put("key", b"program")
        assert cache.get("key") == b"program"


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="owners and modes are those of POSIX")
def test_the_folder_is_the_users_own(tmp_path):
    def folder(cache):
        code = "from openjax.store.compiled_programs import cache_programs; print(cache_programs())"
        environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        ran = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=environment
        )
        assert ran.returncode == 0, ran.stderr
        return ran.stdout.strip()

    assert folder(tmp_path).startswith(str(tmp_path / "openjax"))
    assert stat.S_IMODE((tmp_path / "openjax").stat().st_mode) & 0o022 == 0
    (tmp_path / "openjax").chmod(0o777)
    assert folder(tmp_path) == "None"
    (tmp_path / "file").write_text("")
    assert folder(tmp_path / "file") == "None"


def test_a_user_without_a_home_has_nothing_kept(monkeypatch):
    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", home)
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        assert cache_programs() is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
