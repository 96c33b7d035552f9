"""Presets as YAML: only what differs from the defaults in `fieldfuse.config`."""
