"""Nothing comes between the loop and its moment, and everything is as before afterwards."""

from __future__ import annotations

import gc
import os
import sys

import pytest

from surefoot.deploy.pacer import undisturbed


def test_nothing_is_collected_while_it_lasts():
    before = sys.getswitchinterval()
    with undisturbed():
        assert not gc.isenabled()
        assert sys.getswitchinterval() < before
    assert gc.isenabled()
    assert sys.getswitchinterval() == pytest.approx(before)


def test_it_ends_also_when_something_breaks():
    def broken() -> None:
        with undisturbed():
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        broken()
    assert gc.isenabled()
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_without_the_right_it_does_with_less(monkeypatch):
    def refused(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    monkeypatch.setattr(os, "setpriority", refused)
    with undisturbed():
        assert not gc.isenabled()
    assert gc.isenabled()
