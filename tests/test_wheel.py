"""A user installs a package: sdist and wheel hold all that it needs, and the tested
versions fit what it asks for.
"""

import importlib
import re
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def run(*command, cwd=None):
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env={"PATH": "/usr/bin:/bin", "HOME": str(cwd)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_wheel_of_the_sdist_runs_in_an_environment_of_its_own(tmp_path):
    """The wheel is built from the sdist, and runs beside nothing but its dependencies:
    those of this environment, which the new one borrows.
    """
    build = [sys.executable, "-m", "build", "--outdir", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)  # pip may fetch what builds it
    (sdist,) = tmp_path.glob("openjax-*.tar.gz")
    (wheel,) = tmp_path.glob("openjax-*.whl")
    assert sdist.stat().st_size < 20e6
    venv = tmp_path / "venv"
    run(sys.executable, "-m", "venv", venv, cwd=tmp_path)
    python = venv / "bin" / "python"
    run(python, "-m", "pip", "install", "-q", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    here = f"lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages"
    (venv / here / "borrowed.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    code = (
        "import openjax; print(openjax.__file__); game = openjax.make(); policy = "
        "openjax.load_policy('open'); print(policy.source, float(game.vehicle.mass))"
    )
    told = run(python, "-c", code, cwd=tmp_path)
    assert str(venv) in told  # not the checkout
    assert "0.03" in told
    assert "openjax " in run(venv / "bin" / "openjax", "--version", cwd=tmp_path)
    told = run(python, "-m", "openjax.evaluate", "--help", cwd=tmp_path)
    assert "--scenario" in told
    openjax = venv / "bin" / "openjax"
    run(openjax, "sample_flights", "flights", "--effect", "rotor_drag", cwd=tmp_path)
    assert "mostly rotor drag" in run(openjax, "diagnose", "flights", cwd=tmp_path)
    assert (tmp_path / "diagnosis" / "flights" / "report.html").is_file()


def test_uvx_and_pipx_find_the_command_by_the_distributions_name():
    project = PROJECT["project"]
    module, _, name = project["scripts"][project["name"]].partition(":")
    assert callable(getattr(importlib.import_module(module), name))


def test_the_repositorys_address_is_one():
    """What names it was made from pyproject.toml, or says the same."""
    address = PROJECT["project"]["urls"]["Repository"]
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
    pages += [path for path in (ROOT / "docs").rglob("*.md") if "_build" not in path.parts]
    pages += (ROOT / "docs" / "notebooks").glob("*.ipynb")
    named = {
        found
        for page in (ROOT / "CITATION.cff", *pages)
        for found in re.findall(
            r"\bgithub(?:\.com)?/[\w.-]+/openjax\b", page.read_text(encoding="utf-8")
        )
    }
    place = address.removeprefix("https://github.com/")
    assert named == {f"github.com/{place}", f"github/{place}"}
    assert f"repository-code: {address}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def requirements():
    """All that the project asks for: its own, its extras' and its groups'."""
    project = PROJECT["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    groups += PROJECT["dependency-groups"].values()
    found = [Requirement(text) for group in groups for text in group]
    return [requirement for requirement in found if requirement.name != "openjax"]


def pins():
    """{name: [(version, marker)]} of the constraints."""
    found = {}
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines():
        pin = Requirement(line)
        (exact,) = pin.specifier
        found.setdefault(plain(pin.name), []).append((exact.version, pin.marker))
    return found


def plain(name):
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
def test_tested_versions_are_what_the_project_asks_for(python):
    """One pin for each requirement and Python, within the requirement's range."""
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    known = pins()
    for requirement in requirements():
        chosen = [
            pinned
            for pinned, marker in known[plain(requirement.name)]
            if marker is None or marker.evaluate(environment)
        ]
        assert len(chosen) == 1, (requirement.name, chosen)
        assert requirement.specifier.contains(chosen[0]), (requirement, chosen)
