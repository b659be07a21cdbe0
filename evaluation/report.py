"""Gather what was trained and measured below checkpoints/ on one page, with one picture."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import write_text
from conf.schema import ReportCommand
from conf.sweep import AT_START

if TYPE_CHECKING:
    from evaluation.tables import RetrievalRow, SelectionRow

log = logging.getLogger(__name__)

Row = TypeVar("Row", "SelectionRow", "RetrievalRow")


@command("evaluation.report", ReportCommand)
def main(cfg: ReportCommand, run: Run) -> None:
    root = Path(cfg.checkpoints)
    selected, retrieved = _finished(root, "select"), _finished(root, "retrieve")
    nearest, studies = _finished(root, "similarity"), _finished(root, "export_study")
    if not selected and not nearest and not retrieved and not studies:
        raise UserError(
            f"nothing is measured below {root}: run python -m evaluation.select "
            "model=checkpoints/sft/RUN or python -m evaluation.retrieve "
            "model=checkpoints/contrastive/RUN first"
        )
    from evaluation.figures import retrieval_figure, selection_figure
    from evaluation.tables import (
        RetrievalRow,
        SelectionRow,
        cost_table,
        human_table,
        retrieval_table,
        selection_table,
    )

    trained = [f for kind in ("sft", "contrastive") for f in _finished(root, kind)]
    parts = [training_table(trained, root)] if trained else []
    pictures = [f / "curves.png" for f in trained]
    if selected:
        pictures.insert(0, selected[-1] / "item.png")
    # Measured on another benchmark is measured on other items: never in one table.
    choices = [r for f in [*selected, *nearest] for r in _rows(f, SelectionRow)]
    for benchmark in dict.fromkeys(r.benchmark for r in choices):
        of_it = [r for r in choices if r.benchmark == benchmark]
        # A released model's row stands in the reports of several that were trained from it.
        rows = [r for k, r in enumerate(of_it) if r not in of_it[:k]]
        parts.append(f"benchmark {benchmark}\n{selection_table(rows)}")
        pictures.insert(1, run.folder / f"selection-{benchmark.replace(', ', '-')}.png")
        selection_figure(rows, pictures[1])
    ranks = [r for f in retrieved for r in _rows(f, RetrievalRow) if r.builder is None]
    for benchmark in dict.fromkeys(r.benchmark for r in ranks):
        # The same untrained row stands in the reports of several trained ones.
        rows = list(dict.fromkeys(r for r in ranks if r.benchmark == benchmark))
        parts.append(f"benchmark {benchmark}\n{retrieval_table(rows)}\n\n{cost_table(rows)}")
        pictures.append(run.folder / f"retrieval-{benchmark}.png")
        retrieval_figure(rows, pictures[-1])
    for folder in studies:
        try:
            found = _report(folder)
            head = f"study {folder.name} on benchmark {found['benchmark']}"
            parts.append(f"{head}\n{human_table(found)}")
        except (KeyError, TypeError) as error:
            raise _unreadable(folder) from error
    if drawn := [p for p in pictures if p.exists()]:
        picture = run.folder / "report.png"
        compose_page(drawn, picture)
        parts.append(f"picture: {picture}")
    page = "\n\n".join(parts)
    log.info("%s", page)
    write_text(run.folder / "report.txt", page + "\n")


def _finished(root: Path, command_name: str) -> list[Path]:
    """The folders of a command's finished runs, a sweep's jobs among them, oldest first."""
    done = [*root.glob(f"{command_name}/*/metrics.json")]
    done += root.glob(f"{command_name}/*/*/metrics.json")
    return [p.parent for p in sorted(done, key=lambda p: p.stat().st_mtime)]


def _rows(folder: Path, row: type[Row]) -> list[Row]:
    try:
        return [row.from_dict(r) for r in _report(folder)["rows"]]
    except (KeyError, TypeError) as error:
        raise _unreadable(folder) from error


def _report(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / "report.json").read_text())
    except (OSError, ValueError) as error:
        raise _unreadable(folder) from error


def _unreadable(folder: Path) -> UserError:
    return UserError(
        f"{folder / 'report.json'} is missing, damaged or of another version: delete {folder} "
        "and measure again"
    )


def training_table(runs: list[Path], root: Path) -> str:
    """What each run measured on held-out training scenes, at its start and at its end."""
    lines = [f"{'Training (held-out scenes)':<44}{'start':>10}{'end':>10}"]
    lines.append("-" * 64)
    for folder in runs:
        metrics = json.loads((folder / "metrics.json").read_text())
        for name, value in metrics.items():
            start = metrics.get(f"{name}{AT_START}")
            if start is not None:
                label = f"{folder.relative_to(root)} {name.replace('_', ' ')}"
                lines.append(f"{label:<44}{start:>10.3f}{value:>10.3f}")
    return "\n".join(lines)


def compose_page(pictures: list[Path], path: Path) -> None:
    """Paste pictures into one page of two columns, each column's pictures as wide as it."""
    from PIL import Image

    images = [Image.open(p).convert("RGB") for p in pictures]
    width, gap = 1000, 30
    scaled = [i.resize((width, round(i.height * width / i.width))) for i in images]
    columns: list[list[Image.Image]] = [[], []]
    heights = [gap, gap]
    for image in scaled:
        shorter = heights.index(min(heights))
        columns[shorter].append(image)
        heights[shorter] += image.height + gap
    page = Image.new("RGB", (2 * width + 3 * gap, max(heights)), "white")
    for k, column in enumerate(columns):
        top = gap
        for image in column:
            page.paste(image, (gap + k * (width + gap), top))
            top += image.height + gap
    page.save(path)


if __name__ == "__main__":
    main()
