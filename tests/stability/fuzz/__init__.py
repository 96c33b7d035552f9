"""Damaged and hostile files for every reader: `python -m tests.stability fuzz`, and a short run among the tests."""
