"""Rewards: the narrator's responses earn all, and empty text earns no more than an answer alone."""

from __future__ import annotations

import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.data.records import LETTERS, SelectionItem
from dynapix.data.store import Store
from dynapix.models.student.prompts import answer_line, build_response
from dynapix.teacher.narrator import write_match_lines, write_rationale
from dynapix.teacher.predicates.facts import REGIONS, RelationalPredicates
from dynapix.teacher.predicates.vocabulary import describe_item
from dynapix.train.rewards import REWARDS, judge_response, reward_form, reward_truth

TEACHER = TeacherConfig(name="template", predicates="relational")


@pytest.fixture(scope="module")
def described(micro_store: Store) -> list[tuple[SelectionItem, RelationalPredicates]]:
    items = [(i, describe_item(i, micro_store, TEACHER)) for i in micro_store.selection("train")]
    return [(item, p) for item, p in items if p is not None][:20]


def narrate(item: SelectionItem, predicates: RelationalPredicates) -> str:
    lines = write_match_lines(predicates, item)
    return build_response(
        write_rationale(predicates, item, 0), lines, item.letter, "reasoning", "cot"
    )


def total(text: str, item: SelectionItem, predicates: RelationalPredicates) -> float:
    judged = judge_response(text, False, item, predicates)
    return sum(reward(judged) for reward in REWARDS.values())


def test_the_narrator_earns_every_reward(described) -> None:
    following = 0
    for item, p in described:
        judged = judge_response(narrate(item, p), False, item, p)
        earned = {name: reward(judged) for name, reward in REWARDS.items()}
        following += earned["following"]
        assert (earned["answer"], earned["no_numbers"], earned["form"]) == (1, 0, 0)
        assert earned["truth"] > 0.5
    # Nothing distinguishes the candidates of an undecided item.
    assert following > 0.8 * len(described)


HACKS = {
    "empty": "",
    "the question": "{question}\n",
    "the question in a section": "Scene parse: {question}\n",
    "the answer twice": "Answer: {letter}\n",
    "only the outcome": "Outcome: Only candidate {letter} agrees.\n",
    "negations": "Prediction: {negations}\nOutcome: Only candidate {letter} agrees.\n",
    "a list of what may be": "Prediction: {options}\nOutcome: Only candidate {letter} agrees.\n",
    "nothing to check": "Scene parse: Things are there.\nMotion analysis: They move.\nPrediction: "
    "The future comes.\nCandidate analysis: Candidate {letter} agrees.\nOutcome: Only candidate "
    "{letter} agrees.\n",
    "one sentence, repeated": "Scene parse: {sentences}\n",
    "a false sentence": "Prediction: The {other} will be near the left and near the right.\n",
}


@pytest.mark.parametrize("hack", HACKS)
def test_empty_text_earns_no_more_than_the_answer_alone(described, hack: str) -> None:
    regions = [region for row in REGIONS for region in row]
    for item, p in described:
        name = p.objects[0].object
        for letter in LETTERS:
            text = HACKS[hack].format(
                question=item.question, letter=letter, other=name,
                sentences=f"The {name} is near the top. " * 50,
                negations=" ".join(f"The {name} is not {region}." for region in regions),
                options=" ".join(f"The {name} frobs {region}." for region in regions),
            )  # fmt: skip
            alone = answer_line(letter)
            assert total(text + alone, item, p) <= total(alone, item, p)


def test_all_letters_earn_nothing(described) -> None:
    item, p = described[0]
    assert total(f"Answer: {', '.join(LETTERS)}", item, p) == 0


def test_further_mentions_earn_nothing(described) -> None:
    """A rationale with its sections' sentences twice earns no more for truth."""
    for item, p in described:
        lines = narrate(item, p).splitlines()
        twice = "\n".join(
            f"{line} {line.partition(': ')[2]}" if ": " in line and "Candidate " not in line[:10]
            else line for line in lines
        )  # fmt: skip
        once = judge_response(narrate(item, p), False, item, p)
        assert reward_truth(judge_response(twice, False, item, p)) <= reward_truth(once)


def test_broken_forms_are_punished(described) -> None:
    item, p = described[0]
    text = narrate(item, p)
    sections = text.splitlines()
    assert reward_form(judge_response(text, True, item, p)) == -1
    assert reward_form(judge_response("\n".join(reversed(sections)), False, item, p)) == -1
    assert reward_form(judge_response(f"{text}\n{text}", False, item, p)) == -1
    assert reward_form(judge_response(text, False, item, p)) == 0
