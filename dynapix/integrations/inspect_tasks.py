"""Selection items as a task of Inspect (`pip install 'dynapix[inspect]'`):

inspect eval dynapix/selection --model openai/gpt-5 -T benchmark=tiny -T image_size=336
"""

from __future__ import annotations

from inspect_ai import Task, task
from inspect_ai._util.error import PrerequisiteError
from inspect_ai.dataset import MemoryDataset, Sample
from inspect_ai.model import (
    ChatMessageUser,
    Content,
    ContentImage,
    ContentText,
    GenerateConfig,
)
from inspect_ai.scorer import (
    CORRECT,
    INCORRECT,
    Score,
    Scorer,
    Target,
    accuracy,
    grouped,
    scorer,
    stderr,
)
from inspect_ai.solver import TaskState, generate

from dynapix.benchmark import Item, load
from dynapix.conf.errors import UserError
from dynapix.integrations import TOKENS
from dynapix.models.student.answer_parser import parse_choice


@task
def selection(
    benchmark: str = "tiny",
    split: str = "test",
    mode: str = "reasoning",
    interventions: bool = False,
    store: str = "store",
    frames: int | None = None,
    image_size: int | None = None,
    max_tokens: int | None = None,
) -> Task:
    """Choose the future frame among four candidates.

    Args:
        benchmark: A preset or the folder of a built benchmark; see `dynapix.load`, also for
            `split`, `store`, `frames` and `image_size`.
        mode: `reasoning` asks for a rationale and the letter, `answer` for the letter alone.
        interventions: Whether to ask the pairs about what comes and what would have come.
        max_tokens: Maximum number of tokens of a response; None takes that of the mode.
    """
    # Many items show the same frame, whose text is kept once.
    texts: dict[str, str] = {}
    try:
        bench = load(benchmark, split, store=store, frames=frames, image_size=image_size)
        items = bench.interventions if interventions else bench.selection
        samples = [to_sample(item, mode, texts) for item in items]
    except UserError as error:
        # Inspect prints it without a traceback.
        raise PrerequisiteError(str(error)) from error
    return Task(
        dataset=MemoryDataset(samples, name=bench.name),
        solver=generate(),
        scorer=letter(),
        config=GenerateConfig(temperature=0.0, max_tokens=max_tokens or TOKENS[mode]),
        metadata={"benchmark": bench.name, "build": bench.store.identity},
    )


def to_sample(item: Item, mode: str, texts: dict[str, str]) -> Sample:
    """Return an item as a sample whose images and texts are in the order of `Item.messages`."""
    [message] = item.messages(mode)
    content: list[Content] = []
    for part in message["content"]:
        if part["type"] == "text":
            content.append(ContentText(text=part["text"]))
        else:
            url = part["image_url"]["url"]
            content.append(ContentImage(image=texts.setdefault(url, url)))
    return Sample(
        input=[ChatMessageUser(content=content)],
        target=item.answer,
        id=item.item_id,
        metadata={"scene_id": item.scene_id, "family": item.family, "subtype": item.subtype},
    )


@scorer(
    metrics=[
        # The mean over the families is the macro accuracy.
        grouped(accuracy(), "family", all="groups", all_label="macro"),
        accuracy(),
        stderr(cluster="scene_id"),
    ]
)
def letter() -> Scorer:
    """Score the letter that `dynapix.parse_choice` reads in a response."""

    async def score(state: TaskState, target: Target) -> Score:
        text = state.output.completion
        choice = parse_choice(text, truncated=state.output.stop_reason == "max_tokens")
        return Score(
            value=CORRECT if choice.letter == target.text else INCORRECT,
            answer=choice.letter,
            explanation=str(choice.reason or text),
        )

    return score
