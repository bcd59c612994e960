"""A signal that asks a process to end interrupts it as ctrl+c does, once, where Python can be interrupted."""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import time

import pytest

from ssa_nerfstudio._system import termination

EACH = pytest.mark.parametrize("number", termination.SIGNALS)


def send(number: int) -> None:
    os.kill(os.getpid(), number)


def ended_by(error: BaseException) -> int:
    """The signal that a block ended by."""
    return error.code - 128 if isinstance(error, SystemExit) and isinstance(error.code, int) else signal.SIGINT


def wait() -> None:
    """Until the test's time is over, unless interrupted."""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        time.sleep(0.01)


@EACH
def test_what_cleans_up_after_an_interrupt_is_done_whatever_else_comes(number):
    done, former = [], signal.getsignal(number)
    with pytest.raises(SystemExit) as end, termination.as_ctrl_c():  # noqa: PT012 - the block is the test
        try:
            send(number)
            wait()
        finally:
            send(number)
            send(signal.SIGTERM)
            time.sleep(0.01)
            done.append("cleaned up")
    assert end.value.code == 128 + number
    assert done == ["cleaned up"]
    assert signal.getsignal(number) is former


@EACH
@pytest.mark.parametrize("error", [SystemExit(130), RuntimeError("of an interrupted library"), None])
def test_the_exit_code_names_the_signal_whatever_becomes_of_the_interrupt(number, error):
    with pytest.raises(SystemExit) as end, termination.as_ctrl_c():  # noqa: PT012
        try:
            send(number)
            wait()
        except KeyboardInterrupt:
            if error is not None:
                raise error from None
    assert end.value.code == 128 + number


def test_ctrl_c_stays_what_it_is():
    with pytest.raises(KeyboardInterrupt), termination.as_ctrl_c():  # noqa: PT012
        send(signal.SIGINT)
        wait()


@EACH
def test_a_signal_that_is_ignored_stays_so(number):
    """As after `nohup`."""
    former = signal.signal(number, signal.SIG_IGN)
    try:
        with termination.as_ctrl_c():
            send(number)
    finally:
        signal.signal(number, former)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_import_is_not_interrupted(number, tmp_path, monkeypatch):
    name = f"imported_to_the_end_of_{int(number)}"
    (tmp_path / f"{name}.py").write_text(f"import os, time; os.kill(os.getpid(), {int(number)}); time.sleep(0.2)")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(BaseException) as end, termination.as_ctrl_c():  # noqa: PT011, PT012
        importlib.import_module(name)
        wait()
    assert sys.modules.pop(name, None) is not None, "was interrupted"
    assert ended_by(end.value) == number


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_python_drops_comes_again(number, capsys):
    class Ended:
        def __del__(self) -> None:
            send(number)
            time.sleep(0.01)

    with pytest.raises(BaseException) as end, termination.as_ctrl_c():  # noqa: PT011, PT012
        Ended()
        wait()
    assert ended_by(end.value) == number
    assert capsys.readouterr().err == ""


def test_elsewhere_than_in_the_main_thread_nothing_changes():
    former, seen = signal.getsignal(signal.SIGTERM), []

    def run() -> None:
        with termination.as_ctrl_c():
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [former]
