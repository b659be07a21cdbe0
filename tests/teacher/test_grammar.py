"""The texts that the grammar of rationales accepts in xgrammar, the grammar engine of vLLM."""

import pytest

from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.sections import GRAMMAR
from tests.teacher.test_predicates import random_cases

BROKEN = {
    "a digit": lambda t: t.replace(" the ", " the 2 ", 1),
    "a digit within a word": lambda t: t.replace(" the ", " the2 ", 1),
    "another script": lambda t: t.replace(" the ", " т\u043bе ", 1),
    "markup": lambda t: t.replace(" the ", " **the** ", 1),
    "brackets": lambda t: t.replace(" the ", " (the) ", 1),
    "text before": lambda t: "Well. " + t,
    "text after": lambda t: t + "\n",
    "a wrong letter": lambda t: t[:-1] + "E",
    "no answer": lambda t: t[: t.rindex("\n")],
    "an empty line": lambda t: t.replace("\n", "\n\n", 1),
    "a missing heading": lambda t: t.replace("\nPrediction:", "", 1),
    "a heading of another section": lambda t: t.replace("Prediction:", "Outcome:", 1),
    "no full stop": lambda t: t.replace(".\nPrediction", "\nPrediction", 1),
    "a missing candidate": lambda t: t.replace("andidate D", "andidate A"),
}


@pytest.fixture(scope="module")
def accepts():
    """A function that returns whether the grammar accepts a text."""
    import xgrammar  # It imports torch, which takes longer than these tests.

    tokens = xgrammar.TokenizerInfo(["<end>"], stop_token_ids=[0])
    grammar = xgrammar.GrammarCompiler(tokens).compile_grammar(GRAMMAR)

    def accepts(text: str) -> bool:
        matcher = xgrammar.GrammarMatcher(grammar, terminate_without_stop_token=True)
        return matcher.accept_string(text) and matcher.is_terminated()

    return accepts


def test_rationales_of_the_narrator_are_accepted(accepts):
    for item, predicates in random_cases(60):
        assert accepts(write_rationale(predicates, item, seed=0))


@pytest.mark.parametrize("flaw", BROKEN)
def test_broken_form_is_rejected(accepts, flaw):
    changed = 0
    for item, predicates in random_cases(20):
        valid = write_rationale(predicates, item, seed=0)
        text = BROKEN[flaw](valid)
        assert text == valid or not accepts(text)
        changed += text != valid
    assert changed
