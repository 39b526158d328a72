"""The game with a vehicle: an airframe brings its own family along."""

import dataclasses

import pytest

from openjax.learning import preset
from openjax.store.environments import make_environment, with_airframe
from openjax.vehicle import load_vehicle
from openjax.vehicle.family import vehicle_family


def test_an_airframe_by_name_or_by_file_comes_with_its_family(tmp_path):
    flight = preset("flight").environment
    file = tmp_path / "vehicle.toml"
    file.write_text('[vehicle]\nairframe = "brushless"\nmass = 0.041\n')
    for vehicle, mass in (("brushless", float(load_vehicle("brushless").mass)), (file, 0.041)):
        game = make_environment(flight, vehicle, None)
        assert game.settings.airframe == "brushless"
        assert game.settings.vehicles == vehicle_family("brushless") != flight.vehicles
        assert float(game.vehicle.mass) == pytest.approx(mass)
    # a family of one's own stays
    own = dataclasses.replace(flight, vehicles=flight.vehicles[:1])
    assert with_airframe(own, "brushless").vehicles == own.vehicles
    assert with_airframe(flight, None) is flight
