"""Run directories: one process at a time, nothing foreign overwritten, a killed start
in nobody's way.
"""

import os
import signal
import subprocess
import sys

import pytest

from openjax.errors import UserError
from openjax.learning import preset
from openjax.store.run_directory import (
    EFFECTS_FILE,
    EVADER_FILE,
    VEHICLE_FILE,
    check_free,
    create_run,
    lock_run,
    open_run,
)

HOLD = """
import sys, time
from openjax.store.run_directory import lock_run
with lock_run(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_directory_is_for_one_process_until_it_ends_or_is_killed(tmp_path):
    run = tmp_path / "run"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(run)], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(UserError, match="another process trains"), lock_run(run):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.communicate()
    assert os.listdir(run) == ["run.lock"]  # which holds nobody up
    check_free(run, overwrite=False)
    with lock_run(run):
        with pytest.raises(UserError, match="another process trains"), lock_run(run):
            pass
        create_run(run, overwrite=False)
    assert os.listdir(run) == ["run.lock"]


def test_what_a_killed_start_left_is_taken_over_but_nothing_else(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    for name in ("vehicle.toml", ".writing-123-settings.json", "run.lock"):
        (run / name).write_text("")
    (run / "checkpoints").mkdir()
    check_free(run, overwrite=False)
    with pytest.raises(UserError, match="is no run"):
        open_run(run)
    create_run(run, overwrite=False)
    assert [path.name for path in run.iterdir()] == ["run.lock"]
    (run / "thesis.tex").write_text("")
    for overwrite in (False, True):
        with pytest.raises(UserError, match="holds files that aren't a run's"):
            check_free(run, overwrite)


def test_overwrite_replaces_the_run_and_keeps_foreign_files(tmp_path):
    run = create_run(tmp_path / "run", overwrite=False)
    run.write_settings({}, {})
    (run.checkpoints / "000000001").mkdir(parents=True)
    (run.path / "notes.txt").write_text("mine")
    # a resumed run would take up the old one's game
    for name in (VEHICLE_FILE, EFFECTS_FILE, EVADER_FILE):
        (run.path / name).write_text("")
    create_run(run.path, overwrite=True)
    assert [path.name for path in run.path.iterdir()] == ["notes.txt"]


def test_a_setting_that_nobody_knows_is_told(tmp_path):
    run = create_run(tmp_path, overwrite=False)
    run.write_settings(preset("quick"), {})
    text = run.settings_file.read_text()
    run.settings_file.write_text(text.replace('"observe_time"', '"observe_tide"'))
    with pytest.raises(UserError, match="unknown key 'observe_tide'"):
        run.read_settings()
