"""Signals of a terminal: the foreground program records them, those that move a robot do not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from pronk.deploy.links.realtime import ENDING, TERMINAL, Interrupts, terminal_blocked


@pytest.mark.parametrize("number", ENDING)
def test_an_interrupt_waits_until_it_is_checked(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    interrupts = Interrupts()
    with interrupts:
        interrupts.check()
        for _ in range(2):
            os.kill(os.getpid(), number)
        with pytest.raises(KeyboardInterrupt):
            interrupts.check()
        interrupts.check()
    assert signal.getsignal(number) is before
    interrupts.__exit__(None, None, None)
    assert signal.getsignal(number) is before


def test_what_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupts() as interrupts:
            os.kill(os.getpid(), signal.SIGHUP)
            interrupts.check()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_another_thread_hears_nothing_and_changes_nothing() -> None:
    before = {number: signal.getsignal(number) for number in ENDING}
    unchanged: list[bool] = []

    def enter() -> None:
        with Interrupts() as interrupts:
            interrupts.check()
            unchanged.append({number: signal.getsignal(number) for number in ENDING} == before)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert unchanged == [True]


BORN = "import sys; print('up', flush=True); sys.stdin.readline(); print('alive', flush=True)"
LEFT = "from pronk.deploy.links.realtime import leave; leave();" + BORN


@pytest.mark.parametrize(("code", "blocked_at_start"), [(BORN, True), (LEFT, False)])
def test_a_process_that_moves_a_robot_outlives_its_terminal(
    code: str, blocked_at_start: bool
) -> None:
    def start() -> subprocess.Popen[str]:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        return subprocess.Popen([sys.executable, "-c", code], text=True, **pipes)

    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    if blocked_at_start:
        with terminal_blocked():
            process = start()
    else:
        process = start()
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
    with process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        leads_session = os.getsid(process.pid) == process.pid
        assert leads_session is not blocked_at_start
        for number in TERMINAL:
            process.send_signal(number)
        out, _ = process.communicate("\n")
        assert (out, process.returncode) == ("alive\n", 0)
