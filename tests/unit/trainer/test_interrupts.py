"""Deferred interrupts: the first Ctrl-C waits for the end of the block, a second one exits at once."""

import signal

import pytest

from embomatrix.trainer.lifecycle.interrupts import DeferredInterrupts, sigterm_as_ctrl_c


def interrupt():
    signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(("times", "is_whole"), [(1, True), (2, False)])
def test_first_ctrl_c_is_deferred_and_the_second_is_immediate(times, is_whole):
    done = []

    def whole():
        with DeferredInterrupts() as interrupts:
            interrupts.defer()
            for _ in range(times):
                interrupt()
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        whole()
    assert bool(done) is is_whole


@pytest.mark.parametrize("ctrl_c", [signal.default_int_handler, signal.SIG_IGN])
def test_sigterm_counts_as_ctrl_c_within_the_block(ctrl_c):
    before, usual = signal.getsignal(signal.SIGTERM), signal.signal(signal.SIGINT, ctrl_c)
    done = []

    def ended():
        with sigterm_as_ctrl_c(), DeferredInterrupts() as interrupts:
            interrupts.defer()
            signal.raise_signal(signal.SIGTERM)
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        ended()
    assert done
    assert signal.getsignal(signal.SIGTERM) is before
    assert signal.signal(signal.SIGINT, usual) is ctrl_c


def test_interrupts_are_deferred_only_inside_the_block():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), DeferredInterrupts():
        interrupt()
    with DeferredInterrupts() as interrupts:
        interrupts.defer()
    assert signal.getsignal(signal.SIGINT) is before


def test_deferred_interrupt_does_not_hide_an_error():
    def spoilt():
        with DeferredInterrupts() as interrupts:
            interrupts.defer()
            interrupt()
            raise ValueError("spoilt")

    with pytest.raises(ValueError, match="spoilt"):
        spoilt()
    with pytest.raises(KeyboardInterrupt):
        interrupt()
