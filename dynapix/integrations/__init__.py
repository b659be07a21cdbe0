"""DynaPix in the evaluation harnesses of others; each module needs its harness.

Reading and showing a benchmark needs no more than `import dynapix` does, so that a harness can have
an environment of its own.
"""

from dynapix.models.student.responses import ANSWER_TOKENS

TOKENS = {"reasoning": 512, "answer": ANSWER_TOKENS}
"""Maximum numbers of tokens of a response by mode, the defaults of `evaluation.select`."""
