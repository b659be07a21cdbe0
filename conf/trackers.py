"""Check the experiment trackers that transformers' Trainer reports to."""

from __future__ import annotations

from collections.abc import Sequence

from dynapix.conf.errors import UserError


def check_trackers(report_to: Sequence[str]) -> None:
    """Check that the Trainer knows each tracker and that the tracker's package is installed.

    Call this after `restrict_to_one_gpu`, because it imports transformers if there is a tracker.

    Raises:
        UserError: A tracker is unknown or its package is not installed.
    """
    if not report_to:
        return
    from transformers.integrations import get_reporting_integration_callbacks

    for name in report_to:
        try:
            for callback in get_reporting_integration_callbacks([name]):
                callback()
        except (ImportError, RuntimeError, ValueError) as error:
            raise UserError(f"train.report_to={name}: {error}", code="unknown-tracker") from error
