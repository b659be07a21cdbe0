"""Prompts for a teacher on a server.

The instructions come first and are the same for every item, so that prefix caching applies.
"""

from __future__ import annotations

import json

from conf.schema import TeacherConfig
from data.records import SelectionItem
from teacher.predicates import Predicates
from teacher.sections import SECTIONS

PROMPT_VERSION = "3"

SYSTEM = """You write short chains of reasoning about scenes of moving objects. You are given a \
question with candidate images and a JSON record of true qualitative facts: the objects when the \
observation ends, the objects at the target moment, and how each candidate agrees or differs.

How to read the record:
- objects: "region", "sight", "speed" and "heading" hold when the observation ends; \
"target_region" and "target_sight" hold at the target moment; "extent" and "travel" say how \
far and which way an object goes in between. "hidden" is in view but covered. null is not known: \
say nothing of it.
- entering and leaving: objects that come into view or go out of it in between.
- courses: pairs on a collision course when the observation ends, and when they meet. null: they \
never do. "unseen": it is not known whether they do, so say only that they are on a course.
- contacts: every pair that meets in between. A course whose pair is not there leads to contact \
only after the target moment, if at all.
- close: pairs that are very close at the target moment, and the region midway between the two.
- candidates: "differences" lists every object that is not as at the target moment. "region": it \
is shown in that region. "displaced": it is off, slightly or clearly, toward that heading. \
"missing": it should be seen and is not. "extra": it is seen and should not be. Where \
"other_objects" is true, the image shows a different set of objects.

Turn the facts into plain prose that reasons from what is seen to the answer:
- Write these sections in this order, each on a line of its own that opens with its heading and a \
colon: {sections}. End with a line "Answer: " and the letter of the candidate that agrees.
- Scene parse says where each object is and how it moves. Motion analysis says what the motions \
lead to. Prediction says the layout at the target moment. Candidate analysis goes through every \
candidate by its letter, as in "candidate B", and says what agrees or differs. Outcome sums up.
- Where the facts are too many, leave out the least telling ones.
- Say only what the facts say, with their own words for regions, speeds and directions. Name \
objects exactly as they do. Write as someone who watches the scene, and mention no record.
- State no number of any kind: no digits, counts, ordinals, fractions, times, frames or \
coordinates, in figures or in words. Do not write "one", "two", "first", "second", "once", \
"twice", "half" or "a few".
- Use plain text without markup. Write between {low} and {high} words in all."""


def build_messages(
    predicates: Predicates, item: SelectionItem, cfg: TeacherConfig
) -> list[dict[str, str]]:
    """The chat messages that request an item's rationale."""
    system = SYSTEM.format(sections=", ".join(SECTIONS), low=cfg.min_words, high=cfg.max_words)
    facts = json.dumps(predicates.to_dict(), separators=(",", ":"))
    user = f"Question: {item.question}\nFacts: {facts}\nAnswer to reach: {item.letter}"
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]
