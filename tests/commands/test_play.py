"""A person as the evader: the game's steps, and the page that plays it."""

import http.client
import json
import threading
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import openjax
from openjax.commands.play import main
from openjax.commands.play_game import Moment, Simulation
from openjax.commands.play_server import PlaySession, play_server
from openjax.errors import UserError
from openjax.pursuit import hover_action
from openjax.pursuit.task import uniform_task
from openjax.show.trajectory import Trajectory

STEPS = 12


def test_evader_flies_where_the_person_wants_no_faster_than_it_can():
    game = openjax.make(episode_length=STEPS, capture_radius=0.01)
    hover = jnp.broadcast_to(hover_action(game.vehicle), (3, 4))
    still = SimpleNamespace(
        policy=SimpleNamespace(act=lambda parameters, observation: hover), parameters=None
    )
    simulation = Simulation(game, still, lambda key: uniform_task(game.settings, key))
    played = simulation.begin(jax.random.key(0))
    while not played.over:
        played.step(np.array([0.0, 0.0, 5.0]))
    assert len(played.moments) == STEPS and not played.is_capture
    path = played.trajectory("").evader_position
    speed = np.diff(path, axis=0) / game.settings.time_step
    assert np.all(np.linalg.norm(speed, axis=-1) < 1.3 + 1e-3)
    np.testing.assert_allclose(speed[-1], [0.0, 0.0, 1.3], atol=1e-3)


class ShortGame:
    """A game that rises by the wish's height, and ends with a capture."""

    time_step = 0.001

    def __init__(self):
        self.moments = []
        self.wishes = []

    over = property(lambda self: len(self.moments) == STEPS)
    is_capture = over
    seconds = property(lambda self: len(self.moments) * self.time_step)

    def step(self, wish):
        self.wishes.append(wish)
        self.moments.append(self.moment())

    def moment(self):
        flags = np.zeros(2, bool)
        height = np.full((2, 3), len(self.moments) + 1.0)
        return Moment(height, np.ones((2, 4)), height[0], flags, flags, np.array(True))

    def trajectory(self, title, steps=None):
        moments = [self.moment(), *self.moments[:steps]]
        places = np.stack([moment.pursuer_position for moment in moments])
        return Trajectory(
            title=title,
            pillar_position=np.zeros((0, 2)),
            arena_radius=0.9,
            arena_height=1.2,
            pillar_radius=0.1,
            capture_radius=0.3,
            time_step=self.time_step,
            pursuer_position=places,
            pursuer_quaternion=np.ones((len(moments), 2, 4)),
            evader_position=places[:, 0],
            captured=np.zeros((len(moments), 2), bool),
            crashed=np.zeros((len(moments), 2), bool),
        )


@pytest.fixture
def page():
    """The server of short games, and a function that asks it."""
    games = []

    def begin(number):
        games.append(ShortGame())
        return games[-1]

    table = PlaySession(begin, every=4)
    with play_server(table, 0) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        stop = threading.Event()
        threading.Thread(target=table.play, args=(stop,), daemon=True).start()

        def ask(method, path, body=None, **headers):
            connection = http.client.HTTPConnection("localhost", server.server_port, timeout=60)
            connection.request(method, path, body, headers)
            return connection.getresponse()

        yield SimpleNamespace(ask=ask, games=games, table=table)
        stop.set()
        server.shutdown()


def news(response):
    """The next event of a stream."""
    while not (line := response.readline().decode()).startswith("data: "):
        pass
    return json.loads(line.removeprefix("data: "))


def test_page_is_told_each_game_from_its_start_to_its_end(page):
    assert b"EventSource" in page.ask("GET", "/").read()
    stream = page.ask("GET", "/events")
    for number in (1, 2):
        if number == 2:
            page.ask("POST", "/start").read()
        start = news(stream)["start"]
        assert start["steps"] == 1 and len(start["pursuers"]) == 2
        if number == 1:  # nothing moves before somebody asks
            assert page.games[0].moments == []
            page.ask("POST", "/start").read()
        heights = [news(stream)["frame"]["evader"][2] for _ in range(STEPS // 4)]
        assert heights == [4000, 8000, 12000]
        end = news(stream)["end"]
        assert end["games"] == end["captures"] == number
    assert b"openjax: flights" in page.ask("GET", "/replay").read()


def test_wishes_reach_the_game_and_nothing_else_does(page):
    page.ask("POST", "/start").read()
    assert page.ask("POST", "/wish", "[0, 0.5, 1]").status == 204
    for text in ("[1]", "{}", "nonsense", "[NaN, 0, 0]", '["a", 0, 0]'):
        assert page.ask("POST", "/wish", text).status == 400
    np.testing.assert_array_equal(page.table.wish, [0, 0.5, 1])


def test_pages_of_other_hosts_are_refused(page):
    assert page.ask("GET", "/", Host="elsewhere.example").status == 404
    assert page.ask("POST", "/start", Origin="http://elsewhere.example").status == 404
    assert page.ask("POST", "/wish", "0" * 10_000).status == 404


def test_what_makes_no_sense_is_refused():
    with pytest.raises(UserError, match="unknown setting --opponent"):
        main(["--opponent", "greedy"])
    with pytest.raises(UserError, match="name one layout, or uniform"):
        main(["--scenario", "all"])
