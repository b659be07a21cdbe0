"""The closed vocabulary of the claim extraction: phrases, their tags and values."""

from __future__ import annotations

from teacher.predicates import COMPASS, SPEEDS, VERY_FAST

SLOW, STEADY, QUICK = (word for _, word in SPEEDS)

_COMPASS = {
    word + ending: word
    for word in COMPASS
    for ending in ("", "ward", "wards", "erly", "bound", "wardly")
}
_SCREEN = {"upward": "north", "downward": "south", "leftward": "west", "rightward": "east"}
COARSE = "~"
"""Marks a value that must hold only approximately, such as "leftward" for a motion to the
northwest."""

_TABLE: dict[tuple[str, str], str] = {
    # Motion.
    ("still", ""): (
        "stationary; at rest; motionless; immobile; unmoving; static; does not move; do not move; "
        "did not move; is not moving; are not moving; not moving; not in motion; rests; resting; "
        "stands still; stand still; standing still; sits still; sit still; lies still; lie still; "
        "completely still; perfectly still; entirely still; keeps still; keep still; has no "
        "motion; have no motion; shows no motion; show no motion; shows no movement; show no "
        "movement; without moving; does not stir; do not stir; without motion; idle; sits "
        "motionless; inert; with no motion; not in movement; not move"
    ),
    ("rest", ""): "rest",
    ("moves", ""): (
        "moves; move; head; speeds; dashes; hurries; shoots; carries on; rush; race; creep; "
        "proceed; advance; go; travels; travel; rolls; roll; heads; slides; slide; drifts; drift; "
        "glides; glide; proceeds; advances; races; rushes; creeps; is in motion; are in motion; "
        "goes; shifts; shift; continues moving; keeps moving"
    ),
    ("moving", ""): (
        "moving; traveling; travelling; rolling; heading; headed; sliding; drifting; gliding; "
        "proceeding; advancing; racing; rushing; creeping; in motion; going; shifting; moved; "
        "traveled; travelled; rolled; motion; movement; movements; heads for; speeding"
    ),
    ("speed", SLOW): (
        "slowly; slow; at a slow speed; at a slow pace; at low speed; unhurriedly; in a slow "
        "manner; at a low speed"
    ),
    ("speed", STEADY): (
        "steadily; steady; at a steady speed; at a steady pace; at moderate speed; at a moderate "
        "pace; moderately; at a moderate speed; at steady speed"
    ),
    ("speed", QUICK): (
        "quickly; quick; fast; rapidly; rapid; swiftly; swift; at a quick pace; at high speed; at "
        "a high speed; at speed; at a fast pace; with speed; at a quick speed; at a rapid pace; "
        "briskly"
    ),
    ("speed", VERY_FAST): (
        "very quickly; very quick; very fast; very rapidly; very rapid; very swiftly; at a very "
        "high speed; at very high speed; extremely quickly; extremely fast"
    ),
    ("slight", ""): (
        "slightly; a little; a bit; only slightly; just slightly; slight; small; a short way; "
        "faintly; somewhat; marginally"
    ),
    ("clear", ""): (
        "clearly; far; noticeably; markedly; well; visibly; plainly; distinctly; obviously; "
        "considerably"
    ),
    ("across", ""): (
        "moves across; move across; moving across; travels across; travel across; traveling "
        "across; travelling across; crosses; rolls across; rolling across; slides across; sweeps "
        "across; moves far across; heads across; moved across; goes across; going across; "
        "movement across; motion across; across the scene; across the view; across"
    ),
    ("stays", ""): (
        "stays; stay; remains; remain; staying; keeps its place; holds its place; keep; keeps; "
        "remaining; holds; hold; continues; continue"
    ),
    ("put", ""): (
        "where it is; where they are; in place; in its place; in their places; keep their places; "
        "keep its place; hold their places; stays put; stay put; remains put; in position; in its "
        "position; in the same place; in the same position; its position unchanged; where it "
        "stands; where it rests; where it lies; keeps its position; keep their positions; holds "
        "its position; hold their positions; in their positions; unchanged in position; where "
        "they rest"
    ),
    ("put", COARSE): (
        "hardly moves; hardly move; barely moves; barely move; scarcely moves; scarcely move; "
        "nearly in place; almost in place; roughly in place; hardly moving; essentially in place; "
        "as it is; as they are; largely in place; hardly changes; barely shifts; hardly shifts; "
        "barely changes; virtually in place"
    ),
    ("stop", ""): (
        "comes to rest; come to rest; coming to rest; stops; stop; halts; slows; slows down; "
        "settles; came to rest; slow down; brought to rest"
    ),
    # Sight.
    ("out", ""): (
        "out of view; out of the view; not in view; outside the view; outside of the view; off "
        "screen; out of frame; out of the frame; beyond the view; not in the view; out of the "
        "scene; outside the frame; offscreen; outside of view; no longer in view; beyond view"
    ),
    ("hidden", ""): (
        "hidden; covered; occluded; blocked from view; concealed; obscured; hidden from view; "
        "covered up; obstructed"
    ),
    ("unseen", ""): (
        "not visible; unseen; out of sight; cannot be seen; not seen; invisible; not shown; not "
        "be seen; not be visible; no longer visible"
    ),
    ("visible", ""): (
        "visible; in view; seen; can be seen; in plain view; in sight; in plain sight; be shown"
    ),
    ("leaves", ""): (
        "leaves the view; leave the view; leaving the view; leaves; leave; leaving; moves out of "
        "view; move out of view; moving out of view; exits; exits the view; exit the view; "
        "exiting; exiting the view; goes out of view; go out of view; passes out of view; rolls "
        "out of view; slides out of view; departs; leaves the scene; leaves view; disappears from "
        "view; drifts out of view; leaves the frame; exits the frame; exits view; leaving view; "
        "heads out of view; travels out of view; passing out of view; carried out of view; exit "
        "view; leave view; left the view; taken out of view; takes it out of view; carries it out "
        "of view"
    ),
    ("enters", ""): (
        "enters the view; enter the view; entering the view; comes into view; come into view; "
        "coming into view; moves into view; enters; entering; enters view; rolls into view; "
        "appears in view; appears; entered the view; enter view; entering view; moving into view; "
        "slides into view; move into view; brought into view"
    ),
    # Pairs.
    ("course", ""): (
        "on a collision course; collision course; on course to collide; on course to meet; on "
        "course for contact; on course for a contact; on course for collision; on course for a "
        "collision; on a path to collide; on a path to meet; on paths that meet; on converging "
        "paths; on converging courses; on collision courses; on courses that bring them together; "
        "on a course to meet; on a course to collide"
    ),
    ("course", COARSE): (
        "heading into each other; heading for each other; heading for contact; headed for "
        "contact; heading for a collision; headed for a collision; heading toward contact; headed "
        "toward contact; bound to collide; heading toward a collision; headed toward a collision; "
        "heading into a collision; heading for collision"
    ),
    ("meet", ""): (
        "meet; meets; meeting; collide; collides; colliding; make contact; makes contact; making "
        "contact; come into contact; comes into contact; coming into contact; hit; hits; hitting; "
        "strike; strikes; striking; touch; touches; touching; run into; runs into; bump into; "
        "bumps into; bump; crash; crashes; struck by; hit by; in contact; reach contact; reaches "
        "contact; crash into; crashes into; come together; comes together; knocks into; knock "
        "into; met by; get in contact; impacts; have contact; has contact; running into; catch; "
        "catches"
    ),
    ("contact", ""): "contact; collision; impact; encounter; collisions; contacts",
    ("passed", ""): (
        "pass without contact; passes without contact; without contact; without meeting; without "
        "touching; without colliding; without a collision; pass each other; pass by each other; "
        "pass one another; miss each other; miss one another; misses; miss; avoid; avoids; pass "
        "by; passes by; pass clear of; passes clear of; avoid each other; avoid contact; avoids "
        "contact; without any contact; avoid one another; without a contact; passing without "
        "contact; without making contact; without hitting; without impact; clear each other; pass "
        "clear; passing clear; without striking; ends without contact; end without contact; steer "
        "clear of; come to nothing; comes to nothing; no contact; no collision; without ever "
        "touching; without ever meeting; without coming into contact"
    ),
    ("when", "imminent"): (
        "imminent; imminently; about to; on the verge of; right away; immediately; at any moment; "
        "very soon; on the point of; impending; just about to"
    ),
    ("when", "soon"): "soon; shortly; before long; in a short while",
    ("when", "later"): "later; later on; only later; in a while; at a later time; further on",
    ("struck", ""): (
        "struck; is struck; is hit; are struck; once struck; being struck; after being struck; "
        "when struck; unless struck; until struck; after contact; once hit"
    ),
    ("close", ""): (
        "very close; very close together; very close to; very close to each other; very close to "
        "one another; close together; close to each other; close to one another; extremely close; "
        "right next to; right beside; tightly together; nearly touching; in very close proximity; "
        "very near each other; very near to; very near; very close by"
    ),
    ("close", COARSE): (
        "close to; close; next to; beside; adjacent to; adjacent; side by side; near each other; "
        "near one another; near to; alongside; next to each other; closely together"
    ),
    # Candidates.
    ("agree", ""): (
        "agrees; agree; agrees with; match; matches; matching; fits; fit; fitting; is consistent; "
        "are consistent; consistent; aligns; align; corresponds; correspond; expected layout; "
        "predicted layout; this layout; correct layout; right layout; the same layout; every "
        "object where it should be; all objects where they should be; correct; is right; is the "
        "answer; the answer; best; agreement; agreeing; that layout; exact layout; the layout; "
        "this arrangement; the arrangement; this outcome; this configuration; this picture; as "
        "predicted; conforms; coincides; satisfies; satisfy"
    ),
    ("differ", ""): (
        "error; errors; mistake; mistakes; fault; faults; flaw; flaws; "
        "differs; differ; disagrees; disagree; wrong; wrongly; incorrect; incorrectly; conflicts; "
        "conflict; contradicts; contradict; fails; fail; ruled out; rejected; eliminated; "
        "excluded; inconsistent; mismatch; mismatches; deviates; deviate; mistakenly; is off; "
        "mistaken; differing; departs from; falls short; discarded; dismissed; cannot be right; "
        "rules it out; mismatched; rule out; rules out; goes against; erroneously; falsely; errs"
    ),
    ("lack", ""): (
        "free of; "
        "lacks; lack; lacking; omits; omit; omitting; does not show; do not show; fails to show; "
        "fail to show; leaves out; leave out; does not include; do not include; does not contain; "
        "do not contain; does not have; do not have; without; no sign of; has no; have no; shows "
        "no; not showing; without showing; failing to show; does not display; drops; does not "
        "depict; neither shows; contains no; show no"
    ),
    ("gone", ""): (
        "missing; absent; does not appear; do not appear; nowhere to be seen; gone; is not there; "
        "are not there; missing from; left out; omitted; is nowhere; not present; lacked; nowhere "
        "in sight; is not shown; are not shown; is not visible; are not visible; is not in view; "
        "are not in view; is not seen; are not seen; is not present; are not present; absence of; "
        "the absence of"
    ),
    ("extra", ""): (
        "which should not be seen; that should not be seen; should not be seen; by mistake; "
        "should not be there; should not be visible; should not be shown; should not be in view; "
        "should not appear; which does not belong; does not belong; is not expected; should be "
        "hidden; should be out of view; should not be present; unexpectedly; not expected; do not "
        "belong; is not expected to be seen; should have left the view; expected to be hidden; "
        "expected to be out of view; not supposed to be seen; ought not to be seen; should be "
        "unseen; not be shown; not be there; not be in view; must not be seen; has no place; does "
        "not belong there; does not belong in the scene; which has no place"
    ),
    ("adds", ""): (
        "adds; add; extra; adding; additional; an extra; introduces; introduce; unexpected; "
        "includes an extra"
    ),
    ("off", ""): (
        "off; displaced; shifted; too far; misplaced; out of place; offset; off target; away from "
        "its place; further; farther; not where it should be; away from where it should be; in "
        "the wrong place; in the wrong position; wrongly placed; incorrectly placed; off to"
    ),
    ("misplace", ""): "misplaces; misplace; misplacing; displaces; displace; shifts the; puts off",
    ("show", ""): (
        "shows; show; has; have; showing; having; places; place; placing; puts; put; depicts; "
        "depict; displays; contains; includes; contain; include; positions; sets; draws; "
        "presents; locates; gives; renders"
    ),
    ("strangers", ""): (
        "other objects; different objects; a different set of objects; a different scene; objects "
        "from another scene; unrelated objects; foreign objects; another set of objects; "
        "different set of objects; objects that do not belong; an unrelated scene; objects from a "
        "different scene; objects of another scene; a different group of objects; another scene; "
        "wrong set of objects; wrong objects; unfamiliar objects; objects that are not part of "
        "the scene; other objects entirely"
    ),
    ("expected", ""): (
        "should be; should; ought to be; expected; predicted; belongs; supposed to be; is "
        "expected; expected to be; the prediction; prediction; ought; must be; would be expected; "
        "belong; anticipated; expectation"
    ),
    ("contrast", ""): (
        "instead of; rather than; as opposed to; in place of; and not; but not; instead of being; "
        "rather than being; when it should be; whereas it should be; in contrast to; instead of "
        "at; contrary to"
    ),
    ("ignore", ""): (
        "of where it was; of where it started; of where it is at the cut; where it should be; "
        "where they should be; where it is expected; as expected; than expected; of where it "
        "should be; from where it should be; from its expected place; from its expected position; "
        "from the expected position; from the expected place; of its expected place; of its "
        "expected position; of the expected position; of the expected place; than it should be; "
        "than it should; as it should be; as it should; of the prediction; than predicted; with "
        "the prediction; with the expected layout; with this layout; with the layout; the "
        "prediction for every object; before the contact; just before the contact; at the end of "
        "the observation; at the collision; just after the collision; after the collision; before "
        "the collision; of its predicted position; of its predicted place; as they should be; as "
        "they should; than the prediction; not only; from its predicted place; from its predicted "
        "position; each other; one another; at the moment of contact; from the prediction; of the "
        "collision; with expectations; with the predicted layout; with the correct layout; at the "
        "moment of collision; at contact; at the contact; from its correct place; as predicted "
        "for every object; from its proper place; of its proper place; where it belongs; after "
        "the contact; by contact; of the contact; before contact; until contact; at the time of "
        "the collision; at the moment of the collision; at the instant of collision; as in the "
        "prediction; when the observation ends; as the observation ends; at the end"
    ),
    # Function words.
    ("not", ""): "not; never; neither; nor; no; hardly; cannot; without being; nowhere",
    ("maybe", ""): (
        "no longer; if; unless; until; may; might; could; once; when; whenever; even if; would "
        "have; had it; whether; likely; perhaps; possibly; seems; appears to; unlikely; were it "
        "not; had the; without the need; too late; too slow to; unable to"
    ),
    ("future", ""): (
        "will; will be; going to; at the target moment; by the target moment; ends up; end up; "
        "ending; ends; arrives; arriving; finishes; finishing; reaches; reaching; reach; finally; "
        "shall; by then; to end; settling; later lies; afterward; end; eventually; arrive; brings "
        "it; carries it; takes it; bringing it; carrying it; taking it; would; to reach; to "
        "finish; finish; at that moment; by that moment; brings; carries; bring"
    ),
    ("past", ""): (
        "initially; at the start; originally; started; starts; starting; begins; beginning; at "
        "the cut; was; were; had been; previously; start; begin; earlier; began; leaving from; "
        "its original; formerly; starting out; comes from; coming from; come from; still at rest; "
        "at rest until then; stationary until then; at rest until that moment"
    ),
    ("be", ""): (
        "is; are; be; being; been; had; does; do; sits; sit; lies; lie; stands; stand; can; can "
        "be; located; placed; found; positioned; situated"
    ),
    ("pronoun", "it"): "it; its; itself; the object; this object; this one; that object",
    ("pronoun", "they"): (
        "they; their; them; both; the pair; this pair; the two; these; these objects; both "
        "objects; the objects of this pair; both of them; themselves; each; either; those"
    ),
    ("pronoun", "former"): "the former",
    ("pronoun", "latter"): "the latter",
    ("which", ""): "which; that; who; whose",
    ("rest of", ""): (
        "the other objects; the others; others; the rest; the remaining objects; everything else; "
        "the objects; objects; the stationary objects; the moving objects; any object; an object; "
        "all other objects; the rest of the scene; the rest of the objects; the other object; the "
        "remaining object; nothing else; another object; no other object; something; the scene; "
        "the whole scene; every other object; all others; the other candidates; the resting "
        "objects; stationary objects; moving objects; any other object; an other; the layout of "
        "the other objects; the other pairs; other pairs; another pair; any pair; anything; no "
        "other objects; anything else; any other; the remaining pairs; all the others; the other "
        "two; the other three"
    ),
    ("all", ""): (
        "all objects; every object; all of the objects; everything; all the objects; each object; "
        "all of them; the entire scene"
    ),
    ("none", ""): (
        "no pair; no objects; no object; nothing; none of the objects; no pairs; no two objects; "
        "none of them; none; no pair of objects; no one"
    ),
    ("no other", ""): (
        "no other pair; no other pairs; no further pair; no other contact; no other collision; no "
        "further contact; no further collision; no additional pair"
    ),
    ("others", ""): (
        "other candidates; every other candidate; all other candidates; the remaining candidates; "
        "the other images; no other candidate; none of the other candidates; the other options; "
        "each other candidate; the rest of the candidates; the other layouts; any other "
        "candidate; all the other candidates; the alternatives; the distractors; every other "
        "image; remaining candidates; any of the others; the remaining images; no other image; no "
        "other; unlike the others"
    ),
    ("between", ""): "between; involving; of the pair; by the pair",
    ("with", ""): "with; along with; together with",
    ("by", ""): (
        "to; into; by; against; for; past; behind; toward; towards; above; below; over; under; "
        "through; beyond; like; than; from; of; near; around; about; on; at; in front of; after; "
        "before; approaches; approach; approaching; following; follows; away from; in; within; on "
        "top of; closing on"
    ),
    ("and", ""): "and; or; and also; and then; plus; as well as; and both; and the same holds for",
    ("break", ""): (
        "while; whereas; but; as; so; then; because; since; although; though; yet; however; "
        "therefore; thus; meanwhile; except; hence; and while; even though; also; and thus; which "
        "means; so that; meaning; except that; and therefore; likewise; instead; similarly"
    ),
}


def _trie() -> dict[str, list[tuple[tuple[str, ...], str, str]]]:
    first: dict[str, dict[tuple[str, ...], tuple[str, str]]] = {}
    table = {**_TABLE}
    for word, value in _COMPASS.items():
        table["direction", value] = f"{table.get(('direction', value), word)}; {word}"
        for middle in ("north", "south"):
            if word.startswith(middle) and word[len(middle) :]:
                parted = f"{middle} {word[len(middle) :]}"
                if word[len(middle) :].startswith(("east", "west")):
                    table["direction", value] += f"; {parted}"
    for word, value in _SCREEN.items():
        table["direction", COARSE + value] = f"{word}; {word}s; {word.removesuffix('ward')}ward"
    for (tag, value), phrases in table.items():
        for phrase in phrases.split(";"):
            words = tuple(phrase.split())
            first.setdefault(words[0], {}).setdefault(words, (tag, value))
    return {
        head: sorted(((w, *t) for w, t in found.items()), key=lambda entry: -len(entry[0]))
        for head, found in first.items()
    }


PHRASES = _trie()
"""Every phrase with its tag and value by its first word, the longest first."""
