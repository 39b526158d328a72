"""Files of earlier versions hold settings that are constants now."""

import pytest

from openjax.errors import UserError
from openjax.files import to_plain
from openjax.learning import TrainSettings
from openjax.learning.settings import MappoSettings
from openjax.plain import from_plain
from openjax.store.mixed_policies import as_trained
from openjax.store.policy_files import shipped_policies


def with_former(group, **values):
    plain = to_plain(TrainSettings())
    plain[group] |= values
    return plain


def test_a_former_setting_with_its_constants_value_is_ignored():
    plain = with_former("mappo", huber=MappoSettings.HUBER)
    plain["environment"]["evader_norm"] = "euclidean"
    plain["environment"]["reward"]["territory"] = 0
    plain["predictor"]["decay"] = True
    plain["evaders_validation"] = ["field", "heavy", "pillar_hugger"]
    # weights for teams of eight, and any of a stage that isn't there
    plain["analytic"]["breach"] = 5.3
    plain["first_flights"]["steps"] = 15
    assert from_plain(TrainSettings, plain) == TrainSettings()


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("mappo", "huber", 5.0),
        ("predictor", "loss", "squared"),
        ("predictor", "decay", 1),
        ("analytic", "speed", 2.0),
    ],
)
def test_a_former_setting_with_another_value_is_one_line(group, name, value):
    with pytest.raises(UserError, match=f"{group}.{name} is .* it is no longer a setting and"):
        from_plain(TrainSettings, with_former(group, **{name: value}), "a.json: ")


def test_what_never_was_a_setting_is_unknown():
    for name in ("former", "switch", "nonsense"):
        with pytest.raises(UserError, match=f"unknown key '{name}'"):
            from_plain(TrainSettings, with_former("mappo", **{name: 1.0}))


@pytest.mark.parametrize("name", shipped_policies())
def test_shipped_weights_load(name):
    settings, _ = as_trained(name)
    assert from_plain(TrainSettings, to_plain(settings)) == settings
