"""Paraphrases of the built-in narrator's sentences: synonyms, voice, order, merged sentences."""

from __future__ import annotations

import re
from random import Random

OBJECT = r"((?:small |large )?(?:\w+ )?(?:\w+ )?(?:cube|sphere|cylinder))"
REGION = r"(near the [a-z-]+)"
DIRECTION = r"(\w+)"
SPEED = r"(slowly|steadily|quickly|very quickly)"
NAME = r"[Cc]andidate ([A-D])"

RULES: list[tuple[str, tuple[str, ...]]] = [
    # Scene parse.
    (
        rf"the {OBJECT} is {REGION}(?:, moving| and moves) {SPEED} toward the {DIRECTION}",
        (
            r"the \1 moves \3 \4 \2",
            r"\2, the \1 heads \3 \4ward",
            r"the \1 near by is found \2, traveling \3 to the \4",
            r"moving \3 toward the \4, the \1 is \2",
            r"the \1, which travels \3 toward the \4, is \2",
            r"\2 is the \1, moving \3 \4ward",
        ),
    ),
    (
        rf"the {OBJECT} {REGION} is moving {SPEED} toward the {DIRECTION}",
        (
            r"the \1 \2 heads \3 \4",
            r"the \1, \2, rolls \4ward \3",
            r"the \1 is \2; it is heading \3 toward the \4",
        ),
    ),
    (
        rf"the {OBJECT} (?:is stationary|rests) {REGION}",
        (
            r"the \1 is at rest \2",
            r"\2, the \1 is motionless",
            r"the \1 stands still \2",
            r"the stationary \1 is \2",
            r"at rest \2 is the \1",
            r"the \1 is \2, not moving",
        ),
    ),
    (
        rf"the {OBJECT} is {REGION} and does not move",
        (
            r"the \1 is \2 and is motionless",
            r"the \1, \2, does not move",
            r"the \1 sits \2, at rest",
            r"the motionless \1 sits \2",
        ),
    ),
    (rf"the {OBJECT} is out of view", (r"the \1 cannot be seen", r"the \1 is not in view")),
    (
        rf"the {OBJECT} and the {OBJECT} are on a collision course",
        (
            r"the \1 is on a collision course with the \2",
            r"the \2 and the \1 are on course to collide",
            r"the \2 is headed for a collision with the \1",
        ),
    ),
    (
        r"no pair is (?:on a collision course|heading for contact)",
        ("no objects are on a collision course", "nothing is on a collision course"),
    ),
    # Motion analysis.
    (
        rf"the {OBJECT} and the {OBJECT} are about to meet"
        rf"|contact between the {OBJECT} and the {OBJECT} is imminent",
        (
            r"the \1\3 is about to hit the \2\4",
            r"a collision between the \2\4 and the \1\3 is imminent",
            r"the \2\4 is about to be struck by the \1\3",
            r"the \1\3 is about to make contact with the \2\4",
        ),
    ),
    (
        rf"the {OBJECT} and the {OBJECT} will meet (soon|later)",
        (r"the \1 will collide with the \2 \3", r"the \2 will be hit by the \1 \3"),
    ),
    (
        rf"contact between the {OBJECT} and the {OBJECT} comes (soon|later)",
        (r"the \1 and the \2 will touch \3", r"the \2 runs into the \1 \3"),
    ),
    (
        rf"the {OBJECT} and the {OBJECT} will (?:pass without contact|not meet)",
        (
            r"the \1 does not touch the \2",
            r"the \2 and the \1 will miss each other",
            r"the \1 will never collide with the \2",
            r"no contact comes between the \1 and the \2",
        ),
    ),
    (
        rf"the {OBJECT} (shifts slightly|moves across) toward the {DIRECTION}",
        (
            r"the \1 \2 to the \3",
            r"toward the \3, the \1 \2",
            r"the \1 \2 \3ward",
            r"the \1, in turn, \2 \3",
        ),
    ),
    (rf"the {OBJECT} leaves the view", (r"the \1 exits the view", r"the \1 goes out of view")),
    (
        rf"the {OBJECT} enters the view {REGION}",
        (r"the \1 comes into view \2", r"the \1 enters \2"),
    ),
    # Prediction and outcome.
    (
        rf"the {OBJECT} and the {OBJECT} (will be|are) very close {REGION}",
        (
            r"the \1 and the \2 \3 very close together \4",
            r"the \2 is very close to the \1 \4",
            r"the \2 and the \1 \3 right next to each other \4",
        ),
    ),
    (
        rf"the {OBJECT} (?:will|should) be {REGION}",
        (r"the \1 ends up \2", r"\2 will be the \1", r"the \1 will lie \2", r"\2, expect the \1"),
    ),
    (
        rf"the {OBJECT} (?:remains|stays) {REGION}",
        (r"the \1 is still \2", r"the \1 keeps its place \2"),
    ),
    # Candidates.
    (
        rf"{NAME}(?: wrongly)? (?:shows|has) the {OBJECT} {REGION}(?:,| and) not {REGION}",
        (
            r"in candidate \1, the \2 is \3 instead of \4",
            r"candidate \1 places the \2 \3 rather than \4",
            r"candidate \1 shows the \2 \3, although it should be \4",
            r"the \2 is \3 in candidate \1, not \4",
        ),
    ),
    (
        rf"{NAME}(?: wrongly)? (?:does not show|lacks) the {OBJECT}\b",
        (
            r"the \2 is missing from candidate \1",
            r"candidate \1 leaves out the \2",
            r"in candidate \1 the \2 is absent",
            r"candidate \1 is missing the \2",
        ),
    ),
    (
        rf"{NAME}(?: wrongly)? shows the {OBJECT}(?:, which should not be seen| by mistake)",
        (
            r"candidate \1 shows the \2, although it should not be visible",
            r"candidate \1 adds the \2",
            r"candidate \1 has the \2, which does not belong there",
        ),
    ),
    (
        rf"{NAME}(?: wrongly)? has the {OBJECT} (slightly|clearly) off toward the {DIRECTION}",
        (
            r"in candidate \1 the \2 is \3 too far \4",
            r"candidate \1 places the \2 \3 \4 of its place",
            r"the \2 is displaced \3 to the \4 in candidate \1",
        ),
    ),
    (
        rf"{NAME} (?:agrees with the prediction for every object"
        r"|agrees, with every object where it should be|shows the expected layout)",
        (
            r"candidate \1 matches the prediction",
            r"candidate \1 fits in every respect",
            r"candidate \1 is consistent with the expected layout",
            r"nothing is wrong with candidate \1",
        ),
    ),
    (
        r"(?:only candidate ([A-D]) agrees|candidate ([A-D]) shows this layout)",
        (r"candidate \1\2 is the answer", r"the match is candidate \1\2"),
    ),
]
COMPILED = [(re.compile(pattern, re.IGNORECASE), options) for pattern, options in RULES]


def paraphrase(text: str, rng: Random) -> str:
    """Paraphrase a rationale of the built-in narrator and join some of its sentences."""
    return "\n".join(_line(line, rng) for line in text.splitlines())


def _line(line: str, rng: Random) -> str:
    heading, _, body = line.partition(": ")
    if heading == "Answer":
        return line
    sentences = [_paraphrase_sentence(s, rng) for s in re.split(r"(?<=\.) ", body)]
    joined = [sentences[0]]
    for sentence in sentences[1:]:
        if rng.random() < 0.3 and heading != "Outcome":
            link = rng.choice([", and ", "; ", ", while "])
            start = sentence if sentence[:2] in ("A ", "B ") else sentence[0].lower() + sentence[1:]
            joined[-1] = joined[-1].removesuffix(".") + link + start
        else:
            joined.append(sentence)
    return f"{heading}: {' '.join(joined)}"


def _paraphrase_sentence(sentence: str, rng: Random) -> str:
    if rng.random() < 0.2:
        return sentence
    for pattern, options in COMPILED:
        match = pattern.search(sentence)
        if match:
            words = match.expand(rng.choice(options))
            sentence = sentence[: match.start()] + words + sentence[match.end() :]
            break
    return sentence[0].upper() + sentence[1:]
