"""The page of a person's game and what it asks for, on this machine only: the game's
frames as server-sent events, and the person's wishes and starts.
"""

import json
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from openjax.commands.play_game import PersonsGame
from openjax.commands.view import OWN_NAMES, local_server
from openjax.show.replay import plain_episode, replay_page

TITLE = "you are the evader"
LIVE = Path(__file__).with_name("play.js")
SILENCE = 15.0
"""Seconds after which a page that listens is sent a comment, by which a closed one shows itself."""
LONGEST_WISH = 200
"""Bytes of a message from the page."""


class PlaySession:
    """The place where games are played one after the other: the threads of the page and of the game
    meet here.

    Args:
      begin: a new game, of a number that is counted up.
      every: steps of the game between frames that the page is sent.
    """

    def __init__(self, begin: Callable[[int], PersonsGame], every: int = 2):
        self._begin = begin
        self._every = every
        self._news = threading.Condition()
        self.wish = np.zeros(3)  # the person's, from now on
        self._asked = False
        self._number = 0
        self.game = begin(0)
        self.captures = 0
        self.games = 0
        self.longest = 0.0  # s

    def ask_for_game(self) -> None:
        """Begin the game that lies ready; the next one, where that is over."""
        with self._news:
            if self.game.over:
                self._number += 1
                self.game = self._begin(self._number)
            self._asked = True
            self.wish = np.zeros(3)
            self._news.notify_all()

    def play(self, stop: threading.Event) -> None:
        """Fly games in real time as they are asked for, until `stop` is set."""
        while not stop.is_set():
            with self._news:
                if self._news.wait_for(lambda: self._asked, timeout=0.2):
                    self._asked = False
                    game = self.game
                else:
                    continue
            self._play_one(game)

    def _play_one(self, game):
        due = time.monotonic()
        while not game.over and self.game is game:
            game.step(self.wish)
            # a step that came late isn't made up for: the game slows down
            due = max(due + game.time_step, time.monotonic())
            with self._news:
                if game.over:
                    self._count(game)
                self._news.notify_all()
            time.sleep(max(0.0, due - time.monotonic()))

    def _count(self, game):
        self.games += 1
        self.captures += game.is_capture
        self.longest = max(self.longest, game.seconds)

    def events(self) -> Iterator[dict | None]:
        """The events for a page, for as long as it listens: each game's start, its frames and its
        end. None means that nothing has happened for a while.
        """
        listener = _Listener(self._every)
        while True:
            with self._news:
                if not self._news.wait_for(lambda: listener.is_behind(self.game), SILENCE):
                    yield None
                    continue
                events = listener.catch_up(self.game)
            for event in events:
                yield {"end": self._score()} if event is _END else event

    def _score(self):
        return {
            "captured": self.game.is_capture,
            "seconds": round(self.game.seconds, 2),
            "longest": round(self.longest, 2),
            "games": self.games,
            "captures": self.captures,
        }


_END = object()


class _Listener:
    """A page's progress through the games."""

    def __init__(self, every: int):
        self.every = every
        self.game: PersonsGame | None = None
        self.sent = 0  # steps of it
        self.knows_end = False

    def is_behind(self, game: PersonsGame) -> bool:
        """True if there are events that the page hasn't got."""
        is_over = game.over and not self.knows_end
        return game is not self.game or len(game.moments) >= self.sent + self.every or is_over

    def catch_up(self, game: PersonsGame) -> list:
        """The events that the page hasn't got, which count as sent."""
        events: list = []
        if game is not self.game:
            self.game = game
            self.sent = 0
            self.knows_end = False
            events.append({"start": plain_episode(TITLE, game.trajectory(TITLE, steps=0))})
        while len(game.moments) >= self.sent + self.every:
            self.sent += self.every
            events.append({"frame": _frame(game.moments[self.sent - 1])})
        if game.over and not self.knows_end:
            self.knows_end = True
            events.append(_END)
        return events


def _frame(moment):
    poses = np.concatenate([moment.pursuer_position, moment.pursuer_quaternion], axis=-1)
    return {
        "pursuers": np.rint(1000 * poses).astype(int).tolist(),
        "evader": np.rint(1000 * moment.evader_position).astype(int).tolist(),
        "seen": bool(moment.sight),
        "crashed": moment.crash.tolist(),
    }


def play_page(table: PlaySession) -> str:
    """The replay's page, made live."""
    page = replay_page([(TITLE, table.game.trajectory(TITLE, steps=0))])
    script = LIVE.read_text(encoding="utf-8")
    return page.replace("</body>", f"<script>\n{script}</script>\n</body>")


def play_server(table: PlaySession, port: int) -> ThreadingHTTPServer:
    """A server of the page, of the games' events, and of the last game's replay.

    Raises:
      UserError: the port isn't free.
    """
    return local_server(type("Handler", (_Handler,), {"table": table}), port)


class _Handler(BaseHTTPRequestHandler):
    """Answers the pages of `table`, which a subclass names."""

    table: PlaySession

    def do_GET(self):
        if not self._is_ours():
            self._answer(404)
        elif self.path == "/":
            self._answer(200, play_page(self.table).encode())
        elif self.path == "/replay":
            page = replay_page([("against a person", self.table.game.trajectory("play"))])
            self._answer(200, page.encode())
        elif self.path == "/events":
            self._stream()
        else:
            self._answer(404)

    def do_POST(self):
        size = self.headers.get("Content-Length", "0")
        if not self._is_ours() or not size.isdecimal() or int(size) > LONGEST_WISH:
            self._answer(404)
            return
        text = self.rfile.read(int(size))
        if self.path == "/start":
            self.table.ask_for_game()
            self._answer(204)
        elif self.path == "/wish" and (wish := _wish_of(text)) is not None:
            self.table.wish = wish
            self._answer(204)
        else:
            self._answer(400)

    def _is_ours(self):
        """True if this machine's own page asks, by its host's name and its origin."""
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin", f"http://{host}")
        return host.rpartition(":")[0] in OWN_NAMES and origin == f"http://{host}"

    def _answer(self, status, content=b""):
        self.send_response(status)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _stream(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        try:
            for event in self.table.events():
                text = ": nothing new" if event is None else f"data: {json.dumps(event)}"
                self.wfile.write(f"{text}\n\n".encode())
                self.wfile.flush()
        except (BrokenPipeError, ConnectionResetError):
            """The page was closed."""

    def log_message(self, *_):
        """Say nothing."""


def _wish_of(text):
    """(3,) the wish of a page's message; None where it is none."""
    try:
        wish = np.array(json.loads(text), float)
    except (ValueError, TypeError):
        return None
    return wish if wish.shape == (3,) and np.isfinite(wish).all() else None
