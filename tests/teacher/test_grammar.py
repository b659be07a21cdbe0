"""The grammar in the server's engine (xgrammar): the texts that it accepts and generates."""

import json
import subprocess
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from string import ascii_letters

import numpy as np
import pytest

from conf.schema import TeacherConfig
from teacher.grammar import OPENERS, build_grammar
from teacher.narrator import write_rationale
from teacher.numbers import lexicon
from teacher.predicates import extract_predicates
from teacher.validation.validator import count_words, validate_rationale
from tests.teacher import synthetic
from tests.user_errors import raises_user_error

PYTHON = Path(__file__).parents[2] / ".venv-vllm/bin/python"
ENGINE_SCRIPT = """
import json, sys
import numpy as np, xgrammar
def accepts(compiled, text):
    matcher = xgrammar.GrammarMatcher(compiled, terminate_without_stop_token=True)
    return matcher.accept_string(text) and matcher.is_terminated()
def sample(compiled, vocabulary, seed):
    rng, text = np.random.default_rng(seed), ""
    matcher = xgrammar.GrammarMatcher(compiled)
    mask = xgrammar.allocate_token_bitmask(1, len(vocabulary))
    while not matcher.is_terminated():
        matcher.fill_next_token_bitmask(mask)
        bits = np.unpackbits(mask.numpy().view(np.uint8), bitorder="little")
        token = int(rng.choice(np.flatnonzero(bits[: len(vocabulary)])))
        assert matcher.accept_token(token)
        text += vocabulary[token] if token < len(vocabulary) - 1 else ""
    return text
for line in sys.stdin:
    request = json.loads(line)
    vocabulary = request["pieces"] + ["<end>"]
    tokens = xgrammar.TokenizerInfo(vocabulary, stop_token_ids=[len(vocabulary) - 1])
    compiled = xgrammar.GrammarCompiler(tokens).compile_grammar(request["grammar"])
    accepted = [accepts(compiled, text) for text in request["texts"]]
    sampled = [sample(compiled, vocabulary, seed) for seed in request["seeds"]]
    print(json.dumps([accepted, sampled]), flush=True)
"""
DEFAULT = TeacherConfig(name="test")
NUMBERS = (*lexicon.CARDINALS, *lexicon.ORDINALS, *lexicon.QUANTITIES, *lexicon.TIMES)
PIECES = (
    *ascii_letters,
    *" .,;:'-\n0\u00e9*",
    *(f" {word}" for word in NUMBERS),
    *(word[:cut] for word in (*NUMBERS, "one", "first", "once") for cut in (2, 3)),
    *(word[cut:] for word in (*NUMBERS, "one", "first", "once") for cut in (2, 3) if word[cut:]),
    *(f" {word}" for word in ("the", "cube", "once", "one", "Candidate", "struck", "A", "B", "C")),
    *(".\n", "Motion", " analysis", "Outcome", "Answer", ": "),
)


RunEngine = Callable[..., tuple[list[bool], list[str]]]


@pytest.fixture(scope="module")
def run_engine() -> Iterator[RunEngine]:
    """Returns which texts the engine accepts, and samples of texts made of random tokens."""
    with subprocess.Popen(
        [str(PYTHON), "-c", ENGINE_SCRIPT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as engine:

        def run(cfg: TeacherConfig, texts: list[str], samples: int = 0):
            request = {
                "grammar": build_grammar(cfg),
                "texts": texts,
                "pieces": sorted(set(PIECES)),
                "seeds": list(range(samples)),
            }
            engine.stdin.write(json.dumps(request) + "\n")
            engine.stdin.flush()
            return json.loads(engine.stdout.readline())

        yield run
        engine.stdin.close()


@cache
def rationales() -> list[str]:
    """Valid rationales of synthetic scenes by the built-in narrator."""
    rng, texts = np.random.default_rng(0), []
    while len(texts) < 60:
        scene = synthetic.random_scene(rng)
        item = synthetic.item((60, 80, 100, 120), answer=len(texts) % 4)
        predicates = extract_predicates(item, scene, lambda _, scene=scene: scene)
        if predicates is None:
            continue
        text = write_rationale(predicates, item, seed=0)
        if validate_rationale(text, predicates, item, DEFAULT).accepted:
            texts.append(text)
    return texts


def make_text(count: int, word: str = "near") -> str:
    """A text of `count` words in the form of a rationale, most of them `word`."""
    head = (
        "Scene parse: The red cube is near the top.\nMotion analysis: The cube rests there.\n"
        "Prediction: The cube rests there.\nCandidate analysis: Candidate A agrees well, and "
        "candidate B does not. Candidates C and A differ; candidate D's cube is missing.\n"
        "Outcome: The cube stays"
    )
    missing = count - count_words(head) - 2
    return head + f" {word}" * missing + ".\nAnswer: A"


BROKEN = {
    "a digit": lambda t: t.replace(" the ", " the 2 ", 1),
    "a digit within a word": lambda t: t.replace(" the ", " the2 ", 1),
    "another script": lambda t: t.replace(" the ", " т\u043bе ", 1),
    "an accent": lambda t: t.replace(" the ", " caf\u00e9 ", 1),
    "markup": lambda t: t.replace(" the ", " **the** ", 1),
    "brackets": lambda t: t.replace(" the ", " (the) ", 1),
    "a capital within a word": lambda t: t.replace(" the ", " thE ", 1),
    "an endless word": lambda t: t.replace(" the ", f" {'a' * 40} ", 1),
    "a lone letter": lambda t: t.replace(" the ", " x ", 1),
    "text before": lambda t: "Well. " + t,
    "text after": lambda t: t + "\n",
    "no letter": lambda t: t[:-1],
    "a wrong letter": lambda t: t[:-1] + "E",
    "no answer": lambda t: t[: t.rindex("\n")],
    "an empty line": lambda t: t.replace("\n", "\n\n", 1),
    "a missing section": lambda t: t.replace("\nPrediction:", "", 1),
    "sections out of order": lambda t: t.replace("Prediction:", "Outcome:", 1),
    "no full stop": lambda t: t.replace(".\nPrediction", "\nPrediction", 1),
    "no colon": lambda t: t.replace("\nPrediction:", "\nPrediction", 1),
    "a missing candidate": lambda t: t.replace("andidate D", "andidate A"),
    "a dangling once": lambda t: t.replace(" the ", " once red ", 1),
}


@pytest.mark.slow
def test_rationales_of_the_narrator_are_accepted(run_engine: RunEngine):
    texts = [*rationales(), make_text(150)]
    assert run_engine(DEFAULT, texts)[0] == [True] * len(texts)


@pytest.mark.slow
def test_broken_form_is_rejected(run_engine: RunEngine):
    whole = [*rationales()[:5], make_text(150).replace("rests", "rests at the side", 1)]
    texts = {
        (name, k): spoil(text) for name, spoil in BROKEN.items() for k, text in enumerate(whole)
    }
    spoilt = {key: text for key, text in texts.items() if text != whole[key[1]]}
    assert {name for name, _ in spoilt} == set(BROKEN)
    accepted = run_engine(DEFAULT, list(spoilt.values()))[0]
    assert [key for key, taken in zip(spoilt, accepted, strict=True) if taken] == []


@pytest.mark.slow
def test_number_words_are_rejected_and_harmless_words_are_not(run_engine: RunEngine):
    numbers = {*NUMBERS, "one", "first", "few", "iv", "drei", "tenfold", "twofold", "thirties"}
    # No word may begin with a number word, or the server could only complete it to nonsense.
    numbers |= {f"{n}ness" for n in NUMBERS if n not in OPENERS}
    barred = sorted({form for n in numbers for form in (n, n.title(), f"near-{n}", f"{n}-like")})
    harmless = [
        *("tends", "tension", "often", "center", "central", "section", "secure", "wonder", "stone"),
        *("weight", "height", "freight", "bone", "done", "alone", "top-left", "North-West", "pair"),
        *("cube's", "cubes'", "doesn't", "both", "between", "other", "another", "once struck", "a"),
    ]
    texts = [make_text(150, word) for word in (*barred, *harmless[:-2])]
    texts += [make_text(150).replace("stays", f"stays {word}") for word in harmless[-2:]]
    accepted = run_engine(DEFAULT, texts)[0]
    taken = [w for w, ok in zip((*barred, *harmless), accepted, strict=True) if ok]
    assert taken == harmless


@pytest.mark.slow
@pytest.mark.parametrize(("low", "high"), [(80, 250), (64, 64), (1, 70)])
def test_words_are_counted_like_in_the_validator(run_engine: RunEngine, low, high):
    counts = [n for n in range(60, 260) if abs(n - low) < 3 or abs(n - high) < 3]
    texts = [make_text(n) for n in counts]
    assert [count_words(t) for t in texts] == counts
    accepted = run_engine(TeacherConfig(name="test", min_words=low, max_words=high), texts)[0]
    assert accepted == [low <= n <= high for n in counts]


@pytest.mark.slow
def test_random_texts_have_the_form_and_hardly_any_number(run_engine: RunEngine):
    rng = np.random.default_rng(0)
    while True:
        scene, item = synthetic.random_scene(rng), synthetic.item((60, 80, 100, 120))
        predicates = extract_predicates(item, scene, lambda _, scene=scene: scene)
        if predicates is not None:
            break
    sampled = run_engine(DEFAULT, [], samples=40)[1]
    verdicts = [validate_rationale(text, predicates, item, DEFAULT) for text in sampled]
    # Random claims are seldom true.
    reasons = [
        r for v in verdicts for r in v.reasons if not r.startswith(("wrong answer", "contradicts"))
    ]
    assert {r.split(":")[0] for r in reasons} <= {"number"}
    # Number words with hyphens, in compounds or with doubled letters are left to the validator: a
    # few in 40 texts of 80 to 250 words that are made of pieces of number words.
    assert sum(any("number" in r for r in v.reasons) for v in verdicts) <= 8, reasons


def test_too_few_words_for_the_sections_are_reported():
    with raises_user_error("too-few-words", contains="max_words=30"):
        build_grammar(TeacherConfig(name="test", min_words=10, max_words=30))
