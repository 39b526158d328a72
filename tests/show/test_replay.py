"""The replay page holds the flights as they were, needs nothing from elsewhere, and is
drawn by a browser.
"""

import http.client
import json
import re
import shutil
import subprocess
import threading

import numpy as np
import pytest
from PIL import Image

from openjax.commands.view import page_server
from openjax.show.replay import replay_page, write_replay
from openjax.show.trajectory import Trajectory


@pytest.fixture
def flights():
    rng = np.random.default_rng(0)
    quaternion = rng.normal(size=(400, 3, 4))
    flight = Trajectory(
        title="wall</script>",
        pursuer_position=rng.uniform(-0.5, 0.5, (400, 3, 3)),
        pursuer_quaternion=quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),
        evader_position=rng.uniform(-0.5, 0.5, (400, 3)),
        captured=np.arange(400)[:, None] >= np.array([20, 999, 999]),
        pillar_position=np.array([[0.0, 0.2], [0.3, 0.0]]),
        arena_radius=0.9,
        arena_height=1.2,
        pillar_radius=0.1,
        capture_radius=0.3,
        time_step=0.01,
        crashed=np.arange(400)[:, None] >= np.array([999, 60, 399]),
        seen=np.arange(400) % 100 < 50,
        predicted=rng.uniform(-0.5, 0.5, (400, 5, 3)),
    )
    return [("flight", flight)]


def test_page_holds_the_flight(flights):
    page = replay_page(flights)
    flight = flights[0][1]
    (data,) = re.findall(
        r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL
    )
    (shown,) = json.loads(data)
    assert shown["layout"] == "wall</script>" and shown["dt"] == pytest.approx(0.02)
    steps = range(0, 220, 2)  # two seconds after the capture
    assert shown["steps"] == len(steps)
    poses = np.array(shown["pursuers"][1]).reshape(-1, 7) / 1000
    np.testing.assert_allclose(poses[:, :3], flight.pursuer_position[steps, 1], atol=6e-4)
    np.testing.assert_allclose(poses[:, 3:], flight.pursuer_quaternion[steps, 1], atol=6e-4)
    np.testing.assert_allclose(
        np.array(shown["predicted"]).reshape(-1, 3, 3) / 1000,
        flight.predicted[steps][:, ::2],
        atol=6e-4,
    )
    assert shown["capture"] == 10
    assert shown["crashes"] == [None, 30, None]  # the third's comes after what is shown
    assert shown["seen"] == [[0, 24], [50, 74], [100, 109]]
    assert not re.search(r"https?://", page)


def test_server_answers_this_machine_only(flights):
    with page_server(replay_page(flights), 0) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()

        def status(path, host):
            connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
            connection.request("GET", path, headers={"Host": host})
            return connection.getresponse().status

        try:
            assert status("/", "localhost:8080") == status("/", "127.0.0.1") == 200
            assert status("/", "elsewhere.example:8080") == 404
            assert status("/../etc/passwd", "localhost") == 404
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on this machine")
def test_a_browser_draws_it(flights, tmp_path):
    """Pillars' and pursuers' colours are in what a headless browser shows."""
    picture = tmp_path / "page.png"
    page = tmp_path / "page.html"
    write_replay(page, flights)
    command = "chromium --headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking".split()
    command += [
        "--window-size=900,700",
        f"--screenshot={picture}",
        f"--user-data-dir={tmp_path / 'profile'}",
        f"{page.as_uri()}#t=0.5",
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=240)
    shown = np.asarray(Image.open(picture).convert("RGB"), int)
    blue = shown[..., 2] - shown[..., 0] > 60
    sand = (shown[..., 0] - shown[..., 2] > 40) & (shown[..., 1] - shown[..., 2] > 20)
    assert blue.sum() > 50 and sand.sum() > 2000
