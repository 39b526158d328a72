"""`openjax diagnose` around the diagnosis: where reports go, faults of the machine, and
several vehicles beside each other.
"""

import dataclasses
import errno
import gc
import json

import pytest

from openjax.commands import sample_flights
from openjax.commands.diagnose import main
from openjax.errors import UserError
from openjax.gap.identification.quantities import Quantity
from openjax.gap.report.fleet import differences, fleet_in_words, member_of, page_of_fleet
from tests.gap.made_reports import identification, report


def linked(delay, error=0.001, **more):
    """A report of a vehicle whose commands are so many seconds late."""
    interval = (delay - 1.645 * error, delay + 1.645 * error)
    late = Quantity(delay, interval, 0.0, "s", "command_latency")
    return dataclasses.replace(report(**more), links={"command_latency.delay": late})


@pytest.fixture
def answers(monkeypatch):
    """What a folder's diagnosis answers, by the folder's name: a report, or an error or
    a call that takes its place.
    """
    found = {}

    def diagnosed(folder, *_):
        answer = found[folder.name]
        if isinstance(answer, Exception):
            raise answer
        return answer() if callable(answer) else answer

    monkeypatch.setattr("openjax.gap.folders.diagnose_folder", diagnosed)
    return found


def test_a_second_diagnosis_into_the_same_folder_is_refused(answers, tmp_path):
    arguments = ["flights/monday", "--out", str(tmp_path / "out"), "--no-html"]

    def meanwhile():
        with pytest.raises(UserError, match="another process is writing there"):
            main([*arguments, "--overwrite"])
        return report()

    answers["monday"] = meanwhile
    assert main(arguments) == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["monday"]
    # and with the first one gone nothing is in the way
    answers["monday"] = report()
    assert main([*arguments, "--overwrite"]) == 0


def test_faults_of_the_machine_are_no_faults_of_the_program(answers, tmp_path, capsys):
    answers["full"] = OSError(errno.ENOSPC, "No space left on device", "/somewhere")
    answers["broken"] = KeyError("what no check has foreseen")
    answers["good"] = report()
    out = tmp_path / "out"
    assert main(["full", "broken", "good", "--out", str(out), "--no-html"]) == 0
    full, broken = capsys.readouterr().err.splitlines()
    assert full == "error: full: /somewhere: no space left on device"
    assert broken.startswith("error: broken: KeyError") and "bug in openjax" in broken
    assert [path.name for path in out.iterdir()] == ["good"]
    # nothing diagnosed: nothing is left
    assert main(["full", "--out", str(tmp_path / "other"), "--no-html"]) == 2
    assert not (tmp_path / "other").exists()


def test_several_vehicles_end_with_one_page(answers, tmp_path, capsys):
    answers |= {"cf1": linked(0.004), "cf2": linked(0.005), "cf3": linked(0.018)}
    out = tmp_path / "out"
    arguments = ["cf1", "cf2", "cf3", "--out", str(out)]
    assert main(arguments) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "cf3 differs from the others: command latency delay 18 ms" in told
    data = json.loads((out / "vehicles.json").read_text())
    assert list(data["vehicles"]) == ["cf1", "cf2", "cf3"]
    assert [entry["vehicle"] for entry in data["differences"]] == ["cf3"]
    page = (out / "vehicles.html").read_text()
    assert all(f'href="{name}/report.html"' in page for name in data["vehicles"])
    assert page.count('class="odd"') == 1 and "http" not in page
    with pytest.raises(UserError, match="already exists"):
        main(["cf1", "cf2", "--out", str(out), "--no-html"])


def test_one_vehicle_has_no_page_beside_it(answers, tmp_path):
    answers["cf1"] = linked(0.004)
    assert main(["cf1", "--out", str(tmp_path), "--no-html"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["cf1"]


def test_vehicles_differ_by_more_than_errors():
    sharp = [member_of(name, linked(delay)) for name, delay in (("a", 0.004), ("b", 0.018))]
    assert fleet_in_words(sharp) == [
        "a and b differ, in this order: command latency delay 4 ms [2.36, 5.64] against 18 ms."
    ]
    blunt = [member_of(n, linked(d, 0.01)) for n, d in (("a", 0.004), ("b", 0.018))]
    assert differences(blunt) == []
    assert fleet_in_words(blunt) == ["No number of the 2 vehicles differs by more than its errors."]
    # motors of one that are slower show among three, whatever each one's own answer is
    lags = {"a": 0.025, "b": 0.049, "c": 0.026}
    three = [
        member_of(name, dataclasses.replace(report(), identification=identification(lag=lag)))
        for name, lag in lags.items()
    ]
    assert [d.vehicle for d in differences(three)] == ["b"]
    assert "c/report.html" in page_of_fleet(three)


@pytest.mark.slow
def test_diagnoses_in_one_process_leave_nothing_behind(tmp_path):
    sample_flights.main([str(tmp_path / "flights"), "--effect", "rotor_drag"])
    arguments = [str(tmp_path / "flights"), "--out", str(tmp_path / "out"), "--overwrite"]
    left = []
    for _ in range(5):
        assert main(arguments) == 0
        gc.collect()
        left.append(len(gc.get_objects()))
    # a figure that stays open is some thousand objects, a compiled program some hundred;
    # the first one loads and compiles, and memory itself goes up and down by a quarter
    assert max(left[2:]) - left[1] < 100, left
