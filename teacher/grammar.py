"""Grammar for constrained decoding, which enforces the form of a rationale at the server.

It is stricter than the validator about form and numbers, because it cannot see the context of a
word. It ensures neither true claims nor the right letter, so rationales are still validated.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from string import ascii_lowercase

from conf.errors import UserError
from conf.schema import TeacherConfig
from data.records import LETTERS
from teacher.numbers import lexicon
from teacher.numbers.detection import WORDS
from teacher.sections import SECTIONS
from teacher.validation.validator import count_words

GRAMMAR_VERSION = "1"

Trie = dict[str, "Trie"]
State = tuple[bool, tuple[tuple[str, str], ...]]
"""Whether a word may end, and the rule that follows each letter."""
STEM, WHOLE = "stem", "whole"
"""Marks in a trie: a stem bars all words that begin with it, a whole word only itself."""
WORD_END = "(=[' ,;:.-])"
"""Lookahead for what follows letters. Without it the engine tries tens of thousands of tokens, such
as " fooBar", at every step of the compilation instead of once."""
MAX_TAIL = 16
"""Letters after the point at which a word differs from every number word, so that the words of a
model that repeats itself end. Rules are cheaper than a repeat count, which the engine evaluates at
every step."""
ANSWER_WORDS = count_words("Answer: A")

CONTEXTUAL = ("one", "once", "first", "minute", "frame", "pixel", "feet", "px")
"""Words that state a number in some contexts; a grammar sees no context and bars them."""
VAGUE = ("few", "several", "many", "multiple", "numerous", "countless", "handful", "lots")
"""Words of `lexicon.VAGUE` that a rationale does not need. The others are often harmless; the
plural units after them are barred instead."""
OPENERS = ("ten", "cent", "sec")
"""Number words that harmless words begin with ("tends", "center", "section")."""
TENS = (
    "twenties", "thirties", "forties", "fifties", "sixties", "seventies", "eighties", "nineties"
)  # fmt: skip
AFTER_ONCE = ("struck", "hit", "the", "it", "they", "this", "that", "contact", "moving")
"""Words before which "once" is a conjunction and not a number."""
ENDINGS = ("s", "t", "d", "re", "ve", "ll")


@dataclass(frozen=True)
class Segment:
    """A part of a rationale that opens with fixed text.

    Attributes:
        opening: The fixed text as GBNF.
        words: Words of the fixed text.
        least: Fewest words after it.
        after_stop: Whether a full stop precedes it.
    """

    opening: str
    words: int
    least: int
    after_stop: bool = True


def _section(name: str, least: int, then: str = "", words: int = 0) -> Segment:
    line = "" if name == SECTIONS[0] else r"\n"
    return Segment(f'"{line}{name}:"{then}', count_words(name) + words, least)


def _candidate(letter: str) -> Segment:
    return Segment(_named("[Cc]", letter), 2, 2, after_stop=False)


def _named(first: str, letter: str) -> str:
    return rf"""" " {first} "andidate" "s"? " {letter}" "'s"? [,;:]?"""


PARSE, MOTION, PREDICTION, ANALYSIS, OUTCOME = SECTIONS
SEGMENTS = (
    _section(PARSE, 6),
    _section(MOTION, 4),
    _section(PREDICTION, 4),
    _section(ANALYSIS, 2, then=_named("[C]", LETTERS[0]), words=2),
    *map(_candidate, LETTERS[1:]),
    _section(OUTCOME, 4),
)
"""Candidates come in the order of their letters: any order would need an automaton for every set of
letters and number of words."""
NAMES = ascii_lowercase[: len(SEGMENTS)]


def build_grammar(cfg: TeacherConfig) -> str:
    """GBNF of the texts that have the form of a rationale; it is the same for all items.

    The texts have every section, every candidate's letter, an answer at the end, `cfg.min_words` to
    `cfg.max_words` words, and no number word.

    Raises:
        UserError: The sections do not fit into `cfg.max_words` words.
    """
    fewest = sum(s.words + s.least for s in SEGMENTS) + ANSWER_WORDS
    if cfg.max_words < fewest:
        raise UserError(
            f"teacher.max_words={cfg.max_words} is too low for the sections that "
            f"teacher.grammar=true enforces: set at least {fewest}",
            code="too-few-words",
        )
    rules = [*_openings(), *_counts(cfg.min_words, cfg.max_words), *_words()]
    return "\n".join(rules) + "\n"


def _openings() -> list[str]:
    """Rules for each segment up to its last required word but one, and for the answer."""
    rules = [
        f"open-{name}::={segment.opening} least-{segment.least - 1}"
        for name, segment in zip(NAMES, SEGMENTS, strict=True)
    ]
    most = max(segment.least for segment in SEGMENTS)
    rules += ["least-1::=word", "least-2::=word word|once"]
    rules += [f"least-{n}::=word least-{n - 1}|once least-{n - 2}" for n in range(3, most)]
    return [*rules, rf'answer::="\nAnswer: " [{"".join(LETTERS)}]']


def _counts(low: int, high: int) -> list[str]:
    """Rules that count words: `c57` follows word 57 if that belongs to the third segment.

    There is a rule for every segment and count, but compiling and decoding stay fast, because the
    letters of words are in separate rules that all of these share.
    """
    needs = [segment.words + segment.least for segment in SEGMENTS]
    rules = [f"root::=open-{NAMES[0]} {NAMES[0]}{needs[0] - 1}"]
    for k, name in enumerate(NAMES):
        last = high - ANSWER_WORDS - sum(needs[k + 1 :])
        for n in range(sum(needs[: k + 1]) - 1, last):
            # Another word follows, which ends the segment or does not.
            follow = [f"word {name}{n + 1}"] if n + 1 < last else []
            follow += [f"once {name}{n + 2}"] if n + 2 < last else []
            if k + 1 < len(SEGMENTS):
                ender = "stop" if SEGMENTS[k + 1].after_stop else "word"
                then = NAMES[k + 1]
                follow.append(f"{ender} open-{then} {then}{n + needs[k + 1]}")
            elif n + 1 + ANSWER_WORDS >= low:
                follow.append("stop answer")
            rules.append(f"{name}{n}::={'|'.join(follow)}")
    return rules


def _words() -> list[str]:
    """Rules for a word with the space before it.

    A word is letters, of which only the first of a part may be a capital, in parts joined by
    hyphens, with an optional apostrophe; or a single letter, which is "a" or a candidate.
    """
    states: dict[State, str] = {}
    part = _state(_barred(), states)
    letters = f'([aA-{LETTERS[-1]}]|{part} ("-" {part}){{0,2}})'
    return [
        "word::=spelt [,;:.]? (=[ ])",
        r'stop::=spelt "." (=[ \n])',
        f'once::=" " [Oo] "nce " ({_either(AFTER_ONCE)}) [,;:]? (=[ ])',
        f"""spelt::=" " {letters} ("'" ({_either(ENDINGS)})?)? (=[ ,;:.])""",
        *(f'any{n}::=[a-z] any{n - 1}|"" {WORD_END}' for n in range(MAX_TAIL, 1, -1)),
        f'any1::=[a-z]|"" {WORD_END}',
        *(_rule(name, state, name == part) for state, name in states.items()),
    ]


def _barred() -> Trie:
    """A trie of number words, single letters and the empty word.

    Nothing follows a stem: a server that began a word with one could only complete it to nonsense
    ("twoness").
    """
    stems = {*lexicon.CARDINALS, *lexicon.ORDINALS, *lexicon.QUANTITIES, *lexicon.TIMES}
    stems = stems - set(OPENERS) | {*CONTEXTUAL, *VAGUE}
    whole = {word for word in WORDS if word.isascii()} | {*lexicon.ROMAN, *lexicon.PLURAL_UNITS}
    whole |= set(TENS)
    whole |= {opener + suffix for opener in OPENERS for suffix in lexicon.SUFFIXES}
    whole |= {"", *ascii_lowercase}
    trie: Trie = {}
    for words, mark in ((stems, STEM), (whole, WHOLE)):
        for word in words:
            node = trie
            for letter in word:
                node = node.setdefault(letter, {})
            node[mark] = {}
    return trie


def _state(node: Trie, states: dict[State, str]) -> str:
    """The rule for a node of the trie; equal subtries share a rule."""
    edges = []
    for letter in ascii_lowercase:
        child = node.get(letter, {})
        if STEM not in child:
            edges.append((letter, _state(child, states) if child else f"any{MAX_TAIL}"))
    return states.setdefault((WHOLE not in node, tuple(edges)), f"s{len(states)}")


def _rule(name: str, state: State, either_case: bool) -> str:
    ends, edges = state
    letters = defaultdict(str)
    for letter, target in edges:
        letters[target] += letter + letter.upper() * either_case
    follow = [f"[{choice}] {target}" for target, choice in letters.items()] + ['""'] * ends
    return f"{name}::={'|'.join(follow)} {WORD_END}"


def _either(texts: tuple[str, ...]) -> str:
    return "|".join(f'"{text}"' for text in texts)
