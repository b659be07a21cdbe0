"""Read the chosen letter from a model's response to a selection item.

Only the text after the last `</think>` is read. If it contains records (JSON objects with the key
`choice` or `forced_choice`), the letter is read from these only; otherwise from lines such as
"Answer: B"; and without such lines, the text must be nothing but a letter, such as "(B)" or "Option
b". The parser never guesses: several letters, or a letter in passing, are no answer.
"""

from __future__ import annotations

import json
import re
import string
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from data.records import LETTERS


class Reason(StrEnum):
    """Why a response has no letter. A response with a letter may have the reasons `CUT_OFF` and
    `MALFORMED` too: its record is then invalid JSON, but the choice in it is complete."""

    NO_ANSWER = "no answer"
    CUT_OFF = "cut off"
    SEVERAL = "several"
    REFUSAL = "refusal"
    BAD_LETTER = "bad letter"
    MALFORMED = "malformed"


@dataclass(frozen=True)
class ParsedAnswer:
    """A parsed response.

    Attributes:
        letter: The chosen letter in upper case, or None.
        reason: What is wrong with the response, or None.
        record: The text of the record, if there is exactly one and it is valid JSON.
    """

    letter: str | None
    reason: Reason | None = None
    record: str | None = field(default=None, compare=False)


_INVISIBLE = re.compile("[\u200b-\u200f\u2060\ufeff]")
_THOUGHT_START = re.compile(r"[<◁]think(?:ing)?[>▷]", re.IGNORECASE)
_THOUGHT_END = re.compile(r"[<◁]/think(?:ing)?[>▷]", re.IGNORECASE)

_RECORD_START = re.compile(r"""\{\s*["']""")
_CURLY_START = re.compile(r"\{\s*[“”‘’]")
_STRAIGHT = str.maketrans("“”‘’", "\"\"''")
_BARE_START = re.compile(r"\{\s*(?:forced[ _-]?)?choice\s*:", re.IGNORECASE)
_BARE_KEY = re.compile(r"([{,]\s{0,20})([a-z_]\w{0,40})(?=\s{0,20}:)", re.IGNORECASE)
# The only key of an object that contains the record.
_WRAPPER = re.compile(
    r"""\{\s*["'][a-z_ ]{0,20}(?:answer|response|result|output|record)["']\s*:\s*\{""",
    re.IGNORECASE,
)
_ANSWER_TAG = re.compile(r"<answer>([^<>\n]{0,200})</answer>", re.IGNORECASE)
# Text between two records that announces the second one as a correction of the first.
_CORRECTION = re.compile(
    r"\b(?:wait|actually|correction|corrected|on second thought|revised|"
    r"(?:i made|there is|there was) an? (?:mistake|error)|let me (?:correct|fix|revise))\b",
    re.IGNORECASE,
)
_STRING = r""""(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'"""
_JUNK = r"""[^a-z0-9"']{0,4}"""
_CHOICE = rf"(?:{_JUNK.join('forced')}{_JUNK})?{_JUNK.join('choice')}"
_KEY = rf"""["']{_JUNK}{_CHOICE}{_JUNK}["'][^a-z0-9"':]{{0,4}}:\s*"""
# A value is a string, a list, or unquoted text. Bounding the length of the latter makes the time
# linear. If text follows a string directly or on a new line, a quote or a comma is missing.
_VALUE = (
    rf"""(?:{_STRING})(?=\s*(?:[,}}\]"']|$))|\[[^\[\]{{}}]*\]|(?!,|(?:{_STRING})(?:\w|\s*[\n:]))"""
    rf"""(?:[^\n{{}}"'\[\]]|{_STRING}){{1,200}}?(?=,\s*["'}}]|[\n}}])"""
)
_TOKEN = re.compile(
    rf"""(?P<choice>{_KEY}(?:(?P<nested>(?={{))|(?P<value>{_VALUE}))?)"""
    rf"""|(?P<string>{_STRING})|(?P<open>[{{\[])|(?P<close>[}}\]])|(?P<unclosed>["'])""",
    re.IGNORECASE | re.DOTALL,
)

_ANSWER_LINE = re.compile(
    r"(?:^|[.!?;]\s)[ \t*_#>`\-]*(?:(?:so|thus|hence|therefore),?\s+)?(?:(?:the|my)\s+)?"
    r"(?:(?:final|correct|best|forced)[ \t_]+)*(?:answer|choice)[*_`]*"
    r"(?:\s*(?:\bis\b\s*:?|[:=])|[ \t]*(?=\n))(?P<value>\s*[^\n]*)",
    re.IGNORECASE | re.MULTILINE,
)
_LATEX = re.compile(r"\\(?:boxed|text(?:bf|rm|tt)?|math(?:bf|rm|tt)|displaystyle)(?![a-z])")
_MARKUP = re.compile(r"[*_`\"“”()\[\]{}<>$\\]+|(?<!\w)'|'(?!\w)")
_STATEMENT = re.compile(
    r"(?:the\s+)?(?:(?:correct|best|right|final)\s+)?"
    r"(?:(?:option|candidate|image|choice|frame|letter|answer)(?:\s+is)?[\s:#.\-]\s*)?"
    r"(?P<letter>[^\W_])(?!\w)\s*(?P<rest>$|(?:[.,:;!?/|&+=。]|[\-–—](?!\w)|because\b|since\b).*)",
    re.IGNORECASE | re.DOTALL,
)
# Neither the pronoun "I" nor the article "A" names a candidate.
_NAMED_LETTER = re.compile(
    r"(?<![\w'])[A-HJ-Za-d](?![\w'])(?!(?<=[Aa])\s+(?!(?:or|and|vs|to)\b)[a-z])"
)
_ANY_LETTER = re.compile(r"(?<![^\W_])[a-z](?![^\W_])", re.IGNORECASE)
_ONLY_LETTERS = re.compile(
    r"(?:\b(?:[a-z]|or|and|vs|to|either|both|but|maybe|possibly|perhaps|option)\b|[\W_])*",
    re.IGNORECASE,
)
_REFUSAL = re.compile(
    r"^(?:none|null|n/?a|nil|no|neither|unknown|unsure|abstain|refused?|declined?|pass)$"
    r"|(?:can\s?not|can'?t|unable to|impossible to|hard to|not able to|do(?: not|n'?t)|could not)"
    r"\s+(?:be\s+)?(?:reliably\s+)?(?:determine|tell|answer|decide|choose|select|pick|identify|say|"
    r"know|see\b|view|assist|help|provide|comply)"
    r"|\bsorry\b|refuse to|(?:not enough|insufficient) (?:information|evidence|data)|\bnone of\b"
    r"|\bor none\b|\bno (?:correct|valid|suitable|clear|single) "
    r"(?:answer|option|choice|candidate|image)",
    re.IGNORECASE,
)
# Text after a letter, in the same sentence or in the next line, that withdraws it.
_WITHDRAWAL = re.compile(
    r"\bwait\b|\b(?:that|this|it)(?:['’]s| is) (?:wrong|incorrect|not right)"
    r"|^\W*(?:(?:which|that|this|it)\s+)?(?:(?:is|was|seems|looks|would be)\s+)?"
    r"(?:no|nope|not|wrong|incorrect|false|impossible|rejected|excluded|eliminated|ruled out|"
    r"not (?:it|right|correct|possible|valid|the answer))(?:\W*$|\s*[.,;:!?])",
    re.IGNORECASE,
)
_SECOND_THOUGHT = re.compile(
    r"[ \t*_#>`\-]*(?:(?:oh|no|nope|hmm+|but|sorry|wait|actually|correction|scratch that|"
    r"on second thought)\b[\s,.!:;*_\-–—]*)+"
    r"(?:(?:it|that)(?:['’]s| is)\b|i meant\b|make (?:it|that)\b|the answer is\b)?",
    re.IGNORECASE,
)


def parse_choice(raw: str, truncated: bool = False) -> ParsedAnswer:
    """Read the chosen letter from a response.

    Args:
        raw: The whole response. If the prompt ends with `<think>`, prepend the tag to the response;
            otherwise a thought that was cut off is read as an answer.
        truncated: Whether generation stopped at the token limit, so that the last word may be
            incomplete.
    """
    text = strip_thought(_INVISIBLE.sub("", unicodedata.normalize("NFKC", raw)))
    if text is None:
        return ParsedAnswer(None, Reason.CUT_OFF)
    repaired = _quote(text)
    choices, records, flag, prose = _read_records(repaired)
    if repaired != text:
        if choices:
            flag = flag or Reason.MALFORMED
        else:
            choices, records, flag, prose = _read_records(text)
    prose = _ANSWER_TAG.sub(r"\nAnswer: \1\n", prose)
    if choices:
        answer = _agreed([_read_statement(choice) for choice in choices])
        record = records[0] if len(records) == 1 and flag is None else None
        broken = answer.reason in (None, Reason.MALFORMED) and flag
        return ParsedAnswer(answer.letter, broken or answer.reason, record)
    if flag is Reason.CUT_OFF:
        return ParsedAnswer(None, flag)
    # With "xx" appended, a last word that may have been cut off cannot be read as a letter.
    answer = _read_prose(f"{prose}xx" if truncated else prose)
    if truncated and answer.reason is Reason.NO_ANSWER:
        return ParsedAnswer(None, Reason.CUT_OFF)
    return answer


def strip_thought(text: str) -> str | None:
    """Return the text after the last `</think>`, or None if a later `<think>` is not closed."""
    response = _THOUGHT_END.split(text)[-1]
    return None if _THOUGHT_START.search(response) else response


def _quote(text: str) -> str:
    """Return the text with straight quotes, or with quoted keys, if a record lacks them."""
    if _CURLY_START.search(text):
        text = text.translate(_STRAIGHT)
    return _BARE_KEY.sub(r'\1"\2"', text) if _BARE_START.search(text) else text


def _read_records(text: str) -> tuple[list[str | None], list[str], Reason | None, str]:
    """Return the choices of all records (None for an unreadable one), the complete records with a
    choice, what is wrong with the records (None if nothing is), and the text outside of records.

    A record that repeats the template of the prompt, in which the choice lists all letters, does
    not count beside another record, and neither does a record that the following text corrects.
    """
    choices, records, prose, flag, position = [], [], [], None, 0
    while match := _RECORD_START.search(text, position):
        between = text[position : match.start()]
        prose.append(between)
        values, end = _read_record(text, match.start())
        if values and choices and (_CORRECTION.search(between) or _is_template(choices)):
            choices, records = [], []
        choices += values
        position = len(text) if end is None else end
        if end is None:
            flag = Reason.CUT_OFF
        elif values:
            records.append(text[match.start() : end])
            flag = flag or (None if _is_json(records[-1]) else Reason.MALFORMED)
    return choices, records, flag, "\n".join([*prose, text[position:]])


def _read_record(text: str, start: int) -> tuple[list[str | None], int | None]:
    """Return the choices in the record that begins at `start` (None for an unreadable choice), and
    the record's end (None if it is cut off).

    A record counts only if it has a choice at its outermost level; in {"answer": {...}}, this is
    the level of the inner object. Then choices at deeper levels are returned too, because another
    record may begin inside a record that was broken off.
    """
    choices: list[tuple[int, str | None]] = []
    depth, end = 0, None
    for token in _TOKEN.finditer(text, start):
        if token["unclosed"]:
            break
        if token["choice"]:
            unreadable = token["value"] is None and token["nested"] is None
            choices.append((depth, None if unreadable else _unquote(token["value"] or "")))
        depth += bool(token["open"]) - bool(token["close"])
        if depth == 0:
            end = token.end()
            break
    outermost = 2 if _WRAPPER.match(text, start) else 1
    has_choice = any(depth == outermost for depth, _ in choices)
    return [value for _, value in choices] if has_choice else [], end


def _is_template(choices: Sequence[str | None]) -> bool:
    """Return whether each choice lists all letters, such as "A|B|C|D", and nothing else."""
    return all(
        choice is not None
        and _ONLY_LETTERS.fullmatch(choice)
        and {found.upper() for found in _ANY_LETTER.findall(choice)} == {*LETTERS}
        for choice in choices
    )


def _unquote(value: str) -> str:
    try:
        return json.loads(value, strict=False) if value.startswith('"') else value
    except ValueError:
        return value


def _is_json(text: str) -> bool:
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return False
    return True


def _read_prose(prose: str) -> ParsedAnswer:
    """Read answer lines, such as "Answer: B"; without these, a text that is only a letter."""
    lines = [*_ANSWER_LINE.finditer(prose)]
    if not lines:
        return _read_lone_letter(prose)
    answer = _agreed([_read_statement(line["value"]) for line in lines])
    if answer.reason is Reason.NO_ANSWER and not lines[-1]["value"].strip():
        return ParsedAnswer(None, Reason.CUT_OFF)
    next_line = prose[lines[-1].end() :].strip().partition("\n")[0]
    return _apply_second_thought(answer, next_line) if answer.letter else answer


def _apply_second_thought(answer: ParsedAnswer, line: str) -> ParsedAnswer:
    """Discard the letter of an answer if the next line withdraws it or names another letter."""
    opening = _SECOND_THOUGHT.match(line)
    rest = line[opening.end() :] if opening else line
    if (opening and not rest.strip()) or _WITHDRAWAL.fullmatch(
        rest.strip(f"{string.punctuation} ")
    ):
        return ParsedAnswer(None, Reason.REFUSAL)
    corrected = _read_statement(rest).letter if opening else None
    return answer if corrected in (None, answer.letter) else ParsedAnswer(None, Reason.SEVERAL)


def _read_lone_letter(text: str) -> ParsedAnswer:
    """Read a text that is nothing but a letter, such as "(B)" or "Option b"."""
    value = _strip_markup(text)
    if len(value.split()) > 5:
        return ParsedAnswer(None, Reason.REFUSAL if _REFUSAL.search(value) else Reason.NO_ANSWER)
    answer = _read_statement(value)
    if answer.letter and _STATEMENT.fullmatch(value)["rest"].strip(" .,;!?。"):
        return ParsedAnswer(None, Reason.NO_ANSWER)
    return answer


def _read_statement(value: str | None) -> ParsedAnswer:
    """Read a short statement, such as "B", "option (C)" or "B, because the cube has turned"; None
    stands for an unreadable statement."""
    if value is None:
        return ParsedAnswer(None, Reason.MALFORMED)
    value = _strip_markup(value)
    match = _STATEMENT.fullmatch(value)
    if len(_named_letters(value, match)) > 1:
        return ParsedAnswer(None, Reason.SEVERAL)
    refused = _REFUSAL.search(value) or (match and _WITHDRAWAL.search(match["rest"]))
    if match is None or refused:
        return ParsedAnswer(None, Reason.REFUSAL if refused else Reason.NO_ANSWER)
    letter = match["letter"].upper()
    return ParsedAnswer(letter) if letter in LETTERS else ParsedAnswer(None, Reason.BAD_LETTER)


def _named_letters(value: str, match: re.Match[str] | None) -> set[str]:
    pattern = _ANY_LETTER if _ONLY_LETTERS.fullmatch(value) else _NAMED_LETTER
    named = {letter.upper() for letter in pattern.findall(value)}
    return named | {match["letter"].upper()} if match else named


def _strip_markup(value: str) -> str:
    """Remove quotes, brackets, LaTeX and markdown; apostrophes inside words stay."""
    return " ".join(_MARKUP.sub(" ", _LATEX.sub(" ", value)).split())


def _agreed(answers: Sequence[ParsedAnswer]) -> ParsedAnswer:
    """Combine several answers into one; those with the reason `NO_ANSWER` are ignored."""
    distinct = {answer for answer in answers if answer.reason is not Reason.NO_ANSWER}
    if len(distinct) > 1:
        return ParsedAnswer(None, Reason.SEVERAL)
    return distinct.pop() if distinct else ParsedAnswer(None, Reason.NO_ANSWER)
