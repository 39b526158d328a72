"""The viewer serves its page, and moves what it shows."""

import shutil
import subprocess
import urllib.request

import numpy as np
import pytest
from PIL import Image

from openjax.show.trajectory import Trajectory

viser = pytest.importorskip("viser")


@pytest.fixture
def viewer():
    from openjax.show.viewer import Viewer

    rng = np.random.default_rng(0)
    quaternion = rng.normal(size=(30, 3, 4))
    flights = [
        Trajectory(
            title=title,
            pursuer_position=rng.uniform(-0.5, 0.5, (30, 3, 3)),
            pursuer_quaternion=quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),
            evader_position=rng.uniform(-0.5, 0.5, (30, 3)),
            captured=np.arange(30)[:, None] >= np.array([20, 99, 99]),
            crashed=np.zeros((30, 3), bool),
            pillar_position=np.array([[0.0, 0.2], [0.3, 0.0]]),
            arena_radius=0.9,
            arena_height=1.2,
            pillar_radius=0.1,
            capture_radius=0.3,
            time_step=0.01,
        )
        for title in ("wall", "passage")
    ]
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield Viewer(server, flights)
    server.stop()


def test_page_is_served(viewer):
    with urllib.request.urlopen(f"http://127.0.0.1:{viewer.server.get_port()}/", timeout=10) as page:
        assert page.status == 200 and b"<html" in page.read().lower()


def test_time_moves_the_vehicles_and_ends_where_it_began(viewer):
    viewer.step.value = 12
    viewer.draw()
    flight = viewer.flights["wall"]
    np.testing.assert_allclose(viewer.drones[1].position, flight.pursuer_position[12, 1])
    np.testing.assert_allclose(viewer.drones[1].wxyz, flight.pursuer_quaternion[12, 1])
    np.testing.assert_allclose(viewer.evader.position, flight.evader_position[12])
    assert "captured after 0.2 s" in viewer.told.content
    viewer.advance(0.1)
    assert viewer.step.value == 22
    viewer.advance(0.1)
    assert viewer.step.value == 2
    viewer.playing.value = False
    viewer.advance(0.1)
    assert viewer.step.value == 2


def test_another_layout_is_another_flight(viewer):
    viewer.layout.value = "passage"
    viewer.build()
    np.testing.assert_allclose(viewer.evader.position, viewer.flights["passage"].evader_position[0])


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on this machine")
def test_a_browser_draws_the_scene(viewer, tmp_path):
    """Pillars' and pursuers' colours are in what a headless browser shows."""
    picture = tmp_path / "page.png"
    viewer.playing.value = False
    command = [
        "chromium",
        "--headless=new",
        "--no-sandbox",
        "--enable-unsafe-swiftshader",
        "--window-size=900,700",
    ]
    command += [
        "--virtual-time-budget=20000",
        f"--screenshot={picture}",
        f"--user-data-dir={tmp_path / 'profile'}",
    ]
    page = f"http://127.0.0.1:{viewer.server.get_port()}/"
    subprocess.run([*command, page], check=True, capture_output=True, timeout=240)
    shown = np.asarray(Image.open(picture).convert("RGB"), int)
    blue = shown[..., 2] - shown[..., 0] > 60
    sand = (shown[..., 0] - shown[..., 2] > 25) & (shown[..., 0] > 90)
    assert blue.sum() > 20 and sand.sum() > 500
