"""An interrupt waits for the end of what is put off, a second one does not."""

import signal

import pytest

from embomatrix.trainer.lifecycle.interrupts import DeferredInterrupts


def interrupt():
    signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(("times", "is_whole"), [(1, True), (2, False)])
def test_one_interrupt_comes_at_the_end_and_a_second_one_at_once(times, is_whole):
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


def test_nothing_is_put_off_before_it_is_said_nor_afterwards():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), DeferredInterrupts():
        interrupt()
    with DeferredInterrupts() as interrupts:
        interrupts.defer()
    assert signal.getsignal(signal.SIGINT) is before


def test_an_error_that_ends_the_whole_is_not_hidden_by_an_interrupt():
    def spoilt():
        with DeferredInterrupts() as interrupts:
            interrupts.defer()
            interrupt()
            raise ValueError("spoilt")

    with pytest.raises(ValueError, match="spoilt"):
        spoilt()
    with pytest.raises(KeyboardInterrupt):
        interrupt()
