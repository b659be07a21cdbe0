"""Tasks of lmms-eval. `python -m dynapix.integrations.lmms` prints their folder, for its option
`--include_path`."""
