"""Settings and ranges of the tests in which hypothesis searches for the worst."""

from __future__ import annotations

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

QUICK = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
FEW = settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
KEYS = st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.integers(-3, 3))
