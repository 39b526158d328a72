"""Signals at any moment of a command: it ends by one line, and leaves no file half
written.
"""

import os
import signal
import subprocess
import sys

import pytest

STUCK = """
import ctypes, signal, sys, types
from pathlib import Path
import openjax.__main__ as program
from openjax import interruption
from openjax.files import replacing
from openjax.interruption import StopRequest

def compile():  # what never ends, and never comes back to Python: C that waits for a lock it holds
    lock = ctypes.create_string_buffer(64)
    take = ctypes.CDLL(None).pthread_mutex_lock
    take(lock)
    print("now", flush=True)
    take(lock)

def importing(folder):
    sys.path.insert(0, str(folder))
    (folder / "heavy.py").write_text("from __main__ import compile\\ncompile()\\n")
    import heavy

def writing(folder):
    with replacing(folder / "file") as file, replacing(folder / "report") as report:
        file.write_text("half")
        report.mkdir()
        (report / "page").write_text("half")
        compile()

def compiling(folder):
    with StopRequest(), interruption.last_words(lambda: "saved at update 3"):
        compile()

def tracing(folder):
    import jax
    def forever(x):
        print("now", flush=True)
        while True:
            pass
    with StopRequest(), interruption.last_words(lambda: "saved at update 3"):
        jax.jit(forever)(1.0)

def tracing_behind(folder):  # as a validation is, or a last stage, while updates are learnt
    import jax
    from openjax.background import in_background
    def forever(x):
        print("now", flush=True)
        while True:
            pass
    ready = in_background(lambda: jax.jit(forever).lower(1.0))
    with StopRequest() as stop, stop.while_learning(), stop.while_compiling():
        ready()

def waiting_for_a_program(folder):
    with StopRequest() as stop, stop.while_learning(), stop.while_compiling():
        compile()

def learning(folder):
    with StopRequest() as stop, stop.while_learning():
        print("now", flush=True)
        while stop.name is None:
            pass
    print(f"{stop.name}: saved", file=sys.stderr)

def learning_for_ever(folder):
    with StopRequest() as stop, stop.while_learning():
        compile()

def tidying(folder):
    with interruption.clean_up((folder / "tidied").touch):
        compile()

def hanging(folder):
    interruption.PATIENCE = 0.1
    with interruption.clean_up(lambda: compile()):
        compile()

# as in a terminal: a shell lets what it runs in the background ignore Ctrl-C
signal.signal(signal.SIGINT, signal.default_int_handler)
moment = globals()[sys.argv[1]]
fake = types.SimpleNamespace(main=lambda arguments: moment(Path(arguments[0])))
sys.modules["openjax.commands.train"] = fake
sys.argv[1:] = sys.argv[2:]
program.entry("train")
"""
"""Each function a moment of a command; it gets an empty folder."""


def stopped(moment, folder, *numbers):
    """Exit status and standard error of a command that gets signals at a moment."""
    command = [sys.executable, "-c", STUCK, moment, str(folder)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )
    try:
        assert process.stdout.readline() == "now\n", process.stderr.read()
        for number in numbers:
            process.send_signal(number)
        _, error = process.communicate(timeout=120)
    finally:
        process.kill()
    return process.returncode, error


@pytest.mark.parametrize(
    "moment, line",
    [
        ("importing", "stopped"),
        ("writing", "stopped"),
        ("compiling", "saved at update 3"),
        ("tracing", "saved at update 3"),
        ("tracing_behind", "stopped"),
        ("waiting_for_a_program", "stopped"),
        ("hanging", "stopped"),
    ],
)
def test_a_command_in_a_compiler_that_never_ends_is_over_by_one_line(moment, line, tmp_path):
    assert stopped(moment, tmp_path, signal.SIGTERM) == (143, f"SIGTERM: {line}\n")
    left = {path.name for path in tmp_path.iterdir()} - {"heavy.py", "__pycache__"}
    assert left == set()


def test_ctrl_c_ends_a_command_too_after_it_has_tidied(tmp_path):
    assert stopped("tidying", tmp_path, signal.SIGINT) == (130, "SIGINT: stopped\n")
    assert (tmp_path / "tidied").exists()


def test_what_is_learning_saves_first(tmp_path):
    assert stopped("learning", tmp_path, signal.SIGTERM) == (0, "SIGTERM: saved\n")


def test_a_second_signal_doesnt_wait_for_what_is_learning(tmp_path):
    status, line = stopped("learning_for_ever", tmp_path, signal.SIGTERM, signal.SIGINT)
    assert status in (130, 143) and line.endswith(": stopped\n") and line.count("\n") == 1
