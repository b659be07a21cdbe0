"""What a teacher is asked. The instructions come first and never change, so a server that caches
prefixes reads them once."""

from __future__ import annotations

import json

from conf.schema import TeacherConfig
from data.records import SelectionItem
from teacher.predicates import Predicates
from teacher.validate import SECTIONS

PROMPT_VERSION = "2"

SYSTEM = """You write short chains of reasoning about scenes of moving objects. You are given a \
question with candidate images and a JSON record of true qualitative facts: the objects when the \
observation ends, the objects at the target moment, and how each candidate agrees or differs.

Turn the facts into plain prose that reasons from what is seen to the answer:
- Write these sections in this order, each on a line of its own that opens with its heading and a \
colon: {sections}. End with a line "Answer: " and the letter of the candidate that agrees.
- Scene parse says where each object is and how it moves. Motion analysis says what the motions \
lead to. Prediction says the layout at the target moment. Candidate analysis goes through every \
candidate by its letter and says what agrees or differs. Outcome sums up.
- A course whose "when" is null ends without contact; where it is "unseen", say only that the \
pair is on a collision course.
- Say only what the facts say, with their own words for regions, speeds and directions. Name \
objects exactly as they do. Write as someone who watches the scene, and mention no record.
- State no number of any kind: no digits, counts, ordinals, fractions, times, frames or \
coordinates, in figures or in words. Do not write "one", "two", "first", "second", "once", \
"twice", "half" or "a few".
- Use plain text without markup. Write between {low} and {high} words in all."""


def messages(
    predicates: Predicates, item: SelectionItem, cfg: TeacherConfig
) -> list[dict[str, str]]:
    """The chat that asks for an item's rationale; the shared instructions stand first."""
    system = SYSTEM.format(sections=", ".join(SECTIONS), low=cfg.min_words, high=cfg.max_words)
    facts = json.dumps(predicates.to_dict(), separators=(",", ":"))
    user = f"Question: {item.question}\nFacts: {facts}\nAnswer to reach: {item.letter}"
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]
