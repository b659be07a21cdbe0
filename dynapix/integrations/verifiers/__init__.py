"""Tasksets of verifiers. `python -m dynapix.integrations.verifiers` prints their folder, which
belongs into PYTHONPATH."""
