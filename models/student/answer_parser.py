"""Reads a model's answer to a selection item. It finds a letter or says why there is none, and
never makes one up: an answer that names several letters, or names one only in passing, is none."""

from __future__ import annotations

import json
import re
import unicodedata
from dataclasses import dataclass, field, replace
from enum import StrEnum

from data.records import LETTERS


class Reason(StrEnum):
    """Why an answer has no letter, or (`CUT_OFF`, `MALFORMED` beside a letter) why its record is
    invalid although the choice in it stands."""

    NO_ANSWER = "no answer"
    CUT_OFF = "cut off"
    SEVERAL = "several"
    REFUSAL = "refusal"
    BAD_LETTER = "bad letter"
    MALFORMED = "malformed"


@dataclass(frozen=True)
class ParsedAnswer:
    """The chosen letter, upper case, or None; and what was wrong, None where nothing was. `record`
    is the text of the one record that was read, where there was one that is JSON."""

    letter: str | None
    reason: Reason | None = None
    record: str | None = field(default=None, compare=False)


_TOKEN = re.compile(
    r"""(?P<string>"(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*')|(?P<open>[{\[])|(?P<close>[}\]])"""
    r"""|(?P<colon>:)|(?P<cut>["'])|(?P<bare>[^\s"'{}\[\]:,]+)""",
    re.DOTALL,
)
_RECORD = re.compile(r"""\{\s*["']""")
_LIST = re.compile(r"\[[^\[\]{}]*\]")
_BARE_VALUE = re.compile(r"""[^\n}]*?(?=,\s*["'}]|[\n}])""")
_VALUE_ENDS = re.compile(r"""\s*(?:[,}\]"']|$)""")

_ANSWER = re.compile(
    r"(?:^|[.!?;]\s)[ \t*_#>`\-]*(?:(?:so|thus|hence|therefore),?\s+)?(?:(?:the|my)\s+)?"
    r"(?:(?:final|correct|best|forced)[ \t_]+)*(?:answer|choice)[*_`]*"
    r"(?:\s*(?:\bis\b\s*:?|[:=])|[ \t]*(?=\n))(?P<value>\s*[^\n]*)",
    re.IGNORECASE | re.MULTILINE,
)
_ONE = re.compile(
    r"(?:the\s+)?(?:(?:correct|best|right|final)\s+)?"
    r"(?:(?:option|candidate|image|choice|frame|letter|answer)(?:\s+is)?[\s:#.\-]\s*)?"
    r"(?P<letter>[^\W_])(?!\w)\s*(?P<rest>$|(?:[.,:;!?/|&+=。]|[\-–—](?!\w)|because\b|since\b).*)",
    re.IGNORECASE | re.DOTALL,
)
_STANDALONE = re.compile(
    r"(?<![\w'])(?!I\b)[A-Z](?![\w'])(?!(?<=A)\s+(?!or\b|and\b|vs\b|to\b)[a-z])"
)
_SMALL = re.compile(r"(?<![\w'])[b-d](?![\w'])")
_BETWEEN = frozenset(
    ("or", "and", "vs", "to", "either", "both", "but", "maybe", "possibly", "perhaps", "option")
)

_UNSEEN = re.compile("[\u200b-\u200f\u2060\ufeff]")
_THOUGHT_OPENS = re.compile(r"[<◁]think(?:ing)?[>▷]", re.IGNORECASE)
_THOUGHT_ENDS = re.compile(r"[<◁]/think(?:ing)?[>▷]", re.IGNORECASE)
_LATEX = re.compile(r"\\(?:boxed|text(?:bf|rm|tt)?|math(?:bf|rm|tt)|displaystyle)(?![a-z])")
_DECLINES = frozenset(
    ("none", "null", "n/a", "na", "nil", "no", "neither", "unknown", "unsure", "abstain", "refuse",
     "refused", "decline", "declined", "pass")
)  # fmt: skip
_REFUSAL = re.compile(
    r"(?:can\s?not|can'?t|unable to|impossible to|hard to|not able to)\s+(?:be\s+)?"
    r"(?:reliably\s+)?(?:determine|tell|answer|decide|choose|select|pick|identify|say|know|see|view|"
    r"assist|help|provide|comply)|i'?m sorry|i am sorry|refuse to|do not know|don'?t know|"
    r"not (?:enough|sufficient)|insufficient|none of|no (?:correct|valid|suitable|clear|single) "
    r"(?:answer|option|choice|candidate|image)",
    re.IGNORECASE,
)
_SETTLE = r"(?:determine|tell|say|decide|know|answer|choose|select|pick|identify)\b"
_DENIAL = re.compile(
    r"none of|\bor none\b|no (?:correct|valid|suitable) (?:answer|option|choice|candidate|image)|"
    r"\bwait\b|can\s?not be determined|\b(?:that|this|it)(?:'s| is) (?:wrong|incorrect|not right)|"
    r"i'?m sorry|i am sorry|refuse to|\b(?:i|we) (?:can\s?not|can'?t|do not|don'?t|could not) "
    rf"(?:reliably )?{_SETTLE}|(?:impossible|unable|not able) to {_SETTLE}|"
    r"(?:not enough|insufficient) (?:information|evidence|data)|"
    r"^\W*(?:(?:which|that|this|it)\s+)?(?:(?:is|was|seems|looks|would be)\s+)?"
    r"(?:no|nope|not|wrong|incorrect|false|impossible|rejected|excluded|eliminated|ruled out|"
    r"not (?:it|right|correct|possible|valid|the answer))\s*(?:$|[.,;:!?])",
    re.IGNORECASE,
)
"""Takes back a letter that was said before it."""
_SECOND_THOUGHT = re.compile(
    r"[ \t*_#>`\-]*(?P<taken_back>(?:(?:oh|no|nope|hmm+|but|sorry|wait|actually|correction|"
    r"scratch that|on second thought)\b[\s,.!:;*_\-–—]*)*)"
    r"(?P<denied>(?:that|this|it)(?:['’]s| is) (?:wrong|incorrect|not right)\W*$)?"
    r"(?:(?:it|that)(?:['’]s| is)\b|i meant\b|make (?:it|that)\b|the answer is\b)?(?P<rest>.*)",
    re.IGNORECASE,
)
"""The line after the answer's, which may take it back."""


def parse_choice(raw: str, letters: str = LETTERS, cut: bool = False) -> ParsedAnswer:
    """Reads an output: a structured record, prose that ends in "Answer: B", or a lone letter.

    Only what follows the last `</think>` counts. Where a chat template opens `<think>` itself, put
    it back in front, or a thought that was cut off is read as an answer. A record (JSON with
    `choice` or `forced_choice`) is the only source where there is one; records or answer lines
    that disagree give no letter, nor does one that the next line takes back.

    Args:
        raw: the whole output.
        letters: the letters on offer, upper case.
        cut: whether the model was stopped before its output's end, so that the last word may be a
            part of one.
    """
    text = strip_thought(_UNSEEN.sub("", unicodedata.normalize("NFKC", raw)))
    if text is None:
        return ParsedAnswer(None, Reason.CUT_OFF)
    found, prose, flag, whole = _records(text)
    if found:
        choice = _agree([_read(value, letters) for value in found])
        record = whole[0] if len(whole) == 1 and flag is None else None
        return replace(choice, reason=choice.reason or flag, record=record)
    if flag is Reason.CUT_OFF:
        return ParsedAnswer(None, flag)
    choice = _told(prose, letters, cut)
    if choice.reason is Reason.NO_ANSWER and cut:
        return ParsedAnswer(None, Reason.CUT_OFF)
    return choice


def strip_thought(text: str) -> str | None:
    """What follows an output's last thought; None where one is not closed."""
    said = _THOUGHT_ENDS.split(text)[-1]
    return None if _THOUGHT_OPENS.search(said) else said


def _told(prose: str, letters: str, cut: bool) -> ParsedAnswer:
    """What a text without a record chooses."""
    if cut:
        # The last word goes on as one that says nothing.
        prose += "xx"
    lines = [*_ANSWER.finditer(prose)]
    if not lines:
        return _lone(prose, letters)
    choice = _agree([_read(line["value"], letters) for line in lines])
    if choice.reason is Reason.NO_ANSWER and not lines[-1]["value"].strip():
        return ParsedAnswer(None, Reason.CUT_OFF)
    if choice.letter:
        return _kept(choice, prose[lines[-1].end() :], letters)
    return choice


def _kept(choice: ParsedAnswer, after: str, letters: str) -> ParsedAnswer:
    """A choice, unless the next line takes it back, alone or for another letter. What is explained
    below is no part of the answer."""
    thought = _SECOND_THOUGHT.match(after.strip().partition("\n")[0])
    if not (thought["taken_back"] or thought["denied"]):
        return choice
    if thought["denied"] or not thought["rest"].strip():
        return ParsedAnswer(None, Reason.REFUSAL)
    instead = _read(thought["rest"], letters).letter
    return ParsedAnswer(None, Reason.SEVERAL) if instead not in (None, choice.letter) else choice


def _records(text: str) -> tuple[list[str], str, Reason | None, list[str]]:
    """The choices of all records, the text outside them, what is wrong with a record, and the
    records that hold a choice."""
    values, prose, flag, whole, at = [], [], None, [], 0
    while match := _RECORD.search(text, at):
        found, end = _choices(text, match.start())
        values += found
        prose.append(text[at : match.start()])
        at = len(text) if end is None else end
        if end is None:
            flag = Reason.CUT_OFF
        elif found:
            whole.append(text[match.start() : end])
            flag = flag or (None if _is_json(whole[-1]) else Reason.MALFORMED)
    return values, "\n".join([*prose, text[at:]]), flag, whole


def _choices(text: str, start: int) -> tuple[list[str], int | None]:
    """Values of the choice keys of the record that opens at `start`, and where it ends (None if it
    does not). A choice counts only in the record's outermost level, but one further in can
    contradict it: what looks like a nested record may follow one that was broken off."""
    found: list[tuple[int, str]] = []
    depth, key, awaits, told = 0, "", False, start
    for token in _TOKEN.finditer(text, start):
        kind = token.lastgroup
        if kind == "cut":
            break
        if kind == "colon":
            # Within a value no key begins; to read on from each would take quadratic time.
            awaits, key = token.start() >= told and _is_choice(key), ""
            continue
        if awaits:
            value, told = _value(text, token)
            if value is None:
                break
            found.append((depth, value))
            awaits = False
        elif kind == "string":
            key = _unquote(token[0])
        if kind == "open":
            depth += 1
        elif kind == "close":
            depth -= 1
            if depth == 0:
                return _outermost(found), token.end()
    return _outermost(found), None


def _outermost(found: list[tuple[int, str]]) -> list[str]:
    return [value for _, value in found] if any(depth == 1 for depth, _ in found) else []


def _value(text: str, token: re.Match[str]) -> tuple[str | None, int]:
    """The value that begins at a token, and where it ends; None where the text breaks off inside
    it."""
    if token.lastgroup == "string":
        whole = _VALUE_ENDS.match(text, token.end())
        return (_unquote(token[0]) if whole else ""), token.end()
    if token.lastgroup == "bare":
        match = _BARE_VALUE.match(text, token.start())
    else:
        match = _LIST.match(text, token.start())
        if match is None and token[0] != "[":
            return "", token.end()
    return (match[0], match.end()) if match else (None, token.end())


def _is_choice(key: str) -> bool:
    return re.sub(r"[\W_]", "", key).lower() in ("choice", "forcedchoice")


def _unquote(token: str) -> str:
    try:
        return json.loads(token, strict=False)
    except ValueError:
        return token[1:-1]


def _is_json(text: str) -> bool:
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return False
    return True


def _agree(choices: list[ParsedAnswer]) -> ParsedAnswer:
    """What several statements come to. One that says nothing takes nothing from the others."""
    spoken = {c for c in choices if c.reason is not Reason.NO_ANSWER}
    if not spoken:
        return ParsedAnswer(None, Reason.NO_ANSWER)
    return spoken.pop() if len(spoken) == 1 else ParsedAnswer(None, Reason.SEVERAL)


def _bare(value: str) -> str:
    """A value without its quotes, brackets, LaTeX and markdown; apostrophes inside words stay."""
    value = _LATEX.sub(" ", value)
    value = re.sub(r"[*_`\"“”()\[\]{}<>$\\]+|(?<!\w)'|'(?!\w)", " ", value)
    return " ".join(value.split())


def _read(value: str, letters: str) -> ParsedAnswer:
    """The letter that a short statement chooses."""
    value = _bare(value)
    if not value:
        return ParsedAnswer(None, Reason.NO_ANSWER)
    if value.lower() in _DECLINES:
        return ParsedAnswer(None, Reason.REFUSAL)
    one, named = _ONE.fullmatch(value), _letters_named(value)
    if len(named | {one["letter"].upper()} if one else named) > 1:
        return ParsedAnswer(None, Reason.SEVERAL)
    if one:
        letter = one["letter"].upper()
        if _DENIAL.search(one["rest"]):
            return ParsedAnswer(None, Reason.REFUSAL)
        return ParsedAnswer(letter) if letter in letters else ParsedAnswer(None, Reason.BAD_LETTER)
    return ParsedAnswer(None, Reason.REFUSAL if _REFUSAL.search(value) else Reason.NO_ANSWER)


def _letters_named(value: str) -> set[str]:
    """Every letter that stands alone; of lower case ones, those that may be words only where
    nothing but letters is said."""
    words = re.findall(r"\w+", value.lower())
    letters = {w.upper() for w in words if len(w) == 1}
    if all(len(w) == 1 or w in _BETWEEN for w in words):
        return letters
    return {*_STANDALONE.findall(value), *map(str.upper, _SMALL.findall(value))}


def _lone(text: str, letters: str) -> ParsedAnswer:
    """The answer of a text that is nothing but a letter, such as "(B)" or "Option b"."""
    value = _bare(text)
    if len(value.split()) > 5:
        refused = _REFUSAL.search(value)
        return ParsedAnswer(None, Reason.REFUSAL if refused else Reason.NO_ANSWER)
    choice, one = _read(value, letters), _ONE.fullmatch(value)
    if choice.letter and one["rest"].strip(" .,;!?。"):
        return ParsedAnswer(None, Reason.NO_ANSWER)
    return choice
