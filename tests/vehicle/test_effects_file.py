"""effects.toml: what is written is read back, and anything strange is refused with what
would be right.
"""

import numpy as np
import pytest

from openjax.errors import UserError
from openjax.vehicle.effects import EFFECTS, load_effects, save_effects
from openjax.vehicle.effects.effects_file import load_intervals, unusual_values
from tests.vehicle.typical import typical


def test_everything_comes_back(tmp_path):
    path = tmp_path / "effects.toml"
    written = {name: typical(effect) for name, effect in EFFECTS.items()}
    save_effects(
        path, written, intervals={"rotor_drag": {"d_xy": (0.01, 0.03)}}, notes="three flights"
    )
    names, read = load_effects(path)
    assert names == tuple(sorted(EFFECTS)) and read == written
    text = path.read_text()
    assert 'unit = "N s/m"' in text and "interval90 = [0.01, 0.03]" in text
    assert [file.name for file in tmp_path.iterdir()] == ["effects.toml"]


def test_bare_numbers_and_missing_parameters(tmp_path):
    path = tmp_path / "effects.toml"
    path.write_text('notes = "by hand"\n[wind]\nx = 1\ndrag = 0.01\n[yaw_torque]\n')
    assert load_effects(path) == (
        ("wind", "yaw_torque"),
        {"wind": {"x": 1.0, "drag": 0.01}, "yaw_torque": {}},
    )


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[drag]\nd = 1\n", "effect 'drag' is unknown"),
        ("rotor_drag = 1\n", "must be a table"),
        ("[rotor_drag]\nd = 1\n", "no parameter 'd'"),
        ('[rotor_drag]\nd_xy = { value = 1, unit = "g" }\n', "'N s/m' would be right"),
        (
            "[rotor_drag]\nd_xy = { value = 1, interval = [0, 1] }\n",
            "unknown key 'interval'; did you mean interval90",
        ),
        ('[rotor_drag]\nd_xy = "0.01"\n', "expected a number"),
        ("[rotor_drag]\nd_xy = nan\n", "expected a finite number"),
        ("[rotor_drag]\nd_xy = {}\n", "lacks value"),
        (
            "[rotor_drag]\nd_xy = { value = 0.03, interval90 = [0.01, 0.02] }\n",
            "lies outside its interval90",
        ),
        ("[rotor_drag]\nd_xy = 1e30\n", "far from what occurs"),
        ("x = " + "[" * 5000 + "]" * 5000, "nested more than"),
        ("[rotor_drag\n", "not readable as TOML"),
    ],
)
def test_strange_files_are_refused(tmp_path, text, reason):
    path = tmp_path / "effects.toml"
    path.write_text(text)
    with pytest.raises(UserError, match=reason) as error:
        load_effects(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_nothing_is_written_for_strangers(tmp_path):
    path = tmp_path / "effects.toml"
    for strange in ({"drag": {}}, {"wind": {"speed": 1.0}}):
        with pytest.raises(UserError):
            save_effects(path, strange)
    with pytest.raises(UserError, match="no such effects file"):
        load_effects(path)


BOUNDED = [
    (name, key)
    for name, effect in EFFECTS.items()
    for key, parameter in effect.parameters.items()
    if np.isfinite(parameter.limits()[0])
]


def test_what_no_vehicle_has_is_bounded():
    """Moments of inertia, lags, delays, ratios, drags: where a fit's error may leave
    the domain.
    """
    named = {f"{name}.{key}" for name, key in BOUNDED}
    assert {f"inertia.{axis}" for axis in ("xx", "yy", "zz")} <= named
    assert {"motor_lag.extra_up", "motor_lag.extra_down", "yaw_torque.ratio"} <= named
    assert {"command_latency.delay", "state_latency.delay", "packet_loss.probability"} <= named
    assert {"mass.extra", "thrust_scale.scale", "rotor_drag.d_xy", "rate_gains.p"} <= named
    for effect in EFFECTS.values():
        for parameter in effect.parameters.values():
            low, high = parameter.limits()
            assert low <= min(parameter.none, *parameter.prior)
            assert max(parameter.none, *parameter.prior) <= high


@pytest.mark.parametrize(("name", "key"), BOUNDED)
@pytest.mark.parametrize("where", ["value", "interval90"])
def test_what_no_vehicle_has_is_refused_in_one_line(name, key, where, tmp_path):
    """By whatever reads an effects file: training, adapting, evaluating."""
    parameter = EFFECTS[name].parameters[key]
    least = parameter.limits()[0]
    below = least - 0.5 * (parameter.prior[1] - parameter.prior[0])
    usual = parameter.prior[1]
    entry = (
        f"value = {below}"
        if where == "value"
        else f"value = {usual}, interval90 = [{below}, {usual}]"
    )
    path = tmp_path / "effects.toml"
    path.write_text(f"[{name}]\n{key} = {{ {entry} }}\n")
    for read in (load_effects, load_intervals):
        with pytest.raises(UserError, match="can't be; it lies between") as caught:
            read(path)
        assert "\n" not in str(caught.value) and f"{name}.{key}" in str(caught.value)
    path.write_text(f"[{name}]\n{key} = {{ value = {usual}, interval90 = [{least}, {usual}] }}\n")
    assert load_intervals(path)[name][key] == (least, usual)


def test_the_folder_of_a_diagnosis_is_answered_with_the_file_in_it(tmp_path):
    (tmp_path / "effects.toml").write_text("")
    with pytest.raises(UserError, match="is one, such as effects"):
        load_effects(tmp_path)


def test_a_value_far_beyond_what_is_usual_is_warned_of(tmp_path):
    """A larger vehicle may have it, and a wrong unit, too."""
    path = tmp_path / "effects.toml"
    path.write_text("[rotor_drag]\nd_xy = 0.5\nd_z = 0.01\n[inertia]\nxx = 1.4\n")
    (text,) = unusual_values(path)
    assert "rotor_drag.d_xy = 0.5 N s/m is more than 3 times what is usual" in text
