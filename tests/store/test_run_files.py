"""Settings, metrics, policies and pictures on disk."""

import dataclasses
import json
import os
import pickle
from typing import Literal

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from openjax.errors import UserError
from openjax.files import replacing, to_plain
from openjax.plain import from_plain
from openjax.show.metrics import Continuation, MetricsWriter, read_metrics
from openjax.show.plots import plot_training, plot_trajectories
from openjax.show.trajectory import Trajectory
from openjax.show.videos import (
    AZIMUTH,
    DISTANCE,
    ELEVATION,
    HEIGHT,
    OPENING,
    WIDTH,
    animate,
    caption,
    draw,
)
from openjax.store.policy_files import fill, load_policy_file, save_policy_file


@dataclasses.dataclass(frozen=True)
class Inner:
    kind: Literal["a", "b"] = "a"
    sizes: tuple[int, ...] = (1, 2)
    limit: float | None = None


@dataclasses.dataclass(frozen=True)
class Outer:
    inner: Inner = dataclasses.field(default_factory=Inner)
    rate: float = 0.5
    count: int = 3


def test_what_gets_its_name_is_on_the_disk_before_and_the_name_after(tmp_path, monkeypatch):
    happened = []
    fsync = os.fsync
    rename = os.replace
    monkeypatch.setattr(os, "fsync", lambda of: (happened.append(os.fstat(of).st_ino), fsync(of)))
    monkeypatch.setattr(os, "replace", lambda *paths: (happened.append("renamed"), rename(*paths)))
    with replacing(tmp_path / "run") as partial:
        partial.mkdir()
        (partial / "weights").write_bytes(b"1")
    inodes = [path.stat().st_ino for path in (tmp_path / "run", tmp_path / "run" / "weights")]
    assert set(happened[:2]) == set(inodes) and happened[2:] == ["renamed", tmp_path.stat().st_ino]


def test_settings_round_trip_and_are_strict():
    settings = Outer(Inner("b", (4,), 2.0), 1.0, 7)
    assert from_plain(Outer, to_plain(settings)) == settings
    for wrong, message in (
        (
            {"inner": {"kinds": "a"}},
            r"settings\.inner has the unknown key 'kinds'; did you mean kind",
        ),
        ({"inner": {"kind": "c"}}, r"settings\.inner\.kind is 'c'; expected one of 'a', 'b'"),
        ({"count": 2.5}, r"settings\.count is 2\.5; expected a whole number"),
    ):
        with pytest.raises(UserError, match=message):
            from_plain(Outer, wrong)


def test_metrics_survive_a_kill_and_are_cut_to_the_resumed_update(tmp_path):
    writer = MetricsWriter(tmp_path, tensorboard=False)
    for update in range(1, 6):
        writer.write(
            "train", update, update * 10, 0.1, {"loss": float("nan") if update == 2 else update}
        )
    # No close: the file must already hold everything. Then a write that a kill cut
    # short.
    with open(tmp_path / "metrics.jsonl", "ab") as file:
        file.write(b'{"event": "train", "upd')
    assert [r["loss"] for r in read_metrics(tmp_path / "metrics.jsonl")] == [1, None, 3, 4, 5]
    told = []
    MetricsWriter(tmp_path, Continuation(3), tensorboard=False, on_record=told.append).write(
        "train", 4, 40, 0.1, {"loss": 40}
    )
    assert told == [{"event": "train", "update": 4, "steps": 40, "seconds": 0.1, "loss": 40}]
    assert [r["loss"] for r in read_metrics(tmp_path / "metrics.jsonl")] == [1, None, 3, 40]


def test_policy_file_round_trip(tmp_path):
    parameters = {"actor": {"kernel": jnp.linspace(0, 1, 6).reshape(2, 3)}, "count": jnp.int32(3)}
    path = tmp_path / "policy.npz"
    save_policy_file(path, parameters, Outer(), {"steps": 5})
    leaves, settings, notes = load_policy_file(path)
    restored = fill(parameters, leaves, str(path))
    np.testing.assert_allclose(
        restored["actor"]["kernel"], parameters["actor"]["kernel"], atol=5e-4
    )
    assert restored["actor"]["kernel"].dtype == jnp.float32 and int(restored["count"]) == 3
    assert from_plain(Outer, settings) == Outer() and notes == {"steps": 5}
    with pytest.raises(
        UserError, match=r"actor/kernel is \[2, 3\] there, its settings make it \[2, 4\]"
    ):
        fill({"actor": {"kernel": jnp.zeros((2, 4))}}, leaves, str(path))


def test_arrays_that_somebody_changed_are_refused(tmp_path):
    """A transposed matrix of the same shape, or leaves beside those that were written."""
    path = tmp_path / "policy.npz"
    save_policy_file(path, {"kernel": jnp.arange(4.0).reshape(2, 2)}, Outer())
    with np.load(path) as npz:
        arrays = dict(npz)
    for changed in ({"kernel": arrays["kernel"].T}, {"more": np.zeros(3)}):
        np.savez(tmp_path / "changed.npz", **(arrays | changed))
        with pytest.raises(UserError, match=r"aren't those that openjax\.train wrote"):
            load_policy_file(tmp_path / "changed.npz")
    # a file of before, which says nothing of its arrays, is still read
    header = json.loads(arrays["openjax.json"].tobytes())
    del header["digest"]
    plain = {"openjax.json": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    np.savez(path, **(arrays | plain))
    assert list(load_policy_file(path)[0]) == ["kernel"]


def test_pickle_is_refused_as_a_policy(tmp_path):
    path = tmp_path / "policy.npz"
    path.write_bytes(pickle.dumps({"actor": 1}))
    with pytest.raises(UserError, match="is no policy file"):
        load_policy_file(path)
    np.savez(path, **{"openjax.json": np.array([{"a": 1}], dtype=object)})
    with pytest.raises(UserError, match="is no policy file"):
        load_policy_file(path)


@pytest.fixture(scope="module")
def trajectory():
    steps = 40
    t = np.linspace(0, 1, steps)
    pursuers = np.stack(
        [np.stack([0.5 * np.cos(t + i), 0.5 * np.sin(t + i), 0.5 + 0 * t], -1) for i in range(3)], 1
    )
    captured = np.zeros((steps, 3), bool)
    captured[30:, 1] = True
    crashed = np.zeros((steps, 3), bool)
    crashed[32, 0] = True
    level = np.tile([1.0, 0.0, 0.0, 0.0], (steps, 3, 1))
    pillars = np.array([[0.2, 0.1]])
    return Trajectory(
        "wall",
        pursuers,
        level,
        pursuers[:, 0] * 0.5,
        captured,
        crashed,
        pillars,
        0.9,
        1.2,
        0.1,
        0.3,
        0.01,
    )


def test_animation_is_drawn_without_a_display(tmp_path, trajectory, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    longer = dataclasses.replace(
        trajectory, captured=np.zeros_like(trajectory.captured), time_step=0.04
    )
    animate(tmp_path / "chase.gif", [trajectory])
    animate(tmp_path / "both.gif", [trajectory, longer])
    with Image.open(tmp_path / "chase.gif") as one, Image.open(tmp_path / "both.gif") as both:
        assert (
            one.n_frames == 5 and both.n_frames == 20 and both.size == (one.width, 2 * one.height)
        )


def test_what_is_near_hides_what_is_far_and_all_stands_on_the_floor(trajectory):
    """By the pinhole camera's own formula: the evader's pixels are where its position
    is seen, unless a pillar is before it.
    """

    def red(flight):
        shown = np.asarray(draw(flight, 0)).astype(int)
        return np.argwhere((shown[..., 0] > 150) & (shown[..., 1:].max(axis=-1) < 60))[:, ::-1]

    def alone(place, pillar):
        away = np.full_like(trajectory.pursuer_position, -50.0)
        there = np.broadcast_to(place, trajectory.evader_position.shape)
        return dataclasses.replace(
            trajectory,
            pursuer_position=away,
            evader_position=there,
            pillar_position=np.array([pillar]),
        )

    towards = np.array([np.cos(AZIMUTH), np.sin(AZIMUTH)])  # away from the camera
    for place in ((0.0, 0.0, 0.4), (0.4, -0.5, 0.1), (-0.6, 0.2, 1.0)):
        seen = red(alone(place, place[:2] + 0.4 * towards))
        camera = np.array([0, 0, 0.38 * 1.2]) - DISTANCE * 0.9 * np.array(
            [*np.cos(ELEVATION) * towards, -np.sin(ELEVATION)]
        )
        ahead = (np.array([0, 0, 0.38 * 1.2]) - camera) / (DISTANCE * 0.9)
        right = np.cross(ahead, (0, 0, 1)) / np.linalg.norm(np.cross(ahead, (0, 0, 1)))
        off = np.array(place) - camera
        zoom = HEIGHT / 2 / np.tan(OPENING / 2)
        at = zoom * np.array([off @ right, -off @ np.cross(right, ahead)]) / (off @ ahead)
        assert abs(seen.mean(axis=0) - at - (WIDTH / 2, HEIGHT / 2)).max() < 1.5
        assert len(red(alone(place, place[:2] - 0.2 * towards))) < len(seen) / 4


def test_animation_says_when_something_happened(trajectory):
    assert caption(trajectory, 29) == ("wall: 0.3 s", "")
    assert caption(trajectory, 40) == ("wall: 0.4 s", "caught at 0.3 s, crashed at 0.3 s")


def test_pictures_are_drawn(tmp_path, trajectory):
    writer = MetricsWriter(tmp_path)
    for update in range(3):
        writer.write(
            "train",
            update,
            update,
            0.0,
            {"capture_rate": 0.1 * update, "capture_step": float("nan")},
        )
    writer.close()
    plot_training(tmp_path / "training.png", tmp_path / "metrics.jsonl")
    plot_trajectories(tmp_path / "trajectories.png", [trajectory, trajectory])
    for name in ("training.png", "trajectories.png"):
        with Image.open(tmp_path / name) as image:
            assert len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)) > 10
    assert list((tmp_path / "tensorboard").iterdir())
