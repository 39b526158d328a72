"""The six layouts, and a user's own with everything that can be wrong about it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.pursuit import SCENARIOS, PursuitSettings, find_scenario, scenario_task
from openjax.pursuit.sensing import line_of_sight
from openjax.pursuit.task import starts_clear

NOMINAL = PursuitSettings()
ROOMY = PursuitSettings(max_pillars=6)
"""With slots for the pillars of each layout."""


def mirrored(x, y):
    return {(a, b) for a in {x, -x} for b in {y, -y}}


RIGHT = {(0.6, 0), (0.8, 0), (0.8, -0.2)}
TABLE = {  # pillars, pursuers, evader; all at a height of 0.5 m
    "wall": (mirrored(0, 0.15) | mirrored(0, 0.45), {(0.6, 0.4), (0.6, 0), (0.6, -0.4)}, (-0.8, 0)),
    "narrow_gap": (
        mirrored(0.3, 0.3) | {(0, 0.3)},
        {(0, 0.7), (0.2, 0.7), (-0.2, 0.7)},
        (-0.5, 0.2),
    ),
    "random": (
        {(0.6, 0.4), (-0.6, 0.4), (-0.2, 0.4), (0, 0.2), (-0.2, -0.4), (0, -0.2)},
        RIGHT,
        (-0.8, 0),
    ),
    "passage": (
        {(0, 0.3), (0.2, 0.3), (-0.2, 0.3), (0, -0.2), (0.2, -0.2), (-0.2, -0.2)},
        {(0.6, 0), (0.8, 0.2), (0.8, -0.2)},
        (0, 0.6),
    ),
    "empty": (set(), RIGHT, (-0.8, 0)),
    "hidden": ({(0, 0), (0, 0.2), (0, -0.2), (-0.4, 0.4), (-0.4, -0.4)}, RIGHT, (-0.8, 0)),
}


def start_of(name):
    return ROOMY, scenario_task(ROOMY, SCENARIOS[name])


@pytest.mark.parametrize("name", TABLE)
def test_layouts_are_those_of_the_table_and_start_clear(name):
    assert set(SCENARIOS) == set(TABLE)
    pillars, pursuers, evader = TABLE[name]
    settings, task = start_of(name)

    def rounded(points):
        return {
            tuple(float(x) for x in np.round(point, 6)) for point in np.asarray(points, np.float64)
        }

    assert rounded(np.asarray(task.pillar_position)[np.asarray(task.pillar_active)]) == rounded(
        [*map(list, pillars)]
    )
    assert int(task.pillar_active.sum()) == len(pillars)
    assert rounded(task.pursuer_position) == rounded([[*p, 0.5] for p in pursuers])
    np.testing.assert_allclose(task.evader_position, [*evader, 0.5], atol=1e-6)
    assert starts_clear(settings, task)


@pytest.mark.parametrize(("name", "seeing"), [("hidden", 0), ("random", 2), ("empty", 3)])
def test_how_many_see_the_evader_at_the_start(name, seeing):
    settings, task = start_of(name)
    sees = line_of_sight(
        settings,
        task.pursuer_position,
        task.evader_position,
        task.pillar_position,
        task.pillar_active,
    )
    assert int(sees.sum()) == seeing


def test_a_layout_needs_room_and_the_right_number_of_pursuers():
    with pytest.raises(UserError, match="6 pillars do not fit into 5 slots"):
        scenario_task(NOMINAL, SCENARIOS["random"])
    with pytest.raises(UserError, match="has 3 pursuers, the environment 4"):
        scenario_task(PursuitSettings(num_pursuers=4), SCENARIOS["wall"])


GOOD = """name = "two"
pillars = [[0.0, 0.0]]
pursuers = [[0.5, 0, 0.6], [0.5, 0.3, 0.6]]
evader = [-0.5, 0.1, 0.7]
"""


def test_own_layout(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(GOOD)
    scenario = find_scenario(str(path), NOMINAL)
    assert scenario.name == "two"
    task = scenario_task(PursuitSettings(num_pursuers=2), scenario)
    assert task.pillar_active.sum() == 1
    np.testing.assert_allclose(task.evader_position, [-0.5, 0.1, 0.7], atol=1e-6)
    assert jax.tree.map(jnp.shape, task).pursuer_position == (2, 3)
    path.write_text("pursuers = [[0.5, 0.0, 0.6]]\nevader = [0.0, 0.0, 0.6]\n")
    bare = find_scenario(str(path), NOMINAL)
    assert bare.name == "own" and bare.pillars == ()
    assert not scenario_task(PursuitSettings(num_pursuers=1), bare).pillar_active.any()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "[[0.0, 0.0]]",
            "[[0.95, 0.0]]",
            r"pillar \(0.95, 0.0\) stands outside the arena of radius 0.9 m",
        ),
        (
            "[[0.0, 0.0]]",
            "[[0.45, 0.0]]",
            r"pillar \(0.45, 0.0\) stands over the start of pursuer 1",
        ),
        ("[[0.0, 0.0]]", "[[-0.5, 0.0]]", "stands over the start of the evader"),
        ("[[0.0, 0.0]]", "[[0.0, 0.0, 0.0]]", r"pillars.0. has 3 entries; expected 2"),
        ("[[0.0, 0.0]]", "3", "pillars is 3; expected a list"),
        ("[[0.0, 0.0]]", '[["a", "b"]]', "is 'a'; expected a number"),
        ("[[0.0, 0.0]]", "[[nan, 0.0]]", "is nan; expected a finite number"),
        ("[[0.0, 0.0]]", "[[0.0, 0.0]", "not readable as TOML"),
        ("pillars", "pillar", "unknown key 'pillar'; did you mean pillars"),
        ("pursuers = ", "name2 = ", "unknown key 'name2'; did you mean name"),
        ("pursuers = [[0.5, 0, 0.6], [0.5, 0.3, 0.6]]", "", "lacks pursuers"),
        ("[[0.5, 0, 0.6], [0.5, 0.3, 0.6]]", "[]", "has 0 pursuers; 1 to 8 are possible"),
        ("[0.5, 0, 0.6]", "[0.5, 0.25, 0.6]", "two pursuers start inside each other"),
        (
            "[0.5, 0, 0.6]",
            "[1.5, 0, 0.6]",
            "pursuer 1 starts at .* outside the arena of 0.9 m by 1.2 m",
        ),
        ("0.1, 0.7]", "0.1, 1.7]", "the evader starts at .* outside the arena"),
        ("evader = [-0.5, 0.1, 0.7]", "", "lacks evader"),
        ('"two"', '"two\\nlines"', "isn't a line of up to"),
    ],
)
def test_what_is_wrong_with_a_layout_is_said_in_one_line(tmp_path, old, new, message):
    path = tmp_path / "own.toml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(UserError, match=message) as error:
        find_scenario(str(path), NOMINAL)
    assert "\n" not in str(error.value) and "own.toml" in str(error.value)


def test_unknown_names_and_missing_files(tmp_path):
    with pytest.raises(UserError, match="no such layout"):
        find_scenario("walls", NOMINAL)
    with pytest.raises(UserError, match="no such layout"):
        find_scenario(str(tmp_path / "none.toml"), NOMINAL)
