"""Hard cases: each kernel against a slow float64 reference, where numbers usually break. `fieldfuse selftest` and pytest run the same."""
