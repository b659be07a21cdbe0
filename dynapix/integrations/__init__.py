"""DynaPix in the evaluation harnesses of others; each module needs its harness.

Reading and showing a benchmark needs no more than `import dynapix` does, so that a harness can have
an environment of its own.
"""
