"""Faults planted one at a time, and whether the tests find them."""

from benchmarks.mutation.measure import app as app
from benchmarks.mutation.measure import table as table
