"""The grammar that a server decodes a rationale under, so that its form holds by construction.

It is stricter than `validate` about form and numbers, for it cannot see what stands around a word,
and says nothing of what is true or which letter is right: the validator still judges.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from string import ascii_lowercase

from conf.errors import UserError
from conf.schema import TeacherConfig
from data.records import LETTERS
from teacher.numbers import WORDS, lexicon
from teacher.validation.validator import SECTIONS, word_count

GRAMMAR_VERSION = "1"

Trie = dict[str, "Trie"]
State = tuple[bool, tuple[tuple[str, str], ...]]
"""Whether a word may end here, and the name of the rule that each letter leads to."""
STEM, WHOLE = "stem", "whole"
"""Marks in a trie: no word may go through a stem, nor end where a whole word does."""
SPELT = "(=[' ,;:.-])"
"""What follows letters. Without it the engine would try tens of thousands of tokens, such as
" fooBar", at every step instead of once, when it compiles."""
LONGEST = 16
"""Letters at most behind the point where a word parts from every number word, so that a model that
repeats itself comes to an end. Rules cost less here than a repeat count, which the engine follows
at every step."""
ANSWER_WORDS = word_count("Answer: A")

CONTEXTUAL = ("one", "once", "first", "minute", "frame", "pixel", "feet", "px")
"""Words that state a number in some contexts, which a grammar does not see: barred in all."""
VAGUE = ("few", "several", "many", "multiple", "numerous", "countless", "handful", "lots")
"""The words of `lexicon.VAGUE` that a rationale can do without. The others are as often innocent;
the plurals that they would count are barred instead."""
OPENERS = ("ten", "cent", "sec")
"""Number words that innocent ones begin with ("tends", "center", "section")."""
TENS = (
    "twenties",
    "thirties",
    "forties",
    "fifties",
    "sixties",
    "seventies",
    "eighties",
    "nineties",
)
AFTER_ONCE = ("struck", "hit", "the", "it", "they", "this", "that", "contact", "moving")
"""Words before which "once" is a conjunction, and so no number."""
ENDINGS = ("s", "t", "d", "re", "ve", "ll")


@dataclass(frozen=True)
class Segment:
    """A stretch of a rationale: what it opens with in GBNF, how many words that is, how many
    follow at least, and whether it opens only after a full stop."""

    opening: str
    words: int
    least: int
    after_stop: bool = True


def _section(name: str, least: int, then: str = "", words: int = 0) -> Segment:
    line = "" if name == SECTIONS[0] else r"\n"
    return Segment(f'"{line}{name}:"{then}', word_count(name) + words, least)


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
"""Candidates come by their letters in order: an analysis that could name them in any order would
need an automaton for every set of letters and count of words."""
NAMES = ascii_lowercase[: len(SEGMENTS)]


def grammar(cfg: TeacherConfig) -> str:
    """GBNF of the texts that have a rationale's form: every section, every candidate's letter, an
    answer at the end, `cfg.min_words` to `cfg.max_words` words, and no number word. It is the
    same for all items.

    Raises:
        UserError: `cfg.max_words` leaves no room for the sections.
    """
    fewest = sum(s.words + s.least for s in SEGMENTS) + ANSWER_WORDS
    if cfg.max_words < fewest:
        raise UserError(
            f"teacher.max_words={cfg.max_words} leaves no room for the sections that "
            f"teacher.grammar=true asks for; they take {fewest} words"
        )
    rules = [*_openings(), *_counts(cfg.min_words, cfg.max_words), *_words()]
    return "\n".join(rules) + "\n"


def _openings() -> list[str]:
    """How each segment opens, up to the last of its words but one; and the answer."""
    rules = [
        f"open-{name}::={segment.opening} least-{segment.least - 1}"
        for name, segment in zip(NAMES, SEGMENTS, strict=True)
    ]
    most = max(segment.least for segment in SEGMENTS)
    rules += ["least-1::=word", "least-2::=word word|once"]
    rules += [f"least-{n}::=word least-{n - 1}|once least-{n - 2}" for n in range(3, most)]
    return [*rules, rf'answer::="\nAnswer: " [{"".join(LETTERS)}]']


def _counts(low: int, high: int) -> list[str]:
    """Rules that count words: `c57` is what may follow the 57th word where that is of the third
    segment. There is one for every segment and count, but decoding and compiling hardly notice
    them, for the letters stand in other rules, which all of these share."""
    needs = [segment.words + segment.least for segment in SEGMENTS]
    rules = [f"root::=open-{NAMES[0]} {NAMES[0]}{needs[0] - 1}"]
    for k, name in enumerate(NAMES):
        last = high - ANSWER_WORDS - sum(needs[k + 1 :])
        for n in range(sum(needs[: k + 1]) - 1, last):
            # A further word is to come, and ends the segment or does not.
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
    """Rules for a word with the space before it: letters, of which none but the first of a part is
    a capital, parts that hyphens join, and an apostrophe. A letter alone is "a" or a candidate."""
    states: dict[State, str] = {}
    part = _state(_barred(), states)
    letters = f'([aA-{LETTERS[-1]}]|{part} ("-" {part}){{0,2}})'
    return [
        "word::=spelt [,;:.]? (=[ ])",
        r'stop::=spelt "." (=[ \n])',
        f'once::=" " [Oo] "nce " ({_either(AFTER_ONCE)}) [,;:]? (=[ ])',
        f"""spelt::=" " {letters} ("'" ({_either(ENDINGS)})?)? (=[ ,;:.])""",
        *(f'any{n}::=[a-z] any{n - 1}|"" {SPELT}' for n in range(LONGEST, 1, -1)),
        f'any1::=[a-z]|"" {SPELT}',
        *(_rule(name, state, name == part) for state, name in states.items()),
    ]


def _barred() -> Trie:
    """The words that state numbers, letters alone, and no word at all. Behind a stem the trie ends:
    a word that began with one would leave a server nowhere to go but nonsense ("twoness")."""
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
    """The name of the rule for a node of the trie; nodes that the same letters follow share it."""
    edges = []
    for letter in ascii_lowercase:
        child = node.get(letter, {})
        if STEM not in child:
            edges.append((letter, _state(child, states) if child else f"any{LONGEST}"))
    return states.setdefault((WHOLE not in node, tuple(edges)), f"s{len(states)}")


def _rule(name: str, state: State, either_case: bool) -> str:
    ends, edges = state
    letters = defaultdict(str)
    for letter, target in edges:
        letters[target] += letter + letter.upper() * either_case
    follow = [f"[{choice}] {target}" for target, choice in letters.items()] + ['""'] * ends
    return f"{name}::={'|'.join(follow)} {SPELT}"


def _either(texts: tuple[str, ...]) -> str:
    return "|".join(f'"{text}"' for text in texts)
