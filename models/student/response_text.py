"""Clean the text of a response: thoughts, tokens of chat templates, invisible characters."""

from __future__ import annotations

import re
import unicodedata

_INVISIBLE = re.compile(
    "\x1b\\[[\\d;]{0,9}m|[\0\xad\u061c\u200b-\u200f\u202a-\u202e\u2060-\u2069\ufe0e\ufe0f\ufeff]"
)
_SYMBOLS = str.maketrans(
    dict.fromkeys("✓✔✅☑", " yes ") | dict.fromkeys("✗✘❌✖", " no ") | dict.fromkeys("“”", '"')
    | dict.fromkeys("‘’", "'") | {"→": "->", "⇒": "->", "🅰": "A", "🅱": "B"}
)  # fmt: skip
_LOOK_ALIKE = re.compile(r"(?<![^\W_])[ΑАΒВС](?![^\W_])")
_LATIN = str.maketrans("ΑАΒВС", "AABBC")
_TURN_END = re.compile(
    r"</s>|<\|?(?:im_end|eot_id|end_of_turn|end.of.sentence|endoftext|end)\|?>", re.IGNORECASE
)
_TEMPLATE_TOKEN = re.compile(
    r"<\|(?:im_)?start\|>\s*(?:assistant)?|<\|(?!begin_of_box)[^|<>\n]{1,30}\|>|<s>", re.IGNORECASE
)
_THOUGHT = r"(?:\w{1,9}:)?(?:think(?:ing)?|thoughts?|reasoning|reflection|analysis|scratch_?pad)"
_THOUGHT_START = re.compile(
    rf"[<◁]{_THOUGHT}(?:\s[^<>]{{0,80}})?[>▷]|\[THINK\]|<\|(?:begin_of_|start_)?th(?:ought|inking)\|>"
    r"|```(?:thinking|thoughts?|reasoning)\b|<\|channel\|>\s{0,9}(?:analysis|commentary)\b",
    re.IGNORECASE,
)
_THOUGHT_END = re.compile(
    rf"[<◁]/{_THOUGHT}[>▷]|\[/THINK\]|<\|(?:end_of_|end_|/)th(?:ought|inking)\|>"
    r"|<\|channel\|>\s{0,9}final\b",
    re.IGNORECASE,
)
_FENCED_THOUGHT = re.compile(r"```(?:thinking|thoughts?|reasoning)\b[^`]*```", re.IGNORECASE)


def clean_response(raw: str) -> str | None:
    """Return the text of a response's first turn after its thoughts, or None if a thought is cut
    off.

    Characters are normalised (NFKC), invisible ones and tokens of chat templates are removed, and
    symbols are replaced: check marks by "yes", crosses by "no", and single Greek and Cyrillic
    letters that look like A, B or C by these.
    """
    text = strip_thought(_INVISIBLE.sub("", unicodedata.normalize("NFKC", raw)))
    if text is None:
        return None
    text = _LOOK_ALIKE.sub(lambda found: found[0].translate(_LATIN), text.translate(_SYMBOLS))
    text = next(filter(str.strip, _TURN_END.split(text)), "")
    return _TEMPLATE_TOKEN.sub(" ", text)


def strip_thought(text: str) -> str | None:
    """Return the text after the last end of a thought, such as `</think>`, or before it if nothing
    follows; None if a later thought is not closed."""
    *before, response = _THOUGHT_END.split(_FENCED_THOUGHT.sub("", text))
    if before and not response.strip():
        response = _THOUGHT_START.split(before[-1])[0]
    return None if _THOUGHT_START.search(response) else response
