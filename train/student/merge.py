"""Merges a student into its base."""

from __future__ import annotations

from pathlib import Path

import torch
from transformers import ProcessorMixin

from conf.errors import UserError
from conf.schema import SftCommand
from data.build import ensure_benchmark
from models import compat, loading
from models.student.collator import Collator, letter_ids
from teacher.narrate import JOURNAL_FILE, ensure_rationales
from train.common.merge import ModelOutputs, check_benchmark
from train.student.lazy_samples import StudentDataset
from train.student.metrics import LetterAccuracy
from train.student.run import load_datasets

MAX_SAMPLES = 16
"""Held-out samples of each mode that are compared: at 8B, their logits take 3 GB."""

Items = dict[str, StudentDataset]


class StudentMerge:
    """Compares the logits where a supervised token is predicted, and the letters chosen, by mode.

    At most `MAX_SAMPLES` of the samples that measured the run in each mode are compared.
    """

    product = "student"
    max_difference = 0.05
    """On the tiny student, rounding to bf16 moves logits by 0.005 of their size, and merging into
    the 4-bit weights by 0.2."""

    def __init__(self, settings: SftCommand, saved: Path) -> None:
        self._settings, self._saved = settings, saved
        self._student, self._precision = settings.student, settings.train.precision

    def held_out(self, store: Path, workers: int) -> Items:
        settings = self._settings
        check_benchmark(store / settings.benchmark.name)
        opened = ensure_benchmark(settings.benchmark, store, workers)
        reasons = settings.train.regime not in ("answer_only", "describe")
        if reasons and not (opened.folder / JOURNAL_FILE).exists():
            raise UserError(
                f"{opened.folder / JOURNAL_FILE} is missing, and the export compares the merged "
                "weights with the trained ones on its rationales: run python -m teacher.narrate, "
                "or set verify=false",
                code="missing-rationales",
            )
        rationales = ensure_rationales(opened, settings.teacher) if reasons else []
        return load_datasets(settings, opened, rationales)[1]

    def trained_outputs(self, items: Items) -> ModelOutputs:
        model, processor = loading.load_trained(self._student, self._precision, self._saved)
        # Some CPUs round 4-bit products differently once the weights are packed for inference.
        compat.keep_differentiable(model)
        return self._outputs(model, processor, items, self._precision == "bf16")

    def write(self, folder: Path, format: str) -> None:
        base, processor = loading.load_base(self._student, self._precision, list)
        model = loading.merge_adapters(base, self._saved, self._student.quantization, format)
        loading.write_model(model, processor, folder)

    def merged_outputs(self, folder: Path, items: Items) -> ModelOutputs:
        model, processor = loading.load_merged(folder)
        return self._outputs(model, processor, items, bf16=False)

    def _outputs(
        self, model: torch.nn.Module, processor: ProcessorMixin, items: Items, bf16: bool
    ) -> ModelOutputs:
        """`bf16`: whether passes are autocast; otherwise they compute as the weights are."""
        describes = self._settings.train.regime == "describe"
        letters = None if describes else LetterAccuracy(letter_ids(processor))
        collator = Collator(processor, self._student.max_length)
        device = next(model.parameters()).device
        outputs = ModelOutputs({})
        for mode, samples in items.items():
            logits = outputs.values.setdefault(f"{mode}_logit", [])
            for k in range(min(MAX_SAMPLES, len(samples))):
                batch = {name: value.to(device) for name, value in collator([samples[k]]).items()}
                labels = batch.pop("labels")
                autocast = torch.autocast(device.type, torch.bfloat16, enabled=bf16)
                with torch.inference_mode(), autocast:
                    predicted = model(**batch).logits.float()
                logits.append(predicted[0, :-1].cpu())
                if letters:
                    choices = outputs.choices.setdefault(f"{mode}_letter", [])
                    choices.append(int(letters.reduce(predicted, labels)[0, 0]))
        return outputs
