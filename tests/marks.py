"""Which of several cases a test has time for."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def slow_but(cases: Iterable[Any], *quick: Any) -> list[Any]:
    """All the cases for ``pytest.mark.parametrize``; those that are not among the quick ones run with ``-m slow``."""
    found = list(cases)
    assert set(quick) <= set(found), f"expected quick cases among {found}, got {quick}"
    return [case if case in quick else pytest.param(case, marks=pytest.mark.slow) for case in found]
