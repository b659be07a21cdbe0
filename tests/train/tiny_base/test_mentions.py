"""Where a text names objects and candidates, and which words refer to which."""

from __future__ import annotations

import re

from train.tiny_base.mentions import TokenizedText


def test_texts_speak_of_the_last_name_and_letter(processor) -> None:
    text = (
        "Prediction: The red metal cube will be left of the blue metal cube. It is so.\n"
        "Candidate analysis: Candidate B shows the red metal cube near the top."
    )
    ids = processor.tokenizer(text, add_special_tokens=False)["input_ids"]
    tokenized = TokenizedText(text, processor.tokenizer)
    mentions = [*tokenized.mentions()]
    assert len(tokenized) == len(ids)
    decode = processor.tokenizer.decode
    assert [decode(ids[m.last : m.stop]).split()[1:] for m in mentions] == [
        ["will", "be", "left", "of", "the"],
        [],
        ["near", "the", "top"],
    ]
    assert [(m.section, m.letter) for m in mentions] == [
        ("Prediction", None),
        ("Prediction", None),
        ("Candidate analysis", "B"),
    ]
    assert decode(ids[mentions[2].letter_at]).strip() == "B"
    for m in mentions:
        assert decode(ids[m.first : m.last + 1]).strip() == m.name


def test_outcomes_refer_to_the_candidates_that_agree(processor) -> None:
    text = (
        "Candidate analysis: Candidate A shows the red metal cube near the top, and agrees. "
        "Candidate B shows the red metal cube out of sight. Candidate C shows the red metal cube "
        "near the left, not near the top. Candidate D shows the red metal cube near the top, and "
        "agrees.\n"
        "Outcome: Candidates A and D agree."
    )
    ids = processor.tokenizer(text, add_special_tokens=False)["input_ids"]
    decode = processor.tokenizer.decode
    verdicts = [*TokenizedText(text, processor.tokenizer).verdicts()]
    assert [decode(ids[at]).strip() for at, _ in verdicts] == ["A", "D"]
    for (_, agrees), letter in zip(verdicts, "AD", strict=True):
        before = decode(ids[: agrees + 1])
        assert before[before.rindex("Candidate ") :].startswith(f"Candidate {letter} shows")


def test_the_closest_candidate_refers_to_what_it_shows(processor) -> None:
    text = TokenizedText(
        "Prediction: The red metal cube will be near the top.\n"
        "Candidate analysis: Candidate A shows the red metal cube near the left, far off, not near "
        "the top. Candidate B shows the red metal cube near the top and the gray metal cube near "
        "the left.\n"
        "Outcome: The red metal cube is closest to its expected place in candidate B.\nAnswer: B",
        processor.tokenizer,
    )
    closest = text.token_at(text.text.index("B.\nAnswer"))
    described = text.token_at(text.text.index("gray")) - 1
    assert [*text.choices()] == [(closest, described)]
    answer = text.token_at(len(text.text) - 1)
    assert [*text.verdicts()] == [(answer, closest)]


def test_the_match_layout_refers_to_the_last_letter_of_the_outcome(processor) -> None:
    text = TokenizedText(
        "Candidate analysis: Candidate A shows the red metal cube near the left. Candidate B shows "
        "the red metal cube near the top.\n"
        "Outcome: The red metal cube is closest to its expected place in candidate B. This layout "
        "is that of candidate B.\n"
        "Candidate A does not match.\nCandidate B matches: all is there.\nAnswer: B",
        processor.tokenizer,
    )
    lines = [text.token_at(m.end() - 1) for m in re.finditer("^Candidate .", text.text, re.M)][1:]
    outcome = text.token_at(text.text.index("B.\nCandidate A"))
    assert len(lines) == 2
    assert [*text.matches()] == [(line, outcome) for line in lines]


def test_places_in_candidates_are_compared_with_the_predicted_ones(processor) -> None:
    text = TokenizedText(
        "Prediction: At the end, the red metal cube will be near the top-left. The gray metal cube "
        "should be near the top. The gray metal cube will be left of the red metal cube.\n"
        "Candidate analysis: Candidate A shows the red metal cube near the top, not near the "
        "top-left. Candidate B shows the gray metal cube near the top, and agrees. Candidate C "
        "shows the red metal cube near the top-left and agrees with the prediction. Candidate D "
        "shows the gray metal cube near the top.\n"
        "Candidate A does not match: it shows the red metal cube near the center, not near the "
        "top.",
        processor.tokenizer,
    )
    ends = [text.token_at(m.end() - 1) for m in re.finditer("near the [a-z-]+", text.text)]
    shows = [text.token_at(m.start()) for m in re.finditer("shows", text.text)]
    commas = [text.token_at(m.start()) for m in re.finditer(", (not|and)", text.text)]
    # The gray cube has one predicted region.
    assert [*text.comparisons()] == [
        (ends[2], shows[0]), (commas[0], shows[0]),
        (ends[4], ends[1]), (commas[1], ends[1]),
        (ends[5], ends[0]),
        (ends[6], ends[1]),
        (ends[7], shows[4]), (commas[2], shows[4]),
    ]  # fmt: skip


def test_compared_places_end_before_how_far_they_are_off(processor) -> None:
    text = TokenizedText(
        "Prediction: At the end, the red metal cube will be near the left. The gray metal cube "
        "will be near the top.\n"
        "Candidate analysis: Candidate A shows the red metal cube near the left, slightly off, but "
        "the gray metal cube near the center, clearly off, not near the top. Candidate B shows the "
        "red metal cube near the left, slightly off. Candidate C shows the red metal cube out of "
        "sight, not near the left.\n"
        "Outcome: The red metal cube and the gray metal cube are very close.",
        processor.tokenizer,
    )
    places = re.finditer("near the [a-z]+|out of sight", text.text)
    ends = [text.token_at(m.end() - 1) for m in places]
    commas = [text.token_at(m.start()) for m in re.finditer(", (slightly|clearly|not)", text.text)]
    off = [text.token_at(m.end() - 1) for m in re.finditer("off,?", text.text)]
    but = text.token_at(text.text.index("but "))
    shows = [text.token_at(m.start()) for m in re.finditer("shows", text.text)]
    assert [*text.comparisons()] == [
        (ends[2], ends[0]), (commas[0], ends[0]), (off[0], ends[0]),
        (ends[3], but), (commas[1], but), (off[1], but),
        (ends[5], ends[0]), (commas[3], ends[0]), (off[2], ends[0]),
        (ends[6], shows[2]), (commas[4], shows[2]),
    ]  # fmt: skip


def test_denied_places_and_closeness_are_not_compared(processor) -> None:
    text = TokenizedText(
        "Prediction: The red metal cube and the gray metal cube will be very close near the top. "
        "The blue metal cube will be between the red metal cube and the gray metal cube.\n"
        "Candidate analysis: Candidate A shows the blue metal cube not between the red metal cube "
        "and the gray metal cube.\n"
        "Outcome: The red metal cube and the gray metal cube are very close near the top.",
        processor.tokenizer,
    )
    assert [*text.comparisons()] == []


def test_a_place_between_two_objects_ends_after_both(processor) -> None:
    place = "between the blue metal cube and the green metal cube"
    text = TokenizedText(
        f"Prediction: At the end, the red metal cube will be {place}.\n"
        f"Candidate analysis: Candidate A shows the red metal cube {place}, and agrees. Candidate "
        f"B shows the red metal cube {place} and agrees with the prediction. Candidate C shows "
        f"the red metal cube left of the blue metal cube, not {place}.",
        processor.tokenizer,
    )
    ends = [text.token_at(m.end() - 1) for m in re.finditer(place, text.text)]
    left = text.token_at(text.text.index(", not") - 1)
    shows = [text.token_at(m.start()) for m in re.finditer("shows", text.text)]
    commas = [text.token_at(m.start()) for m in re.finditer(", and agrees|, not", text.text)]
    assert [*text.comparisons()] == [
        (ends[1], ends[0]), (commas[0], ends[0]),
        (ends[2], ends[0]),
        (left, shows[2]), (commas[1], shows[2]),
    ]  # fmt: skip


def test_owners_are_named_before_what_is_beside_them(processor) -> None:
    text = TokenizedText(
        "Prediction: At the end, the red metal cube will have the gray metal cube left of it. The "
        "gray metal cube will be near the top.\n"
        "Candidate analysis: Candidate A shows the red metal cube near the top and with the gray "
        "metal cube above it and with the blue rubber sphere near it, and agrees. Candidate B "
        "shows the red metal cube nearer to the gray metal cube than to the blue rubber sphere.",
        processor.tokenizer,
    )
    owners = [mention.owner for mention in text.mentions()]
    assert owners == [None, 0, None, None, 3, 3, None, None, None]
