"""Print an overview of DynaPix: `python -m dynapix`."""

from __future__ import annotations

import dynapix
from dynapix.benchmark import preset_names
from dynapix.conf.failures import report_failures

COMMANDS = {
    "data.build": "build a benchmark: scenes, items, queries, frames",
    "data.statistics": "report a benchmark's statistics and the accuracy of baselines",
    "data.gallery": "draw contact sheets of items and queries",
    "data.export": "write a Hugging Face dataset, or rows for other trainers",
    "teacher.narrate": "write rationales with the built-in narrator or a served model",
    "teacher.claims_benchmark": "write claims of students and of false texts, with verdicts",
    "teacher.serve": "serve a model with vLLM",
    "train.sft": "train a student",
    "train.distill": "train a student further on its own responses",
    "train.reinforce": "train a student further with rewards from the oracle",
    "train.contrastive": "train a retriever",
    "train.export": "export a trained model",
    "evaluation.select": "evaluate a student or a base on selection items",
    "evaluation.similarity": "evaluate a retriever on selection items",
    "evaluation.retrieve": "evaluate a retriever on retrieval queries",
    "evaluation.two_stage": "evaluate retrieval through a text that a model writes",
    "evaluation.study": "run the human study",
    "evaluation.study.export": "export the votes of the human study",
    "evaluation.report": "write one page with all tables, figures and items",
}
"""What each command does."""


def overview() -> str:
    """Return the text that `python -m dynapix` prints."""
    lines = [
        "DynaPix: can a vision-language model pick the exact future frame of a physical scene?",
        "",
        "In Python:",
        '  bench = dynapix.load("tiny")                         # or the folder of a benchmark',
        "  result = dynapix.evaluate(bench.selection, predict)  # a letter, a text or scores",
        '  print(result); result.save("runs/mine")',
        "",
        "Names: " + ", ".join(dynapix.__all__),
        "",
        "Commands (python -m COMMAND --help lists the settings):",
        *(f"  {name:<26}{purpose}" for name, purpose in COMMANDS.items()),
        "",
        "Benchmarks (benchmark=NAME): " + ", ".join(preset_names()),
        "Worlds (world=NAME): " + ", ".join(preset_names("world")),
        "",
        "make run trains and evaluates a tiny student and a tiny retriever. README.md has more.",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    with report_failures():
        print(overview())
