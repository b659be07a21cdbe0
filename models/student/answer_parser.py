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
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum

from dynapix.data.records import LETTERS
from dynapix.models.student.answer_records import AnswerRecord, read_records
from dynapix.models.student.response_text import clean_response


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


def _compile(pattern: str) -> re.Pattern[str]:
    """Compile a pattern without regard to case, in which "~" stands for white space."""
    return re.compile(pattern.replace("~", r"\s{1,9}"), re.IGNORECASE)


# The head of a statement: the words that announce a letter.
_NOUN = r"(?:option|candidate|image|choice|frame|letter|picture|panel|photo|number|answer)"
_REVISED = r"(?:revised|corrected|updated|new|real|true|actual)"
_OWN = (
    rf"(?:(?:{_REVISED}|final|correct|best|right|forced|own|single|likely|closest|chosen|selected)"
    r"[\s_]+)"
)
_FOREIGN = (
    r"(?:答案|正解|答え|回答|정답|réponse|respuesta|antwort|ответ|risposta|resposta|odpowiedź|"
    r"cevap|jawaban|đáp~án)(?:~\w+)?"
)
_IS = (
    r"(?:\b(?:is|are|was|remains?|becomes?|lautet|est|es|ist|è"
    r"|(?:would|should|must|will|has~to|have~to|would~have~to|seems~to|appears~to)~be)\b"
    r"|是|为|は|은|는)"
)
_HEAD = _compile(
    rf"(?:\b(?:{_OWN}{{0,4}}(?:answer|ans|choice|final|pick|selection|selected|verdict|conclusion|"
    rf"guess|output|result)|{_OWN}{{1,4}}(?:match|fit|{_NOUN}))\b|{_FOREIGN})[*_`]*"
    r"(?:\s?\([^()\n]{0,60}\)|,[^,:\n]{1,60},"
    r"|~(?:to|for|of|in|here|by|with|based|among|i|one)\b[^.:;?!=\n]{0,60}?){0,2}"
    rf"[*_`]*\s{{0,3}}(?:{_IS}\s{{0,3}}:?|[:=]|[-–—/]>?(?!\w)|\.{{1,9}}(?=\s?\w\b)|=>)"
    r"|\b(?:i|we)(?:'d|'ll|~(?:would|will|must|have~to|had~to|therefore|thus)){0,3}"
    r"~(?:choose|chose|pick|select|go(?:~with)?|opt~for|vote~for|settle~on|answer(?:~with)?)\b"
    r"\s{0,3}:?"
    r"|\bchang(?:e|ed|ing)~(?:my~answer|my~choice|it|that)~to\b"
    r"|(?<!候)[选選](?![项項](?!\s*(?:是|为|:|[A-D]\W*$)))(?:择|択)?\s{0,3}:?"
)
_HEADING = _compile(rf"^[\s*_#>-]*(?:the~|my~)?{_OWN}{{0,4}}(?:answer|choice)[\s*_#:`]*$")
# What makes a later record or statement replace an earlier one.
_CORRECTING = _compile(
    rf"\b(?:{_REVISED}|actually|instead|reflection|second~thought|after~all|chang\w+|must|forced|"
    r"wait|correction|mistake|error|meant|sorry|let~me)\b"
)
_REVISING = _compile(rf"\b(?:{_REVISED}|actually|instead|on~reflection|after~all|chang\w+|must)\b")
_REOPENING = _compile(
    r"\W*(?:hmm+\W{1,3})?(?:wait|let~me~(?:double[- ]?check|re-?check|re-?examine)|scratch~that|"
    r"on~second~thought|on~reflection|let~me~correct|correction)\b"
)
# Words before a statement that is an example, a condition or somebody else's. A clause such as
# "Since the cube has not moved," is skipped, unless it names a source.
_REPORTED = _compile(
    r"\b(?:some(?:one|body)?|others?|reader|people|they|he|she|you|your|whether|if|unless|suppose|"
    r"assuming|otherwise|wrote|writes|says|said|reads|caption|claim\w*|thinks|another|user|might|"
    r"could|may|seems?|tempt\w+|not|never|(?<!no )(?<!without a )doubt|such~as|e\.?g|"
    r"for~(?:example|instance)|example|format|template|instructions?|like~this|in~the~form|"
    r"(?:first|second|third|initial|previous|"
    r"earlier|original|other|alternative|naive|wrong|incorrect|next|no|any|every|each)~"
    rf"(?:guess|pick|selection|{_NOUN}))(?=\W|$)|n't\b|^\W*had\b"
)
_CAUSE = _compile(
    r"\W*(?:since|because|as|given|after|based~on|compared|unlike|considering|taking|from|thus|"
    r"though|although|while)\b[^:]*,~"
    r"(?=(?:(?:and|thus|therefore|hence|then)~)*(?:the|my|i|we|i'd|i'll)\b)"
)
_SOURCE = _compile(
    r"\b(?:if|unless|suppos\w+|assum\w+|whether|otherwise|some(?:one|body)?|others?(?!~\w)|people|"
    r"he|she|reader|model|user|teacher|caption|wrote|written|sa(?:y|ys|id)|states?|stated|reads|"
    r"claim\w*|think\w*|argu\w+|example|instance|e\.?g|format|template|instructions?|question)\b"
)
_OWN_WORDS = _compile(r"\b(?:requested|required|if~i~(?:must|have~to|had~to))\b")
# The value of a statement: what may stand between its head and its letter, and after the letter.
_BEFORE_LETTER = (
    r"(?:(?:(?:i|we|it|this|that|the|is|it's|that's|must|has|have|be|to|should|would|i'd|say|think|"
    r"believe|guess|go|going|choose|pick|select|with|for|probably|most|more|likely|clearly|because|"
    r"definitely|certainly|surely|indeed|fits|matches|shows|which|therefore|thus|hence|so|now|"
    rf"simply|just|only|best|correct|right|final|closest|my|one|either|both|{_NOUN})\b"
    r"|[^\x00-\x7f]{1,9})[\s:,.#=-]*){0,12}"
)
_STATEMENT = _compile(
    rf"[\s\-•.:,=>#]*(?:[^,\d]{{1,60}},\s)??{_BEFORE_LETTER}"
    r"(?P<letter>[a-z0-9])(?![a-z0-9_])(?!'\w)\s*(?P<rest>.*)$"
)
_POSITION = _compile(
    r"\b(?:(?P<ordinal>first|second|third|fourth)~(?:image|picture|candidate|option|frame|panel)"
    r"|(?:image|picture|candidate|option|frame|panel)[ #]{1,2}(?P<number>[1-4]))\b"
)
_ORDINALS = {"first": "A", "second": "B", "third": "C", "fourth": "D"}
_AFTER_A = _compile(
    r"$|[^\w\s]|[^\x00-\x7f]|(?:or|and|vs|to|yes|no|because|since|as|due|which|that|where|if|shows?|"
    r"match\w*|fits?|is|was|seems|looks|agrees|with|near|at|in|on|by|xx)\b"
)
# Other letters: those that are named, alternatives, and reasons for which one is named.
_NAMED = re.compile(
    r"(?<![a-zA-Z0-9_'])([B-HJ-Z]|A(?!\s+(?!(?:or|and|vs|to|is|as)\b)[a-z]))(?![\w'])"
)
_AND_OR = _compile(
    r"(?:[\W_]|或|和|また?は|또는|или|\b(?:or|and|oder|ou|vs|to|possibly|maybe|perhaps|likely|"
    rf"probably|clearly|definitely|also|either|both|but|the|{_NOUN})\b)*"
)
_ALONE = _compile(rf"(?:{_AND_OR.pattern}(?<![\w'])[a-z0-9](?![\w'])){{1,4}}[\s.,;!?)。]*")
_EXCUSE = _compile(
    r"\b(?:because|since|as|due|though|although|while|whereas|unlike|instead|rather|not|no|than|"
    r"second~choice|runner|wrong|incorrect|earl(?:y|ier)|lat(?:e|er)|ruled?\sout|too|cannot|never|"
    r"neither|reject\w*|eliminat\w*|exclud\w*)\b|n't\b"
)
# What takes a letter back (SELF stands for it) or refuses to answer.
_REASON = _compile(r"\W*(?:because|since|as|due|though|although|while)\b")
_FALSE = r"(?:wrong|incorrect|false|impossible|rejected|excluded|eliminated|ruled~out|implausible)"
_NOT = r"(?:not|never|cannot|can't|doesn't|isn't|won't|hardly)"
_WITHDRAWAL = _compile(
    r"^\W*(?:(?:wait|but|so|no|oh|actually)\b\W*){0,3}(?:i~(?:think|believe)~)?"
    r"(?:which|this|that|it|that's|it's|SELF)\b"
    rf"\W*(?:\w+~){{0,2}}?(?:{_FALSE}|{_NOT}~(?:(?:be|quite|really)~)?(?:fit|match|work|hold|"
    r"follow|right|correct|true|valid|possible|plausible|it|the~answer))\b"
    r"(?!~(?:that|for|to~(?:tell|say|be))\b|[^.!?]{0,20}\b[A-D]\b)"
    rf"|^\W*(?:{_FALSE}|not~(?!SELF\b|[A-D]\b)\w+)\W*$|no[,.]~none\b"
    r"|^\W*(?:(?:oh|ah|hmm+|wait|but|actually|well|sorry|no|nope)\b\W*)+$"
    r"|\b(?:i~doubt|so~i~thought|scratch~that|take~(?:it|that)~back|never~mind|"
    r"chang\w+~my~(?:answer|choice|mind)|"
    r"(?:disregard|ignore)~(?:that|this|it|my|the~(?:line|answer|letter|above))|typo|placeholder|"
    r"withdraw|retract)\b"
    rf"|\bSELF~(?:(?:is|was|must~be)~(?:\w+~)?(?:{_FALSE}|{_NOT})|"
    r"(?:cannot|can't|couldn't|could~not)~be)\b"
)
_REFUSAL = _compile(
    r"^(?:none|null|n/?a|nil|no|neither|unknown|unsure|abstain|refused?|declined?|pass)\W*$"
    r"|(?:can\s?not|can't|unable~to|impossible~to|not~able~to|could~not)~(?:be~)?(?:reliably~)?"
    r"(?:determine|tell|answer|decide|choose|select|pick|identify|say|assist|help|comply)"
    r"|refuse~to|(?:not~enough|insufficient)~(?:information|evidence|data)"
    r"|\bnone~of\b|\bor~none\b|\bno~(?:correct|valid|suitable|clear)~\w+"
)
_ASIDE = _compile(
    r"(?:determine|tell|decide|identify|say|information~to~\w+|see)~(?:you~)?(?:(?:much|more|"
    r"anything)~)?(?:about~)?(?:the(?!~(?:answer|letter|correct|right|best|match|future|next|"
    r"candidate|option|image|frame))|its?~\w+|how~(?!to)|whether~(?!th|it|[A-D]\b)|more~about)\b"
    r"|\bnone~of~the~(?!candidates|options|images|above|answers|choices|four|frames|pictures)"
    r"|\bno~clear~\w+~of\b"
)
_OTHERS = _compile(r"\b(?:others?|remaining|rest)\b|(?<![\w'])[A-D](?![\w'])")
_CONDITION = _compile(r"\W*(?:if|unless|provided)\b")
_WEAK_REFUSAL = _compile(
    r"\bsorry\b|(?:hard~to|do(?:~not|n't))~(?:determine|tell|answer|decide|know|see)"
)
# Sentences without a head: those that speak for a letter, conclusions, and verdicts.
_RIVAL = _compile(
    r"\b(?:i~meant~|(?:argue|case)~for~|(?:it|this|that|edit|correction)(?:(?:'s|~is|~must~be|~has~to~be|~should~be|"
    r"~(?:could|may|might)(?:~(?!not\b|never\b)\w+){0,3}?~be)~|\s?:\s?"
    r"(?:(?:could|may|might)(?:~(?!not\b)\w+){0,3}?~be~)?))"
    rf"(?:\w+~)?(?:the~)?(?:{_NOUN}~)?(?P<said>[A-D])(?=\W*$|[,;])"
    r"|(?<![\w'])(?P<subject>[A-D]):?~(?:(?:also|still)~)?(?:(?:fits|matches|agrees)\b|(?:is|seems"
    r"|looks)~(?:(?:just|equally|also|as|more|the|a|far|much|too)~){0,3}(?:likely|plausible|"
    r"possible|probable|right|correct|better|best|closest|answer|match)\b"
    r"(?!~(?:only|if|about|until|of~the|alternative|(?:to~be~)?an?~(?:\w+~)?(?:frame|image|state)|"
    r"the~frame|intermediate|earlier|later)\b))"
)
_CONTRAST = _compile(
    r"\w:?~(?:also~)?(?:fits|matches|agrees|(?:is|seems|looks)~(?:also~)?(?:plausible|possible))\b"
    r"(?![^.]*\b(?:equally|just~as|as~well|later|sure|decide|tell|know|exclude)\b)"
    r"[^.]*\b(?:but|yet|except|until|only|neither)\b"
)
_SUPERIOR = _compile(r"\b(?:better|best|correct|right|answer|closest)\b")
_CONCESSION = _compile(r"\W*(?:while|although|though|even~though)\b")
_CONCLUSION = _compile(
    rf"\b(?:match|matches|image|one|frame|candidate|option|state|future|it|this)\b[^.:;\n]{{0,40}}?~"
    rf"(?:is|must~be|has~to~be)~(?:\w+~)?(?:the~)?(?:{_NOUN}~)?(?P<said>[A-D])\W*$"
    r"|(?<![\w'])(?P<subject>[A-D])~(?:is|must~be)~the~"
    r"(?:one|only|correct|right|best|match|closest)\b"
)
_VERDICT = _compile(rf"\W*(?:{_NOUN}~)?(?P<letter>[A-D])\b[\s).,:=*_-]+(?P<verdict>\w.*)")
_YES = _compile(r"\b(?:yes|match(?:es)?|fits|correct|right|true|best)\b")
_NO = _compile(r"\b(?:no|not|wrong|incorrect|false|mismatch|reject\w*|too)\b|n't\b")
# Markup.
_TAG = _compile(
    r"<(?P<tag>(?:final_?)?(?:answer|choice))(?:\s[^<>]{0,80})?>(?P<value>[^<>]{0,200})</(?P=tag)>"
)
_SINGLE = re.compile(r"(?<![\w'])[a-zA-Z0-9](?![\w'])")
_STRUCK = re.compile(r"~~[^~\n]*~~")
_BOXED = re.compile(
    r"\\boxed\s?\{(?:\\\w{1,9}\s?\{)?\s?([A-D])\s?\}|<\|begin_of_box\|>\s?([A-D])\b"
)
_LATEX = re.compile(r"\\(?:boxed|text(?:bf|rm|tt)?|math(?:bf|rm|tt)|displaystyle)(?![a-z])")
_BRACKETED = re.compile(r"""[(\[{*_`"'<$]\s?([A-D])\s?[)\]}*_`"'>$]""")
_MARKUP = re.compile(r"[*_`\"()\[\]{}<>$\\]+|(?<!\w)'|'(?!\w)")
_SENTENCE = re.compile(r"(?<=[.!?;])\s+|\n+")


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
        return ParsedAnswer(None, Reason.CUT_OFF)
    records, after = read_records(text)
    own = _choose_records(records)
    others = [value for record in records for value in record.others]
    is_cut = any(not record.is_complete for record in records)
    if own:
        return _read_choices(own, others, after, is_cut)
    if is_cut:
        return ParsedAnswer(None, Reason.CUT_OFF)
    # With "xx" appended, a last word that may have been cut off cannot be read as a letter.
    prose = "\n".join([*(record.before for record in records), after])
    answer = _read_prose(f"{prose}xx" if truncated else prose)
    if answer.reason is Reason.NO_ANSWER:
        answer = _agreed(map(_read_value, others))
    is_cut = truncated and answer.reason is Reason.NO_ANSWER
    return ParsedAnswer(None, Reason.CUT_OFF) if is_cut else answer


def _choose_records(records: list[AnswerRecord]) -> list[AnswerRecord]:
    """Return the records with a choice. A record that the text before it calls an example does not
    count, and neither does the template of the prompt or a record that a later one corrects."""
    own: list[AnswerRecord] = []
    for record in records:
        if record.choices and not _is_reported(record.before.strip()[-200:], ""):
            replaces = own and (
                _CORRECTING.search(record.before) or _read_value(own[0].choices[0]).letter is None
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
        answer = ParsedAnswer(None, Reason.SEVERAL)
    if answer.letter:
        answer = _read_prose(after, answer)
    is_valid = all(record.is_valid for record in records)
    damage = Reason.CUT_OFF if is_cut else None if is_valid else Reason.MALFORMED
    broken = answer.reason in (None, Reason.MALFORMED) and damage
    record = records[0].text if len(records) == 1 and damage is None else None
    return ParsedAnswer(answer.letter, broken or answer.reason, record)


def _read_prose(prose: str, answer: ParsedAnswer | None = None) -> ParsedAnswer:
    """Read the statements of a text in order, after an answer that was given before it."""
    prose = _TAG.sub(r"\nAnswer: \g<value>\n", _STRUCK.sub(" ", prose))
    boxed = {one or two for one, two in _BOXED.findall(prose)}
    prose = re.sub(r"\bans\.", "answer:", prose, flags=re.IGNORECASE)
    sentences = [s for s in map(_strip_markup, _SENTENCE.split(prose)) if re.search(r"\w|=>", s)]
    is_given, rank, k, is_next, is_reopened, is_cut = answer is not None, 0, 0, True, False, False
    plain: list[str] = []
    while k < len(sentences):
        sentence, previous, k = sentences[k], sentences[k - 1] if k else "", k + 1
        heads = [*_HEAD.finditer(sentence)] or [*_HEADING.finditer(sentence)]
        stops = [head.start() for head in heads[1:]] + [len(sentence)]
        for head, stop in zip(heads, stops, strict=False):
            words, value = sentence[: head.end()][-200:], sentence[head.end() : stop]
            if _is_reported(words, "" if head.start() > 3 else previous):
                continue
            if not value.strip(" :.") and stop == len(sentence):
                value, k = _read_block(sentences, k)
                is_cut = not value
            stated = _read_value(value)
            if stated.reason is Reason.NO_ANSWER:
                continue
            replaces = answer and re.search(rf"\bnot {answer.letter}\b", value)
            is_revised = is_reopened or replaces or _REVISING.search(words)
            own = 2 if is_revised else int("final" in words.lower())
            if answer is None or own > rank or own == 2:
                answer = stated
            elif stated != answer:
                answer = ParsedAnswer(None, Reason.SEVERAL)
            rank, is_next, is_reopened = max(rank, own), True, False
        plain += [] if heads else [sentence]
        if not heads and answer and answer.letter:
            is_reopened |= bool(_REOPENING.match(sentence))
            answer, is_next = _react(answer, sentence, is_next), False
    if answer is None and is_cut:
        return ParsedAnswer(None, Reason.CUT_OFF)
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
        found = _VERDICT.match(sentences[stop])
        if found is None and re.fullmatch(r"\W*[A-D]\W*", sentences[stop]):
            found = _VERDICT.match(joined)
            stop += found is not None
        text = found["verdict"] if found else ""
        if (
            found is None
            or found["letter"] in verdicts
            or not (_YES.search(text) or _NO.search(text))
        ):
            break
        verdicts[found["letter"]] = found["verdict"]
        stop += 1
    if len(verdicts) > 1:
        right = [
            key for key, text in verdicts.items() if _YES.search(text) and not _NO.search(text)
        ]
        return " or ".join(right) or "none", stop
    return (sentences[k], k + 1) if k < len(sentences) else ("", k)


def _react(answer: ParsedAnswer, sentence: str, is_next: bool) -> ParsedAnswer:
    """Return the answer after a later sentence, which may take it back or name a rival."""
    sentence = sentence[:400]
    own = re.sub(rf"(?<![\w']){answer.letter}(?![\w'])", "SELF", sentence)
    taken_back = _WITHDRAWAL.search(own)
    is_aside = _OTHERS.search(sentence) or _ASIDE.search(sentence)
    refuses = is_next and _REFUSAL.search(sentence) and not is_aside
    if refuses or (taken_back and (is_next or "SELF" in taken_back[0])):
        return ParsedAnswer(None, Reason.REFUSAL)
    named = {
        found["said"] or found["subject"]
        for rule in (_RIVAL, _CONCLUSION)
        for found in rule.finditer(sentence)
        if not _is_conceded(found, sentence)
    }
    named |= {*_positions(sentence)} if not _EXCUSE.search(sentence) else set()
    alone = _NAMED.findall(sentence)
    if alone and _AND_OR.fullmatch(_NAMED.sub("", sentence)) and not sentence.endswith(":"):
        named |= {*alone}
    if _EXCUSE.search(sentence) and not alone:
        named = set()
    return answer if named <= {answer.letter} else ParsedAnswer(None, Reason.SEVERAL)


def _is_conceded(rival: re.Match[str], sentence: str) -> bool:
    """Return whether a sentence speaks for another candidate only to reject it."""
    is_concession = _CONCESSION.match(sentence) and not _SUPERIOR.search(rival[0])
    return bool(rival["subject"] and (is_concession or _CONTRAST.match(sentence[rival.start() :])))


def _read_without_statement(sentences: list[str]) -> ParsedAnswer:
    """Read a list of verdicts, a letter alone on the first or the last line, or the conclusion of
    the last sentence."""
    if not sentences:
        return ParsedAnswer(None, Reason.NO_ANSWER)
    value, stop = _read_block(sentences, 0)
    if stop == len(sentences) > 2:
        return _read_value(value)
    first, last = sentences[0], sentences[-1]
    is_single = len(sentences) == 1
    found = [_read_value(line) for line in {first, last} if _ALONE.fullmatch(line)]
    said = [*_CONCLUSION.finditer(last), *(_RIVAL.finditer(last) if is_single else ())]
    names = {each["said"] or each["subject"] for each in said}
    others = {*_NAMED.findall(last), *re.findall(r"\b(A)\W*$", last)} - names
    if others and not _EXCUSE.search(last):
        said = []
    if not found and not _is_reported(last, ""):
        found = [ParsedAnswer((each["said"] or each["subject"]).upper()) for each in said]
    if not found and any(map(_REFUSAL.search, sentences)):
        return ParsedAnswer(None, Reason.REFUSAL)
    answer = _agreed(found)
    for sentence in sentences[1:-1]:
        answer = _react(answer, sentence, is_next=False) if answer.letter else answer
    return answer


def _read_value(value: str | None) -> ParsedAnswer:
    """Read what follows the head of a statement, such as "B", "option (C)" or "B, because the cube
    has turned"; None stands for an unreadable value."""
    if value is None:
        return ParsedAnswer(None, Reason.MALFORMED)
    value = _strip_markup(value)[:400]
    match, positions = _STATEMENT.match(value), _positions(value)
    letter = match and match["letter"]
    if match and not (letter.isupper() and letter != "A") and not _AFTER_A.match(match["rest"]):
        match = None
    if (
        match
        and (letter in "Xx" or letter.islower())
        and (letter in "Xx" or match["rest"][:1].isalpha())
    ):
        match = None
    if match is None or (letter.isdigit() and positions):
        names_letter = re.match(rf"(?:{_NOUN}\s)?[A-D]\b", value, re.IGNORECASE)
        if positions and not names_letter and not _EXCUSE.search(value):
            return _agreed(map(ParsedAnswer, positions))
        refused = _REFUSAL.search(value) or _WEAK_REFUSAL.search(value)
        return ParsedAnswer(None, Reason.REFUSAL if refused else Reason.NO_ANSWER)
    letter, rest = letter.upper(), match["rest"]
    if {letter, *_NAMED.findall(rest)} == {*LETTERS} and _AND_OR.fullmatch(_SINGLE.sub("", rest)):
        return ParsedAnswer(None, Reason.NO_ANSWER)  # the template of the prompt
    if _has_rival(letter, rest) or not {*positions} <= {letter}:
        return ParsedAnswer(None, Reason.SEVERAL)
    own = re.sub(rf"(?<![\w']){letter}(?![\w'])", "SELF", rest)
    refused = _REFUSAL.search(own.strip(" ,.;?!")) and not _REASON.match(own)
    if (
        refused
        or _CONDITION.match(own)
        or _WITHDRAWAL.search(own)
        or _WITHDRAWAL.search(f"it {own}")
    ):
        return ParsedAnswer(None, Reason.REFUSAL)
    return ParsedAnswer(letter) if letter in LETTERS else ParsedAnswer(None, Reason.BAD_LETTER)


def _has_rival(letter: str, rest: str) -> bool:
    """Return whether the text after a letter names another one that is not only compared with."""
    for found in _NAMED.finditer(rest):
        between = rest[: found.start()]
        if found[0] != letter and (_AND_OR.fullmatch(between) or not _EXCUSE.search(rest)):
            return True
    return bool(re.match(r"\W*(?:or|and|,|/|\|)\W*[a-d]\b(?!\s\w)", rest, re.IGNORECASE))


def _positions(text: str) -> list[str]:
    """Return the letters of the images that a text names by position."""
    return [
        _ORDINALS[found["ordinal"].lower()]
        if found["ordinal"]
        else LETTERS[int(found["number"]) - 1]
        for found in _POSITION.finditer(text)
    ]


def _is_reported(words: str, previous: str) -> bool:
    """Return whether a statement is an example, a condition or somebody else's, by the words up to
    the letter and the sentence before."""
    text = re.split(r"\b(?:but|so|however)\b|;", words, flags=re.IGNORECASE)[-1]
    clause = _CAUSE.match(text)
    if clause and not _SOURCE.search(clause[0]):
        text = text[clause.end() :]
    if re.search(r"(?::|like|as|e\.?g\.?,?)\s*$", previous):
        text = previous[-200:]
    return bool(_REPORTED.search(text) and not _OWN_WORDS.search(text))


def _strip_markup(value: str) -> str:
    """Remove quotes, brackets, LaTeX and markdown; a letter in brackets is followed by a comma."""
    value = _BRACKETED.sub(r" \1, ", _LATEX.sub(" ", value))
    return " ".join(_MARKUP.sub(" ", value).split())


def _agreed(answers: Iterable[ParsedAnswer]) -> ParsedAnswer:
    """Combine several answers into one; those with the reason `NO_ANSWER` are ignored."""
    distinct = {answer for answer in answers if answer.reason is not Reason.NO_ANSWER}
    if len(distinct) > 1:
        return ParsedAnswer(None, Reason.SEVERAL)
    return distinct.pop() if distinct else ParsedAnswer(None, Reason.NO_ANSWER)
