"""Read the chosen letter from a model's response to a selection item.

A response is cleaned, and its thoughts are removed. Records (JSON objects with the key `choice` or
`forced_choice`) come first. Without them, the sentences are read in order: a statement, such as
"Answer: B" or "I choose B", gives a letter; a later statement may correct it, and a later sentence
may take it back or name a rival. Without a statement, a letter on a line of its own counts, and so
does the conclusion of the last sentence. The parser never guesses: two letters without a
correction, or a letter in passing, are no answer. docs/evaluation.md lists what counts.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from dynapix.data.records import LETTERS
from dynapix.models.student import answer_patterns as patterns
from dynapix.models.student.answer_records import AnswerRecord, read_records
from dynapix.models.student.response_text import clean_response


class ParseFailure(StrEnum):
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
    reason: ParseFailure | None = None
    record: str | None = field(default=None, compare=False)


def parse_choice(raw: str, truncated: bool = False) -> ParsedAnswer:
    """Read the chosen letter from a response.

    Args:
        raw: The whole response. If the prompt ends with `<think>`, prepend the tag to the response;
            otherwise a thought that was cut off is read as an answer.
        truncated: Whether generation stopped at the token limit, so that the last word may be
            incomplete.
    """
    text = clean_response(raw)
    if text is None:
        return ParsedAnswer(None, ParseFailure.CUT_OFF)
    records, after = read_records(text)
    own = _choose_records(records)
    others = [value for record in records for value in record.others]
    is_cut = any(not record.is_complete for record in records)
    if own:
        return _read_choices(own, others, after, is_cut)
    if is_cut:
        return ParsedAnswer(None, ParseFailure.CUT_OFF)
    # With "xx" appended, a last word that may have been cut off cannot be read as a letter.
    prose = "\n".join([*(record.before for record in records), after])
    answer = _read_prose(f"{prose}xx" if truncated else prose)
    if answer.reason is ParseFailure.NO_ANSWER:
        answer = _agreed(map(_read_value, others))
    is_cut = truncated and answer.reason is ParseFailure.NO_ANSWER
    return ParsedAnswer(None, ParseFailure.CUT_OFF) if is_cut else answer


def _choose_records(records: list[AnswerRecord]) -> list[AnswerRecord]:
    """Return the records with a choice. A record that the text before it calls an example does not
    count, and neither does the template of the prompt or a record that a later one corrects."""
    own: list[AnswerRecord] = []
    for record in records:
        if record.choices and not _is_reported(record.before.strip()[-200:], ""):
            replaces = own and (
                patterns.CORRECTING.search(record.before)
                or _read_value(own[0].choices[0]).letter is None
            )
            own = [record] if replaces else [*own, record]
    return own


def _read_choices(
    records: list[AnswerRecord], others: list[str | None], after: str, is_cut: bool
) -> ParsedAnswer:
    """Combine the choices of records with what the text after them says."""
    answer = _agreed(_read_value(choice) for record in records for choice in record.choices)
    other = _agreed(map(_read_value, others)).letter
    if answer.letter and other not in (None, answer.letter):
        answer = ParsedAnswer(None, ParseFailure.SEVERAL)
    if answer.letter:
        answer = _read_prose(after, answer)
    is_valid = all(record.is_valid for record in records)
    damage = ParseFailure.CUT_OFF if is_cut else None if is_valid else ParseFailure.MALFORMED
    broken = answer.reason in (None, ParseFailure.MALFORMED) and damage
    record = records[0].text if len(records) == 1 and damage is None else None
    return ParsedAnswer(answer.letter, broken or answer.reason, record)


def _read_prose(prose: str, answer: ParsedAnswer | None = None) -> ParsedAnswer:
    """Read the statements of a text in order, after an answer that was given before it."""
    prose = patterns.TAG.sub(r"\nAnswer: \g<value>\n", patterns.STRUCK.sub(" ", prose))
    boxed = {one or two for one, two in patterns.BOXED.findall(prose)}
    prose = re.sub(r"\bans\.", "answer:", patterns.LIST_NUMBER.sub("", prose), flags=re.IGNORECASE)
    sentences = [
        s for s in map(_strip_markup, patterns.SENTENCE.split(prose)) if re.search(r"\w|=>", s)
    ]
    is_given, rank, k, is_next, is_reopened, is_cut = answer is not None, 0, 0, True, False, False
    plain: list[str] = []
    while k < len(sentences):
        sentence, previous, k = sentences[k], sentences[k - 1] if k else "", k + 1
        heads = [*patterns.HEAD.finditer(sentence)] or [*patterns.HEADING.finditer(sentence)]
        stops = [head.start() for head in heads[1:]] + [len(sentence)]
        for head, stop in zip(heads, stops, strict=False):
            words, value = sentence[: head.end()][-200:], sentence[head.end() : stop]
            if _is_reported(words, "" if head.start() > 3 else previous):
                continue
            if not value.strip(" :.") and stop == len(sentence):
                value, k = _read_block(sentences, k)
                is_cut = not value
            stated = _read_value(value)
            if stated.reason is ParseFailure.NO_ANSWER:
                continue
            replaces = answer and re.search(rf"\bnot {answer.letter}\b", value)
            is_revised = is_reopened or replaces or patterns.REVISING.search(words)
            own = 2 if is_revised else int("final" in words.lower())
            if answer is None or own > rank or own == 2:
                answer = stated
            elif stated != answer:
                answer = ParsedAnswer(None, ParseFailure.SEVERAL)
            rank, is_next, is_reopened = max(rank, own), True, False
        plain += [] if heads else [sentence]
        if not heads and answer and answer.letter:
            is_reopened |= bool(patterns.REOPENING.match(sentence))
            answer, is_next = _react(answer, sentence, is_next), False
    if answer is None and is_cut:
        return ParsedAnswer(None, ParseFailure.CUT_OFF)
    if answer or is_given:
        return answer
    return _agreed(map(ParsedAnswer, boxed)) if boxed else _read_without_statement(plain)


def _read_block(sentences: list[str], k: int) -> tuple[str, int]:
    """Return what follows a heading at the sentences from `k` on, and where it ends: the next
    sentence, or the letter with the only positive verdict in a list of verdicts."""
    verdicts: dict[str, str] = {}
    stop = k
    while stop < len(sentences):
        joined = " ".join(sentences[stop : stop + 2])
        found = patterns.VERDICT.match(sentences[stop])
        if found is None and re.fullmatch(r"\W*[A-D]\W*", sentences[stop]):
            found = patterns.VERDICT.match(joined)
            stop += found is not None
        text = found["verdict"] if found else ""
        if (
            found is None
            or found["letter"] in verdicts
            or not (patterns.YES.search(text) or patterns.NO.search(text))
        ):
            break
        verdicts[found["letter"]] = found["verdict"]
        stop += 1
    if len(verdicts) > 1:
        right = [
            key
            for key, text in verdicts.items()
            if patterns.YES.search(text) and not patterns.NO.search(text)
        ]
        return " or ".join(right) or "none", stop
    return (sentences[k], k + 1) if k < len(sentences) else ("", k)


def _react(answer: ParsedAnswer, sentence: str, is_next: bool) -> ParsedAnswer:
    """Return the answer after a later sentence, which may take it back or name a rival."""
    sentence = sentence[:400]
    own = re.sub(rf"(?<![\w']){answer.letter}(?![\w'])", "SELF", sentence)
    taken_back = patterns.WITHDRAWAL.search(own)
    is_aside = patterns.OTHERS.search(sentence) or patterns.ASIDE.search(sentence)
    refuses = is_next and patterns.REFUSAL.search(sentence) and not is_aside
    if refuses or (taken_back and (is_next or "SELF" in taken_back[0])):
        return ParsedAnswer(None, ParseFailure.REFUSAL)
    named = {
        _letter_of(found)
        for rule in (patterns.RIVAL, patterns.CONCLUSION)
        for found in rule.finditer(sentence)
        if not _is_conceded(found, sentence)
    }
    named |= {each["letter"].upper() for each in patterns.CORRECTED.finditer(sentence)}
    named |= {*_positions(sentence)} if not patterns.EXCUSE.search(sentence) else set()
    alone = patterns.NAMED.findall(sentence)
    if (
        alone
        and patterns.AND_OR.fullmatch(patterns.NAMED.sub("", sentence))
        and not sentence.endswith(":")
    ):
        named |= {*alone}
    if patterns.EXCUSE.search(sentence) and not alone:
        named = set()
    return answer if named <= {answer.letter} else ParsedAnswer(None, ParseFailure.SEVERAL)


def _is_conceded(rival: re.Match[str], sentence: str) -> bool:
    """Return whether a sentence speaks for another candidate only to reject it."""
    is_concession = patterns.CONCESSION.match(sentence) and not patterns.SUPERIOR.search(rival[0])
    return bool(
        rival["subject"] and (is_concession or patterns.CONTRAST.match(sentence[rival.start() :]))
    )


def _read_without_statement(sentences: list[str]) -> ParsedAnswer:
    """Read a list of verdicts, a letter alone on the first or the last line, or the conclusion of
    the last sentence."""
    if not sentences:
        return ParsedAnswer(None, ParseFailure.NO_ANSWER)
    listed = [f"{letter}: {text}" for letter, text in patterns.LISTED.findall(sentences[0])]
    for lines in (sentences, listed if len(sentences) == 1 else []):
        value, stop = _read_block(lines, 0)
        if stop == len(lines) > 2:
            return _read_value(value)
    first, last = sentences[0], sentences[-1]
    found = [_read_value(line) for line in {first, last} if patterns.ALONE.fullmatch(line)]
    if (
        not found
        and len(sentences) == 1
        and patterns.POSITION_ALONE.match(last)
        and not patterns.NAMED.search(last)
    ):
        found = [*map(ParsedAnswer, _positions(last))]
    if not found:
        found = _read_conclusion(last, sentences[:-1])
    if not found and any(map(patterns.REFUSAL.search, sentences)):
        return ParsedAnswer(None, ParseFailure.REFUSAL)
    answer = _agreed(found)
    for sentence in sentences[1:-1]:
        answer = _react(answer, sentence, is_next=False) if answer.letter else answer
    return answer


def _read_conclusion(last: str, earlier: Sequence[str]) -> list[ParsedAnswer]:
    """Return the candidate for which the last sentence of a text speaks, if the `earlier` sentences
    speak for no other."""
    last = next(
        (c for c in reversed(patterns.CLAUSE.split(last)) if patterns.NAMED.search(c)), last
    )
    last = patterns.TAIL.sub("", last)
    if patterns.ALONE.fullmatch(last):
        return [_read_value(last)]
    said = [
        each
        for rule in (
            patterns.LEFT,
            patterns.DRAWN,
            patterns.ENDING,
            patterns.CONCLUSION,
            patterns.RIVAL,
        )
        for each in rule.finditer(last)
        if not _is_reported(last[: each.start(each.lastgroup)].rpartition(",")[2], "")
        and (each.lastgroup == "drawn" or not patterns.AGAINST.search(last[: each.end()]))
    ]
    names = {*map(_letter_of, said)}
    rivals = {*patterns.NAMED.findall(last), *re.findall(r"\b(A)\W*$", last)} - names
    if len(names) != 1 or (rivals and not patterns.EXCUSE.search(last)):
        return []
    before = {
        _letter_of(each) for sentence in earlier for each in patterns.RIVAL.finditer(sentence)
    }
    is_drawn = any(each.lastgroup == "drawn" for each in said)
    return [ParsedAnswer(*names)] if is_drawn or before <= names else []


def _read_value(value: str | None) -> ParsedAnswer:
    """Read what follows the head of a statement, such as "B", "option (C)" or "B, because the cube
    has turned"; None stands for an unreadable value."""
    if value is None:
        return ParsedAnswer(None, ParseFailure.MALFORMED)
    value = _strip_markup(value)[:400]
    match, positions = patterns.STATEMENT.match(value), _positions(value)
    letter = match and match["letter"]
    is_sure = match and (
        (letter.isupper() and letter != "A") or patterns.NAMING.search(match["before"])
    )
    if match and not is_sure and not patterns.AFTER_A.match(match["rest"]):
        match = None
    if (
        match
        and (letter in "Xx" or letter.islower())
        and (letter in "Xx" or match["rest"][:1].isalpha())
    ):
        match = None
    if match is None or (letter.isdigit() and positions):
        names_letter = re.match(rf"(?:{patterns.NOUN}\s)?[A-D]\b", value, re.IGNORECASE)
        if positions and not names_letter and not patterns.EXCUSE.search(value):
            return _agreed(map(ParsedAnswer, positions))
        refused = patterns.REFUSAL.search(value) or patterns.WEAK_REFUSAL.search(value)
        return ParsedAnswer(None, ParseFailure.REFUSAL if refused else ParseFailure.NO_ANSWER)
    letter, rest = letter.upper(), match["rest"]
    if {letter, *patterns.NAMED.findall(rest)} == {*LETTERS} and patterns.AND_OR.fullmatch(
        patterns.SINGLE.sub("", rest)
    ):
        return ParsedAnswer(None, ParseFailure.NO_ANSWER)  # the template of the prompt
    if patterns.CORRECTED.match(rest) or _has_rival(letter, rest) or not {*positions} <= {letter}:
        return ParsedAnswer(None, ParseFailure.SEVERAL)
    own = re.sub(rf"(?<![\w']){letter}(?![\w'])", "SELF", rest)
    refused = patterns.REFUSAL.search(own.strip(" ,.;?!")) and not patterns.REASON.match(own)
    if (
        refused
        or patterns.CONDITION.match(own)
        or patterns.WITHDRAWAL.search(own)
        or patterns.WITHDRAWAL.search(f"it {own}")
    ):
        return ParsedAnswer(None, ParseFailure.REFUSAL)
    return (
        ParsedAnswer(letter) if letter in LETTERS else ParsedAnswer(None, ParseFailure.BAD_LETTER)
    )


def _has_rival(letter: str, rest: str) -> bool:
    """Return whether the text after a letter names another one that is not only compared with."""
    for found in patterns.NAMED.finditer(rest):
        between = rest[: found.start()]
        if found[0] != letter and (
            patterns.AND_OR.fullmatch(between) or not patterns.EXCUSE.search(rest)
        ):
            return True
    return bool(re.match(r"\W*(?:or|and|,|/|\|)\W*[a-d]\b(?!\s\w)", rest, re.IGNORECASE))


def _letter_of(found: re.Match[str]) -> str:
    """Return the letter in the only named group that took part in a match."""
    return found[found.lastgroup].upper()


def _positions(text: str) -> list[str]:
    """Return the letters of the images that a text names by position."""
    return [
        patterns.ORDINALS[found["ordinal"].lower()]
        if found["ordinal"]
        else LETTERS[int(found["number"]) - 1]
        for found in patterns.POSITION.finditer(text)
    ]


def _is_reported(words: str, previous: str) -> bool:
    """Return whether a statement is an example, a condition or somebody else's, by the words up to
    the letter and the sentence before."""
    text = re.split(r"\b(?:but|so|however)\b|;", words, flags=re.IGNORECASE)[-1]
    clause = patterns.CAUSE.match(text)
    if clause and not patterns.SOURCE.search(clause[0]):
        text = text[clause.end() :]
    if re.search(r"(?::|like|as|e\.?g\.?,?)\s*$", previous):
        text = previous[-200:]
    return bool(patterns.REPORTED.search(text) and not patterns.OWN_WORDS.search(text))


def _strip_markup(value: str) -> str:
    """Remove quotes, brackets, LaTeX and markdown; a letter in brackets is followed by a comma."""
    value = patterns.BRACKETED.sub(r" \1, ", patterns.LATEX.sub(" ", value))
    value = patterns.SPLIT_CLAUSE.sub(
        r"\1 ", patterns.NO_SIGN.sub(r"\1 no ", patterns.YES_SIGN.sub(r"\1 yes ", value))
    )
    return " ".join(patterns.MARKUP.sub(" ", value).split())


def _agreed(answers: Iterable[ParsedAnswer]) -> ParsedAnswer:
    """Combine several answers into one; those with the reason `NO_ANSWER` are ignored."""
    distinct = {answer for answer in answers if answer.reason is not ParseFailure.NO_ANSWER}
    if len(distinct) > 1:
        return ParsedAnswer(None, ParseFailure.SEVERAL)
    return distinct.pop() if distinct else ParsedAnswer(None, ParseFailure.NO_ANSWER)
