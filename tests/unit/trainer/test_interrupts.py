"""An interrupt waits for the end of what is put off, a second one does not."""

import signal

import pytest

from embomatrix.trainer.interrupts import Interrupts


def interrupt():
    signal.raise_signal(signal.SIGINT)


def test_an_interrupt_that_is_put_off_comes_at_the_end():
    done = []

    def whole():
        with Interrupts() as interrupts:
            interrupts.put_off()
            interrupt()
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        whole()
    assert done


def test_a_second_interrupt_comes_at_once():
    done = []

    def whole():
        with Interrupts() as interrupts:
            interrupts.put_off()
            interrupt()
            interrupt()
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        whole()
    assert not done


def test_nothing_is_put_off_before_it_is_said_nor_afterwards():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), Interrupts():
        interrupt()
    with Interrupts() as interrupts:
        interrupts.put_off()
    assert signal.getsignal(signal.SIGINT) is before


def test_an_error_that_ends_the_whole_is_not_hidden_by_an_interrupt():
    def spoilt():
        with Interrupts() as interrupts:
            interrupts.put_off()
            interrupt()
            raise ValueError("spoilt")

    with pytest.raises(ValueError, match="spoilt"):
        spoilt()
    with pytest.raises(KeyboardInterrupt):
        interrupt()
