"""Merge the adapters of a trained student into its base."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from transformers import ProcessorMixin

from dynapix.conf.errors import UserError
from dynapix.conf.schema import SftCommand
from dynapix.models import compat, loading
from dynapix.models.student.collator import Collator, letter_ids
from dynapix.teacher.narrate import JOURNAL_FILE, ensure_rationales
from dynapix.train.common.output_comparison import ModelOutputs, require_benchmark
from dynapix.train.student.dataset import load_datasets
from dynapix.train.student.lazy_samples import StudentDataset
from dynapix.train.student.metrics import LetterAccuracy

MAX_SAMPLES = 16
"""Number of validation samples per mode that are compared; at 8B, their logits take 3 GB."""

Items = dict[str, StudentDataset]
"""Validation samples by mode."""


@dataclass(frozen=True)
class StudentMerge:
    """Merges a student, and computes its outputs before and after: for each mode, the logits that
    predict supervised tokens and the chosen letters.

    Attributes:
        settings: The settings of the training run.
        saved: The folder of the trained adapters.
    """

    settings: SftCommand
    saved: Path
    max_difference = 0.05
    """Largest accepted relative difference. In the tiny student, rounding to bf16 causes 0.005;
    merging into the 4-bit weights would cause 0.2."""

    def held_out(self, root: Path, workers: int) -> Items:
        """Return the run's validation samples, from a benchmark and rationales that must exist."""
        settings = self.settings
        store = require_benchmark(settings.benchmark, root, workers)
        if settings.train.regime == "answer_only":
            return load_datasets(settings, store, [])[1]
        if not (journal := store.folder / JOURNAL_FILE).exists():
            raise UserError(
                f"{journal} is missing, and the export compares the merged with the trained model "
                "on its rationales: run python -m teacher.narrate, or set verify=false",
                code="missing-rationales",
            )
        return load_datasets(settings, store, ensure_rationales(store, settings.teacher))[1]

    def trained_outputs(self, items: Items) -> ModelOutputs:
        """Return the outputs of the trained student, the adapters over their base."""
        precision = self.settings.train.precision
        options = self.settings.student, precision, self.saved
        model, processor = loading.load_trained(*options, merge=False)
        # Prevent a CPU from repacking 4-bit weights for inference, which changes the rounding.
        compat.keep_differentiable(model)
        return self._outputs(model, processor, items, precision == "bf16")

    def write(self, folder: Path, format: str) -> None:
        """Write the merged model with weights in `format`, bf16 or fp32."""
        student = self.settings.student
        base, processor = loading.load_base(student, self.settings.train.precision, list)
        model = loading.merge_adapters(base, self.saved, student.quantization, format)
        loading.write_model(model, processor, folder)

    def merged_outputs(self, folder: Path, items: Items) -> ModelOutputs:
        """Return the outputs of the merged student in a folder."""
        return self._outputs(
            *loading.load_merged(folder, self.settings.student.max_length), items, False
        )

    @torch.inference_mode()
    def _outputs(
        self, model: torch.nn.Module, processor: ProcessorMixin, items: Items, autocast: bool
    ) -> ModelOutputs:
        letters = LetterAccuracy(letter_ids(processor))
        collator = Collator(processor, self.settings.student.max_length)
        device = next(model.parameters()).device
        outputs = ModelOutputs({})
        for mode, samples in items.items():
            logits = outputs.values.setdefault(f"{mode}_logit", [])
            for k in range(min(MAX_SAMPLES, len(samples))):
                batch = {name: value.to(device) for name, value in collator([samples[k]]).items()}
                labels = batch.pop("labels")
                with torch.autocast(device.type, torch.bfloat16, enabled=autocast):
                    predicted = model(**batch).logits.float()
                logits.append(predicted[0, :-1].cpu())
                choices = outputs.choices.setdefault(f"{mode}_letter", [])
                choices.append(int(letters.reduce(predicted, labels)[0, 0]))
        return outputs
